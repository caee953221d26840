"""The planner: one network, one Q field per goal, one rollout per start."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import Cell, GridMap, MoveRule, legal_moves, path_cost
from ddqn_planner.grid.arguments import as_cell
from ddqn_planner.model import ModelMetadata, QNetwork, load_model
from ddqn_planner.model.move_costs import MoveCosts
from ddqn_planner.planning.distance_field import DistanceField
from ddqn_planner.planning.path_under_way import keep_or_switch
from ddqn_planner.planning.plan import Plan, PlanMethod, PlanRequest, PlanStatus
from ddqn_planner.planning.q_field import QField
from ddqn_planner.planning.repair import repaired, shift_between
from ddqn_planner.planning.search import search
from ddqn_planner.planning.simplification import simplify

CACHE_BYTES = 2**29
"""Memory for the Q fields that a planner keeps: 14 of 2000 x 2000 cells, at 9 bytes per cell."""

UNLABELLED_SHARE = 1 / 2
"""Share of the map's cells that a request may visit before the connected cells are looked at. A
request without a path would visit all that its goal is connected to."""

ROUNDING = 1e-6
"""Relative error of a tolerance in cells: 0.15 m in cells of 0.05 m must reach 3 cells, not
2.9999999."""


@dataclass(eq=False)
class _KnownMap:
    """What a planner knows of a map under a move rule: the network's costs of moves, and fields.

    The costs are None for a network that gives none, see `QNetwork.move_costs`.
    """

    grid: GridMap
    move_rule: MoveRule
    costs: MoveCosts | None
    fields: OrderedDict[Cell, QField] = dataclass_field(default_factory=OrderedDict)

    @property
    def nbytes(self) -> int:
        """Memory of the fields and the costs, bytes."""
        of_costs = self.costs.patch.nbytes if self.costs else 0
        return of_costs + sum(field.nbytes for field in self.fields.values())


class Planner:
    """Plans paths with a trained Q-network, by greedy steps in its Q field.

    Several threads may use one planner.

    Parameters
    ----------
    network : QNetwork
    metadata : ModelMetadata
        Its move rule is the default of `plan` and `q_field`.

    Attributes
    ----------
    cache_bytes : int
        Memory for the fields that it keeps, those used last; the last one is always kept.
    """

    def __init__(self, network: QNetwork, metadata: ModelMetadata) -> None:
        self.network = network
        self.metadata = metadata
        self.cache_bytes = CACHE_BYTES
        self._maps: list[_KnownMap] = []  # used last at the end
        self._lock = threading.Lock()

    @classmethod
    def load(cls, model: str | Path) -> Planner:
        """Load a shipped model by its name (``"any_map"``), or a model file by its path.

        Raises
        ------
        ModelFileError
            If there is no such model, or its file cannot be used.
        """
        return cls(*load_model(model))

    def q_field(self, grid: GridMap, goal: Cell, move_rule: MoveRule | str | None = None) -> QField:
        """Return the Q field of a map toward a goal, a free cell, computed or from the cache.

        The move rule is by default the one that the model was trained for.

        Raises
        ------
        ValueError
            If the goal is not a free cell of the map, or the model cannot plan on this size.
        """
        goal, rule = as_cell(goal, "the goal"), self._rule(move_rule)
        if not grid.is_free(goal):
            raise ValueError(f"the goal {goal} is not a free cell of the map; give another")
        if not self.network.supports((grid.height, grid.width)):
            raise ValueError(
                f"the model was not trained for maps of {grid.width} x {grid.height} cells; "
                "train one on such a map"
            )
        with self._lock:
            known = self._map(grid, rule)
            field = known.fields.get(goal)
        if field is None:
            if known.costs is None:
                q = self.network.q_values(grid, goal, rule)
                field = QField(goal, q, grid.legal_moves(rule), rule)
            else:
                field = self._repaired(known, goal)
                field = field or DistanceField(goal, grid, known.costs, rule)
        self._remember(known, field)
        return field

    def known_field(
        self, grid: GridMap, goal: Cell, move_rule: MoveRule | str | None = None
    ) -> QField | None:
        """Return the Q field of a map toward a goal if it is in the cache, else None."""
        goal, rule = as_cell(goal, "the goal"), self._rule(move_rule)
        with self._lock:
            known = self._known_map(grid, rule)
            field = known.fields.get(goal) if known else None
            if known and field:
                self._use(known, field)
            return field

    def _known_map(self, grid: GridMap, rule: MoveRule) -> _KnownMap | None:
        """Return what is known of an equal map."""
        for known in reversed(self._maps):
            if known.move_rule is rule and known.grid.same_cells(grid):
                known.grid = grid  # which may lie elsewhere
                return known
        return None

    def _map(self, grid: GridMap, rule: MoveRule) -> _KnownMap:
        """Return what is known of an equal map, or what the network says of a new one."""
        known = self._known_map(grid, rule)
        if known is None:
            known = _KnownMap(grid, rule, self.network.move_costs(grid, rule))
            # A map on which no goal got a field is not kept.
            self._maps = [*(other for other in self._maps if other.fields), known]
        return known

    def _repaired(self, known: _KnownMap, goal: Cell) -> QField | None:
        """Return the field of a map that a field of an older one becomes, if there is one."""
        assert known.costs is not None
        with self._lock:
            olders = [other for other in reversed(self._maps) if other is not known]
        for older in olders:
            shift = shift_between(older.grid, known.grid)
            if shift is None or older.move_rule is not known.move_rule:
                continue
            old_goal = goal[0] - shift[0], goal[1] - shift[1]
            field = older.fields.get(old_goal)
            if isinstance(field, DistanceField):
                new = repaired(field, goal, known.grid, known.costs, shift)
                if new:  # it has the older one's memory
                    with self._lock:
                        older.fields.pop(old_goal, None)
                return new
        return None

    def _remember(self, known: _KnownMap, field: QField) -> None:
        """Keep a field, and forget the oldest ones beyond the bound."""
        with self._lock:
            self._use(known, field)
            size = sum(other.nbytes for other in self._maps)
            while size > self.cache_bytes and (len(self._maps) > 1 or len(known.fields) > 1):
                oldest = self._maps[0]
                size -= oldest.nbytes
                oldest.fields.popitem(last=False)
                if oldest.fields:
                    size += oldest.nbytes
                else:
                    del self._maps[0]

    def _use(self, known: _KnownMap, field: QField) -> None:
        """Put a map and its field where those lie that were used last."""
        known.fields[field.goal] = field
        known.fields.move_to_end(field.goal)
        self._maps = [other for other in self._maps if other is not known and other.fields]
        self._maps.append(known)

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
    ) -> Plan:
        """Plan a path.

        Parameters
        ----------
        grid, start, goal, method, tolerance, simplified
            See `PlanRequest`.
        move_rule : MoveRule, optional
            By default the rule that the model was trained for.

        Returns
        -------
        Plan
            Every move of its path is legal under the rule, whatever the network says. The cells
            are free, except the first ones of a start that is too near to an obstacle.

        Raises
        ------
        ValueError
            If the tolerance is negative or NaN, the start or the goal is no pair of whole numbers,
            or there is no such move rule or method.
        """
        start, goal = as_cell(start, "the start"), as_cell(goal, "the goal")
        rule, method = self._rule(move_rule), PlanMethod(method)
        if not tolerance >= 0:
            raise ValueError(f"the tolerance is {tolerance}; give 0 or more")
        request = PlanRequest(grid, start, goal, rule, method, tolerance, simplified)
        return last_step(self.steps(request))

    def steps(self, request: PlanRequest) -> Iterator[Plan | None]:
        """Plan a path in steps, so that a caller can take the slow ones in another thread.

        Yields
        ------
        Plan or None
            None before each step that may be slow (a new field, a search); at last the plan.
        """
        grid, start, goal, rule = request.grid, request.start, request.goal, request.move_rule
        status = self._refusal(request)
        if status is not None:
            yield Plan(status, move_rule=rule)
            return
        field_time, rollout_time = _Stopwatch(), _Stopwatch()
        way_out: tuple[Cell, ...] = (start,)
        with field_time:
            field = self.known_field(grid, goal, rule) if grid.is_free(start) else None
        with rollout_time:
            plan = field.rollout_if_known(start) if field else None
        if plan is None or (not plan.path.size and _reach(request) >= 1):
            yield None
        if plan is None and grid.is_free(start) and grid.is_free(goal):
            with field_time:
                field, plan = self._visit_some(request)
        if plan is None or not plan.path.size:
            with field_time:
                if plan and plan.status is PlanStatus.NO_PATH and _reach(request) < 1:
                    way_out, end = (), goal
                else:
                    way_out, end = _way_out_and_end(request)
                if way_out and (field is None or field.goal != end):
                    field, plan = self.q_field(grid, end, rule), None
            if field is None or not way_out:
                status = PlanStatus.NO_PATH if grid.is_free(goal) else PlanStatus.GOAL_OCCUPIED
                yield Plan(status, move_rule=rule, field_ms=field_time.ms)
                return
            with rollout_time:
                plan = plan or field.rollout(way_out[-1])
            if not plan.path.size and request.method is PlanMethod.ASTAR_FALLBACK:
                yield None
                costs = grid.cost_multiplier
                with rollout_time:
                    cells = search(way_out[-1], end, field.legal, costs, rule, field.value)
                plan = Plan(PlanStatus.SUCCEEDED, np.array(cells), PlanMethod.ASTAR_FALLBACK)
        assert field is not None
        path, cost, extra_cost = plan.path, None, None
        with rollout_time:
            if path.size:
                if len(request.under_way):
                    threshold = request.switch_threshold
                    path, extra_cost = keep_or_switch(
                        request.under_way, path, grid, rule, threshold
                    )
                if len(way_out) > 1:
                    path = np.concatenate([way_out[:-1], path], dtype=np.int32)
                if grid.has_costs:
                    cost = path_cost(path, grid.cost_multiplier, rule)
                    cost *= grid.seconds_per_cell or 1.0
            every_cell = path
            if request.simplified:
                path = np.array(simplify(path.tolist(), grid, rule), dtype=np.int32)
        yield replace(
            plan,
            path=path,
            move_rule=rule,
            cost=cost,
            goal=field.goal,
            every_cell=every_cell,
            extra_cost=extra_cost,
            field_ms=field_time.ms,
            rollout_ms=rollout_time.ms,
        )

    def _visit_some(self, request: PlanRequest) -> tuple[QField | None, Plan | None]:
        """Return the field of the goal and the plan from it, if these take few visits of cells.

        So most requests need no connected components.
        """
        grid, rule = request.grid, request.move_rule
        with self._lock:
            known = self._map(grid, rule)
        if known.costs is None:
            return None, None
        field = self.q_field(grid, request.goal, rule)
        assert isinstance(field, DistanceField)
        plan = field.rollout(request.start, int(UNLABELLED_SHARE * grid.occupancy.size))
        if plan.status is PlanStatus.ROLLOUT_TRAPPED:
            labels = grid.labels(rule)
            joined = labels[request.start[::-1]] == labels[request.goal[::-1]]
            plan = field.rollout(request.start) if joined else Plan(PlanStatus.NO_PATH)
        return field, plan

    def _refusal(self, request: PlanRequest) -> PlanStatus | None:
        """Return why there is no path, where one look at start and goal says so."""
        grid = request.grid
        if not grid.contains(request.start):
            return PlanStatus.START_OUTSIDE_MAP
        if not grid.contains(request.goal):
            return PlanStatus.GOAL_OUTSIDE_MAP
        if grid.is_obstacle(request.start):
            return PlanStatus.START_OCCUPIED
        if not grid.is_free(request.goal) and _reach(request) < 1:
            return PlanStatus.GOAL_OCCUPIED
        if not self.network.supports((grid.height, grid.width)):
            return PlanStatus.MAP_SIZE_UNSUPPORTED
        return None


def last_step(steps: Iterator[Plan | None]) -> Plan:
    """Take all steps that are left of `Planner.steps`, and return the plan."""
    *_, plan = steps
    assert plan is not None
    return plan


class _Stopwatch:
    """Adds up the milliseconds of some blocks of code."""

    def __init__(self) -> None:
        self.ms = 0.0

    def __enter__(self) -> None:
        self._began = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self.ms += 1e3 * (time.perf_counter() - self._began)


def _reach(request: PlanRequest) -> float:
    return request.tolerance * (1 + ROUNDING)


def _way_out_and_end(request: PlanRequest) -> tuple[tuple[Cell, ...], Cell]:
    """Return the way from the start to the first free cell, and where the path can end.

    The way is the start alone where that is free. It is empty where no path leads to the goal, nor
    to a cell within the tolerance: connected cells say so, without a field.
    """
    grid, start, goal, rule = request.grid, request.start, request.goal, request.move_rule
    goals = [np.array([goal])] if grid.is_free(goal) else []
    if _reach(request) >= 1:
        goals.append(_free_cells(grid, goal, _reach(request)))
    for ends in goals:
        joined = grid.reachable(ends, rule, backward=True)
        way_out: tuple[Cell, ...] = (start,)
        if not grid.is_free(start):
            # The robot is too near to an obstacle: the shortest way through such cells.
            assert grid.obstacles is not None
            closed = ~joined & (grid.obstacles | ~grid.occupancy)
            legal = legal_moves(closed, rule, grid.forbidden)
            way_out = search(start, joined, legal, np.ones(joined.shape, np.float32), rule)
        if way_out and joined[way_out[-1][1], way_out[-1][0]]:
            reached = grid.reachable([way_out[-1]], rule)
            x, y = ends[np.argmax(reached[ends[:, 1], ends[:, 0]])].tolist()
            return way_out, (x, y)
    return (), goal


def _free_cells(grid: GridMap, goal: Cell, tolerance: float) -> NDArray[np.int64]:
    """Return the free cells within a distance of a cell, the nearest first: (N, 2) int64."""
    reach = int(min(tolerance, max(grid.height, grid.width)))
    left, bottom = max(goal[0] - reach, 0), max(goal[1] - reach, 0)
    near = ~grid.occupancy[bottom : goal[1] + reach + 1, left : goal[0] + reach + 1]
    cells: NDArray[np.int64] = np.argwhere(near)[:, ::-1] + (left, bottom)
    distance = np.hypot(*(cells - goal).T)
    order = np.argsort(distance, kind="stable")
    return cells[order[: np.count_nonzero(distance <= tolerance)]]
