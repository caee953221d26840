"""The planner: one network, one Q field per goal, one rollout per start."""

from __future__ import annotations

import math
import time
from collections.abc import Generator, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ddqn_planner.grid import Cell, GridMap, MoveRule, path_cost
from ddqn_planner.grid.arguments import as_cell, as_flag, listed, real
from ddqn_planner.grid.grid_map import check_grid
from ddqn_planner.model import ModelMetadata, QNetwork, load_model
from ddqn_planner.planning.field import DistanceField, Goals, QField
from ddqn_planner.planning.field_cache import FieldCache
from ddqn_planner.planning.path_under_way import keep_or_switch
from ddqn_planner.planning.plan import Plan, PlanMethod, PlanRequest, PlanStatus, joined
from ddqn_planner.planning.search import search
from ddqn_planner.planning.simplification import simplify
from ddqn_planner.planning.way_out import can_leave, reach, way_out_and_ends

VISITS = 2**18
"""About how many cells a field visits in one step of a plan: some 30 ms, then comes another."""

UNLABELLED_SHARE = 1 / 2
"""Share of the map's cells that a request may visit before the connected cells are looked at. A
request without a path would visit all that its goal is connected to."""


class Planner:
    """Plans paths with a trained Q-network, by greedy steps in its Q field.

    Several threads may use one planner.

    Parameters
    ----------
    network : QNetwork
    metadata : ModelMetadata
        Its move rule is the default of `plan` and `q_field`.
    """

    def __init__(self, network: QNetwork, metadata: ModelMetadata) -> None:
        if not (hasattr(network, "move_costs") and hasattr(metadata, "move_rule")):
            raise ValueError(
                f"network is {network!r}, metadata is {metadata!r}; give what load_model returns"
            )
        self.network = network
        self.metadata = metadata
        self._fields = FieldCache(network)

    @classmethod
    def load(cls, model: str | Path) -> Planner:
        """Load a shipped model by its name (``"any_map"``), or a model file by its path.

        Raises
        ------
        ModelFileError
            If there is no such model, or its file cannot be used.
        """
        return cls(*load_model(model))

    @property
    def cache_bytes(self) -> int:
        """Memory for the fields that it keeps, those used last; the last one is always kept."""
        return self._fields.nbytes

    @cache_bytes.setter
    def cache_bytes(self, nbytes: int) -> None:
        self._fields.nbytes = nbytes

    def q_field(self, grid: GridMap, goal: Cell, move_rule: MoveRule | str | None = None) -> QField:
        """Return the Q field of a map toward a goal, a free cell, computed or from the cache.

        The move rule is by default the one that the model was trained for.

        Raises
        ------
        ValueError
            If the goal is not a free cell of the map, or the model cannot plan on this size.
        """
        check_grid(grid)
        goal, rule = as_cell(goal, "the goal"), self._rule(move_rule)
        if not grid.is_free(goal):
            raise ValueError(f"the goal {goal} is not a free cell of the map; give another")
        if not self.network.supports((grid.height, grid.width)):
            raise ValueError(
                f"the model was not trained for maps of {grid.width} x {grid.height} cells; "
                "train one on such a map"
            )
        return self._fields.get(grid, (goal,), rule)

    def known_field(
        self, grid: GridMap, goal: Cell, move_rule: MoveRule | str | None = None
    ) -> QField | None:
        """Return the Q field of a map toward a goal if it is in the cache, else None."""
        return self._fields.find(grid, (as_cell(goal, "the goal"),), self._rule(move_rule))

    def _rule(self, move_rule: MoveRule | str | None) -> MoveRule:
        return self.metadata.move_rule if move_rule is None else MoveRule(move_rule)

    def plan(
        self,
        grid: GridMap,
        start: Cell,
        goal: Cell,
        move_rule: MoveRule | str | None = None,
        method: PlanMethod | str = PlanMethod.GREEDY,
        tolerance: float = 0.0,
        simplified: bool = False,
        start_clearing_radius: float = 0.0,
    ) -> Plan:
        """Plan a path.

        Parameters
        ----------
        grid, start, goal, method, tolerance, simplified, start_clearing_radius
            See `PlanRequest`.
        move_rule : MoveRule, optional
            By default the rule that the model was trained for.

        Returns
        -------
        Plan
            Every move of its path is legal under the rule, whatever the network says. The cells
            are free, except the first ones of a start that is too near to an obstacle, or on one.

        Raises
        ------
        ValueError
            If the tolerance or the radius is negative or NaN, the start or the goal is no pair of
            whole numbers, or there is no such move rule or method.
        """
        check_grid(grid)
        start, goal = as_cell(start, "the start"), as_cell(goal, "the goal")
        rule, method = self._rule(move_rule), PlanMethod(method)
        tolerance = _cells("the tolerance", tolerance)
        simplified = as_flag("simplified", simplified)
        radius = _cells("start_clearing_radius", start_clearing_radius)
        request = PlanRequest(
            grid,
            start,
            goal,
            rule,
            method,
            tolerance,
            simplified,
            start_clearing_radius=radius,
        )
        return last_step(self.steps(request))

    def plan_nearest(
        self,
        grid: GridMap,
        start: Cell,
        goals: Sequence[Cell],
        move_rule: MoveRule | str | None = None,
        method: PlanMethod | str = PlanMethod.GREEDY,
        simplified: bool = False,
        start_clearing_radius: float = 0.0,
    ) -> Plan:
        """Plan a path to the goal that the cheapest path reaches; `Plan.goal` tells which.

        Goals that are occupied or outside the map are left out. If all are, the status says so:
        GOAL_OCCUPIED if any lies on the map. One field leads to all goals that are free.

        Parameters
        ----------
        grid, start, method, simplified, start_clearing_radius
            See `PlanRequest`.
        goals : sequence of (x, y)
            At least one, in any order. No goal moves: there is no tolerance.
        move_rule : MoveRule, optional
            As for `plan`.

        Raises
        ------
        ValueError
            As for `plan`, or if there is no goal.
        """
        check_grid(grid)
        first, *others = _cells_of_goals(goals)
        rule, method = self._rule(move_rule), PlanMethod(method)
        start, simplified = as_cell(start, "the start"), as_flag("simplified", simplified)
        radius = _cells("start_clearing_radius", start_clearing_radius)
        request = PlanRequest(
            grid,
            start,
            first,
            rule,
            method,
            simplified=simplified,
            others=(*others,),
            start_clearing_radius=radius,
        )
        return last_step(self.steps(request))

    def plan_through(
        self,
        grid: GridMap,
        start: Cell,
        goals: Sequence[Cell],
        move_rule: MoveRule | str | None = None,
        method: PlanMethod | str = PlanMethod.GREEDY,
        tolerance: float = 0.0,
        simplified: bool = False,
        start_clearing_radius: float = 0.0,
    ) -> Plan:
        """Plan a path through all goals in their order, see `joined`.

        Parameters
        ----------
        grid, start, move_rule, method, tolerance, simplified, start_clearing_radius
            As for `plan`. The tolerance holds for each goal. A simplified path keeps all goals.
        goals : sequence of (x, y)
            At least one.

        Returns
        -------
        Plan
            If there is no path to one of the goals, its status tells why, and its goal which.

        Raises
        ------
        ValueError
            As for `plan`, or if there is no goal.
        """
        plans: list[Plan] = []
        how = move_rule, method, tolerance, simplified, start_clearing_radius
        for goal in _cells_of_goals(goals):
            plans.append(self.plan(grid, start, goal, *how))
            if plans[-1].status is not PlanStatus.SUCCEEDED:
                return replace(plans[-1], goal=goal)
            assert plans[-1].goal is not None
            start = plans[-1].goal
        return joined(plans)

    def steps(self, request: PlanRequest) -> Iterator[Plan | None]:
        """Plan a path in steps, so that a caller can take the slow ones in another thread.

        Yields
        ------
        Plan or None
            None before each step that may be slow (a part of a new field, a search); at last the
            plan.
        """
        grid, start, rule = request.grid, request.start, request.move_rule
        status = self._refusal(request)
        if status is not None:
            yield Plan(status, move_rule=rule)
            return
        goals, field_time, rollout_time = _free_goals(request), _Stopwatch(), _Stopwatch()
        if len(goals) > 1 and not self._fields.has_costs(grid, rule):
            yield None
            each = [replace(request, goal=goal, others=(), under_way=()) for goal in goals]
            with field_time:
                nearest = min((last_step(self.steps(one)) for one in each), key=_cost)
            goals = nearest.cells[-1:] or goals[:1]
        way_out: tuple[Cell, ...] = (start,)
        with field_time:
            field = self._fields.find(grid, goals, rule) if grid.is_free(start) else None
        with rollout_time:
            plan = field.rollout_if_known(start) if field else None
        if plan is None or (not plan.path.size and reach(request) >= 1):
            yield None
        if plan is None and grid.is_free(start) and goals:
            with field_time:
                if self._fields.has_costs(grid, rule):
                    field = self._fields.get(grid, goals, rule, start)
            if isinstance(field, DistanceField):
                plan = yield from _in_parts(field, request, field_time)
        if plan is None or not plan.path.size:
            with field_time:
                if plan and plan.status is PlanStatus.NO_PATH and reach(request) < 1:
                    way_out, ends = (), goals
                else:
                    way_out, ends = way_out_and_ends(request, goals)
                if way_out and (field is None or field.goals != ends):
                    field, plan = self._fields.get(grid, ends, rule, way_out[-1]), None
            if field is None or not way_out:
                status = PlanStatus.NO_PATH if goals else PlanStatus.GOAL_OCCUPIED
                if grid.is_obstacle(start) and not can_leave(request):
                    status = PlanStatus.START_OCCUPIED
                yield Plan(status, move_rule=rule, field_ms=field_time.ms)
                return
            with rollout_time:
                plan = plan or field.rollout(way_out[-1])
            if not plan.path.size and request.method is PlanMethod.ASTAR_FALLBACK:
                yield None
                costs = grid.cost_multiplier
                with rollout_time:
                    cells = search(way_out[-1], ends[0], field.legal, costs, rule, field.value)
                plan = Plan(PlanStatus.SUCCEEDED, np.array(cells), PlanMethod.ASTAR_FALLBACK)
        assert field is not None
        path, cost, extra_cost, goal = plan.path, None, None, field.goal
        with rollout_time:
            if path.size:
                if len(request.under_way):
                    threshold = request.switch_threshold
                    path, extra_cost = keep_or_switch(
                        request.under_way, path, grid, rule, threshold, request.goals
                    )
                goal = (int(path[-1, 0]), int(path[-1, 1]))
                if len(way_out) > 1:
                    path = np.concatenate([way_out[:-1], path], dtype=np.int32)
                    if not np.array_equal(path, np.asarray(request.under_way)[-len(path) :]):
                        extra_cost = None  # only from the first free cell on it is the one kept
                if grid.has_costs:
                    cost = path_cost(path, grid.cost_multiplier, rule)
                    cost *= grid.seconds_per_cell or 1.0
            every_cell = path
            if request.simplified:
                path = np.array(simplify(path, grid, rule), dtype=np.int32)
        yield replace(
            plan,
            path=path,
            move_rule=rule,
            cost=cost,
            goal=goal,
            every_cell=every_cell,
            extra_cost=extra_cost,
            field_ms=field_time.ms,
            rollout_ms=rollout_time.ms,
        )

    def _refusal(self, request: PlanRequest) -> PlanStatus | None:
        """Return why there is no path, where one look at start and goals says so."""
        grid = request.grid
        if not grid.contains(request.start):
            return PlanStatus.START_OUTSIDE_MAP
        if not any(grid.contains(goal) for goal in request.goals):
            return PlanStatus.GOAL_OUTSIDE_MAP
        if grid.is_obstacle(request.start) and request.start_clearing_radius == 0:
            return PlanStatus.START_OCCUPIED
        if not _free_goals(request) and reach(request) < 1:
            return PlanStatus.GOAL_OCCUPIED
        if not self.network.supports((grid.height, grid.width)):
            return PlanStatus.MAP_SIZE_UNSUPPORTED
        return None


