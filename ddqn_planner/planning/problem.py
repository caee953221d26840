"""A request for a path with all that it is planned with, and what becomes of it."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.planning.plan import Plan, PlanMethod, PlanStatus
from ddqn_planner.planning.planner import Planner, Route
from ddqn_planner.planning.q_field import QField
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
    field_ms, rollout_ms : float
        How long it took to get the field, and to walk in it.
    route : Route, optional
    field : QField, optional
        Both, unless there is no path for a reason that needs no field.
    """

    plan: Plan
    goal: Cell | None = None
    cells: tuple[Cell, ...] = ()
    field_ms: float = 0.0
    rollout_ms: float = 0.0
    route: Route | None = None
    field: QField | None = None


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
    cells = _shown_cells(problem, plan)
    ended = time.perf_counter()
    times = 1e3 * (field_at_hand - began), 1e3 * (ended - field_at_hand)
    return Solution(plan, route.goal, cells, *times, route, field)


def search_on(problem: Problem, trapped: Solution) -> Solution:
    """Search where the greedy steps of a solution were trapped, in any thread.

    Parameters
    ----------
    problem : Problem
    trapped : Solution
        Its plan's status is ROLLOUT_TRAPPED. Its route and its field are used again.
    """
    assert trapped.route is not None
    assert trapped.field is not None
    began = time.perf_counter()
    plan = problem.planner.search(trapped.route, problem.grid, trapped.field, problem.move_rule)
    cells = _shown_cells(problem, plan)
    rollout_ms = trapped.rollout_ms + 1e3 * (time.perf_counter() - began)
    return replace(trapped, plan=plan, cells=cells, rollout_ms=rollout_ms)


def _shown_cells(problem: Problem, plan: Plan) -> tuple[Cell, ...]:
    if not problem.simplified:
        return plan.cells
    return simplify(plan.cells, problem.grid, problem.move_rule)
