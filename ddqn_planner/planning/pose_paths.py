"""Paths of poses: their plans, whether a body has room along them, what they cost."""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.layers import multipliers_of
from ddqn_planner.grid.moves import ACTION_OF_STEP
from ddqn_planner.planning.plan import (
    SAME_POSE,
    Explanation,
    PlanStatus,
    PosePlan,
    explained,
)
from ddqn_planner.planning.pose_world import body_costs
from ddqn_planner.robot.directions import (
    ON_THE_SPOT,
    cusps_before,
    directions_of_travel,
)
from ddqn_planner.robot.driving_costs import Rates
from ddqn_planner.robot.footprint import inside, outline
from ddqn_planner.robot.motions import BEHIND, TURN, turn_between

Float64 = NDArray[np.float64]

# Cells and radians by which a robot may be off its path.
REACH: Final = 5.0, math.pi / 4
OUTLINE_SPACING: Final = 0.25  # cells between two points of a body's outline
# And inside: so each cell there, turned as it may be, has a point.
FILL_SPACING: Final = 0.7
LEAST_PART: Final = 1e-6  # of a line: a smaller one is rounding
SAME: Final = 1 + 1e-6  # what is rounded in sums of float32 is less
ESCAPE_IN_WORDS: Final = (
    "the start is occupied: cells that the robot's body covers there do not count until"
    " it has left them"
)

NO_DRIVE: Final = (
    "start and goal lie in one cell and one heading, and no curve that is free leads"
    " from one to the other: the path is one pose"
)


class PosePath(NamedTuple):
    """A path of N poses."""

    poses: Float64  # (N, 3), in metres and radians
    cells: NDArray[np.int32]  # (N, 2)
    costs: Float64  # (N,): from the first pose to each, in cells
    # (N,): a lower bound of the cost of any path from each pose to the end; 0 or less
    # where nothing is proved.
    least_costs: Float64
    # Poses that lead out of the obstacles on which the path starts.
    escape: int = 0
    is_finished: bool = False  # see `pose_finish`

    def part(self, first: int, end: int) -> "PosePath":
        """Return the path from pose number `first` to before `end`, without escape."""
        part = slice(first, end)
        return PosePath(
            self.poses[part],
            self.cells[part],
            self.costs[part],
            self.least_costs[part],
        )

    def or_cheaper(self, other: "PosePath") -> "PosePath":
        """Return another path from the same start if it costs less, else this one.

        What is proved of the cost of any path holds beside the other path, too.
        """
        if other.costs[-1] >= self.costs[-1]:
            return self
        gain = max(self.least_costs[0] - other.least_costs[0], 0.0)
        return other._replace(least_costs=other.least_costs + gain)

    def cusps_to(self, rest: "PosePath") -> int:
        """Return whether a cusp lies between a path and the next one: 1, else 0."""
        together = np.concatenate([self.poses, rest.poses[1:]])
        cusps = [
            int(cusps_before(directions_of_travel(poses))[-1])
            for poses in (together, self.poses, rest.poses)
        ]
        return cusps[0] - cusps[1] - cusps[2]

    def followed_by(self, rest: "PosePath", extra_cost: float) -> "PosePath":
        """Return the path and then another one, which begins in its last pose.

        `extra_cost` is what the cusp between both costs more than the costs of the
        other one say.
        """
        costs_of_rest = rest.costs[1:] - rest.costs[0] + extra_cost
        return self._replace(
            poses=np.concatenate([self.poses, rest.poses[1:]]),
            cells=np.concatenate([self.cells, rest.cells[1:]]),
            costs=np.concatenate([self.costs, self.costs[-1] + costs_of_rest]),
            least_costs=np.concatenate([self.least_costs, rest.least_costs[1:]]),
        )

    def plan(self, grid: GridMap, remark: str = "") -> PosePlan:
        """Return the plan along the path.

        Parameters
        ----------
        grid : GridMap
            On a map of expected times the plan's cost is in seconds, else in cells.
        remark : str
            In what the path differs from its request, besides an escape; empty for
            nothing.
        """
        poses = self.poses[:]  # a view, which alone cannot be written to
        poses.flags.writeable = False
        cells = self.cells
        is_new_cell = np.append(True, (cells[1:] != cells[:-1]).any(axis=1))
        cost = float(self.costs[-1]) - float(self.costs[0])
        least_cost = float(self.least_costs[0])
        bound = math.inf  # of the ratio of the cost to the least cost of any path
        if cost <= least_cost * SAME:
            bound = 1.0
        elif least_cost > 0:
            bound = max(cost / least_cost, 1.0)
        steps = np.diff(poses[:, :2], axis=0)  # (N - 1, 2), in metres
        goal_x, goal_y = cells[-1].tolist()
        remarks = []
        if self.escape:
            remarks.append(ESCAPE_IN_WORDS)
        if remark:
            remarks.append(remark)
        plan = PosePlan(
            PlanStatus.SUCCEEDED,
            cells[is_new_cell],
            cost=cost * (grid.seconds_per_cell or 1.0),
            goal=(goal_x, goal_y),
            poses=poses,
            driven=float(np.hypot(steps[:, 0], steps[:, 1]).sum()) / grid.resolution,
            bound=bound,
            escape=self.escape,
        )
        return explained(plan, Explanation(plan.status.value, tuple(remarks)))


