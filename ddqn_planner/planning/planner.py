"""The planner: a network, a Q field a goal, and a walk a start."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import Cell, GridMap, MoveRule, connected_cells, legal_moves, path_cost
from ddqn_planner.grid.arguments import as_cell
from ddqn_planner.grid.moves import component_labels
from ddqn_planner.model import ModelMetadata, QNetwork, load_model
from ddqn_planner.planning.plan import Plan, PlanMethod, PlanStatus
from ddqn_planner.planning.q_field import QField
from ddqn_planner.planning.search import search

CACHE_BYTES = 2**29
"""Memory for the Q fields that a planner keeps, the last ones used: two of 2000 x 2000 cells, at 45
bytes a cell. The last one is kept whatever its size."""

ROUNDING = 1e-6
"""A tolerance and a resolution have errors of float32, or of a division: 0.15 m of cells of 0.05 m
shall reach 3 cells, not 2.9999999."""


@dataclass(frozen=True)
class Route:
    """What can be said of a path before there is a Q field.

    Parameters
    ----------
    status : PlanStatus
        SUCCEEDED if a path may follow, else why there is none.
    leave : tuple of (x, y)
        From the start to the first free cell: the start alone, where that is free. The cells
        between are too near to an obstacle.
    goal : (x, y)
        A free cell: the goal, or the nearest that may stand for it and can be reached.
    """

    status: PlanStatus
    leave: tuple[Cell, ...] = ()
    goal: Cell = (-1, -1)


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
        Bound of the memory for the fields that it keeps; `CACHE_BYTES` until it is set.
    """

    def __init__(self, network: QNetwork, metadata: ModelMetadata) -> None:
        self.network = network
        self.metadata = metadata
        self.cache_bytes = CACHE_BYTES
        self._fields: OrderedDict[tuple[str, Cell, MoveRule], QField] = OrderedDict()
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
        """Return the Q field of a map toward a goal; asked again, it is looked up.

        Parameters
        ----------
        grid : GridMap
        goal : (x, y)
            A free cell.
        move_rule : MoveRule, optional
            The rule that the model was trained for by default.

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
        field = self.known_field(grid, goal, rule)
        if field is None:
            q = self.network.q_values(grid, goal, rule)
            field = QField(goal, q, legal_moves(grid.occupancy, rule), rule)
            self._remember(grid, field)
        return field

    def known_field(
        self, grid: GridMap, goal: Cell, move_rule: MoveRule | str | None = None
    ) -> QField | None:
        """Return the Q field of a map toward a goal if it was computed lately, else None."""
        key = (grid.fingerprint, as_cell(goal, "the goal"), self._rule(move_rule))
        with self._lock:
            if key in self._fields:
                self._fields.move_to_end(key)
            return self._fields.get(key)

    def _rule(self, move_rule: MoveRule | str | None) -> MoveRule:
        return self.metadata.move_rule if move_rule is None else MoveRule(move_rule)

    def _remember(self, grid: GridMap, field: QField) -> None:
        with self._lock:
            self._fields[grid.fingerprint, field.goal, field.move_rule] = field
            size = sum(known.nbytes for known in self._fields.values())
            while size > self.cache_bytes and len(self._fields) > 1:
                size -= self._fields.popitem(last=False)[1].nbytes

    def plan(
        self,
        grid: GridMap,
        start: Cell,
        goal: Cell,
        move_rule: MoveRule | str | None = None,
        method: PlanMethod | str = PlanMethod.GREEDY,
        tolerance: float = 0.0,
    ) -> Plan:
        """Plan a path: `route`, `q_field`, and then `follow`.

        Parameters
        ----------
        grid : GridMap
        start, goal : (x, y)
        move_rule : MoveRule, optional
            The rule that the model was trained for by default.
        method : PlanMethod
            Whether to search where the greedy steps are trapped.
        tolerance : float
            How far a goal that is occupied or cut off may move, in cells: to the nearest free cell
            that a path reaches.

        Returns
        -------
        Plan
            Every move of its path is legal under the rule, whatever the network says. The cells
            are free, but for those by which a start leaves that is too near to an obstacle.

        Raises
        ------
        ValueError
            If the tolerance is negative or NaN, the start or the goal is no pair of whole numbers,
            or there is no such move rule or method.
        """
        method, move_rule = PlanMethod(method), self._rule(move_rule)
        route = self.route(grid, start, goal, move_rule, tolerance)
        if route.status is not PlanStatus.SUCCEEDED:
            return Plan(route.status, move_rule=move_rule)
        field = self.q_field(grid, route.goal, move_rule)
        return self.follow(route, grid, field, method, move_rule)

    def route(
        self,
        grid: GridMap,
        start: Cell,
        goal: Cell,
        move_rule: MoveRule | str | None = None,
        tolerance: float = 0.0,
    ) -> Route:
        """Say where a path enters the free cells and where it ends, or why there is none.

        The parameters are those of `plan`.
        """
        start, goal = as_cell(start, "the start"), as_cell(goal, "the goal")
        rule = self._rule(move_rule)
        ruled_out = self._ruled_out(grid, start, goal, tolerance)
        if ruled_out:
            return Route(ruled_out)
        if self._is_a_walk(grid, start, goal, rule, tolerance):
            return Route(PlanStatus.SUCCEEDED, (start,), goal)
        # Where no path leads, there is no need to compute a field to say so.
        labels = component_labels(grid.occupancy, rule)
        goals = [np.array([goal])] if grid.is_free(goal) else []
        if _reach(tolerance) >= 1:
            goals.append(_free_cells(grid, goal, _reach(tolerance)))
        for candidates in goals:
            labels_of_goals = labels[candidates[:, 1], candidates[:, 0]]
            leave = _way_out(grid, start, np.isin(labels, labels_of_goals), rule)
            if leave:
                label = labels[leave[-1][1], leave[-1][0]]
                x, y = candidates[np.argmax(labels_of_goals == label)].tolist()
                return Route(PlanStatus.SUCCEEDED, leave, (x, y))
        return Route(PlanStatus.NO_PATH if grid.is_free(goal) else PlanStatus.GOAL_OCCUPIED)

    def is_quick(
        self,
        grid: GridMap,
        start: Cell,
        goal: Cell,
        move_rule: MoveRule | str | None = None,
        tolerance: float = 0.0,
    ) -> bool:
        """Say whether a look rules a path out, or it is a walk in a field that is known."""
        start, goal = as_cell(start, "the start"), as_cell(goal, "the goal")
        return self._ruled_out(grid, start, goal, tolerance) is not None or self._is_a_walk(
            grid, start, goal, self._rule(move_rule), tolerance
        )

    def _ruled_out(
        self, grid: GridMap, start: Cell, goal: Cell, tolerance: float
    ) -> PlanStatus | None:
        if not tolerance >= 0:
            raise ValueError(f"the tolerance is {tolerance}; give 0 or more")
        if not grid.contains(start):
            return PlanStatus.START_OUTSIDE_MAP
        if not grid.contains(goal):
            return PlanStatus.GOAL_OUTSIDE_MAP
        if grid.is_obstacle(start):
            return PlanStatus.START_OCCUPIED
        if not grid.is_free(goal) and _reach(tolerance) < 1:
            return PlanStatus.GOAL_OCCUPIED
        if not self.network.supports((grid.height, grid.width)):
            return PlanStatus.MAP_SIZE_UNSUPPORTED
        return None

    def _is_a_walk(
        self, grid: GridMap, start: Cell, goal: Cell, rule: MoveRule, tolerance: float
    ) -> bool:
        field = self.known_field(grid, goal, rule) if grid.is_free(start) else None
        if field is None:
            return False
        # A goal that may move need not where a walk arrives.
        return _reach(tolerance) < 1 or field.rollout(start).status is PlanStatus.SUCCEEDED

    def follow(
        self,
        route: Route,
        grid: GridMap,
        field: QField,
        method: PlanMethod | str = PlanMethod.GREEDY,
        move_rule: MoveRule | str | None = None,
    ) -> Plan:
        """Walk a route in the field of its goal; see `plan`."""
        method, rule, entry = PlanMethod(method), self._rule(move_rule), route.leave[-1]
        plan = field.rollout(entry)
        if plan.status is PlanStatus.ROLLOUT_TRAPPED:
            joined = connected_cells(grid.occupancy, field.goal, rule)
            if not joined[entry[1], entry[0]]:
                return Plan(PlanStatus.NO_PATH, move_rule=rule)
            if method is PlanMethod.ASTAR_FALLBACK:
                return self.search(route, grid, field, rule)
        return _on_route(route, plan, grid, rule)

    def search(
        self, route: Route, grid: GridMap, field: QField, move_rule: MoveRule | str | None = None
    ) -> Plan:
        """Search a route in the order of its field's values, where greedy steps are trapped."""
        rule, entry = self._rule(move_rule), route.leave[-1]
        end = np.zeros(grid.occupancy.shape, dtype=np.bool_)
        end[field.goal[1], field.goal[0]] = True
        cells = search(entry, end, field.legal, grid.cost_multiplier, rule, field.value)
        plan = Plan(PlanStatus.SUCCEEDED, cells, PlanMethod.ASTAR_FALLBACK)
        return _on_route(route, plan, grid, rule)


