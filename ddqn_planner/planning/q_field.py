"""The Q field: Q(s, a) of every cell toward one goal, and greedy rollouts in it."""

from __future__ import annotations

from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import MOVES, Cell, MoveRule
from ddqn_planner.grid.arguments import cell_inside, numbers
from ddqn_planner.planning.plan import Plan, PlanStatus

Goals: TypeAlias = tuple[Cell, ...]
"""Different free cells, sorted: a path may end in any of them."""

_STEPS: list[Cell] = [(int(dx), int(dy)) for dx, dy in MOVES]


class QField:
    """Q(s, a) of every cell of one map toward one goal.

    Parameters
    ----------
    goal : (x, y)
        A free cell.
    q : (8, H, W) float32
        The network's value of each action in each cell; -inf where no way to the goal is known.
    legal : (8, H, W) bool
        The legal moves. The robot knows its map and takes no other.
    move_rule : MoveRule
        The rule by which they are legal.
    """

    q: NDArray[np.float32]
    legal: NDArray[np.bool_]

    def __init__(
        self,
        goal: Cell,
        q: NDArray[np.float32],
        legal: NDArray[np.bool_],
        move_rule: MoveRule = MoveRule.ROBOT_SAFE,
    ) -> None:
        self.q = numbers("q", q)
        if self.q.ndim != 3 or len(self.q) != len(MOVES) or not self.q.size:
            raise ValueError(f"q has shape {self.q.shape}; give (8, H, W)")
        self.legal, self.move_rule = numbers("legal", legal, self.q.shape, "b"), MoveRule(move_rule)
        self.goal = cell_inside(goal, self.q.shape[1:], "the goal")
        self.goals: Goals = (self.goal,)

    @cached_property
    def value(self) -> NDArray[np.float32]:
        """(H, W) float32: the greatest Q of a legal move, and at the goal the greatest of all."""
        legal_q = np.where(self.legal, self.q, np.float32(-np.inf))
        value: NDArray[np.float32] = legal_q.max(axis=0)
        value[self.goal[1], self.goal[0]] = value.max()
        return value

    @cached_property
    def policy(self) -> NDArray[np.int8]:
        """(H, W) int8: the legal action of the greatest Q; -1 where that is -inf."""
        best = np.full(self.q.shape[1:], -np.inf, dtype=np.float32)
        policy = np.full(self.q.shape[1:], -1, dtype=np.int8)
        for action, (q, legal) in enumerate(zip(self.q, self.legal, strict=True)):
            better = legal & (q > best)
            np.copyto(best, q, where=better)
            np.copyto(policy, action, where=better)
        return policy

    @property
    def nbytes(self) -> int:
        """Memory of the field with its value and policy, bytes."""
        return int(self.q.nbytes + self.legal.nbytes + 5 * self.q[0].size)

    def unmasked(self) -> QField:
        """Return the field without action masking: a rollout is trapped by an illegal move."""
        greedy_1HW = self.q.argmax(axis=0, keepdims=True)
        actions_A11 = np.arange(len(MOVES)).reshape(-1, 1, 1)
        legal = self.legal & (actions_A11 == greedy_1HW)
        return QField(self.goal, self.q, legal, self.move_rule)

    def rollout_if_known(self, start: Cell) -> Plan | None:
        """Return the rollout from a start if no more of the field is needed, else None."""
        return self.rollout(start)

    def rollout(self, start: Cell) -> Plan:
        """Take greedy steps from a free cell until the goal, and return the path.

        The plan is ROLLOUT_TRAPPED as soon as a cell is entered again: the steps would repeat.

        Raises
        ------
        ValueError
            If the start is no cell of the map.
        """
        policy = self.policy
        cell = cell_inside(start, policy.shape, "the start")
        cells, visited = [cell], {cell}
        while cell != self.goal:
            action = int(policy[cell[1], cell[0]])
            cell = (cell[0] + _STEPS[action][0], cell[1] + _STEPS[action][1])
            if action < 0 or cell in visited:
                return Plan(PlanStatus.ROLLOUT_TRAPPED, move_rule=self.move_rule)
            visited.add(cell)
            cells.append(cell)
        return Plan(PlanStatus.SUCCEEDED, np.array(cells), move_rule=self.move_rule)
