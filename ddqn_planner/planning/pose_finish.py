"""The finish of a body's path: straight lines and curves from the exact start to goal.

A path of primitives begins and ends in the centres of cells, in one of 16 headings, and
bends more often than it must. Between poses of such a path, the finish tries the curves
of `pose_curves`. Curves with cusps between them are those of Reeds and Shepp (1990); an
omnidirectional robot also drives lines in a held heading.
The best chain of free curves and of stretches of the path is that of `pose_chain`.
"""

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import GridMap
from ddqn_planner.planning.pose_chain import (
    FROM_START,
    NODE_SPACING,
    NODES_OF_END,
    PLANNED,
    TO_GOAL,
    Chain,
    Limits,
    Track,
    best_chain,
    lengths_of,
)
from ddqn_planner.planning.pose_curves import (
    DUBINS_WORDS,
    LENGTH_OF_PIECE,
    MARGIN,
    PLACES,
    SAME_END,
    SLIDE_AFTER_TURN,
    SLIDE_BEFORE_TURN,
    SPIN_AHEAD,
    SPIN_BEHIND,
    STEP,
    YAWS,
    Course,
    Int64,
    cost_of_curve,
    count_free,
    write_costs,
    write_masks,
)
from ddqn_planner.planning.pose_joints import (
    chain_between,
    with_exact_goal,
    with_exact_start,
)
from ddqn_planner.planning.pose_paths import (
    BodyPoints,
    Float64,
    PosePath,
    cells_of,
    in_cells,
    is_free,
    touches,
)
from ddqn_planner.planning.pose_world import BORDER, World
from ddqn_planner.robot.directions import cusps_before, directions_of_travel
from ddqn_planner.robot.driving_costs import Rates, least_radius_of
from ddqn_planner.robot.motions import Motions, turn_between

# What a curve may cost, as a share of what it replaces, if the whole path costs no more
# than before; and else.
SLACKS: Final = (1.05, 1.0)
# Cells that an exact end may cost more than the end in the centre of a cell.
END_COST: Final = 3.0
# Besides, an exact goal may cost so many cusps, and the radius of the sharpest bend.
CUSPS_OF_JOINT: Final = 2
MAX_FAR: Final = BORDER - 8.0  # cells: masks of a larger body do not fit in the border


