"""The Q fields that a planner keeps, of the maps and goals used last."""

from __future__ import annotations

import threading
from functools import cache
from typing import NamedTuple

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.model import QNetwork
from ddqn_planner.model.move_costs import MoveCosts
from ddqn_planner.planning.field import DistanceField, Goals, QField, network_field, shift_between

CACHE_BYTES = 2**23  # for a planner's Q fields: 3 of 500 x 500 cells, at 9 bytes per cell
ALWAYS_KEPT = 2  # fields, whatever their size: on a large map, too, a robot drives to and fro


class _Kept(NamedTuple):
    """What is known of a map under a move rule: `QNetwork.move_costs`, and perhaps a field."""

    grid: GridMap
    rule: MoveRule
    costs: MoveCosts | None
    field: QField | None = None


class FieldCache:
    """Gives the Q fields of a network, computed, repaired or kept. Several threads may use it."""

    def __init__(self, network: QNetwork) -> None:
        self.network = network
        self.nbytes = CACHE_BYTES
        self._kept: list[_Kept] = []  # used last at the end
        self._lock = threading.Lock()

    def has_costs(self, grid: GridMap, rule: MoveRule) -> bool:
        """Return whether the network gives the costs of a map's moves, see `DistanceField`."""
        return self._costs(grid, rule) is not None

    def find(self, grid: GridMap, goals: Goals, rule: MoveRule) -> QField | None:
        """Return the field of a map toward the nearest of some goals if it is kept, else None."""
        for kept in self._of_rule(rule):
            if kept.field and kept.field.goals == goals and grid.same_cells(kept.grid):
                self._use(_Kept(grid, rule, kept.costs, kept.field))  # the map may lie elsewhere
                return kept.field
        return None

    def get(self, grid: GridMap, goals: Goals, rule: MoveRule, start: Cell | None = None) -> QField:
        """Return the field of a map toward the nearest of some goals: several, if it has costs."""
        field = self.find(grid, goals, rule)
        if field is None:
            costs = self._costs(grid, rule)
            if costs is None:
                field = network_field(self.network, grid, goals[0], rule)
            else:
                field = DistanceField(goals, grid, costs, rule)
                self._repair(field, start)
            self._use(_Kept(grid, rule, costs, field))
            self._forget()
        return field

    def _of_rule(self, rule: MoveRule) -> list[_Kept]:
        """Return what is kept for a move rule, used last first."""
        return [kept for kept in reversed(self._kept) if kept.rule is rule]

    def _costs(self, grid: GridMap, rule: MoveRule) -> MoveCosts | None:
        """Return the costs of a map's moves: known, from those of the map it patches, or new."""
        known = self._of_rule(rule)
        for kept in known:
            if grid.same_cells(kept.grid):
                return kept.costs
        costs = None
        for kept in known:
            boxes = grid.patches_since(kept.grid)
            if boxes is not None and kept.costs is not None and costs is None:
                costs = kept.costs.after(grid, boxes)
        costs = costs or self.network.move_costs(grid, rule)
        self._use(_Kept(grid, rule, costs))
        return costs

    def _repair(self, new: DistanceField, start: Cell | None) -> None:
        """Give a new field what a field of an older map knows, if there is one."""
        shift_from = cache(lambda older: shift_between(older, new.grid))  # many are of one map
        for kept in self._of_rule(new.move_rule):
            old, shift = kept.field, shift_from(kept.grid)
            if shift is None or not isinstance(old, DistanceField):
                continue
            moved_goals = tuple((x + shift[0], y + shift[1]) for x, y in old.goals)
            if moved_goals == new.goals and new.take_over(old, shift, start):
                with self._lock:  # the place will hardly be again what it was
                    self._kept = [other for other in self._kept if other.field is not old]
                return

    def _use(self, used: _Kept) -> None:
        """Put what is used at the end; of maps without a field, only the last stays."""
        with self._lock:
            others = [kept for kept in self._kept if kept.field and kept.field is not used.field]
            self._kept = [*others, used]

    def _forget(self) -> None:
        """Forget the oldest fields beyond the bound; those of one map share its costs."""
        size, of_costs = 0, dict[int, int]()
        with self._lock:
            for number, kept in enumerate(reversed(self._kept)):
                size += kept.field.nbytes if kept.field else 0
                of_costs[id(kept.costs)] = kept.costs.patch.nbytes if kept.costs else 0
                if number >= ALWAYS_KEPT and size + sum(of_costs.values()) > self.nbytes:
                    self._kept = self._kept[-number:]
                    break
