"""Plans for a robot whose place is a cell: from a Q field, by greedy steps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.grid.arguments import Cells
from ddqn_planner.grid.map_changes import changed_cells
from ddqn_planner.model import QNetwork
from ddqn_planner.model.move_costs import MoveCosts
from ddqn_planner.planning import unknown_space
from ddqn_planner.planning.field import DistanceField, Goals, QField, network_field
from ddqn_planner.planning.field_cache import CACHE_BYTES, FieldCache
from ddqn_planner.planning.path_finder import (
    Clock,
    PathFinder,
    PausingGenerator,
    last_step,
)
from ddqn_planner.planning.paths import (
    keep_or_switch,
    rest_of_path,
    search,
    way_and_ends,
)
from ddqn_planner.planning.plan import (
    Explanation,
    Plan,
    PlanMethod,
    PlanRequest,
    PlanStatus,
)
from ddqn_planner.planning.segments import Path, cost_along, straightened

VISITS = 2**18  # about how many cells a field visits in one step of a plan: some 30 ms


@dataclass
class _Task:
    """A request, and what the attempts to answer it have shown up to now."""

    request: PlanRequest
    clock: Clock
    goals: Goals
    """The free goals of the request, or those that a path can reach, once known."""
    costs: MoveCosts | None = None
    """The costs of the map's moves, once they are known."""
    failure: PlanStatus | None = None
    """Why the greedy steps of the last rollout found no path."""
    escape_path: tuple[Cell, ...] = ()
    """From the start to its first free cell: the start alone if that is free."""
    field: QField | None = None
    """The field toward the goals that the escape path's end can reach."""