class Finish:
    """Finishes the paths of a robot.

    Parameters
    ----------
    motions : Motions
    rates : Rates
        What these motions cost, see `rates_of`.
    footprint : (K, 2)
        The corners of the body, in metres.
    points : BodyPoints
        Of the same body, in cells.
    """

    def __init__(
        self, motions: Motions, rates: Rates, footprint: Float64, points: BodyPoints
    ) -> None:
        self._points = points
        self._corners = np.ascontiguousarray(footprint / motions.resolution)
        self._far = float(np.hypot(*self._corners.T).max())
        self._rates = rates
        self._radius = least_radius_of(motions)
        self._words = words_of(self._rates)
        self._mask = np.empty((0, 0, 0), np.uint64)

    def course(self, world: World) -> Course:
        """Return the robot on a map for one request, with buffers of its own."""
        if not self._mask.size:
            self._mask = self._masks()
        cells_free = world.body.reach - self._far - 1 - MARGIN
        corners = len(self._corners)
        return Course(
            self._corners,
            self._mask,
            self._far,
            self._radius,
            self._words,
            self._rates,
            steps_when_far=max(int(cells_free / STEP), 0),
            world=world,
            placed=np.empty((corners, 2)),
            pieces=np.empty((3, 3)),
        )

    def _masks(self) -> NDArray[np.uint64]:
        """Return the masks of the body at rounded poses, see `Course.mask`."""
        # So far is a point of the body from where the rounded pose has it, at most.
        rounded = math.sqrt(0.5) / PLACES + self._far * math.pi / YAWS
        reach = math.ceil(self._far + rounded + MARGIN) + 1
        side = 2 * reach + 1
        mask = np.zeros((YAWS * PLACES**2, side, math.ceil(side / 64)), np.uint64)
        placed = np.empty_like(self._corners)
        write_masks(self._corners, placed, 0.5 + rounded + MARGIN, mask)
        return mask

    def finished(
        self,
        path: PosePath,
        start: Any,
        goal: Any,
        grid: GridMap,
        world: World,
        may_turn_back: bool = True,
    ) -> PosePath:
        """Return a path with exact ends that costs no more than a path of primitives.

        Parameters
        ----------
        path : PosePath
        start, goal : (x, y, yaw)
            In metres and radians, in the map's frame. If the body has no room there, or
            no curve leads there at little cost, an end of the path stays.
        grid : GridMap
        world : World
            The body on it.
        may_turn_back : bool
            Whether joints may lead from the start and to the goal, see `pose_joints`.
        """
        if len(path.poses) == 1 and may_turn_back:
            return self._in_one_cell(path, start, goal, grid, world)
        if len(path.poses) < 2 or not len(self._words) or self._far > MAX_FAR:
            return path
        course = self.course(world)
        tracks = self._tracks(path, start, goal, grid, course)
        costs = path.costs - path.costs[0]
        length = float(lengths_of(tracks[PLANNED].poses)[-1])
        cost_of_cell = float(costs[-1]) / max(length, 1.0)
        chain = self._chain(tracks, costs, cost_of_cell, course)
        if chain is None:
            return path
        if may_turn_back:
            chain = self._with_joints(chain, tracks, cost_of_cell, course)
        return _path_of(chain, path, np.array([start, goal], np.float64), grid)

    def joined(
        self, path: PosePath, start: Any, grid: GridMap, world: World
    ) -> PosePath:
        """Return a path that begins exactly at a start near its first pose, with room.

        Only the first part of the path changes. For the rest, see `finished`.
        """
        if np.abs(path.poses[0] - start).max() < SAME_END:
            return path
        lengths = lengths_of(in_cells(path.poses, grid))
        count = int(np.searchsorted(lengths[:-1], NODES_OF_END * NODE_SPACING)) + 1
        head = path.part(0, count)
        joint = head.poses[-1]
        new_head = self.finished(head, start, joint, grid, world, may_turn_back=False)
        if new_head is head:
            return path
        rest = path.part(count - 1, len(path.poses))
        more_cusps = new_head.cusps_to(rest) - head.cusps_to(rest)
        return new_head.followed_by(rest, more_cusps * self._rates.cusp)

    def finished_after(
        self, escape: int, path: PosePath, goal: Any, grid: GridMap, world: World
    ) -> PosePath:
        """Return a path that is finished from pose number `escape` on.

        For the rest, see `finished`.
        """
        head = path.part(0, escape + 1)
        rest = path.part(escape, len(path.poses))
        new_rest = self.finished(rest, rest.poses[0], goal, grid, world)
        # If it is the same cusp as before, it counts twice.
        extra_cost = head.cusps_to(new_rest) * self._rates.cusp
        return head.followed_by(new_rest, extra_cost)._replace(escape=escape)

    def _tracks(
        self, path: PosePath, start: Any, goal: Any, grid: GridMap, course: Course
    ) -> list[Track]:
        """Return a planned path, and this moved to an exact start and goal."""
        poses = in_cells(path.poses, grid)  # (N, 3)
        poses[:, 2] = np.unwrap(poses[:, 2])
        ends = in_cells(np.array([start, goal], np.float64), grid)  # (2, 3)
        ends[:, 2] = poses[[0, -1], 2] + turn_between(poses[[0, -1], 2], ends[:, 2])
        cusps = cusps_before(directions_of_travel(poses))
        costs = path.costs - path.costs[0] - self._rates.cusp * cusps
        planned = Track(poses, costs)
        from_start = self._moved(planned, 0, ends[0], grid, course)
        to_goal = self._moved(planned, len(poses) - 1, ends[1], grid, course)
        return [planned, from_start, to_goal]

    def _moved(
        self,
        planned: Track,
        number: int,
        end: Float64,
        grid: GridMap,
        course: Course,
    ) -> Track:
        """Return the path moved so that pose `number`, its first or last, is an end."""
        poses = _moved_poses(planned.poses, number, end)
        costs = np.full(len(poses), np.inf)
        is_same = np.abs(planned.poses[number] - end).max() < SAME_END
        occupied = grid.uninflated.view(np.uint8)
        if is_same or touches(end[None], self._points.inside, occupied):
            return Track(poses, costs)
        if number == 0:
            write_costs(poses, count_free(poses, course), course, costs)
            return Track(poses, costs)
        # From the goal on, against the drive: the costs that remain.
        first = len(poses) - count_free(np.ascontiguousarray(poses[::-1]), course)
        write_costs(poses[first:], len(poses) - first, course, costs[first:])
        return Track(poses, costs)

    def _with_joints(
        self, chain: Chain, tracks: list[Track], cost_of_cell: float, course: Course
    ) -> Chain:
        """Return a chain with joints to its exact ends, where it lacks them.

        At the start, a joint costs no more than another exact end: a robot that asks
        for a path while it drives is not told to turn back for some centimetres.
        """
        _, from_start, to_goal = tracks
        if chain.first_track != FROM_START and math.isfinite(from_start.costs[0]):
            start = from_start.poses[0]
            chain = with_exact_start(chain, start, END_COST * cost_of_cell, course)
        if chain.last_track != TO_GOAL and math.isfinite(to_goal.costs[-1]):
            goal = to_goal.poses[-1]
            joint_cost = self.cost_of_joint(cost_of_cell)
            chain = with_exact_goal(chain, goal, joint_cost, course)
        return chain

    def cost_of_joint(self, cost_of_cell: float) -> float:
        """Return what a joint to an exact goal may cost where cells cost so much."""
        rates = self._rates
        cells = END_COST
        if math.isfinite(self._radius):
            cells += self._radius
        if math.isfinite(rates.spin):
            cells += 2 * math.pi * rates.spin
        # Else a car that cannot reverse would drive a circle to move aside.
        has_cusps = math.isfinite(rates.behind + rates.bend_behind)
        cusps = CUSPS_OF_JOINT if has_cusps else 0
        return cells * cost_of_cell + cusps * rates.cusp

    def _in_one_cell(
        self, path: PosePath, start: Any, goal: Any, grid: GridMap, world: World
    ) -> PosePath:
        """Return a path from a start to a goal in one cell and one heading.

        `path` is one pose in the middle of the cell. It stays if the body has no room
        at an end, or if no joint leads from end to end.
        """
        exact_ends = np.array([start, goal], np.float64)
        ends = in_cells(exact_ends, grid)  # (2, 3)
        ends[1, 2] = ends[0, 2] + turn_between(ends[0, 2], ends[1, 2])
        if np.abs(ends[1] - ends[0]).max() < SAME_END:
            is_room = is_free(exact_ends[:1], grid, self._points)
            return path._replace(poses=exact_ends[:1]) if is_room else path
        if not len(self._words) or self._far > MAX_FAR:
            return path
        course = self.course(world)
        is_inside_free = not touches(
            ends, self._points.inside, grid.uninflated.view(np.uint8)
        )
        if not is_inside_free or not all(count_free(end[None], course) for end in ends):
            return path
        most_cost = self.cost_of_joint(_cost_of_cell_ahead(ends[0], course))
        chain = chain_between(ends[0], ends[1], most_cost, course)
        if chain is None:
            return path
        dx, dy, turn = ends[1] - ends[0]
        # Each cell costs 1 or more, and so does each cell of a bend.
        cost_of_turn = min(self._radius / 1.001, self._rates.spin)
        least_cost = max(math.hypot(dx, dy), abs(turn) * cost_of_turn)
        chain = chain._replace(planned_costs=chain.costs)
        path = path._replace(least_costs=np.array([least_cost]))
        return _path_of(chain, path, exact_ends, grid)

    def _chain(
        self,
        tracks: list[Track],
        costs: Float64,
        cost_of_cell: float,
        course: Course,
    ) -> Chain | None:
        """Return the best chain that costs no more than the path; None without one.

        `costs` (N,) are those of the path up to each pose, with cusps, and
        `cost_of_cell` is their mean.
        """
        cost = float(costs[-1])
        end_cost = END_COST * cost_of_cell
        for slack in SLACKS:
            chain = best_chain(tracks, costs, Limits(slack, end_cost), course)
            exact_ends = int(chain.first_track == FROM_START) + int(
                chain.last_track == TO_GOAL
            )
            most_cost = cost * (1 + SAME_END) + exact_ends * end_cost
            if chain.cost <= most_cost:
                return chain
        # An exact goal may cost as much as by a joint.
        most_cost += self.cost_of_joint(cost_of_cell) - end_cost
        if chain.last_track == TO_GOAL and chain.cost <= most_cost:
            return chain
        chain = best_chain(tracks[:1], costs, Limits(1.0, end_cost), course)
        return chain if chain.cost <= cost * (1 + SAME_END) else None


