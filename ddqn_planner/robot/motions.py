"""Motion primitives: what a robot with a heading can do next, made here or read from a lattice."""

import json
import math
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.files import as_path, read_file
from ddqn_planner.grid.arguments import Choice, as_number, as_whole, numbers

Array = NDArray[np.float64]

# As in Nav2's lattices (Pivtoraiko and Kelly 2005), a robot that drives straight ahead passes
# through the centres of cells: the headings are not evenly spaced.
QUARTER: Final = np.array([(1, 0), (2, 1), (1, 1), (1, 2)])
TURNED: Final = QUARTER[:, ::-1] * (-1, 1)
DIRECTIONS: Final = np.concatenate([QUARTER, TURNED, -QUARTER, -TURNED])
HEADINGS: Final = len(DIRECTIONS)

MAX_LATTICE_BYTES = 2**26  # Nav2's own files have up to 1 MB
STRIDE = 0.4  # metres of a long step straight ahead
BEHIND = 2.0  # what a metre counts that is not driven ahead; Nav2's reverse_penalty
TURN = 0.5  # metres that a turn on the spot by one radian counts
CELL_SIZES: Final = (
    0.001,
    10.0,
)  # metres: with finer cells a body covers too many to be learned
MOST_CELLS: Final = 100  # of a turning radius
FARTHEST: Final = (
    100.0  # metres from the begin of a lattice's primitive, and of its length
)
MOST_TURNED: Final = 100.0  # radians of a yaw in a lattice
MOST_POSES: Final = 10_000  # of a lattice's primitive
OFF_CENTRE: Final = (
    0.01  # cells by which a lattice's primitive may miss the centre of a cell
)
LEAST_LENGTH: Final = (
    0.9  # of the straight distance: a shorter trajectory_length is wrong
)
LEAST_COST: Final = 1e-6
OF_GENERATOR: Final = "give a file of Nav2's lattice generator"
SPACING, ANGLE = (
    0.5,
    math.radians(5),
)  # between the poses of a primitive: at most so many cells


class Motion(Choice):
    """How a robot moves."""

    DIFFERENTIAL = "differential"
    ACKERMANN = "ackermann"
    OMNIDIRECTIONAL = "omnidirectional"


@dataclass(frozen=True, eq=False)
class Motions:
    """P motion primitives: from a heading, so many cells further, to a heading."""

    resolution: float  # metres per cell
    angles: Array  # (16,) the yaw of each heading, radians
    start: NDArray[np.int64]  # (P,) the heading before
    end: NDArray[np.int64]  # (P,) and after
    offset: NDArray[np.int64]  # (P, 2) cells, x and y
    cost: NDArray[np.float32]  # (P,) what it counts, in cells of its length
    poses: tuple[
        Array, ...
    ]  # P times (n, 3): x, y in cells from where it begins, and the yaw


def turn_between(before: Any, after: Any) -> Any:
    """Return by how many radians to turn, from -pi to pi, counter-clockwise positive."""
    return (np.asarray(after) - before + math.pi) % (2 * math.pi) - math.pi


def make_motions(
    motion: Motion | str, turning_radius: float, resolution: float
) -> Motions:
    """Make primitives: ahead, bends, behind; turns on the spot, or sideways, where it can."""
    motion = Motion(motion)
    cell = _cell_size("the resolution", resolution)
    metres = as_number(
        "the turning radius", turning_radius, 0, math.inf, "metres, 0 or more"
    )
    radius = metres / cell
    if motion is Motion.ACKERMANN and radius < 1:
        problem = (
            f"the turning radius is {turning_radius} m; a car cannot turn on the spot"
        )
        raise ValueError(f"{problem}: give at least the resolution, {cell} m")
    if radius > MOST_CELLS:
        most = f"{MOST_CELLS} cells of {cell:g} m, {MOST_CELLS * cell:g} m"
        raise ValueError(
            f"the turning radius is {metres:g} m; give at most {most}, or a coarser resolution, "
            "or a lattice"
        )
    angles = np.arctan2(DIRECTIONS[:, 1], DIRECTIONS[:, 0]) % (2 * math.pi)
    found: list[tuple[int, int, Array, float]] = []
    for heading, angle in enumerate(angles):
        for towards in (0, 4, 12, 2, 14) if motion is Motion.OMNIDIRECTIONAL else (0,):
            step = DIRECTIONS[(heading + towards) % HEADINGS]
            long = max(round(STRIDE / cell / math.hypot(*step)), 2)
            for count in (1, long) if towards in (0, 4, 12) else (1,):
                poses = _straight(np.zeros(2), step * count, angle)
                found += _both_ways(
                    heading, heading, poses, 1.0 if towards == 0 else BEHIND
                )
        for side in (-1, 1):
            end = (heading + side) % HEADINGS
            found += _both_ways(heading, end, _bend(heading, end, angles, radius), 1.0)
            if motion is not Motion.ACKERMANN:
                turn = turn_between(angle, angles[end])
                yaw = angle + turn * np.linspace(0, 1, math.ceil(abs(turn) / ANGLE) + 1)
                spin = np.column_stack([np.zeros((len(yaw), 2)), yaw])
                found.append((heading, end, spin, abs(turn) * TURN / cell))
    return _motions(cell, angles, found)