class CellPlanner(PathFinder[PlanRequest, Plan]):
    """Finds paths of cells with a Q-network.

    Parameters
    ----------
    network : QNetwork
    """

    def __init__(self, network: QNetwork) -> None:
        self.network = network
        self.fields = FieldCache[QField](CACHE_BYTES, changed_cells)

    def field(
        self,
        grid: GridMap,
        goals: Goals,
        rule: MoveRule,
        start: Cell | None = None,
        costs: MoveCosts | None = None,
    ) -> QField:
        """Return the field of a map toward the nearest of some goals.

        It is kept, repaired or new, see `FieldCache.get`.

        Parameters
        ----------
        grid : GridMap
        goals : tuple of (x, y)
            Free cells; only one if the network gives no costs of moves.
        rule : MoveRule
        start : (x, y), optional
            From where the field is needed; None for all of it.
        costs : MoveCosts, optional
            What `move_costs` returned for the map, if that was asked before.
        """

        def new_field() -> QField:
            costs_of_moves = costs or self.move_costs(grid, rule)
            if costs_of_moves is None:
                return network_field(self.network, grid, goals[0], rule)
            return DistanceField(goals, grid, costs_of_moves, rule)

        return self.fields.get((goals, rule), grid, new_field, start)

    def move_costs(self, grid: GridMap, rule: MoveRule) -> MoveCosts | None:
        """Return the costs of a map's moves; None if the network gives none.

        They are taken from a kept field on a map of the same cells; or from one on a
        map of which this map is a patched copy, and read anew in the patches. Without
        such a field, the network reads all of the map.
        """
        for field in reversed(self.fields.kept):
            if not isinstance(field, DistanceField) or field.move_rule is not rule:
                continue
            if grid.same_cells(field.grid):
                return field.costs
            boxes = grid.patches_since(field.grid)  # where the maps differ, or None
            if boxes is not None:
                costs = field.costs.on_changed_map(grid, boxes)
                if costs is not None:
                    return costs
        return self.network.move_costs(grid, rule)

    def rest_of_path(self, request: PlanRequest) -> Path:
        """Return the rest of the path under way, (N, 2)."""
        return rest_of_path(
            request.under_way, request.start, request.grid, request.move_rule
        )

    def _explanation(
        self, request: PlanRequest, plan: Plan
    ) -> PausingGenerator[Explanation]:
        """Return why there is no path, in words."""
        yield from ()  # it never pauses, but must be a generator
        return unknown_space.explanation_of(request, plan)

    def expected(self, plan: Plan, request: PlanRequest) -> Plan:
        """Return a plan with the cost of its path on the map of a request."""
        cost = _cost(plan.path, request.grid, request.move_rule)
        return replace(plan, cost=cost)

    def _find_on_map(
        self, request: PlanRequest, clock: Clock
    ) -> PausingGenerator[Plan]:
        """Return the plan on a map without an exploration.

        Attempts to find it are made one after another, until one returns a plan.
        """
        grid = request.grid
        free_goals = {goal for goal in request.goals if grid.is_free(goal)}
        goals = tuple(sorted(free_goals))
        status = self._refusal(request, goals)
        if status is not None:
            return Plan(status, move_rule=request.move_rule)
        task = _Task(request, clock, goals)
        plan = self._from_known_field(task)
        if plan is not None:
            return plan
        for attempt in (self._from_grown_field, self._by_escape, self._by_search):
            plan = yield from attempt(task)
            if plan is not None:
                return plan
        assert task.failure is not None
        return Plan(
            task.failure,
            move_rule=request.move_rule,
            goal=task.goals[0],
            field_ms=clock.field_ms,
        )

    def _refusal(self, request: PlanRequest, free_goals: Goals) -> PlanStatus | None:
        """Return why there is no path if start and goals alone tell that, else None.

        `free_goals` are the goals of the request that are free cells.
        """
        grid = request.grid
        if not grid.contains(request.start):
            return PlanStatus.START_OUTSIDE_MAP
        if not free_goals and not any(map(grid.contains, request.goals)):
            return PlanStatus.GOAL_OUTSIDE_MAP
        if grid.is_obstacle(request.start) and request.start_clearing_radius == 0:
            return PlanStatus.START_OCCUPIED
        if not free_goals and request.reach < 1:
            return PlanStatus.GOAL_OCCUPIED
        if not self.network.supports((grid.height, grid.width)):
            return PlanStatus.MAP_SIZE_UNSUPPORTED
        return None

    def _from_known_field(self, task: _Task) -> Plan | None:
        """Return the plan by a kept field that is known as far as the start.

        Return None if the start is occupied, if there is no such field, or if its
        greedy steps find no path: then `task.failure` tells why.
        """
        request = task.request
        if not request.grid.is_free(request.start):
            return None
        field = self.fields.find((task.goals, request.move_rule), request.grid)
        if field is None or not field.is_known(request.start):
            return None
        return _roll_out(task, field)

    def _from_grown_field(self, task: _Task) -> PausingGenerator[Plan | None]:
        """Return the plan by a field that is grown as far as the start.

        Return None where another attempt has to find the path: if the start or all
        goals are occupied, if the greedy steps of the field find no path (then
        `task.failure` is set), or if the network gives no costs of moves. With costs,
        `task.costs` is set. Without them, fields have one goal: of several goals only
        the nearest stays in `task.goals`.
        """
        if task.failure is not None:  # by a kept field, which is as good
            return None
        yield  # a pause: a slow step follows
        request = task.request
        grid = request.grid
        task.costs = self.move_costs(grid, request.move_rule)
        if task.costs is None:
            if len(task.goals) > 1:
                task.goals = self._nearest_alone(request, task.goals)
            return None
        is_start_free = grid.is_free(request.start)
        if not is_start_free or not task.goals:  # the task has free goals alone
            return None
        field = self.field(
            grid, task.goals, request.move_rule, request.start, task.costs
        )
        if isinstance(field, DistanceField):
            while not field.grow(request.start, VISITS):
                yield  # a pause: a slow step follows
        return _roll_out(task, field)

    def _by_escape(self, task: _Task) -> PausingGenerator[Plan | None]:
        """Return the plan by an escape path to the first free cell, and a rollout.

        The escape path and the goals that a path can reach, found on the whole map, are
        set in the task, and so is the field toward these goals. If there are none, the
        plan says why. Return None if greedy steps from that cell find no path.
        """
        request = task.request
        if task.failure is not None and request.reach >= 1:
            yield  # a pause: a slow step follows
        outcome = way_and_ends(request, task.goals)
        if isinstance(outcome, PlanStatus):  # there is no path
            return Plan(outcome, move_rule=request.move_rule)
        task.escape_path, task.goals = outcome
        task.field = self.field(
            request.grid,
            task.goals,
            request.move_rule,
            task.escape_path[-1],
            task.costs,
        )
        return _roll_out(task, task.field)

    def _by_search(self, task: _Task) -> PausingGenerator[Plan | None]:
        """Return the plan by a search in the order of the task's Q field.

        Return None if the request wants greedy steps alone. The search leads from the
        end of the escape path to the field's goal.
        """
        request = task.request
        if request.method is not PlanMethod.ASTAR_FALLBACK or task.field is None:
            return None
        yield  # a pause: a slow step follows
        task.clock.end_field()
        cells = search(
            task.escape_path[-1],
            task.field.goal,
            request.grid,
            request.move_rule,
            task.field.value,
        )
        return _finished(task, np.array(cells), PlanMethod.ASTAR_FALLBACK)

    def _nearest_alone(self, request: PlanRequest, goals: Goals) -> Goals:
        """Return the one of several goals to which a plan is cheapest, as a tuple of 1.

        A path to each of them is planned. Without a path to any, return the first goal.
        """
        plans = []
        for goal in goals:
            request_of_goal = replace(request, goals=(goal,), under_way=())
            plan = last_step(self.steps(request_of_goal))
            if plan.path.size:
                plans.append(plan)
        if not plans:
            return goals[:1]
        cheapest = min(plans, key=lambda plan: plan.cost or plan.length)
        return cheapest.cells[-1:]