class BodyPoints(NamedTuple):
    """Points of a footprint from its origin, in cells."""

    outline: Float64  # (M, 2): along its sides
    inside: Float64  # (K, 2)


def points_of(corners: Float64, resolution: float) -> BodyPoints:
    """Return points on the outline of a footprint and inside, in cells.

    The corners of the footprint, (C, 2), are in metres, and the resolution in metres
    per cell.
    """
    corners_in_cells = corners / resolution
    min_x, min_y = corners_in_cells.min(axis=0)
    max_x, max_y = corners_in_cells.max(axis=0)
    x = np.arange(min_x, max_x, FILL_SPACING)
    y = np.arange(min_y, max_y, FILL_SPACING)
    # (L, 2): points of a square lattice over the footprint.
    lattice = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return BodyPoints(
        outline=outline(corners_in_cells, OUTLINE_SPACING),
        inside=lattice[inside(lattice, corners_in_cells)],
    )


def ends_in_words(path: PosePath, start: Any, goal: Any) -> str:
    """Return which ends of a new path are not exact, and why; empty if both are.

    `start` and `goal` are (x, y, yaw) in metres and radians, as the path's poses.
    """
    ends = inexact_ends_in_words(path, start, goal)
    if not ends:
        return ""
    if len(path.poses) == 1:
        return NO_DRIVE
    return f"{ends}: no curve that is free leads there"


def inexact_ends_in_words(path: PosePath, start: Any, goal: Any) -> str:
    """Return which ends of a path are not exact; empty if both are.

    A path out of obstacles begins where its primitives do. `start` and `goal` are as in
    `ends_in_words`.
    """
    off = np.abs(path.poses[[0, -1]] - (start, goal))  # (2, 3)
    off[:, 2] = np.abs(turn_between(0, off[:, 2]))
    is_start_off, is_goal_off = (off.max(axis=1) > SAME_POSE).tolist()
    if path.escape:
        is_start_off = False
    places = []
    if is_start_off:
        places.append("begins beside the start")
    if is_goal_off:
        places.append("ends beside the goal")
    return f"the path {' and '.join(places)}" if places else ""


def in_cells(poses: Float64, grid: GridMap) -> Float64:
    """Return poses (N, 3) with x and y in cells from the centre of cell (0, 0).

    The poses given are in metres and radians, in the map's frame. Each yaw becomes that
    from the map's x axis.
    """
    poses = np.reshape(poses, (-1, 3))
    cells = grid.in_cells(poses[:, :2]) - 0.5
    yaw = poses[:, 2] - grid.origin[2]
    return np.column_stack([cells, yaw])


