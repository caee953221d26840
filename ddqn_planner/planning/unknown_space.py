"""Names unknown space where it is the reason that a plan has no path."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.grid.body import ROUNDING, with_unknown_free
from ddqn_planner.grid.copies import wider
from ddqn_planner.planning.paths import way_and_ends
from ddqn_planner.planning.plan import Plan, PlanRequest, PlanStatus

REMEDY = "set allow_unknown, or map it"
IN_UNKNOWN_SPACE = "lies in unknown space"
THROUGH_UNKNOWN_SPACE = "but a path leads through unknown space"
MAYBE_THROUGH_UNKNOWN_SPACE = "but a path may lead through unknown space"

MOST_NAMED = 5  # goals


def may_be_the_reason(grid: GridMap, plan: Plan) -> bool:
    """Return whether to look if unknown space is the reason that there is no path."""
    possible = PlanStatus.START_OCCUPIED, PlanStatus.GOAL_OCCUPIED, PlanStatus.NO_PATH
    return grid.unknown is not None and plan.status in possible


def reason_of(request: PlanRequest, plan: Plan) -> str:
    """Return why a plan has no path: the status in words, or unknown space and what to do."""
    grid = request.grid
    status: str = plan.status.value
    if plan.status is PlanStatus.START_OCCUPIED:
        place = place_in_words(grid, request.start)
        return f"the start {place}; {REMEDY}" if place else status
    if plan.status is PlanStatus.GOAL_OCCUPIED:
        places = [place_in_words(grid, goal) for goal in request.goals]
        if any(places):
            return f"{goals_in_words(places)}; {REMEDY}"
        if request.reach < 1:
            return status
    for possible in _grids_without_unknown(grid):
        goals = tuple(sorted({goal for goal in request.goals if possible.is_free(goal)}))
        found = way_and_ends(replace(request, grid=possible), goals)
        if isinstance(found, PlanStatus):
            return status
    return f"{status}, {THROUGH_UNKNOWN_SPACE}; {REMEDY}"


def place_in_words(grid: GridMap, cell: Cell) -> str:
    """Return how a cell lies that unknown space closes; empty if it is free or an obstacle is."""
    if grid.unknown is None or not grid.contains(cell) or grid.is_free(cell):
        return ""
    x, y = cell
    if grid.unknown[y, x]:
        return IN_UNKNOWN_SPACE
    if grid.obstacles is None or grid.is_obstacle(cell) or grid.body_radius == 0:
        return ""
    cells = grid.body_radius * (1 - ROUNDING) / grid.resolution
    rows, columns = wider((slice(y, y + 1), slice(x, x + 1)), int(cells) + 1, grid.occupancy.shape)
    obstacles = grid.obstacles[rows, columns] & ~grid.unknown[rows, columns]
    for row, column in zip(*obstacles.nonzero(), strict=True):
        if math.hypot(row + rows.start - y, column + columns.start - x) < cells:
            return ""
    return "is nearer to unknown space than the robot's body allows"


def goals_in_words(places: Sequence[str]) -> str:
    """Return how the goals lie of which something is known, by their numbers if there are more."""
    if len(places) == 1:
        return f"the goal {places[0]}"
    named = [f"goal {number} {place}" for number, place in enumerate(places, 1) if place]
    more = ", ..." if len(named) > MOST_NAMED else ""
    return ", ".join(named[:MOST_NAMED]) + more


def _grids_without_unknown(grid: GridMap) -> Iterator[GridMap]:
    """Yield maps with free unknown cells: what is possible at most, and what is true."""
    if grid.body_radius > 0 and grid.obstacles is not None and grid.unknown is not None:
        # To look only at obstacles is quick, and often shows that there is no path either.
        obstacles = grid.obstacles & ~grid.unknown
        yield grid.with_layers(occupancy=obstacles, obstacles=obstacles, cost=None, unknown=None)
    yield with_unknown_free(grid)