def _cell_size(name: str, metres: Any) -> float:
    lowest, highest = CELL_SIZES
    remedy = f"metres per cell, {lowest:g} to {highest:g}"
    return as_number(name, metres, lowest, highest, remedy)


def read_lattice(file: str | Path) -> Motions:
    """Read the motion primitives of a state lattice in Nav2's JSON format; else a ValueError."""
    file = as_path(file, "the lattice")
    try:
        content = read_file(file, MAX_LATTICE_BYTES)
    except OSError as error:
        problem = f"the lattice {file}: it cannot be read ({error.strerror})"
        raise ValueError(f"{problem}; {OF_GENERATOR}") from None
    try:
        return _motions_in(_json_of(content))
    except ValueError as error:
        raise ValueError(f"the lattice {file}: {error}") from None


def _json_of(content: bytes) -> Any:
    try:
        return json.loads(content)
    except RecursionError:
        problem = "its brackets are nested too deeply"
    except ValueError as error:
        problem = f"it is no JSON ({error})"
    raise ValueError(f"{problem}; {OF_GENERATOR}")


def _field(owner: Any, field: str, name: str) -> Any:
    """Return a field of a lattice; `name` says whose."""
    if not isinstance(owner, dict) or field not in owner:
        raise ValueError(f"{name} has no {field}; {OF_GENERATOR}")
    return owner[field]


def _motions_in(lattice: Any) -> Motions:
    """Return the motion primitives of a lattice's JSON."""
    about = _field(lattice, "lattice_metadata", "it")
    cell = _cell_size(
        "grid_resolution", _field(about, "grid_resolution", "lattice_metadata")
    )
    if "num_of_headings" in about:  # which not every lattice has
        as_number(
            "num_of_headings",
            about["num_of_headings"],
            HEADINGS,
            HEADINGS,
            f"{HEADINGS}",
        )
    angles = _angles(_field(about, "heading_angles", "lattice_metadata"))
    primitives = _field(lattice, "primitives", "it")
    if not isinstance(primitives, list) or not primitives:
        raise ValueError(f"its primitives are no list of one or more; {OF_GENERATOR}")
    found = [
        _primitive(f"primitive {number}", primitive, cell, angles)
        for number, primitive in enumerate(primitives)
    ]
    motions = _motions(cell, angles, found)
    for headings, verb in ((motions.start, "starts"), (motions.end, "ends")):
        if missing := sorted(set(range(HEADINGS)) - set(headings.tolist())):
            remedy = f"give primitives that start and end with each of the {HEADINGS}"
            raise ValueError(
                f"no primitive {verb} with the headings {missing}; {remedy}"
            )
    return motions


def _angles(values: Any) -> Array:
    """Return the yaws of a lattice's headings, (16,)."""
    angles = numbers("heading_angles", values)
    if angles.shape != (HEADINGS,):
        raise ValueError(f"it has {angles.size} headings; give {HEADINGS}")
    turned = -MOST_TURNED, MOST_TURNED
    numbers(
        "heading_angles", angles, between=turned, whole=False, remedy="finite radians"
    )
    return angles.astype(np.float64)


def _primitive(
    name: str, primitive: Any, cell: float, angles: Array
) -> tuple[int, int, Array, float]:
    """Return headings before and after, poses and cost of a primitive in a lattice."""
    start, end = (
        as_whole(f"{field} of {name}", _field(primitive, field, name), 0, HEADINGS - 1)
        for field in ("start_angle_index", "end_angle_index")
    )
    field, metres = "trajectory_length", f"metres, 0 to {FARTHEST:g}"
    length = as_number(
        f"{field} of {name}", _field(primitive, field, name), 0, FARTHEST, metres
    )
    poses = _poses(f"the poses of {name}", _field(primitive, "poses", name)) / (
        cell,
        cell,
        1,
    )
    poses[-1, 2] = angles[end]
    first = np.array([0, 0, angles[start]])
    if np.abs(poses[0] - first).max() > 1e-6:  # only old files begin with it
        poses = np.vstack([first, poses])
    poses[:, 2] = np.unwrap(poses[:, 2])
    misses = np.abs(poses[-1, :2] - np.rint(poses[-1, :2])).max()
    if misses > OFF_CENTRE:
        problem = f"{name} ends {misses:.2g} cells off the centres of cells"
        raise ValueError(f"{problem}; give a file of the same grid_resolution")
    turn = float(np.abs(np.diff(poses[:, 2])).sum())
    cost = length / cell or turn * TURN / cell
    distance = float(np.hypot(*poses[-1, :2])) * cell
    if length < LEAST_LENGTH * distance or cost < LEAST_COST:
        problem = (
            f"{field} of {name} is {length:g}, and its poses lead {distance:.3g} m far"
        )
        raise ValueError(f"{problem}; give the metres that it drives, or leave it out")
    return start, end, closer(poses, SPACING, SPACING / ANGLE), cost


