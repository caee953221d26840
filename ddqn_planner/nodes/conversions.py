"""Conversions between ROS messages and grid maps, paths, and bytes.

Messages are checked as Nav2 does (nav2_util).
"""

import array
import hashlib
import math
import pickle
from typing import Any, NamedTuple

import numpy as np
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from nav_msgs.msg import MapMetaData, OccupancyGrid, Path
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from std_msgs.msg import Header, MultiArrayDimension, MultiArrayLayout, UInt8MultiArray

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.grid.arguments import Cells
from ddqn_planner.grid.grid_map import METRES_PER_CELL, RESOLUTIONS
from ddqn_planner.grid.inflation import grid_from_costmap
from ddqn_planner.grid.map_file import MAX_CELLS
from ddqn_planner.grid.rotations import Rotation
from ddqn_planner.planning.exact_paths import dense

Origin = tuple[float, float, float]
Float64 = NDArray[np.float64]

# `Rotation.tilt` of a turn by one degree; quaternions of two decimals tilt less.
MAX_TILT = math.sin(math.radians(1) / 2)
NORM_TOLERANCE = 1e-6  # a norm that differs less from 1 is left as it is
# Of bytes in a message: "model" or "experience", the version of that, and the digest.
LABEL = "ddqn_planner {} 1 sha256:{}"
CHANGES = "changes"  # the kind of messages with changes of experience
ENCODING_BYTES = 4  # at the start of a serialised message


def _blank_poses() -> bytes:
    """Return 64 pickled poses that share a header and an orientation."""
    header = Header()
    orientation = Quaternion()
    return pickle.dumps(
        [
            PoseStamped(header=header, pose=Pose(orientation=orientation))
            for _ in range(64)
        ]
    )


BLANK_POSES = _blank_poses()


class MapRules(NamedTuple):
    """How a node reads the values of a map: its parameters of these names."""

    occupied_threshold: int = 65
    allow_unknown: bool = False
    use_map_costs: bool = False
    map_type: str = "map"  # or "costmap"


DEFAULT_RULES = MapRules()


def grid_from_message(
    message: OccupancyGrid, rules: MapRules = DEFAULT_RULES
) -> GridMap:
    """Make a grid map of a map message; the rules say how to read its values.

    Raises
    ------
    ValueError
        If the message is no complete map in a named frame; with the remedy.
    """
    _check_map(message)
    pose = message.info.origin
    origin = (pose.position.x, pose.position.y, rotation(pose.orientation).yaw)
    resolution = message.info.resolution
    try:
        return grid_from_values(occupancy_values(message), resolution, origin, rules)
    except MemoryError:
        raise ValueError("no memory is left for the map; give a smaller one") from None


def _check_map(message: OccupancyGrid) -> None:
    """Raise a ValueError with the remedy if a message is no complete map in a frame."""
    if not message.header.frame_id:
        raise ValueError("the map's frame is ''; name one in header.frame_id")
    resolution = message.info.resolution
    finest, coarsest = RESOLUTIONS
    if not finest <= resolution <= coarsest:
        wrong = f"the map's resolution is {resolution}"
        raise ValueError(f"{wrong}; give {METRES_PER_CELL}")
    width = message.info.width
    height = message.info.height
    number_of_cells = width * height
    size = f"{width} x {height} cells"
    if number_of_cells == 0:
        wrong = f"the map's size is {size}"
        raise ValueError(f"{wrong}; give at least one row and column")
    if number_of_cells > MAX_CELLS:
        remedy = f"give at most {MAX_CELLS}, or a coarser resolution"
        raise ValueError(f"the map's size is {size}; {remedy}")
    if len(message.data) != number_of_cells:
        wrong = f"the map's data has {len(message.data)} values"
        raise ValueError(f"{wrong}; its {size} need {number_of_cells}")
    origin = message.info.origin
    _check_pose("the map's origin", origin)
    if rotation(origin.orientation).tilt > MAX_TILT:
        wrong = (
            f"the map's origin is rolled or pitched ({_numbers(origin.orientation)})"
        )
        raise ValueError(f"{wrong}; give a yaw")


def occupancy_values(message: OccupancyGrid) -> NDArray[np.int8]:
    """Return a view of the values of a map message, (H, W) int8."""
    values = np.frombuffer(message.data, np.int8)
    return values.reshape(message.info.height, message.info.width)


def grid_from_values(
    values: NDArray[np.int8], resolution: float, origin: Origin, rules: MapRules
) -> GridMap:
    """Make a grid map of the values of a map message.

    `values` are (H, W) int8, the resolution is in metres per cell, and the origin is
    the pose of the corner of the first cell: x and y in metres, yaw in radians. `rules`
    say what the values mean.
    """
    if rules.map_type == "costmap":
        return grid_from_costmap(values, resolution, origin, rules.allow_unknown)
    return GridMap.from_occupancy_values(
        values,
        resolution,
        origin,
        occupied_threshold=rules.occupied_threshold,
        allow_unknown=rules.allow_unknown,
        use_map_costs=rules.use_map_costs,
    )


