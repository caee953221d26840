"""A Q field that is computed where a request needs it, and repaired when the map changes."""

from __future__ import annotations

import threading
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.grid.arguments import cell_inside
from ddqn_planner.model.move_costs import MoveCosts
from ddqn_planner.planning.plan import Plan, PlanStatus
from ddqn_planner.planning.q_field import Goals, QField


class Known(NamedTuple):
    """What is known of a field, see `wavefront`.

    Parameters
    ----------
    distance, state : (C,) float64, (C,) uint8
    opened : (N,) int32
        The open cells.
    closed_is_final : bool
        Whether the distances of closed cells are the least ones. After a repair they may be too
        great, until the field grows to the cell.
    """

    distance: NDArray[np.float64]
    state: NDArray[np.uint8]
    opened: NDArray[np.int32]
    closed_is_final: bool = True


class DistanceField(QField):
    """The Q field of a network that judges every move of the map right.

    Q(s, a) is minus the cost of a and of the cheapest path from where it leads, so distances to the
    goal hold all of it. They grow from the goal until they reach a start, see
    `ddqn_planner.model.wavefront`; `q`, `value` and `policy` are made of the whole map when asked
    for. Several threads may use one field.

    Parameters
    ----------
    goals : tuple of (x, y)
        Free cells. Paths lead to the nearest one; `goal` is the first.
    grid : GridMap
    costs : MoveCosts
        Of this map under the move rule.
    move_rule : MoveRule
    """

    def __init__(self, goals: Goals, grid: GridMap, costs: MoveCosts, move_rule: MoveRule) -> None:
        from ddqn_planner.model import field_values, wavefront

        self.wavefront, self.field_values = wavefront, field_values
        self.grid, self.costs, self.move_rule = grid, costs, move_rule
        self.goal, self.goals = goals[0], goals
        self.lock = threading.RLock()

    @cached_property
    def known(self) -> Known:
        """What is known, at first the goals alone."""
        cells = self.costs.patch.size
        roots = np.array([self._number(goal) for goal in self.goals], np.int32)
        return Known(*self.wavefront.begun(np.zeros(cells), np.zeros(cells, np.uint8), roots))

    def _number(self, cell: Cell) -> int:
        return (cell[1] + 1) * self.costs.width + cell[0] + 1

    def take(self) -> Known:
        """Return what is known, and begin anew.

        What changes it takes it, and gives it back when it is done. So after any exception on the
        way, as a lack of memory, the field begins anew.
        """
        with self.lock:
            known = self.known
            del self.known
            return known

    @property
    def is_whole(self) -> bool:
        """Whether the distances of all cells are known."""
        return not self.known.opened.size

    @property
    def has_values_of_all(self) -> bool:
        """Whether values of the whole map were asked for."""
        return not self.__dict__.keys().isdisjoint(("q", "value", "policy"))

    def reach(self, start: Cell, limit: int | None = None) -> bool:
        """Compute the field as far as a start needs it; return whether its distance is known."""
        number, done = self._number(start), True
        if not self._is_final(number):
            distance, state, opened, closed_is_final = self.take()
            limit = distance.size if limit is None else limit
            opened, done = self.wavefront.grow(distance, state, opened, self.costs, number, limit)
            self.known = Known(distance, state, opened, closed_is_final)
        closed = self.known.state[number] == self.wavefront.CLOSED
        return bool((done or self.is_whole) and closed)

    def _is_final(self, number: int) -> bool:
        """Return whether no more of the field is needed to know the distance of a cell."""
        closed = self.known.state[number] == self.wavefront.CLOSED
        return self.is_whole or bool(self.known.closed_is_final and closed)

    def rollout_if_known(self, start: Cell) -> Plan | None:
        """Return the rollout from a start if no more of the field is needed, else None."""
        start = cell_inside(start, self.grid.occupancy.shape, "the start")
        if not self.lock.acquire(blocking=False):
            return None  # another thread computes it
        try:
            return self._rollout(start) if self._is_final(self._number(start)) else None
        finally:
            self.lock.release()

    def rollout(self, start: Cell, limit: int | None = None) -> Plan:
        """Take greedy steps from a free cell until a goal, and return the path.

        Parameters
        ----------
        start : (x, y)
        limit : int, optional
            About how many cells may be visited to compute the field as far as the start. The plan
            is ROLLOUT_TRAPPED if that is not enough.

        Raises
        ------
        ValueError
            If the start is no cell of the map.
        """
        return self._rollout(cell_inside(start, self.grid.occupancy.shape, "the start"), limit)

    def _rollout(self, start: Cell, limit: int | None = None) -> Plan:
        with self.lock:
            if not self.reach(start, limit):
                status = PlanStatus.NO_PATH if self.is_whole else PlanStatus.ROLLOUT_TRAPPED
                return Plan(status, move_rule=self.move_rule)
            path = self.field_values.roll_out(self.known.distance, self.costs, self._number(start))
        return Plan(PlanStatus.SUCCEEDED, path, move_rule=self.move_rule)

    def _whole(self) -> NDArray[np.float64]:
        """Return the distance of every cell of the padded map, 0 where there is none: (C,)."""
        if not self.is_whole:
            distance, state, opened, _ = self.take()
            self.wavefront.grow_whole(distance, state, opened, self.costs)
            self.known = Known(distance, state, opened[:0])
        return self.known.distance

    @cached_property
    def q(self) -> NDArray[np.float32]:  # type: ignore[override]
        """(8, H, W) float32: Q(s, a); -inf where no path to the goal begins with the action."""
        with self.lock:
            return self.field_values.q_of(self._whole(), self.costs)

    @cached_property
    def legal(self) -> NDArray[np.bool_]:  # type: ignore[override]
        """(8, H, W) bool: the legal moves."""
        return self.grid.legal_moves(self.move_rule)

    @cached_property
    def value(self) -> NDArray[np.float32]:
        """(H, W) float32: the greatest Q of a legal move, and at the goal the greatest of all."""
        with self.lock:
            distance = self._whole().reshape(-1, self.costs.width)[1:-1, 1:-1]
            value = np.negative(distance, dtype=np.float32, casting="same_kind")
            value[value == 0] = -np.inf
        x, y = np.transpose(self.goals)
        value[y, x] = -np.inf
        value[y, x] = value.max()
        return value

    @cached_property
    def policy(self) -> NDArray[np.int8]:
        """(H, W) int8: the action of a rollout in each cell; -1 without one."""
        with self.lock:
            return self.field_values.policy_of(self._whole(), self.costs)

    @property
    def nbytes(self) -> int:
        """Memory, bytes: 9 per cell, and more once `q` and so on were made."""
        made = (self.__dict__.get(name) for name in ("q", "legal", "value", "policy"))
        cells = int(self.costs.patch.size)
        return 9 * cells + sum(int(array.nbytes) for array in made if array is not None)