def _roll_out(task: _Task, field: QField) -> Plan | None:
    """Return the plan by greedy steps in a field.

    The steps begin at the end of the task's escape path, or at the start without one.
    If they find no path, but another attempt may find one, set `failure` of the task
    and return None.
    """
    request = task.request
    task.clock.end_field()  # the time from here on is that of the rollout
    start = task.escape_path[-1] if task.escape_path else request.start
    outcome = field.greedy_path(start, request.simplified)
    if not isinstance(outcome, PlanStatus) and request.grid.turn_cost > 0:
        outcome = _path_with_turns(outcome, field, request)
    if not isinstance(outcome, PlanStatus):
        return _finished(task, outcome, PlanMethod.GREEDY)
    # The field has looked at the whole map: no path leads from a free start to these
    # goals. With a tolerance, a path to another goal may do.
    is_cut_off = outcome is PlanStatus.NO_PATH and request.reach < 1
    if is_cut_off and not task.escape_path:
        return Plan(outcome, move_rule=request.move_rule, field_ms=task.clock.field_ms)
    task.failure = outcome
    return None


def _path_with_turns(path: Path, field: QField, request: PlanRequest) -> Path:
    """Return the path that costs less with its turns: greedy, or of few turns.

    The search for few turns knows only the turns between moves to adjacent cells. Made
    straight, a path among small obstacles may turn less although its cells turn more.

    Parameters
    ----------
    path : (N, 2)
        The greedy path.
    field : QField
    request : PlanRequest
        Its map has a cost of turning.
    """
    grid = request.grid
    rule = request.move_rule
    start_x, start_y = path[0].tolist()
    path_of_few_turns = field.path_of_few_turns((start_x, start_y), grid.turn_cost)
    if path_of_few_turns is None:
        return path
    if not request.simplified:
        return path_of_few_turns
    straight_path = straightened(path, grid, rule)
    straight_path_of_few_turns = straightened(path_of_few_turns, grid, rule)
    cost = cost_along(straight_path, grid, rule)
    cost_of_few_turns = cost_along(straight_path_of_few_turns, grid, rule)
    return path if cost < cost_of_few_turns else path_of_few_turns


def _finished(task: _Task, path: Path, method: PlanMethod) -> Plan:
    """Return the plan of a path (N, 2) from the first free cell to a goal.

    If the request says so, the path is made straight. If the rest of the path under way
    hardly costs more, the rest takes its place. Last, the task's escape path is put
    before it. `method` is how the path was found.
    """
    request = task.request
    grid = request.grid
    rule = request.move_rule
    extra_cost = None  # the share by which the rest of a path under way costs more
    if request.simplified:
        path = straightened(path, grid, rule)
    if len(request.under_way):
        path, extra_cost = keep_or_switch(request, path)
    goal = (int(path[-1, 0]), int(path[-1, 1]))
    if len(task.escape_path) > 1:
        path = np.concatenate([task.escape_path[:-1], path], dtype=np.int32)
        # The path is still the rest of the path under way only if the escape path
        # belongs to that, too.
        under_way = np.asarray(request.under_way)
        if not np.array_equal(path, under_way[-len(path) :]):
            extra_cost = None
    return Plan(
        PlanStatus.SUCCEEDED,
        path,
        method,
        rule,
        cost=_cost(path, grid, rule) if grid.has_costs else None,
        goal=goal,
        extra_cost=extra_cost,
        field_ms=task.clock.field_ms,
        rollout_ms=task.clock.rollout_ms,
    )


def _cost(path: Cells, grid: GridMap, rule: MoveRule) -> float:
    """Return the cost of a path (N, 2), in seconds on a map of expected times."""
    return cost_along(path, grid, rule) * (grid.seconds_per_cell or 1.0)
