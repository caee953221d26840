"""Paths of poses: what is left of one, whether a body has room along it, what it costs."""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.layers import multipliers_of
from ddqn_planner.grid.moves import ACTION_OF_STEP
from ddqn_planner.planning.plan import PlanStatus, PosePlan
from ddqn_planner.planning.pose_world import body_costs, occupied_for_body
from ddqn_planner.robot.footprint import inside, outline
from ddqn_planner.robot.motions import BEHIND, TURN, turn_between

Float64 = NDArray[np.float64]
Body = tuple[Float64, Float64]

REACH: Final = 5.0, math.pi / 4  # cells and radians that a robot may be beside its path
BETWEEN: Final = 0.25  # cells between two points of a body's outline
WITHIN: Final = 0.7  # and inside: so each cell there, turned as it may be, has a point
SAME: Final = 1 + 1e-6  # what is rounded in sums of float32 is less
AHEAD: Final = (
    0.9  # the cosine above which a robot drives ahead, not behind or sideways
)


class Way(NamedTuple):
    """A path of N poses."""

    poses: Float64  # (N, 3), in metres and radians
    cells: NDArray[np.int32]  # (N, 2)
    spent: Float64  # (N,) before each pose
    least: float  # a lower bound of what must be spent

    def plan(self, first: int, grid: GridMap) -> PosePlan:
        """Return the plan along the poses from one on."""
        poses, cells = self.poses[first:], self.cells[first:]
        poses.flags.writeable = False
        (x, y, _), (column, line) = poses.T, cells.T
        is_next = (column[1:] != column[:-1]) | (line[1:] != line[:-1])
        cost, least = (
            float(self.spent[-1] - self.spent[first]),
            self.least - self.spent[first],
        )
        bound = max(cost / least, 1.0) if least > 0 else math.inf
        return PosePlan(
            PlanStatus.SUCCEEDED,
            cells[np.append(True, is_next)],
            cost=cost * (grid.seconds_per_cell or 1.0),
            goal=(int(cells[-1, 0]), int(cells[-1, 1])),
            poses=poses,
            driven=float(np.hypot(np.diff(x), np.diff(y)).sum()) / grid.resolution,
            bound=float(bound) if cost > least * SAME else 1.0,
        )


def points_of(corners: Float64, resolution: float) -> Body:
    """Return points along the sides of a footprint, (M, 2), and inside it, in cells."""
    body = corners / resolution
    axes = (np.arange(axis.min(), axis.max(), WITHIN) for axis in body.T)
    filled = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    return outline(body, BETWEEN), filled[inside(filled, body)]


def in_cells(poses: Float64, grid: GridMap) -> Float64:
    """Return poses (N, 3) with x and y in cells from the centre of cell (0, 0), turned with it."""
    poses = np.reshape(poses, (-1, 3))
    cells = grid.in_cells(poses[:, :2]) - 0.5
    return np.column_stack([cells, poses[:, 2] - grid.origin[2]])


def nearest_pose(
    poses: Float64, robot: Any, grid: GridMap, reach: tuple[float, float]
) -> int:
    """Return which of some poses (N, 3) is nearest to a robot; -1 if none is within reach."""
    apart = np.hypot(poses[:, 0] - robot[0], poses[:, 1] - robot[1]) / grid.resolution
    near = np.flatnonzero(apart <= reach[0])
    turn = np.abs(turn_between(poses[near, 2], robot[2]))
    near, turn = near[turn <= reach[1]], turn[turn <= reach[1]]
    far = apart[near] / REACH[0] + turn / REACH[1]
    return int(near[far.argmin()]) if len(near) else -1


def is_free(poses: Float64, grid: GridMap, body: Body) -> bool:
    """Return whether a body has room along a path, and leaves no cell as it forbids."""
    path = in_cells(poses, grid)
    occupied, (outline, within) = occupied_for_body(grid).view(np.uint8), body
    cells = cells_of(path)
    if not ((cells >= 0) & (cells < occupied.shape[::-1])).all():
        return False  # an origin outside of the body leaves the map
    # What is inside the body at a later pose has come through its outline.
    if touches(path, outline, occupied) or touches(path[:1], within, occupied):
        return False
    if grid.forbidden is None:
        return True
    x, y = cells.T
    leaves = ACTION_OF_STEP[
        np.clip(np.diff(y), -1, 1) + 1, np.clip(np.diff(x), -1, 1) + 1
    ]
    return not (grid.forbidden[y[:-1], x[:-1]] >> leaves & 1).any()


def cells_of(path: Float64) -> NDArray[np.int32]:
    """Return the cells in which poses `in_cells` lie, (N, 2)."""
    return np.floor(path[:, :2] + 0.5).astype(np.int32)


def cost_of_poses(poses: Float64, grid: GridMap) -> float:
    """Return nearly what the primitives of a free path cost."""
    path = in_cells(poses, grid)
    steps = np.diff(path[:, :2], axis=0)
    length, turn = np.hypot(*steps.T), np.abs(turn_between(path[:-1, 2], path[1:, 2]))
    yaw = path[:-1, 2] + turn_between(path[:-1, 2], path[1:, 2]) / 2
    ahead = steps[:, 0] * np.cos(yaw) + steps[:, 1] * np.sin(yaw) > AHEAD * length
    spent = np.where(ahead, 1.0, BEHIND) * length
    spent[length < 1e-6] = (turn * TURN / grid.resolution)[length < 1e-6]
    x, y = cells_of(path[:-1]).T
    if (cost := body_costs(grid)) is not None:
        spent *= multipliers_of(cost[y, x])
    if grid.slowness is not None:
        spent *= grid.slowness[y, x]
    return float(spent.sum())


@in_place
def touches(path: Float64, points: Float64, occupied: NDArray[np.uint8]) -> bool:
    """Return whether points of a body touch an occupied cell at a pose, or leave the map."""
    for number in range(len(path)):
        x, y, yaw = path[number, 0] + 0.5, path[number, 1] + 0.5, path[number, 2]
        cos, sin = math.cos(yaw), math.sin(yaw)
        for point in range(len(points)):
            over, up = points[point, 0], points[point, 1]
            column = math.floor(x + cos * over - sin * up)
            line = math.floor(y + sin * over + cos * up)
            is_inside = (
                0 <= column < occupied.shape[1] and 0 <= line < occupied.shape[0]
            )
            if not is_inside or occupied[line, column]:
                return True
    return False