def _reach(tolerance: float) -> float:
    return tolerance * (1 + ROUNDING)


def _on_route(route: Route, plan: Plan, grid: GridMap, rule: MoveRule) -> Plan:
    """Let a plan from where a route enters the free cells begin at the route's start."""
    if not plan.cells:
        return replace(plan, move_rule=rule)
    cells = route.leave[:-1] + plan.cells
    cost = None if grid.cost is None else path_cost(cells, grid.cost_multiplier, rule)
    return replace(plan, cells=cells, move_rule=rule, cost=cost)


def _free_cells(grid: GridMap, goal: Cell, tolerance: float) -> NDArray[np.int64]:
    """Return the free cells within a distance of a cell, the nearest first: (N, 2) int64."""
    reach = int(min(tolerance, max(grid.height, grid.width)))
    left, bottom = max(goal[0] - reach, 0), max(goal[1] - reach, 0)
    near = ~grid.occupancy[bottom : goal[1] + reach + 1, left : goal[0] + reach + 1]
    cells: NDArray[np.int64] = np.argwhere(near)[:, ::-1] + (left, bottom)
    distance = np.hypot(*(cells - goal).T)
    order = np.argsort(distance, kind="stable")
    return cells[order[: np.count_nonzero(distance <= tolerance)]]


def _way_out(
    grid: GridMap, start: Cell, ends: NDArray[np.bool_], rule: MoveRule
) -> tuple[Cell, ...]:
    """Return the shortest way from a cell, by cells too near to an obstacle, to one of some."""
    if grid.is_free(start):
        return (start,) if ends[start[1], start[0]] else ()
    assert grid.obstacles is not None
    closed = ~ends & (grid.obstacles | ~grid.occupancy)
    plain = np.ones(ends.shape, dtype=np.float32)
    return search(start, ends, legal_moves(closed, rule), plain, rule)