def _cost_of_cell_ahead(pose: Float64, course: Course) -> float:
    """Return what a line of one cell costs from a pose (3,) on."""
    course.pieces[:] = 0
    course.pieces[0, LENGTH_OF_PIECE] = 1
    cost: float = cost_of_curve(pose, course)
    return cost


def words_of(rates: Rates) -> Int64:
    """Return the words that a robot can drive; none if it cannot drive ahead."""
    words: list[int] = []
    if math.isfinite(rates.ahead + rates.bend_ahead):
        words += range(DUBINS_WORDS)
    if math.isfinite(rates.behind + rates.bend_behind):
        words += range(DUBINS_WORDS, 2 * DUBINS_WORDS)
    if math.isfinite(rates.ahead + rates.spin):
        words.append(SPIN_AHEAD)
    if math.isfinite(rates.behind + rates.spin):
        words.append(SPIN_BEHIND)
    if len(rates.slide):
        words += [SLIDE_BEFORE_TURN, SLIDE_AFTER_TURN]
    return np.array(words if math.isfinite(rates.ahead) else [], np.int64)


def _moved_poses(poses: Float64, number: int, end: Float64) -> Float64:
    """Return poses (N, 3) turned and moved together, so that one becomes `end`."""
    x, y, yaw = poses[number]
    turn = end[2] - yaw
    cos = math.cos(turn)
    sin = math.sin(turn)
    dx = poses[:, 0] - x
    dy = poses[:, 1] - y
    moved_x = end[0] + cos * dx - sin * dy
    moved_y = end[1] + sin * dx + cos * dy
    moved = np.column_stack([moved_x, moved_y, poses[:, 2] + turn])
    moved[number] = end
    return moved


def _path_of(
    chain: Chain, path: PosePath, exact_ends: Float64, grid: GridMap
) -> PosePath:
    """Return a chain as a path in the place of the planned path.

    `exact_ends` (2, 3) are the start and the goal in the map's frame.
    """
    yaw = chain.poses[:, 2] + grid.origin[2]
    poses = np.column_stack([grid.centres(chain.poses[:, :2]), yaw])
    # The ends themselves, without the rounding of their way to cells and back.
    if chain.first_track == FROM_START:
        poses[0] = exact_ends[0]
    if chain.last_track == TO_GOAL:
        poses[-1] = exact_ends[1]
    poses[:, 2] = turn_between(0, poses[:, 2])
    return PosePath(
        poses=poses,
        cells=cells_of(chain.poses),
        costs=chain.costs,
        least_costs=path.least_costs[0] - chain.planned_costs,
    )