def occupancy_message(
    values: NDArray[Any] | None, resolution: float, origin: Origin, header: Header
) -> OccupancyGrid:
    """Make a map message.

    Parameters
    ----------
    values : (H, W) integers, or None
        A map's values, or its forbidden directions (see `GridMap`); None for a message
        without cells.
    resolution
        Metres per cell.
    origin
        The pose of the corner of the first cell: metres, and radians.
    header
        The header of the message.
    """
    if values is None:
        return OccupancyGrid(header=header)
    height, width = values.shape
    x, y, yaw = origin
    corner = Point(x=float(x), y=float(y))
    info = MapMetaData(map_load_time=header.stamp, resolution=float(resolution))
    info.origin = Pose(position=corner, orientation=quaternion(float(yaw)))
    info.width = width
    info.height = height
    data = array.array("b", values.astype(np.int8, copy=False).tobytes())
    return OccupancyGrid(header=header, info=info, data=data)


def path_message(
    points: Float64, yaws: Float64, header: Header, last: Quaternion | None = None
) -> Path:
    """Make the message of a path.

    Parameters
    ----------
    points : (N, 2) float64
        x and y of each pose, metres.
    yaws : (N,) float64, or (N - 1,) with `last`
        The heading of each pose, radians.
    header
        The header of the path and of each pose.
    last
        The orientation of the last pose, if `yaws` has none.
    """
    path = Path(header=header)
    # Making messages takes most of the time of an answer. So poses are copies of blank
    # ones, which take a quarter of the time of the messages' constructors, and poses
    # with the same heading share a quaternion.
    poses: list[PoseStamped] = []
    while len(poses) < len(points):
        poses += pickle.loads(BLANK_POSES)
    del poses[len(points) :]
    yaw_of_poses: list[float] = yaws.tolist()
    quaternion_of_yaw = {yaw: quaternion(yaw) for yaw in set(yaw_of_poses)}
    orientations = [quaternion_of_yaw[yaw] for yaw in yaw_of_poses]
    if last is not None:
        orientations.append(last)
    positions: list[list[float]] = points.tolist()
    for stamped, (x, y), orientation in zip(
        poses, positions, orientations, strict=False
    ):
        stamped.header = header
        stamped.pose.orientation = orientation
        stamped.pose.position.x = x
        stamped.pose.position.y = y
    path.poses = poses
    return path


def along(points: Float64, spacing: float = math.inf) -> tuple[Float64, Float64]:
    """Return points on a path of straight pieces, and the headings between them.

    Parameters
    ----------
    points : (N, 2) float64
        The corners of the path, metres.
    spacing
        The greatest distance from a point to the next, metres; if infinite, the points
        are the corners.

    Returns
    -------
    (M, 2) float64 and (M - 1,) float64
        The points, with all corners among them, and the heading from each point to the
        next, radians.
    """
    steps: NDArray[np.float64] = np.diff(points, axis=0)  # of the N - 1 straight pieces
    yaw_of_pieces = np.arctan2(steps[:, 1], steps[:, 0])  # (N - 1,)
    if len(points) < 2 or math.isinf(spacing):
        return points, yaw_of_pieces
    dense_points, piece_of_points = dense(points, spacing)
    return dense_points, yaw_of_pieces[piece_of_points]


def centres(cells: Cells, grid: GridMap) -> Float64:
    """Return the centres of cells (x, y) of a map in metres, (N, 2)."""
    return grid.centres(np.asarray(cells, dtype=np.float64).reshape(-1, 2))


def frame_of(path: Path) -> str:
    """Return the frame of a path, or of its first pose where the path names none."""
    frame = path.header.frame_id or (
        path.poses[0].header.frame_id if path.poses else ""
    )
    return str(frame)


def poses_of(path: Path, with_yaw: bool = True) -> Float64:
    """Return the N poses of a path message, (N, 3): x, y in metres, yaw in radians.

    Without `with_yaw`, the yaw is 0. A ValueError says which pose is not finite, or
    that the path has no pose.
    """
    messages: list[Pose] = [stamped.pose for stamped in path.poses]
    if not messages:
        raise ValueError("the path has no pose; give one or more")
    poses = np.zeros((len(messages), 3))
    poses[:, :2] = [(pose.position.x, pose.position.y) for pose in messages]
    if with_yaw:
        poses[:, 2] = [rotation(pose.orientation).yaw for pose in messages]
    is_finite = np.isfinite(poses).all(axis=1)  # (N,)
    if not is_finite.all():
        number = int(is_finite.argmin())
        wrong = f"pose {number} of the path is {poses[number]}"
        raise ValueError(f"{wrong}; give finite numbers")
    return poses