def nearest_pose(
    poses: Float64, robot: Any, grid: GridMap, reach: tuple[float, float]
) -> int:
    """Return the number of the pose that is nearest to a robot's pose.

    Parameters
    ----------
    poses : (N, 3)
        In metres and radians.
    robot : (x, y, yaw)
        In metres and radians, in the same frame.
    grid : GridMap
        Tells the size of a cell.
    reach : (float, float)
        How many cells and how many radians the pose may be away from the robot's pose.

    Returns
    -------
    int
        -1 if no pose is within reach.
    """
    x: float
    y: float
    yaw: float
    x, y, yaw = robot
    max_distance, max_turn = reach
    # (N,) each.
    distance: Float64 = np.hypot(poses[:, 0] - x, poses[:, 1] - y) / grid.resolution
    turn: Float64 = np.abs(turn_between(poses[:, 2], yaw))
    candidates = np.flatnonzero((distance <= max_distance) & (turn <= max_turn))
    if not len(candidates):
        return -1
    # A distance of `cells_per_unit` counts as much as a turn of `radians_per_unit`.
    cells_per_unit, radians_per_unit = REACH
    distance_units = distance[candidates] / cells_per_unit
    apartness = distance_units + turn[candidates] / radians_per_unit
    return int(candidates[apartness.argmin()])


def is_free(poses: Float64, grid: GridMap, body: BodyPoints) -> bool:
    """Return whether a body has room at all poses (N, 3), and no cell forbids the path.

    The poses are in metres and radians, in the map's frame. `body` has points of the
    body's outline and inside, in cells.
    """
    path = in_cells(poses, grid)  # (N, 3): cells, cells, radians
    occupied = grid.uninflated.view(np.uint8)  # (H, W)
    height, width = occupied.shape
    cells = cells_of(path)  # (N, 2): those of the origin, which may lie off the body
    if not ((cells >= 0) & (cells < (width, height))).all():
        return False
    if touches(path, body.outline, occupied):
        return False
    # Only at the first pose: an obstacle that is inside the body at a later pose came
    # in through the outline.
    if touches(path[:1], body.inside, occupied):
        return False
    if grid.forbidden is None:
        return True
    # Whether each cell forbids the move of the origin to the next one. Two poses in one
    # cell have the action 8, which no cell forbids: its bit is not in 8 bits.
    x = cells[:-1, 0]
    y = cells[:-1, 1]
    steps = np.clip(np.diff(cells, axis=0), -1, 1)  # (N - 1, 2)
    actions = ACTION_OF_STEP[steps[:, 1] + 1, steps[:, 0] + 1]  # (N - 1,)
    is_forbidden = grid.forbidden[y, x] >> actions & 1
    return not is_forbidden.any()


def cells_of(path: Float64) -> NDArray[np.int32]:
    """Return the cells (N, 2) in which poses (N, 3) from `in_cells` lie."""
    return np.floor(path[:, :2] + 0.5).astype(np.int32)


@in_place
def rate_of_slide(bearing: float, slide_rates: Float64) -> float:
    """Return what a cell of a line in a held heading costs where each cell costs 1.

    `bearing` is the direction of travel from the heading, in radians, and `slide_rates`
    are those of `slide_rates_of`. The line costs as much as two lines to the same place
    with the bearings in this table beside its own.
    """
    part = 2 * math.pi / len(slide_rates)
    number = math.floor(bearing / part)
    excess = bearing - number * part
    first = math.sin(part - excess) / math.sin(part)
    last = math.sin(excess) / math.sin(part)
    rate = 0.0
    # An infinite rate counts only where the line has a part of its bearing.
    if first > LEAST_PART:
        rate += first * slide_rates[number % len(slide_rates)]
    if last > LEAST_PART:
        rate += last * slide_rates[(number + 1) % len(slide_rates)]
    return rate


@in_place
def least_cost_of_step(
    length: float, turn: float, direction: int, bearing: float, rates: Any
) -> float:
    """Return what a step from pose to pose costs where each cell costs 1, in cells.

    Parameters
    ----------
    length : float
        In cells. A step shorter than `ON_THE_SPOT` is a turn on the spot.
    turn : float
        In radians.
    direction : int
        Of travel, see `directions_of_travel`.
    bearing : float
        From the heading to the end of the step, in radians.
    rates : Rates
        Infinite where the robot cannot drive so; then so is the cost.
    """
    is_bend = abs(turn) > ON_THE_SPOT
    if length < ON_THE_SPOT:
        return abs(turn) * rates.spin if is_bend else 0.0
    if not is_bend and len(rates.slide) > 0:
        return length * rate_of_slide(bearing, rates.slide)
    if direction > 0:
        rate: float = rates.bend_ahead if is_bend else rates.ahead
    elif direction < 0:
        rate = rates.bend_behind if is_bend else rates.behind
    else:
        rate = rates.aside
    return length * rate


