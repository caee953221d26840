"""Motion primitives: what a robot with a heading can do next.

They are made here, or read from a state lattice of Nav2.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ddqn_planner.files import as_path, read_file
from ddqn_planner.grid.arguments import Choice, as_number, as_whole, numbers, shortened

Float64 = NDArray[np.float64]
Poses = NDArray[np.float64]  # (N, 3): x and y in cells, yaw in radians

# As in Nav2's lattices (Pivtoraiko and Kelly 2005), a robot that drives straight ahead
# passes through the centres of cells: the headings are not evenly spaced. For each
# number of headings, these are the cells (dx, dy) from one centre to the next along the
# headings of the first octant. The 64 are at most 6.4 degrees apart.
OCTANTS: Final = {
    16: ((1, 0), (2, 1)),
    32: ((1, 0), (4, 1), (2, 1), (4, 3)),
    64: ((1, 0), (9, 1), (9, 2), (3, 1), (9, 4), (7, 4), (3, 2), (5, 4)),
}
HEADINGS: Final = 16  # unless another number is chosen
HEADINGS_OF_LATTICES: Final = range(16, 65, 8)
# Bends lead to the next heading on each side, and to the one that is farthest within
# this turn, in radians. It is the largest between two of 16 headings: so many headings
# allow turns as tight as few.
MAX_BEND: Final = math.atan2(1, 2) + 1e-9

STRIDE = 0.4  # metres of a long step straight ahead
SHIFTED_HEADINGS: Final = 32  # more headings come with drives that shift a robot aside
# Cells from the begin of such a drive to its end, beside the radius of its arcs.
MAX_SHIFT: Final = 40
SHARES_OF_TURN: Final = (0.76, 1.24)  # its arcs', of the turn to the next heading
LONG_STEP: Final = 6.0  # cells: a short step that is longer needs no long one
LONGEST_STEP: Final = 10.0  # cells, of any heading in `OCTANTS`
BEHIND = 2.0  # cost of a metre that is not driven ahead; Nav2's reverse_penalty
TURN = 0.5  # metres driven ahead that cost as much as a turn by one radian
# Between two poses of a primitive, at most.
SPACING = 0.5  # cells
ANGLE = math.radians(5)

CELL_SIZES: Final = (0.001, 10.0)  # metres: a body covers too many finer cells
MAX_TURNING_RADIUS: Final = 360  # cells: a bend leads up to 0.47 times as far

MAX_LATTICE_BYTES = 2**26  # Nav2's own files have up to 1 MB
MAX_DISTANCE: Final = 100.0  # metres from the start of a lattice's primitive
MAX_YAW: Final = 100.0  # radians in a lattice
MAX_POSES: Final = 10_000  # of a lattice's primitive
MAX_OFF_CENTRE: Final = 0.01  # cells from a lattice's end to the centre of its cell
MAX_YAW_OFF: Final = 0.01  # radians from a lattice's end to the yaw of its heading
# Of the way that a robot drives on a primitive: a cost below is wrong, as lower bounds
# rely on costs. Nav2's files round to 1e-5.
MIN_COST_SHARE: Final = 1 - 1e-4
MIN_COST: Final = 1e-3  # cells, also of a turn on the spot
SAME_POSE: Final = 1e-6  # cells and radians
GENERATOR_REMEDY: Final = "give a file of Nav2's lattice generator"


class Motion(Choice):
    """How a robot moves."""

    DIFFERENTIAL = "differential"
    ACKERMANN = "ackermann"
    OMNIDIRECTIONAL = "omnidirectional"


@dataclass(frozen=True, eq=False)
class Motions:
    """P motion primitives: from a heading, over some cells, to a heading."""

    resolution: float  # metres per cell
    angles: Float64  # (H,) the yaw of each heading, radians
    start: NDArray[np.int64]  # (P,) the first heading
    end: NDArray[np.int64]  # (P,) the last heading
    offset: NDArray[np.int64]  # (P, 2) cells, x and y
    cost: NDArray[np.float32]  # (P,) as that of so many cells driven ahead
    poses: tuple[Poses, ...]  # P times (N, 3), from the cell where the primitive begins
    # What a change between ahead and reverse costs, as so many cells driven ahead.
    cusp: float = 0.0

    @property
    def headings(self) -> int:
        """The number H of headings."""
        return len(self.angles)


class Primitive(NamedTuple):
    """One motion primitive."""

    start: int  # heading
    end: int  # heading
    poses: Poses
    cost: float  # as that of so many cells driven ahead


def driven_length(poses: Poses) -> float:
    """Return the length of the origin's way along poses (N, 3), in their unit."""
    steps = np.diff(poses[:, :2], axis=0)
    return float(np.hypot(steps[:, 0], steps[:, 1]).sum())