def in_outer_frame(poses: Float64, origin: Origin) -> Float64:
    """Return poses of one frame as poses of another one.

    Parameters
    ----------
    poses : (N, 3) float64
        x and y in metres, yaw in radians.
    origin
        The pose (x, y, yaw) of the frame of the poses in the other frame.
    """
    x = poses[:, 0]
    y = poses[:, 1]
    yaw = poses[:, 2]
    origin_x, origin_y, origin_yaw = origin
    cos = math.cos(origin_yaw)
    sin = math.sin(origin_yaw)
    outer_x = origin_x + cos * x - sin * y
    outer_y = origin_y + sin * x + cos * y
    return np.column_stack([outer_x, outer_y, yaw + origin_yaw])


def path_bytes(
    positions: Float64, yaw: Float64, header: Header, last: Quaternion | None = None
) -> bytes:
    """Return the serialized message of a path, as middleware sends it.

    Parameters
    ----------
    positions : (N, 2) float64
        Metres.
    yaw : (N,) float64, or (N - 1,) with `last`
        Radians.
    header
        The header of the path and of each pose.
    last
        The orientation of the last pose, if `yaw` has none.

    Returns
    -------
    The message in OMG DDS-XTypes' plain CDR, little-endian.
    """
    count = len(positions)  # N
    # The header without the four bytes that name the encoding.
    pose_header = serialize_message(header)[ENCODING_BYTES:]
    # A path without poses ends with the number of its poses, 0, in four bytes.
    empty_path = serialize_message(Path(header=header))
    start = empty_path[:-4] + count.to_bytes(4, "little")
    if count == 0:
        return start
    # The seven numbers of a pose are aligned to 8 bytes, counted from the end of the
    # encoding on. They end at a multiple of 8 bytes, where the next pose begins: so all
    # poses but the first have the same bytes before their numbers.
    first_pose_header = _padded(pose_header, offset=len(start) - ENCODING_BYTES)
    next_pose_header = _padded(pose_header, offset=0)
    header_type = f"V{len(next_pose_header)}"  # NumPy's type of that many bytes
    poses = np.zeros(count, dtype=[("header", header_type), ("numbers", "<f8", 7)])
    poses["header"] = np.void(next_pose_header)
    numbers = poses["numbers"]  # (N, 7): x, y, z, and a quaternion x, y, z, w
    numbers[:, :2] = positions
    numbers[: len(yaw), 5] = np.sin(yaw / 2)
    numbers[: len(yaw), 6] = np.cos(yaw / 2)
    if last is not None:
        numbers[-1, 3:] = (last.x, last.y, last.z, last.w)
    content = poses.tobytes()
    # The first pose has its own header.
    return start + first_pose_header + content[len(next_pose_header) :]


def _padded(content: bytes, offset: int) -> bytes:
    """Return bytes with zeros appended, so that they end at a multiple of 8 bytes.

    `offset` is the position of the first byte.
    """
    end = offset + len(content)
    return content + bytes(-end % 8)


def bytes_message(kind: str, data: bytes) -> UInt8MultiArray:
    """Make the message that carries the bytes `data` of a file.

    `kind` is "model", "experience" or CHANGES: the label of the message has the kind, a
    version and a digest of the bytes.
    """
    label = LABEL.format(kind, hashlib.sha256(data).hexdigest())
    dimension = MultiArrayDimension(label=label, size=len(data), stride=len(data))
    return UInt8MultiArray(
        layout=MultiArrayLayout(dim=[dimension]), data=array.array("B", data)
    )


def bytes_of(kind: str, message: UInt8MultiArray) -> bytes:
    """Return the bytes that a message of `bytes_message` carries.

    A ValueError if they are damaged, or not of this kind (see `bytes_message`) and of
    the present version.
    """
    data = bytes(message.data)
    label = _label_of(message)
    expected_label = LABEL.format(kind, hashlib.sha256(data).hexdigest())
    if label == expected_label:
        return data
    wrong = f"{len(data)} bytes with the label {label!r}, not {expected_label!r}"
    kind_and_version = label.partition(":")[0]
    if kind_and_version == expected_label.partition(":")[0]:  # the bytes are damaged
        remedy = "save there again"
    else:
        remedy = "let trainer and planner have one version"
    raise ValueError(f"the message has {wrong}; {remedy}")


def has_changes(message: UInt8MultiArray) -> bool:
    """Return whether a message tells of changes of experience, by its label."""
    before_version, _, _ = LABEL.format(CHANGES, "").rpartition(" 1 ")
    return _label_of(message).startswith(f"{before_version} ")


