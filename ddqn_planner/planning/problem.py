"""A request for a path with all that it is planned with, and what becomes of it."""

from __future__ import annotations

import time
from dataclasses import dataclass

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.planning.plan import Plan, PlanMethod, PlanStatus
from ddqn_planner.planning.planner import Planner
from ddqn_planner.planning.simplification import simplify


@dataclass(frozen=True)
class Problem:
    """What a path is planned with, all of it: so it may wait, whatever changes meanwhile.

    Parameters
    ----------
    planner : Planner
    grid : GridMap
    start, goal : (x, y)
    move_rule : MoveRule
    method : PlanMethod
    tolerance : float
        In cells.
    simplified : bool
        Whether cells are left out; see `simplify`.
    """

    planner: Planner
    grid: GridMap
    start: Cell
    goal: Cell
    move_rule: MoveRule
    method: PlanMethod
    tolerance: float
    simplified: bool


@dataclass(frozen=True)
class Solution:
    """What became of a problem.

    Parameters
    ----------
    plan : Plan
    goal : (x, y), optional
        Where the path ends, or would: there is a field toward it.
    cells : tuple of (x, y)
        The path, simplified if asked for.
    field_ms, walk_ms : float
        How long it took to get the field, and to walk in it.
    """

    plan: Plan
    goal: Cell | None = None
    cells: tuple[Cell, ...] = ()
    field_ms: float = 0.0
    walk_ms: float = 0.0


def solve(problem: Problem) -> Solution:
    """Plan a path, in any thread, and note the times."""
    planner, grid, rule = problem.planner, problem.grid, problem.move_rule
    began = time.perf_counter()
    route = planner.route(grid, problem.start, problem.goal, rule, problem.tolerance)
    if route.status is not PlanStatus.SUCCEEDED:
        return Solution(Plan(route.status), field_ms=1e3 * (time.perf_counter() - began))
    field = planner.q_field(grid, route.goal, rule)
    field_at_hand = time.perf_counter()
    plan = planner.follow(route, grid, field, problem.method, rule)
    cells = simplify(plan.cells, grid, rule) if problem.simplified else plan.cells
    ended = time.perf_counter()
    times = 1e3 * (field_at_hand - began), 1e3 * (ended - field_at_hand)
    return Solution(plan, route.goal, cells, *times)