def is_too_cheap(cost: float, poses: Poses) -> bool:
    """Return whether a primitive costs less than its way; all is in cells."""
    return not cost >= max(MIN_COST_SHARE * driven_length(poses), MIN_COST)


def turn_between(start_yaw: ArrayLike, end_yaw: ArrayLike) -> Float64:
    """Return the turn between two yaws: -pi to pi, counter-clockwise positive."""
    turn: Float64 = np.asarray(end_yaw) - np.asarray(start_yaw)
    return (turn + math.pi) % (2 * math.pi) - math.pi


# Primitives that are made


def directions_of(headings: int) -> NDArray[np.int64]:
    """Return the cells (dx, dy) from one centre to the next along each heading: (H, 2).

    `headings` is one of the numbers in `OCTANTS`.
    """
    octant = np.array(OCTANTS[headings])
    # The next octant begins with the diagonal and mirrors all but the first heading.
    next_octant = np.vstack([[(1, 1)], octant[:0:-1, ::-1]])
    quarter = np.concatenate([octant, next_octant])
    turned_quarter = quarter[:, ::-1] * (-1, 1)
    return np.concatenate([quarter, turned_quarter, -quarter, -turned_quarter])


def make_motions(
    motion: Motion | str,
    turning_radius: float,
    resolution: float,
    headings: int = HEADINGS,
) -> Motions:
    """Make the primitives of a robot.

    Every robot drives straight ahead and behind, and in bends to headings on each side.
    All robots except cars also turn on the spot. An omnidirectional robot also drives
    straight sideways and diagonally.

    Parameters
    ----------
    motion : Motion
        A car is `Motion.ACKERMANN`.
    turning_radius : float
        Metres: at most the length of 100 cells, and for a car at least that of one.
    resolution : float
        Metres per cell.
    headings : int
        16, 32 or 64.

    Raises
    ------
    ValueError
        If there is no such motion, or a number is out of its range.
    """
    motion = Motion(motion)
    if headings not in OCTANTS:
        choice = ", ".join(map(str, OCTANTS))
        raise ValueError(f"headings is {shortened(headings)}; give one of {choice}")
    cell_size = _cell_size("the resolution", resolution)
    radius = _radius_in_cells(motion, turning_radius, cell_size)
    directions = directions_of(headings)
    angles = np.arctan2(directions[:, 1], directions[:, 0]) % (2 * math.pi)
    primitives: list[Primitive] = []
    for heading in range(headings):
        yaw = float(angles[heading])
        step = directions[heading]
        for ahead in _straight(heading, step, yaw, cell_size):
            primitives += [ahead, _driven_behind(ahead)]
        if motion is Motion.OMNIDIRECTIONAL:
            primitives += _aside(heading, directions, yaw, cell_size)
        for end in _ends_of_bends(heading, angles):
            bend = _driven_ahead(heading, end, _bend(heading, end, angles, radius))
            primitives += [bend, _driven_behind(bend)]
        if headings > SHIFTED_HEADINGS:
            for poses in _shifts(heading, angles, radius):
                shift = _driven_ahead(heading, heading, poses)
                primitives += [shift, _driven_behind(shift)]
        if motion is not Motion.ACKERMANN:
            for end in _neighbours(heading, headings):
                primitives.append(_turn_on_the_spot(heading, end, angles, cell_size))
    return _motions(cell_size, angles, primitives)


