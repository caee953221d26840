"""The Q fields that a planner keeps, of the maps and goals used last."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass, field

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.model import QNetwork
from ddqn_planner.model.move_costs import MoveCosts
from ddqn_planner.planning.field import DistanceField, Goals, QField, network_field, shift_between

CACHE_BYTES = 2**23  # for a planner's Q fields: 3 of 500 x 500 cells, at 9 bytes per cell
ALWAYS_KEPT = 2  # fields, whatever their size: on a large map, too, a robot drives to and fro


@dataclass(eq=False)
class _KnownMap:
    """What is known of a map under a move rule: `QNetwork.move_costs`, and fields."""

    grid: GridMap
    move_rule: MoveRule
    costs: MoveCosts | None
    fields: OrderedDict[Goals, QField] = field(default_factory=OrderedDict)

    @property
    def nbytes(self) -> int:
        """Memory of the fields and the costs, bytes."""
        of_costs = self.costs.patch.nbytes if self.costs else 0
        return of_costs + sum(field.nbytes for field in self.fields.values())


class FieldCache:
    """Gives the Q fields of a network, computed, repaired or kept. Several threads may use it."""

    def __init__(self, network: QNetwork) -> None:
        self.network = network
        self.nbytes = CACHE_BYTES
        self._maps: list[_KnownMap] = []  # used last at the end
        self._lock = threading.Lock()

    def has_costs(self, grid: GridMap, rule: MoveRule) -> bool:
        """Return whether the network gives the costs of a map's moves, see `DistanceField`."""
        return self._map(grid, rule).costs is not None

    def find(self, grid: GridMap, goals: Goals, rule: MoveRule) -> QField | None:
        """Return the field of a map toward the nearest of some goals if it is kept, else None."""
        with self._lock:
            known = self._known_map(grid, rule)
            found = known.fields.get(goals) if known else None
            if known and found:
                self._use(known, found)
            return found

    def get(self, grid: GridMap, goals: Goals, rule: MoveRule, start: Cell | None = None) -> QField:
        """Return the field of a map toward the nearest of some goals: several, if it has costs."""
        known = self._map(grid, rule)
        with self._lock:
            found = known.fields.get(goals)
        if found is None:
            if known.costs is None:
                found = network_field(self.network, grid, goals[0], rule)
            else:
                found = DistanceField(goals, grid, known.costs, rule)
                self._repair(known, found, start)
        self._remember(known, found)
        return found

    def _known_map(self, grid: GridMap, rule: MoveRule) -> _KnownMap | None:
        """Return what is known of an equal map."""
        for known in reversed(self._maps):
            if known.move_rule is rule and grid.same_cells(known.grid):
                known.grid = grid  # which may lie elsewhere
                return known
        return None

    def _map(self, grid: GridMap, rule: MoveRule) -> _KnownMap:
        """Return what is known of an equal map, or what the network says of a new one."""
        with self._lock:
            known = self._known_map(grid, rule)
        if known is not None:
            return known
        new = _KnownMap(grid, rule, self._costs(grid, rule))
        with self._lock:
            known = self._known_map(grid, rule)  # another thread may have been faster
            if known is None:
                # A map on which no goal got a field is not kept.
                self._maps = [*(other for other in self._maps if other.fields), new]
        return known or new

    def _costs(self, grid: GridMap, rule: MoveRule) -> MoveCosts | None:
        """Return the costs of a map's moves, from those of the map that it is a patch of."""
        for known in reversed(self._maps):
            boxes = grid.patches_since(known.grid)
            if boxes is not None and known.move_rule is rule and known.costs is not None:
                after = known.costs.after(grid, boxes)
                if after is not None:
                    return after
        return self.network.move_costs(grid, rule)

    def _repair(self, known: _KnownMap, new: DistanceField, start: Cell | None) -> None:
        """Give a new field what a field of an older map knows, if there is one."""
        with self._lock:
            olders = [other for other in reversed(self._maps) if other is not known]
        for older in olders:
            shift = shift_between(older.grid, known.grid)
            if shift is None or older.move_rule is not known.move_rule:
                continue
            old_goals = tuple((x - shift[0], y - shift[1]) for x, y in new.goals)
            old = older.fields.get(old_goals)
            if isinstance(old, DistanceField):
                if new.take_over(old, shift, start):
                    with self._lock:  # the place will hardly be again what it was
                        older.fields.pop(old_goals, None)
                return

    def _remember(self, known: _KnownMap, used: QField) -> None:
        """Keep a field, and forget the oldest ones beyond the bound."""
        with self._lock:
            self._use(known, used)
            size = sum(other.nbytes for other in self._maps)
            count = sum(len(other.fields) for other in self._maps)
            while size > self.nbytes and (count := count - 1) >= ALWAYS_KEPT:
                _, forgotten = self._maps[0].fields.popitem(last=False)
                size -= forgotten.nbytes
                if not self._maps[0].fields:
                    size -= self._maps.pop(0).nbytes

    def _use(self, known: _KnownMap, used: QField) -> None:
        """Put a map and its field where those lie that were used last."""
        known.fields[used.goals] = used
        known.fields.move_to_end(used.goals)
        others = (other for other in self._maps if other is not known and other.fields)
        self._maps = [*others, known]