def last_step(steps: Iterator[Plan | None]) -> Plan:
    """Take all steps that are left of `Planner.steps`, and return the plan."""
    *_, plan = steps
    assert plan is not None
    return plan


def _in_parts(
    field: DistanceField, request: PlanRequest, field_time: _Stopwatch
) -> Generator[None, None, Plan]:
    """Return the rollout from the start; after each part that the field grows for it, yield.

    Once the field has visited many cells, the connected cells say whether there is a path: most
    requests need not look at them.
    """
    grid, start = request.grid, request.start
    until_labels = int(UNLABELLED_SHARE * grid.occupancy.size)
    while True:
        with field_time:
            visits = min(VISITS, until_labels) or VISITS
            plan = field.rollout(start, visits)
            if plan.status is not PlanStatus.ROLLOUT_TRAPPED:
                return plan
            if until_labels == visits:
                labels = grid.labels(request.move_rule)
                if all(labels[y, x] != labels[start[::-1]] for x, y in field.goals):
                    return Plan(PlanStatus.NO_PATH)
            until_labels = max(until_labels - visits, 0)
        yield None


class _Stopwatch:
    """Adds up the milliseconds of some blocks of code."""

    def __init__(self) -> None:
        self.ms = 0.0

    def __enter__(self) -> None:
        self._began = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self.ms += 1e3 * (time.perf_counter() - self._began)


def _cells_of_goals(goals: Sequence[Cell]) -> list[Cell]:
    goals = listed(goals, "goals")
    cells = [as_cell(goal, f"goal {number}") for number, goal in enumerate(goals, 1)]
    if not cells:
        raise ValueError("there is no goal; give at least one cell")
    return cells


def _cells(name: str, value: float) -> float:
    if not real(value) >= 0:
        raise ValueError(f"{name} is {value!r}; give 0 cells or more")
    return real(value)


def _free_goals(request: PlanRequest) -> Goals:
    """Return the free ones of a request's goals, each once."""
    return tuple(sorted({goal for goal in request.goals if request.grid.is_free(goal)}))


def _cost(plan: Plan) -> float:
    if plan.status is not PlanStatus.SUCCEEDED:
        return math.inf
    return plan.length if plan.cost is None else plan.cost