def _neighbours(heading: int, headings: int) -> tuple[int, int]:
    """Return the next headings to the right and to the left of a heading."""
    return (heading - 1) % headings, (heading + 1) % headings


def _ends_of_bends(heading: int, angles: Float64) -> list[int]:
    """Return the headings to which bends lead: the next and the farthest on each side.

    `angles` (H,) has the yaw of each heading, radians.
    """
    turn = turn_between(angles[heading], angles)  # (H,)
    may_bend = np.abs(turn) <= MAX_BEND
    farthest_left = int(np.where(may_bend, turn, 0).argmax())
    farthest_right = int(np.where(may_bend, turn, 0).argmin())
    next_headings = _neighbours(heading, len(angles))
    return sorted({farthest_right, *next_headings, farthest_left})


def _cell_size(name: str, metres: Any) -> float:
    """Return metres per cell, checked; an error calls them `name`."""
    smallest, largest = CELL_SIZES
    remedy = f"metres per cell, {smallest:g} to {largest:g}"
    return as_number(name, metres, smallest, largest, remedy)


def _radius_in_cells(motion: Motion, turning_radius: float, cell_size: float) -> float:
    """Return a turning radius in cells. `turning_radius` and `cell_size` are in metres.

    A ValueError if the radius is too large, or too small for the motion of a car.
    """
    metres = as_number(
        "the turning radius", turning_radius, 0, math.inf, "metres, 0 or more"
    )
    radius = metres / cell_size
    if motion is Motion.ACKERMANN and radius < 1:
        problem = (
            f"the turning radius is {turning_radius} m; a car cannot turn on the spot"
        )
        raise ValueError(f"{problem}: give at least the resolution, {cell_size} m")
    if radius > MAX_TURNING_RADIUS:
        largest = MAX_TURNING_RADIUS * cell_size
        limit = f"{MAX_TURNING_RADIUS} cells of {cell_size:g} m, {largest:g} m"
        raise ValueError(
            f"the turning radius is {metres:g} m; give at most {limit}, or a coarser "
            "resolution, or a lattice"
        )
    return radius


def _straight(
    heading: int, step: NDArray[np.int64], yaw: float, cell_size: float
) -> list[Primitive]:
    """Return a short and a long straight drive with a fixed heading, or a short one.

    Parameters
    ----------
    heading : int
        The robot's heading, whose yaw is `yaw`, in radians.
    step : (2,) int64
        The short drive: cells from a centre to the next one in its direction.
    yaw : float
        Radians.
    cell_size : float
        Metres per cell.
    """
    length = math.hypot(*step)  # cells
    counts = [1]
    if length < LONG_STEP:
        counts.append(max(round(STRIDE / cell_size / length), 2))
    lines = [_line(np.zeros(2), step * count, yaw) for count in counts]
    return [_driven_ahead(heading, heading, poses) for poses in lines]


