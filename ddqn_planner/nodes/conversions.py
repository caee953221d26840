"""Conversions between ROS messages, checked as Nav2 does (nav2_util), and grid maps and paths."""

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

MAX_TILT = math.sin(
    math.radians(1) / 2
)  # of one degree: two decimals of a quaternion tilt less
AS_SENT = 1e-6  # a norm so near to 1 is left as it is
LABEL = (
    "ddqn_planner {} 1 sha256:{}"  # of bytes: their kind, its version and their digest
)
BLANK_POSES = pickle.dumps(
    [
        PoseStamped(header=header, pose=Pose(orientation=rotation))
        for header, rotation in [(Header(), Quaternion())]
        for _ in range(64)
    ]
)


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
    """Make a grid map of a map message.

    Raises
    ------
    ValueError
        If the message is no complete map in a named frame; with the remedy.
    """
    _check_map(message)
    pose: Pose = message.info.origin
    origin = (pose.position.x, pose.position.y, rotation(pose.orientation).yaw)
    resolution: float = message.info.resolution
    try:
        return grid_from_values(occupancy_values(message), resolution, origin, rules)
    except MemoryError:
        raise ValueError("no memory is left for the map; give a smaller one") from None


def _check_map(message: OccupancyGrid) -> None:
    if not message.header.frame_id:
        raise ValueError("the map's frame is ''; name one in header.frame_id")
    resolution: float = message.info.resolution
    finest, coarsest = RESOLUTIONS
    if not finest <= resolution <= coarsest:
        wrong = f"the map's resolution is {resolution}"
        raise ValueError(f"{wrong}; give {METRES_PER_CELL}")
    width: int = message.info.width
    height: int = message.info.height
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
    origin: Pose = message.info.origin
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
    """Make a grid map of values as they are in a map message, (H, W) int8."""
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
    """Make a message of a map's values or forbidden directions, see `GridMap`; empty of none."""
    if values is None:
        return OccupancyGrid(header=header)
    (height, width), (x, y, yaw) = values.shape, map(float, origin)
    corner = Pose(position=Point(x=x, y=y), orientation=quaternion(yaw))
    info = MapMetaData(
        map_load_time=header.stamp, resolution=float(resolution), origin=corner
    )
    info.width, info.height = width, height
    data = array.array("b", values.astype(np.int8, copy=False).tobytes())
    return OccupancyGrid(header=header, info=info, data=data)


def path_message(
    points: Float64, yaws: Float64, header: Header, last: Quaternion | None = None
) -> Path:
    """Make a path message of points and directions, see `path_bytes`."""
    path = Path(header=header)
    # Most of an answer's time is making messages. Poses in the same direction share a quaternion,
    # and all are copies, which take a quarter of the time of the messages' constructors.
    poses: list[PoseStamped] = []
    while len(poses) < len(points):
        poses += pickle.loads(BLANK_POSES)
    del poses[len(points) :]
    towards = {yaw: quaternion(yaw) for yaw in {*yaws.tolist()}}
    orientations = [*map(towards.get, yaws.tolist()), last]
    places = points.tolist()
    for stamped, (x, y), orientation in zip(poses, places, orientations, strict=False):
        stamped.header = header
        stamped.pose.orientation = orientation
        stamped.pose.position.x = x
        stamped.pose.position.y = y
    path.poses = poses
    return path


def along(points: Float64, spacing: float = math.inf) -> tuple[Float64, Float64]:
    """Return points on a path (N, 2), at most a spacing apart, and headings (N - 1)."""
    x, y = np.diff(points, axis=0).T
    yaws = np.arctan2(y, x)
    if len(yaws) and math.isfinite(spacing):
        points, piece = dense(points, spacing)
        yaws = yaws[piece]
    return points, yaws


def centres(cells: Cells, grid: GridMap) -> Float64:
    """Return the centres of cells in metres, (N, 2)."""
    return grid.centres(np.asarray(cells, dtype=np.float64).reshape(-1, 2))


def frame_of(path: Path) -> str:
    """Return the frame of a path, or of its first pose where the path names none."""
    frame = path.header.frame_id or (
        path.poses[0].header.frame_id if path.poses else ""
    )
    return str(frame)


def poses_of(path: Path, with_yaw: bool = True) -> Float64:
    """Return the poses of a path, (N, 3), with the yaw 0 if it does not count; or a ValueError."""
    if not path.poses:
        raise ValueError("the path has no pose; give one or more")
    poses = [stamped.pose for stamped in path.poses]
    array = np.zeros((len(poses), 3))
    array[:, :2] = [(pose.position.x, pose.position.y) for pose in poses]
    if with_yaw:
        array[:, 2] = [rotation(pose.orientation).yaw for pose in poses]
    is_finite = np.isfinite(array).all(axis=1)
    if not is_finite.all():
        number = int(is_finite.argmin())
        raise ValueError(
            f"pose {number} of the path is {array[number]}; give finite numbers"
        )
    return array


def moved(poses: Float64, origin: Origin) -> Float64:
    """Return poses (N, 3) of a frame in the one where the frame's origin is given."""
    x, y, yaw = poses.T
    cos, sin = math.cos(origin[2]), math.sin(origin[2])
    points = origin[0] + cos * x - sin * y, origin[1] + sin * x + cos * y
    return np.column_stack([*points, yaw + origin[2]])


