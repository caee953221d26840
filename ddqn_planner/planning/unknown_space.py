"""Explains why a plan has no path: unknown space, and what stops each goal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.grid.boxes import Box, wider
from ddqn_planner.grid.inflation import ROUNDING, with_unknown_free
from ddqn_planner.planning.paths import way_and_ends
from ddqn_planner.planning.plan import Explanation, Plan, PlanRequest, PlanStatus

REMEDY = "set allow_unknown, or map it"
# Why no path can end at a goal, in words.
OUTSIDE = "lies outside the map"
OCCUPIED = "is occupied"
IN_UNKNOWN_SPACE = "lies in unknown space"
NEAR_UNKNOWN_SPACE = "is nearer to unknown space than the robot's body allows"
TOUCHING_UNKNOWN_SPACE = "is so near to unknown space that the robot's body touches it"
# Those that have the remedy.
UNKNOWN_PLACES: Final = (
    IN_UNKNOWN_SPACE,
    NEAR_UNKNOWN_SPACE,
    TOUCHING_UNKNOWN_SPACE,
)
THROUGH_UNKNOWN_SPACE = "but a path leads through unknown space"
MAYBE_THROUGH_UNKNOWN_SPACE = "but a path may lead through unknown space"

MOST_NAMED = 5  # goals

# Of several goals, each may have a reason of its own.
DIFFERS_BY_GOAL: Final = (
    PlanStatus.GOAL_OUTSIDE_MAP,
    PlanStatus.GOAL_OCCUPIED,
    PlanStatus.NO_PATH,
)
# Unknown space may be the reason.
POSSIBLY_UNKNOWN: Final = (
    PlanStatus.START_OCCUPIED,
    PlanStatus.GOAL_OCCUPIED,
    PlanStatus.NO_PATH,
)


def has_more_to_say(grid: GridMap, plan: Plan, has_several_goals: bool) -> bool:
    """Return whether the reason why a plan has no path may say more than its status.

    It may name unknown space, or say what stops each of several goals.
    """
    if has_several_goals and plan.status in DIFFERS_BY_GOAL:
        return True
    return grid.unknown is not None and plan.status in POSSIBLY_UNKNOWN


def explanation_of(request: PlanRequest, plan: Plan) -> Explanation:
    """Return why a plan has no path, in words.

    These are the words of the plan's status. If unknown space may be the reason, they
    say that and what to do. For several goals, they say what stops each of them.
    """
    grid = request.grid
    status = plan.status.value
    if plan.status is PlanStatus.START_OCCUPIED:
        place = place_in_words(grid, request.start)
        if place:
            return Explanation(f"the start {place}", remedy=REMEDY)
        return Explanation(status)
    if len(request.goals) > 1:
        places = [goal_in_words(grid, goal) for goal in request.goals]
        free_goals = tuple(goal for goal in request.goals if grid.is_free(goal))
        through = ""
        if free_goals:
            request_of_free = replace(request, goals=free_goals)
            if _leads_through_unknown_space(request_of_free):
                through = THROUGH_UNKNOWN_SPACE
        return explanation_of_goals(places, through)
    if plan.status is PlanStatus.GOAL_OCCUPIED:
        place = place_in_words(grid, request.goals[0])
        if place:
            return Explanation(f"the goal {place}", remedy=REMEDY)
        if request.reach < 1:  # no other cell is within the tolerance
            return Explanation(status)
    if _leads_through_unknown_space(request):
        return Explanation(f"{status}, {THROUGH_UNKNOWN_SPACE}", remedy=REMEDY)
    return Explanation(status)


def _leads_through_unknown_space(request: PlanRequest) -> bool:
    """Return whether there is a path for a request if all unknown cells are free."""
    if request.grid.unknown is None:
        return False
    # A path must exist on each of these maps: the last one is decisive, and the first
    # one often shows sooner that there is none.
    for grid in _grids_without_unknown(request.grid):
        free_goals = {goal for goal in request.goals if grid.is_free(goal)}
        outcome = way_and_ends(replace(request, grid=grid), tuple(sorted(free_goals)))
        if isinstance(outcome, PlanStatus):  # the status says why there is no path
            return False
    return True


def goal_in_words(grid: GridMap, cell: Cell) -> str:
    """Return why no path can end in a cell; empty if it is free."""
    if not grid.contains(cell):
        return OUTSIDE
    if grid.is_free(cell):
        return ""
    return place_in_words(grid, cell) or OCCUPIED


def place_in_words(grid: GridMap, cell: Cell) -> str:
    """Return in words why unknown space closes a cell.

    The words are empty for a cell that is free, or is occupied for another reason.
    """
    if grid.unknown is None or not grid.contains(cell) or grid.is_free(cell):
        return ""
    x, y = cell
    if grid.unknown[y, x]:
        return IN_UNKNOWN_SPACE
    if grid.obstacles is None or grid.is_obstacle(cell) or grid.body_radius == 0:
        return ""
    # The cell is inflated: an obstacle or an unknown cell is within the body's radius.
    # If any of these is an obstacle, unknown space is not the reason.
    radius = grid.body_radius * (1 - ROUNDING) / grid.resolution  # cells
    box_of_cell = Box(slice(y, y + 1), slice(x, x + 1))
    box = wider(box_of_cell, int(radius) + 1, grid.occupancy.shape)
    is_obstacle = grid.obstacles[box] & ~grid.unknown[box]
    rows, columns = is_obstacle.nonzero()  # (M,) each, from the box's first cell
    dy = rows + box.rows.start - y  # from the cell to each obstacle
    dx = columns + box.columns.start - x
    if (np.hypot(dx, dy) < radius).any():
        return ""
    return NEAR_UNKNOWN_SPACE


def explanation_of_goals(places: Sequence[str], through: str) -> Explanation:
    """Return why no path leads to any of several goals, by their numbers from 1 on.

    Parameters
    ----------
    places : sequence of str
        Why no path can end at each goal, such as "is occupied"; empty for a goal that
        is free, to which no path leads.
    through : str
        The words for a path through unknown space; empty if there is no such path.
    """
    causes = []
    numbers_cut_off = []  # of the goals that are free
    for index in _goals_to_name(places):
        if places[index]:
            causes.append(f"goal {index + 1} {places[index]}")
        else:
            numbers_cut_off.append(str(index + 1))
    if numbers_cut_off:
        goals = "goals" if len(numbers_cut_off) > 1 else "goal"
        causes.append(f"no path leads to {goals} {', '.join(numbers_cut_off)}")
    if len(places) > MOST_NAMED:
        causes.append("...")
    if through:
        causes.append(through)
    is_unknown = bool(through) or any(place in UNKNOWN_PLACES for place in places)
    return Explanation(", ".join(causes), remedy=REMEDY if is_unknown else "")


def _goals_to_name(places: Sequence[str]) -> list[int]:
    """Return the indices of the `MOST_NAMED` goals, or fewer, that a reason names.

    `places` says why no path can end at each goal. Of too many goals, those for which
    unknown space is the reason are preferred, as there is a remedy for them.
    """
    indices = range(len(places))
    unknown_first = sorted(
        indices, key=lambda index: places[index] not in UNKNOWN_PLACES
    )
    return sorted(unknown_first[:MOST_NAMED])


def _grids_without_unknown(grid: GridMap) -> Iterator[GridMap]:
    """Yield one or two maps like `grid` whose unknown cells are free.

    Only for a robot with a radius there are two. On the first map only obstacles are
    occupied: it is quick to make, and often shows that there is no path. On the last
    map the cells are occupied, too, that are too near to obstacles for the body.
    """
    if grid.body_radius > 0 and grid.obstacles is not None and grid.unknown is not None:
        obstacles = grid.obstacles & ~grid.unknown
        yield grid.with_layers(
            occupancy=obstacles, obstacles=obstacles, cost=None, unknown=None
        )
    yield with_unknown_free(grid)