def _aside(
    heading: int, directions: NDArray[np.int64], yaw: float, cell_size: float
) -> list[Primitive]:
    """Return straight drives sideways, and short ones diagonally ahead.

    Parameters
    ----------
    heading : int
        The robot's heading, whose yaw is `yaw`, in radians.
    directions : (H, 2) int64
        Cells from one centre to the next along each heading.
    yaw : float
        Radians.
    cell_size : float
        Metres per cell.
    """
    headings = len(directions)
    quarter = headings // 4
    drives: list[Primitive] = []
    for direction in (heading + quarter, heading - quarter):
        step = directions[direction % headings]
        drives += _straight(heading, step, yaw, cell_size)
    for direction in (heading + quarter // 2, heading - quarter // 2):
        step = directions[direction % headings]
        drives += _straight(heading, step, yaw, cell_size)[:1]
    return [drive._replace(cost=BEHIND * drive.cost) for drive in drives]


def _driven_ahead(start: int, end: int, poses: Poses) -> Primitive:
    """Return the primitive along poses (N, 3); its cost is its length in cells.

    `start` and `end` are the headings of the first and the last pose.
    """
    return Primitive(start, end, poses, cost=driven_length(poses))


def _driven_behind(primitive: Primitive) -> Primitive:
    """Return the primitive that drives back along another, from the origin on."""
    last_x, last_y, _ = primitive.poses[-1]
    return Primitive(
        start=primitive.end,
        end=primitive.start,
        poses=primitive.poses[::-1] - [last_x, last_y, 0],
        cost=BEHIND * primitive.cost,
    )


def _turn_on_the_spot(
    start: int, end: int, angles: Float64, cell_size: float
) -> Primitive:
    """Return the primitive that turns from one heading to another in the origin.

    `start` and `end` are headings; `angles` (H,) has the yaw of each heading
    in radians; `cell_size` is in metres.
    """
    turn = float(turn_between(angles[start], angles[end]))
    count = math.ceil(abs(turn) / ANGLE) + 1  # poses
    yaw = angles[start] + turn * np.linspace(0, 1, count)
    poses = np.column_stack([np.zeros((count, 2)), yaw])
    return Primitive(start, end, poses, cost=abs(turn) * TURN / cell_size)


def _line(start: NDArray[Any], end: NDArray[Any], yaw: float) -> Poses:
    """Return poses on a line from one point (2,) to another, in cells, with a yaw.

    Neighbours are at most `SPACING` apart; a line of length 0 has one pose.
    """
    length = math.hypot(*np.subtract(end, start))
    # A length that is greater than n spacings by rounding alone has n parts.
    count = math.ceil(length / SPACING - 1e-9) + 1  # poses
    points = np.linspace(start, end, count)
    return np.column_stack([points, np.full(count, yaw)])


def _bend(start: int, end: int, angles: Float64, radius: float) -> Poses:
    """Return the shortest bend to another heading that ends in a cell's centre.

    Two straight sides meet in a corner: from the origin ahead, and from the corner to
    the end in the last heading. The bend cuts the corner by an arc, which begins as far
    before the corner as it ends after it. This distance is radius * tan(turn / 2).

    Parameters
    ----------
    start, end : int
        The first and the last heading.
    angles : (H,) float64
        The yaw of each heading, radians.
    radius : float
        The least radius of the arc, in cells; one below 1 cell counts as 1.

    Returns
    -------
    (N, 3) float64
        Poses from the origin on: cells, cells, radians.
    """
    turn = float(turn_between(angles[start], angles[end]))
    yaws = angles[[start, end]]
    directions = np.array([np.cos(yaws), np.sin(yaws)])  # (2, 2): a column for each
    cut_per_radius = math.tan(abs(turn) / 2)
    min_cut = max(radius, 1.0) * cut_per_radius
    corner = _nearest_end(directions, min_cut)  # its two sides, and the end
    # The arc replaces all of the shorter side, and the same length of the longer side.
    cut = min(corner.length_before, corner.length_after)
    arc_start = (corner.length_before - cut) * directions[:, 0]
    arc_radius = cut / cut_per_radius
    arc = _arc(arc_start, float(angles[start]), turn, arc_radius)
    # What remains of the two sides. One of these lines is a single pose of the arc.
    first_line = _line(np.zeros(2), arc[0, :2], arc[0, 2])
    last_line = _line(arc[-1, :2], corner.end_cell, arc[-1, 2])
    return np.concatenate([first_line[:-1], arc, last_line[1:]])


def _shifts(heading: int, angles: Float64, radius: float) -> list[Poses]:
    """Return a drive to each side that ends in the heading in which it begins.

    Two arcs lead about half as far aside as a straight drive in the next heading: so a
    robot that follows a direction between two headings turns less from it.

    Parameters
    ----------
    heading : int
        The first and the last heading.
    angles : (H,) float64
        The yaw of each heading, radians.
    radius : float
        The least radius of the arcs, in cells.
    """
    yaw = float(angles[heading])
    cells = _cells_around(MAX_SHIFT + math.ceil(radius))  # (N, 2)
    ahead = cells @ [math.cos(yaw), math.sin(yaw)]  # (N,)
    left = cells @ [-math.sin(yaw), math.cos(yaw)]
    turn = 2 * np.arctan2(left, ahead)  # of the first arc, back by the second
    is_wide = ahead >= 2 * max(radius, 1.0) * np.sin(np.abs(turn))
    shifts = []
    for neighbour in _neighbours(heading, len(angles)):
        share = turn / float(turn_between(yaw, angles[neighbour]))
        lowest, highest = SHARES_OF_TURN
        is_shift = (ahead > 0) & (lowest <= share) & (share <= highest)
        nearest = int(np.where(is_shift & is_wide, ahead, np.inf).argmin())
        shifts.append(_two_arcs(yaw, float(turn[nearest]), float(ahead[nearest])))
    return shifts


def _cells_around(distance: int) -> NDArray[np.int64]:
    """Return the cells of a square around cell (0, 0), `distance` to each side."""
    coordinates = np.arange(-distance, distance + 1)
    x, y = np.meshgrid(coordinates, coordinates, indexing="ij")
    return np.column_stack([x.ravel(), y.ravel()])


def _two_arcs(yaw: float, turn: float, length: float) -> Poses:
    """Return poses (N, 3) on two arcs, the first by a turn and the second back by it.

    They end `length` cells ahead, along the first `yaw`; angles are in radians.
    """
    radius = length / (2 * math.sin(abs(turn)))
    first = _arc(np.zeros(2), yaw, turn, radius)
    last = _arc(first[-1, :2], float(first[-1, 2]), -turn, radius)
    return np.concatenate([first, last[1:]])


def _arc(start: Float64, start_yaw: float, turn: float, radius: float) -> Poses:
    """Return poses (N, 3) on an arc: cells, cells, radians.

    Parameters
    ----------
    start : (2,)
        The first point, in cells.
    start_yaw : float
        The yaw there, radians.
    turn : float
        The angle by which the arc turns, radians; above 0 to the left.
    radius : float
        In cells.
    """
    # As many parts as both the greatest angle and the greatest length of a part need.
    parts_by_angle = math.ceil(abs(turn) / ANGLE)
    parts_by_length = math.ceil(abs(turn) * radius / SPACING)
    count = max(parts_by_angle, parts_by_length) + 1
    yaw = start_yaw + turn * np.linspace(0, 1, count)  # (N,)
    # The circle's centre lies at a right angle to the yaw, to the left if `side` is 1.
    side = math.copysign(1, turn)
    to_centre = np.array([-math.sin(start_yaw), math.cos(start_yaw)]) * side
    centre = start + radius * to_centre
    from_centre = np.column_stack([np.sin(yaw), -np.cos(yaw)]) * side  # (N, 2)
    points = centre + radius * from_centre
    return np.column_stack([points, yaw])


class _Corner(NamedTuple):
    """Two sides that meet in a corner: from the origin to it, and on to a cell."""

    length_before: float  # of the side along the first heading, in cells
    length_after: float  # of the side along the last heading, in cells
    end_cell: NDArray[np.int64]  # (2,), from the cell where the bend begins


def _nearest_end(directions: Float64, min_length: float) -> _Corner:
    """Return the corner whose two sides end in a cell's centre and are shortest.

    Parameters
    ----------
    directions : (2, 2) float64
        The unit vectors of the first and the last heading, in columns.
    min_length : float
        The least length of each side, in cells.
    """
    # All cells in a square around the origin, which contains the nearest end: sides
    # that are whole numbers of steps end in the centre of a cell.
    max_distance = math.ceil(2 * (min_length + LONGEST_STEP))
    cells = _cells_around(max_distance)  # (N, 2)
    # The lengths of the two sides that lead to each cell: directions @ lengths = cells.
    lengths = np.linalg.solve(directions, cells.T)  # (2, N)
    is_possible = (lengths >= min_length - 1e-9).all(axis=0)  # (N,)
    total_length = np.where(is_possible, lengths.sum(axis=0), np.inf)
    nearest = total_length.argmin()
    length_before, length_after = lengths[:, nearest].tolist()
    return _Corner(length_before, length_after, cells[nearest])


def _motions(
    cell_size: float, angles: Float64, primitives: Sequence[Primitive]
) -> Motions:
    """Return primitives as arrays, sorted by their first and then their last headings.

    `cell_size` is in metres; `angles` (H,) has the yaw of each heading, radians.
    """
    in_order = sorted(
        primitives, key=lambda primitive: (primitive.start, primitive.end)
    )
    offsets = [np.rint(primitive.poses[-1, :2]) for primitive in in_order]
    return Motions(
        resolution=cell_size,
        angles=angles,
        start=np.array([primitive.start for primitive in in_order]),
        end=np.array([primitive.end for primitive in in_order]),
        offset=np.array(offsets, dtype=np.int64),
        cost=np.array([primitive.cost for primitive in in_order], np.float32),
        poses=tuple(primitive.poses for primitive in in_order),
    )


def dense_poses(poses: Poses, spacing: float, lever: float) -> Poses:
    """Return poses (N, 3), and more poses between them: (M, 3).

    From one pose to the next, a point of the body moves by `spacing` at most, if it
    lies at most `lever` from the robot's origin. Both have the unit of the poses' x, y.
    """
    changes = np.diff(poses, axis=0)  # (N - 1, 3)
    movement = np.hypot(changes[:, 0], changes[:, 1]) + lever * np.abs(changes[:, 2])
    # A movement that is greater than n spacings by rounding alone takes n steps.
    steps = np.maximum(np.ceil(movement / spacing - 1e-9), 1).astype(np.int64)
    change = np.repeat(np.arange(len(steps)), steps)  # (M - 1,): of each step
    first_steps = np.cumsum(steps) - steps
    number = np.arange(len(change)) - first_steps[change] + 1  # 1 to `steps`
    shares = number * (1 / steps)[change]  # of the change
    shares[number == steps[change]] = 1
    between = poses[change] + shares[:, None] * changes[change]
    return np.concatenate([poses[:1], between])


# Lattice files


def read_lattice(file: str | Path, allow_reverse: bool = False) -> Motions:
    """Read the primitives of a state lattice in Nav2's JSON format.

    A ValueError says what is wrong with a file.

    Parameters
    ----------
    file : path
    allow_reverse : bool
        Whether the robot can also drive each primitive back, at `BEHIND` times its
        cost. Files of Nav2's generator have no primitives in reverse.
    """
    path = as_path(file, "the lattice")
    try:
        content = read_file(path, MAX_LATTICE_BYTES)
    except OSError as error:
        problem = f"the lattice {path}: it cannot be read ({error.strerror})"
        raise ValueError(f"{problem}; {GENERATOR_REMEDY}") from None
    try:
        return _motions_in(_json_of(content), allow_reverse)
    except ValueError as error:
        raise ValueError(f"the lattice {path}: {error}") from None


def _json_of(content: bytes) -> Any:
    """Return the value that a JSON text stands for; a ValueError if it is no JSON."""
    try:
        return json.loads(content)
    except RecursionError:
        problem = "its brackets are nested too deeply"
    except ValueError as error:
        problem = f"it is no JSON ({error})"
    raise ValueError(f"{problem}; {GENERATOR_REMEDY}")


def _field(owner: object, field: str, owner_name: str) -> Any:
    """Return a field of an object in a lattice's JSON; a ValueError if it lacks it.

    `owner_name` is what the error calls the object.
    """
    if not isinstance(owner, dict) or field not in owner:
        raise ValueError(f"{owner_name} has no {field}; {GENERATOR_REMEDY}")
    return owner[field]


def _motions_in(lattice: object, allow_reverse: bool) -> Motions:
    """Return the motion primitives of a lattice's JSON, perhaps also in reverse."""
    metadata: object = _field(lattice, "lattice_metadata", "it")
    cell_size = _cell_size(
        "grid_resolution", _field(metadata, "grid_resolution", "lattice_metadata")
    )
    angles = _angles(_field(metadata, "heading_angles", "lattice_metadata"))
    _check_number_of_headings(metadata, len(angles))
    objects: object = _field(lattice, "primitives", "it")
    if not isinstance(objects, list) or not objects:
        raise ValueError(
            f"its primitives are no list of one or more; {GENERATOR_REMEDY}"
        )
    primitives = []
    for number, primitive in enumerate(objects):
        name = f"primitive {number}"
        primitives.append(_primitive(name, primitive, cell_size, angles))
    if allow_reverse:
        primitives += _reversed(primitives)
    motions = _motions(cell_size, angles, primitives)
    _check_headings(motions.start, len(angles), "starts")
    _check_headings(motions.end, len(angles), "ends")
    return motions


def _reversed(primitives: Sequence[Primitive]) -> list[Primitive]:
    """Return the primitives in reverse, except turns and those that are there."""
    ends = {_ends_of(primitive) for primitive in primitives}
    reverses = [
        _driven_behind(primitive)
        for primitive in primitives
        if driven_length(primitive.poses) > 0
    ]
    return [reverse for reverse in reverses if _ends_of(reverse) not in ends]


def _ends_of(primitive: Primitive) -> tuple[int, int, int, int]:
    """Return the headings of a primitive, and its way from cell to cell."""
    x, y, _ = np.rint(primitive.poses[-1]).astype(int).tolist()
    return primitive.start, primitive.end, x, y


def _check_number_of_headings(metadata: object, count: int) -> None:
    """Raise a ValueError unless a lattice has the number of headings that it says.

    A lattice may not say a number; `count` are those that it has.
    """
    field = "num_of_headings"
    if isinstance(metadata, dict) and field in metadata:
        as_number(field, metadata[field], count, count, f"{count}")


def _check_headings(headings: NDArray[np.int64], count: int, verb: str) -> None:
    """Raise a ValueError unless each of `count` headings is among those of primitives.

    `headings` (P,) are those with which P primitives start or end, as `verb` says:
    "starts" or "ends".
    """
    missing = sorted(set(range(count)) - set(headings.tolist()))
    if missing:
        remedy = f"give primitives that start and end with each of the {count}"
        raise ValueError(f"no primitive {verb} with the headings {missing}; {remedy}")


def _angles(values: Any) -> Float64:
    """Return the yaws of a lattice's headings, (H,) radians; a ValueError for others.

    `values` are those in the lattice's JSON.
    """
    name = "heading_angles"
    angles = numbers(name, values)
    if angles.ndim != 1 or len(angles) not in HEADINGS_OF_LATTICES:
        choice = ", ".join(map(str, HEADINGS_OF_LATTICES))
        raise ValueError(f"it has {angles.size} headings; give one of {choice}")
    limits = (-MAX_YAW, MAX_YAW)
    numbers(name, angles, between=limits, whole=False, remedy="finite radians")
    return angles.astype(np.float64)


def _primitive(
    name: str, primitive: object, cell_size: float, angles: Float64
) -> Primitive:
    """Return a primitive of a lattice's JSON; a ValueError says what is wrong with it.

    Parameters
    ----------
    name : str
        What errors call the primitive.
    primitive : object
        The value in the list of primitives, which should be a dict.
    cell_size : float
        Metres per cell.
    angles : (H,) float64
        The yaw of each heading, radians.
    """
    start = _heading("start_angle_index", name, primitive, len(angles))
    end = _heading("end_angle_index", name, primitive, len(angles))
    length = as_number(
        f"trajectory_length of {name}",
        _field(primitive, "trajectory_length", name),
        0,
        MAX_DISTANCE,
        f"metres, 0 to {MAX_DISTANCE:g}",
    )
    metric_poses = _poses(f"the poses of {name}", _field(primitive, "poses", name))
    poses = metric_poses / (cell_size, cell_size, 1)  # cells, cells, radians
    _check_last_yaw(name, poses, angles[end])
    poses = _from_heading_to_heading(poses, angles[start], angles[end])
    _check_end(name, poses)
    metres = length
    if length == 0:  # a turn on the spot, which costs as much as these metres
        turn = float(np.abs(np.diff(poses[:, 2])).sum())
        metres = turn * TURN
    cost = metres / cell_size
    if is_too_cheap(cost, poses):
        driven = driven_length(poses) * cell_size  # metres
        raise ValueError(
            f"trajectory_length of {name} is {length:g}, and its poses drive "
            f"{driven:.5g} m; give the metres that it drives, 0 for a turn on the "
            "spot, or leave it out"
        )
    return Primitive(start, end, dense_poses(poses, SPACING, SPACING / ANGLE), cost)


def _heading(field: str, name: str, primitive: object, headings: int) -> int:
    """Return a field of a lattice's primitive that is one of `headings` headings."""
    value = _field(primitive, field, name)
    return as_whole(f"{field} of {name}", value, 0, headings - 1)


def _from_heading_to_heading(poses: Poses, start_yaw: float, end_yaw: float) -> Poses:
    """Return a primitive's poses from the origin on, from `start_yaw` to `end_yaw`.

    The yaws, in radians, have no jumps by whole turns. `poses` (N, 3), x and y in
    cells, may lack the pose in the origin; their last yaw is changed in place.
    """
    poses[-1, 2] = end_yaw
    start_pose = np.array([0, 0, start_yaw])
    # Old files of Nav2 begin with the start pose, newer ones with the pose after it.
    if np.abs(poses[0] - start_pose).max() > SAME_POSE:
        poses = np.vstack([start_pose, poses])
    poses[:, 2] = np.unwrap(poses[:, 2])
    return poses


def _check_last_yaw(name: str, poses: Poses, end_yaw: float) -> None:
    """Raise a ValueError unless a primitive's last yaw is that of its last heading.

    `name` is what the error calls it; `end_yaw` and the yaws of its poses (N, 3) are in
    radians.
    """
    last_yaw = float(poses[-1, 2])
    if abs(turn_between(last_yaw, end_yaw)) > MAX_YAW_OFF:
        raise ValueError(
            f"{name} ends with a yaw of {last_yaw:.4g}, and its end_angle_index has "
            f"{end_yaw:.4g} in heading_angles; {GENERATOR_REMEDY}"
        )


def _check_end(name: str, poses: Poses) -> None:
    """Raise a ValueError if a primitive does not end in the centre of a cell.

    `name` is what the error calls it; its poses (N, 3) are in cells and radians.
    """
    end = poses[-1, :2]
    off_centre = np.abs(end - np.rint(end)).max()
    if off_centre > MAX_OFF_CENTRE:
        raise ValueError(
            f"{name} ends {off_centre:.2g} cells off the centres of cells; give a file "
            "of the same grid_resolution"
        )


def _poses(name: str, values: Any) -> Float64:
    """Return the poses of a lattice's primitive, (N, 3): metres, metres and radians.

    `values` are those in the lattice's JSON, and `name` is what errors call them.
    """
    poses = numbers(name, values)
    if poses.ndim != 2 or poses.shape[1] != 3 or not 0 < len(poses) <= MAX_POSES:
        raise ValueError(
            f"{name} have shape {poses.shape}; give 1 to {MAX_POSES} of [x, y, yaw]"
        )
    _check_column(name, poses[:, 0], "metres", MAX_DISTANCE)
    _check_column(name, poses[:, 1], "metres", MAX_DISTANCE)
    _check_column(name, poses[:, 2], "radians", MAX_YAW)
    return poses.astype(np.float64)


def _check_column(name: str, column: Float64, unit: str, limit: float) -> None:
    """Raise a ValueError unless all numbers lie within -limit to limit."""
    remedy = f"{unit}, {-limit:g} to {limit:g}"
    numbers(name, column, between=(-limit, limit), whole=False, remedy=remedy)