def _poses(name: str, values: Any) -> Array:
    """Return the poses of a lattice's primitive, (N, 3): metres, metres and radians."""
    poses = numbers(name, values)
    if poses.ndim != 2 or poses.shape[1] != 3 or not 0 < len(poses) <= MOST_POSES:
        raise ValueError(
            f"{name} have shape {poses.shape}; give 1 to {MOST_POSES} of [x, y, yaw]"
        )
    for column, unit, most in (
        (0, "metres", FARTHEST),
        (1, "metres", FARTHEST),
        (2, "radians", MOST_TURNED),
    ):
        remedy = f"{unit}, {-most:g} to {most:g}"
        numbers(
            name, poses[:, column], between=(-most, most), whole=False, remedy=remedy
        )
    return poses.astype(np.float64)


def closer(poses: Array, spacing: float, lever: float) -> Array:
    """Return poses with others between them: what is so far from the origin moves by `spacing`."""
    parts = [poses[:1]]
    for before, after in pairwise(poses):
        moves = math.hypot(*(after - before)[:2]) + lever * abs(after[2] - before[2])
        share = np.linspace(0, 1, max(math.ceil(moves / spacing - 1e-9), 1) + 1)[
            1:, None
        ]
        parts.append(before + share * (after - before))
    return np.concatenate(parts)


def _both_ways(start: int, end: int, poses: Array, factor: float) -> list[Any]:
    """Return a primitive, and, unless it leads sideways, the same in reverse."""
    length = factor * float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
    primitives = [(start, end, poses, length)]
    if factor == 1:
        back = poses[::-1] - [*poses[-1, :2], 0]
        primitives.append((end, start, back, BEHIND * length))
    return primitives


def _straight(begin: Any, end: Any, yaw: float) -> Array:
    """Return poses on a line, from its begin to its end."""
    count = math.ceil(math.hypot(*np.subtract(end, begin)) / SPACING - 1e-9) + 1
    return np.column_stack([np.linspace(begin, end, count), np.full(count, yaw)])


def _bend(start: int, end: int, angles: Array, radius: float) -> Array:
    """Return the shortest way to a neighbouring heading that ends in the centre of a cell."""
    # A line, an arc, a line, one line of length 0. With tangents of equal length, so many cells
    # ahead and so many in the new heading, an arc of the least radius leads from one to the other.
    turn = float(turn_between(angles[start], angles[end]))
    ahead = np.array([np.cos(angles[[start, end]]), np.sin(angles[[start, end]])])
    tangent = max(radius, 1.0) * math.tan(abs(turn) / 2)
    far = math.ceil(4 * tangent) + 6
    cells = np.array(list(product(range(-far, far + 1), repeat=2)))
    lengths = np.linalg.solve(ahead, cells.T).T
    possible = (lengths >= tangent - 1e-9).all(axis=1)
    best = np.where(possible, lengths.sum(axis=1), np.inf).argmin()
    (first, last), whole = lengths[best], cells[best]
    arc = min(first, last)
    arc_radius = arc / math.tan(abs(turn) / 2)
    count = (
        max(math.ceil(abs(turn) / ANGLE), math.ceil(abs(turn) * arc_radius / SPACING))
        + 1
    )
    yaw = angles[start] + turn * np.linspace(0, 1, count)
    side = np.array(
        [-math.sin(angles[start]), math.cos(angles[start])]
    ) * math.copysign(1, turn)
    centre = (first - arc) * ahead[:, 0] + arc_radius * side
    outward = np.column_stack([np.sin(yaw), -np.cos(yaw)]) * math.copysign(1, turn)
    on_arc = np.column_stack([centre + arc_radius * outward, yaw])
    parts = [
        _straight((0, 0), on_arc[0, :2], yaw[0])[:-1],
        on_arc,
        _straight(on_arc[-1, :2], whole, yaw[-1])[1:],
    ]
    return np.concatenate(parts)


def _motions(cell: float, angles: Array, found: list[Any]) -> Motions:
    start, end, poses, cost = zip(*sorted(found, key=lambda it: it[:2]), strict=True)
    offset = np.array([np.rint(one[-1, :2]) for one in poses], dtype=np.int64)
    return Motions(
        cell,
        angles,
        np.array(start),
        np.array(end),
        offset,
        np.array(cost, np.float32),
        poses,
    )