def _label_of(message: UInt8MultiArray) -> str:
    """Return the label of a message of `bytes_message`; empty without a label."""
    return message.layout.dim[0].label if message.layout.dim else ""


def check_pose(
    name: str, stamped: PoseStamped, frame: str = "", other_remedy: str = ""
) -> None:
    """Raise a ValueError unless a message is a pose in a frame.

    Parameters
    ----------
    name
        The name of the pose in errors, such as "the goal".
    stamped
        The pose.
    frame
        The map's frame, in which the pose must be; empty for any frame with a name.
    other_remedy
        What else to do about another frame, in words.

    Raises
    ------
    ValueError
        If a number is not finite, the orientation is no rotation, or the frame is
        wrong.
    """
    pose_frame = stamped.header.frame_id
    if pose_frame and frame in ("", pose_frame):
        return _check_pose(name, stamped.pose)
    remedy = "name one in header.frame_id"
    if pose_frame:
        transform = "transform the pose to that frame (in RViz: set Fixed Frame to it)"
        remedy = f"{transform}{other_remedy}"
    map_frame = f", the map's is {frame!r}" if frame else ""
    raise ValueError(f"{name}'s frame is {pose_frame!r}{map_frame}; {remedy}")


def cell_from_pose(name: str, stamped: PoseStamped, grid: GridMap, frame: str) -> Cell:
    """Return the cell (x, y) of a pose on the map `grid`; it may be off the map.

    `frame` is the frame of the map, in which the pose must be, and `name` is what
    errors call the pose. A ValueError if it is no such pose, see `check_pose`, or too
    far away to have a cell.
    """
    check_pose(name, stamped, frame)
    position = stamped.pose.position
    try:
        return grid.world_to_cell(position.x, position.y)
    except (OverflowError, ValueError):  # the floor of infinity, and of NaN
        wrong = f"{name}'s position ({_numbers(position)}) is too far from the map"
        remedy = "give one on the map, in metres"
        raise ValueError(f"{wrong} to have a cell; {remedy}") from None


def pose_of(stamped: PoseStamped) -> Origin:
    """Return x, y (metres) and yaw (radians) of a pose."""
    position = stamped.pose.position
    return position.x, position.y, rotation(stamped.pose.orientation).yaw


def rotation(message: Quaternion) -> Rotation:
    """Return the rotation of a message."""
    return Rotation(message.x, message.y, message.z, message.w)


def with_unit_quaternion(stamped: PoseStamped) -> PoseStamped:
    """Return a pose with a quaternion scaled to the norm 1; the same object if it is 1.

    `check_pose` accepts rounded quaternions; Nav2 refuses them in a path.
    """
    pose = stamped.pose
    orientation = unit_quaternion(pose.orientation)
    if orientation is pose.orientation:
        return stamped
    pose = Pose(position=pose.position, orientation=orientation)
    return PoseStamped(header=stamped.header, pose=pose)


def unit_quaternion(message: Quaternion) -> Quaternion:
    """Return a quaternion scaled to the norm 1; the same object if the norm is 1."""
    rounded = rotation(message)
    if abs(rounded.norm - 1) <= NORM_TOLERANCE:
        return message
    x, y, z, w = rounded.normalised()
    return Quaternion(x=x, y=y, z=z, w=w)


def quaternion(yaw: float) -> Quaternion:
    """Return the rotation by `yaw` radians about z, counter-clockwise."""
    turned = Quaternion()
    turned.z = math.sin(yaw / 2)
    turned.w = math.cos(yaw / 2)
    return turned


def _check_pose(name: str, pose: Pose) -> None:
    """Raise a ValueError if a pose has a number that is not finite, or no rotation.

    `name` is the pose's name in errors, such as "the goal".
    """
    position = pose.position
    coordinates = (position.x, position.y, position.z)
    if not all(map(math.isfinite, coordinates)):
        wrong = f"{name}'s position is ({_numbers(position)})"
        raise ValueError(f"{wrong}; give finite numbers")
    turned = rotation(pose.orientation)
    if not turned.is_rounded:
        orientation = f"{name}'s orientation is ({_numbers(pose.orientation)})"
        wrong = f"{orientation}, a quaternion of norm {turned.norm:.6g}"
        remedy = "give one of norm 1 (w = 1 and the rest 0 means no rotation)"
        raise ValueError(f"{wrong}; {remedy}")


def _numbers(message: Point | Quaternion) -> str:
    """Return the fields of a message in words, such as "x = 1, y = 2, z = 0"."""
    names = message.get_fields_and_field_types()
    return ", ".join(f"{name} = {getattr(message, name):.6g}" for name in names)
