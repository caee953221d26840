"""A Q field that is computed where a request needs it, and repaired when the map changes."""

from __future__ import annotations

import threading
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.model.move_costs import MoveCosts
from ddqn_planner.planning.plan import Plan, PlanStatus
from ddqn_planner.planning.q_field import Goals, QField, check_inside

FieldArrays: TypeAlias = tuple[NDArray[np.float64], NDArray[np.uint8], NDArray[np.int32]]
"""The distances, (C,); the states of the cells, (C,); the open cells, (N,). See `wavefront`."""


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
        self.is_whole = False
        # After a repair the distance of a closed cell may be too great, until `reach` is called.
        self.closed_is_final = True

    @cached_property
    def arrays(self) -> FieldArrays:
        """What is known, at first the goals alone."""
        cells = self.costs.patch.size
        roots = np.array([self._number(goal) for goal in self.goals], np.int32)
        return self.wavefront.begun(np.zeros(cells), np.zeros(cells, np.uint8), roots)

    def _number(self, cell: Cell) -> int:
        return (cell[1] + 1) * self.costs.width + cell[0] + 1

    def forget(self) -> FieldArrays:
        """Return what is known, and begin anew."""
        with self.lock:
            arrays = self.arrays
            del self.arrays
            self.is_whole, self.closed_is_final = False, True
            return arrays

    @property
    def has_values_of_all(self) -> bool:
        """Whether values of the whole map were asked for."""
        return not self.__dict__.keys().isdisjoint(("q", "value", "policy"))

    def reach(self, start: Cell, limit: int | None = None) -> bool:
        """Compute the field as far as a start needs it; return whether its distance is known."""
        distance, state, opened = self.arrays
        number, closed, done = self._number(start), self.wavefront.CLOSED, True
        if not self.is_whole and not (self.closed_is_final and state[number] == closed):
            limit = distance.size if limit is None else limit
            opened, done = self.wavefront.grow(distance, state, opened, self.costs, number, limit)
            self.arrays = distance, state, opened
            self.is_whole = not opened.size
            self.closed_is_final |= self.is_whole
        return bool((done or self.is_whole) and state[number] == closed)

    def rollout_if_known(self, start: Cell) -> Plan | None:
        """Return the rollout from a start if no more of the field is needed, else None."""
        if not self.lock.acquire(blocking=False):
            return None  # another thread computes it
        try:
            closed = self.arrays[1][self._number(start)] == self.wavefront.CLOSED
            known = self.is_whole or (self.closed_is_final and closed)
            return self.rollout(start) if known else None
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
        start = check_inside(start, (self.grid.height, self.grid.width))
        with self.lock:
            if not self.reach(start, limit):
                status = PlanStatus.NO_PATH if self.is_whole else PlanStatus.ROLLOUT_TRAPPED
                return Plan(status, move_rule=self.move_rule)
            path = self.field_values.roll_out(self.arrays[0], self.costs, self._number(start))
        return Plan(PlanStatus.SUCCEEDED, path, move_rule=self.move_rule)

    def _whole(self) -> NDArray[np.float64]:
        """Return the distance of every cell of the padded map, 0 where there is none: (C,)."""
        if not self.is_whole:
            distance, state, opened = self.arrays
            self.wavefront.grow_whole(distance, state, opened, self.costs)
            self.arrays = distance, state, opened[:0]
            self.is_whole = self.closed_is_final = True
        return self.arrays[0]

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