def path_bytes(
    positions: Float64, yaw: Float64, header: Header, last: Quaternion | None = None
) -> bytes:
    """Return a path as it is sent: positions (N, 2), and directions (N), or (N - 1) and a last."""
    # OMG DDS-XTypes, plain CDR, little-endian: numbers are aligned to their size, so that each pose
    # has the same bytes before its seven numbers, except for the first one.
    count, stamp = len(positions), serialize_message(header)[4:]
    start = serialize_message(Path(header=header))[:-4] + count.to_bytes(4, "little")
    if not count:
        return start
    first, others = (
        stamp + bytes(-(at + len(stamp)) % 8) for at in (len(start) - 4, 0)
    )
    poses = np.zeros(
        count, dtype=[("header", f"V{len(others)}"), ("numbers", "<f8", 7)]
    )
    poses["header"], numbers = np.void(others), poses["numbers"]
    numbers[:, :2] = positions
    numbers[: len(yaw), 5], numbers[: len(yaw), 6] = np.sin(yaw / 2), np.cos(yaw / 2)
    if last is not None:
        numbers[-1, 3:] = last.x, last.y, last.z, last.w
    return start + first + poses.tobytes()[len(others) :]


def bytes_message(kind: str, data: bytes) -> UInt8MultiArray:
    """Make the message that carries bytes of a kind, a model or an experience."""
    label = LABEL.format(kind, hashlib.sha256(data).hexdigest())
    dimension = MultiArrayDimension(label=label, size=len(data), stride=len(data))
    return UInt8MultiArray(
        layout=MultiArrayLayout(dim=[dimension]), data=array.array("B", data)
    )


def bytes_of(kind: str, message: UInt8MultiArray) -> bytes:
    """Return the bytes of a kind that a message carries; a ValueError if it has others."""
    data = bytes(message.data)
    label = message.layout.dim[0].label if message.layout.dim else ""
    if label != (right := LABEL.format(kind, hashlib.sha256(data).hexdigest())):
        wrong = f"{len(data)} bytes with the label {label!r}, not {right!r}"
        is_cut = label.partition(":")[0] == right.partition(":")[0]
        remedy = (
            "save there again" if is_cut else "let trainer and planner have one version"
        )
        raise ValueError(f"the trainer sent {wrong}; {remedy}")
    return data


def check_pose(
    name: str, stamped: PoseStamped, frame: str = "", other_remedy: str = ""
) -> None:
    """Check a pose, which the ValueError calls by its name, and that it is in the map's frame."""
    its = stamped.header.frame_id
    if its and frame in ("", its):
        return _check_pose(name, stamped.pose)
    known = f", the map's is {frame!r}" if frame else ""
    remedy = "name one in header.frame_id"
    if its:
        remedy = f"transform the pose to that frame (in RViz: set Fixed Frame to it){other_remedy}"
    raise ValueError(f"{name}'s frame is {its!r}{known}; {remedy}")


def cell_from_pose(name: str, stamped: PoseStamped, grid: GridMap, frame: str) -> Cell:
    """Return the cell of a pose, which may lie outside the map; see `check_pose` for errors."""
    check_pose(name, stamped, frame)
    position = stamped.pose.position
    try:
        return grid.world_to_cell(position.x, position.y)
    except (OverflowError, ValueError):  # the floor of infinity, and of NaN
        where = f"({_numbers(position)}) is too far from the map to have a cell"
        raise ValueError(
            f"{name}'s position {where}; give one on the map, in metres"
        ) from None


def pose_of(stamped: PoseStamped) -> Origin:
    """Return x, y and yaw of a pose, about z alone."""
    position = stamped.pose.position
    return position.x, position.y, rotation(stamped.pose.orientation).yaw


def rotation(message: Quaternion) -> Rotation:
    """Return the numbers of a message."""
    return Rotation(message.x, message.y, message.z, message.w)


def with_unit_quaternion(stamped: PoseStamped) -> PoseStamped:
    """Return a pose that `check_pose` accepts, or a copy of it whose quaternion has the norm 1.

    Whoever reads a path may refuse others, as Nav2 does.
    """
    sent = stamped.pose.orientation
    unit = unit_quaternion(sent)
    if unit is sent:
        return stamped
    pose = Pose(position=stamped.pose.position, orientation=unit)
    return PoseStamped(header=stamped.header, pose=pose)


def unit_quaternion(message: Quaternion) -> Quaternion:
    """Return a quaternion with the norm 1: itself if it has that already."""
    sent = rotation(message)
    if abs(sent.norm - 1) <= AS_SENT:
        return message
    x, y, z, w = sent.normalised()
    return Quaternion(x=x, y=y, z=z, w=w)


def quaternion(yaw: float) -> Quaternion:
    """Return the rotation by `yaw` radians about z, counter-clockwise."""
    turned = Quaternion()
    turned.z, turned.w = math.sin(yaw / 2), math.cos(yaw / 2)
    return turned


def _check_pose(name: str, pose: Pose) -> None:
    position = pose.position
    if not all(map(math.isfinite, (position.x, position.y, position.z))):
        raise ValueError(
            f"{name}'s position is ({_numbers(position)}); give finite numbers"
        )
    turned = rotation(pose.orientation)
    if not turned.is_rounded:
        numbers = _numbers(pose.orientation)
        wrong = f"{name}'s orientation is ({numbers}), a quaternion of norm {turned.norm:.6g}"
        raise ValueError(
            f"{wrong}; give one of norm 1 (w = 1 and the rest 0 means no rotation)"
        )


def _numbers(message: Point | Quaternion) -> str:
    names = message.get_fields_and_field_types()
    return ", ".join(f"{name} = {getattr(message, name):.6g}" for name in names)