@in_place
def _write_least_costs(
    lengths: Float64,
    turns: Float64,
    directions: NDArray[np.int64],
    bearings: Float64,
    rates: Any,
    costs: Float64,
) -> None:
    """Write what N steps cost where each cell costs 1: (N,), see `least_cost_of_step`.

    All arrays are (N,).
    """
    for step in range(len(costs)):
        costs[step] = least_cost_of_step(
            lengths[step], turns[step], directions[step], bearings[step], rates
        )


def _with_usual_rates(rates: Rates, usual_rates: Rates) -> Rates:
    """Return rates with those of another robot where a robot cannot drive."""
    numbers = rates[:-1]  # all except the array of slides
    finite = np.where(np.isfinite(numbers), numbers, usual_rates[:-1])
    slide = np.where(np.isfinite(rates.slide), rates.slide, usual_rates.aside)
    return Rates(*finite.tolist())._replace(slide=slide)


def cost_of_poses(poses: Float64, grid: GridMap, rates: Rates) -> float:
    """Return the cost of a path along poses (N, 3), in cells.

    The poses are in metres and radians, in the map's frame. The layers of the map count
    at the cell in which a step begins, so the sum is nearly the cost of the primitives
    of which the path is made. What the robot cannot drive costs as much as another
    robot's.
    """
    path = in_cells(poses, grid)
    path[:, 2] = np.unwrap(path[:, 2])
    usual_spin = TURN / grid.resolution
    usual_rates = Rates(1.0, 1.0, BEHIND, BEHIND, BEHIND, usual_spin)
    finite_rates = _with_usual_rates(rates, usual_rates)
    dx, dy, turns = np.diff(path, axis=0).T  # (N - 1,) each
    lengths = np.hypot(dx, dy)
    bearings = np.arctan2(dy, dx) - path[:-1, 2]
    directions = directions_of_travel(path)  # (N - 1,)
    costs = np.empty(len(directions))  # of the steps
    _write_least_costs(lengths, turns.copy(), directions, bearings, finite_rates, costs)
    cells = cells_of(path[:-1])  # (N - 1, 2)
    x = cells[:, 0]
    y = cells[:, 1]
    cell_costs = body_costs(grid)
    if cell_costs is not None:
        costs *= multipliers_of(cell_costs[y, x])
    if grid.slowness is not None:
        costs *= grid.slowness[y, x]
    cusps = int(cusps_before(directions)[-1])
    return float(costs.sum()) + finite_rates.cusp * cusps


@in_place
def touches(path: Float64, points: Float64, occupied: NDArray[np.uint8]) -> bool:
    """Return whether points of a body lie in an occupied cell, or outside the map.

    Parameters
    ----------
    path : (N, 3)
        Poses at which the body stands: x and y in cells from the centre of cell (0, 0),
        yaw in radians.
    points : (M, 2)
        From the origin of the body, ahead and to the left, in cells.
    occupied : (H, W)
        1 where a cell is occupied, else 0.
    """
    height, width = occupied.shape
    for number in range(len(path)):
        # From the corner of cell (0, 0), so that rounding down gives the cell.
        x: float = path[number, 0] + 0.5
        y: float = path[number, 1] + 0.5
        yaw: float = path[number, 2]
        cos = math.cos(yaw)
        sin = math.sin(yaw)
        for point in range(len(points)):
            ahead: float = points[point, 0]
            left: float = points[point, 1]
            column = math.floor(x + cos * ahead - sin * left)
            row = math.floor(y + sin * ahead + cos * left)
            if not (0 <= column < width and 0 <= row < height):
                return True
            if occupied[row, column]:
                return True
    return False
