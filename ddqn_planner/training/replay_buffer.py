"""Experience replay: a ring buffer of transitions, with cell numbers instead of observations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Transitions(NamedTuple):
    """B transitions as arrays, (B,) each; cells are numbers y * W + x on the scenario's map."""

    scenario: NDArray[np.int64]
    cell: NDArray[np.int64]
    action: NDArray[np.int64]
    reward: NDArray[np.float32]
    next_cell: NDArray[np.int64]
    discount: NDArray[np.float32]
    """γ, or 0 where the move terminated the episode; a truncated episode keeps γ."""


class ReplayBuffer:
    """The last `capacity` transitions."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.added = 0
        self.transitions = Transitions._make(
            np.zeros(capacity, np.float32 if name in ("reward", "discount") else np.int64)
            for name in Transitions._fields
        )

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    def add(self, transitions: Transitions) -> None:
        """Add B transitions, B <= capacity; they replace the oldest ones."""
        indices = (self.added + np.arange(len(transitions.cell))) % self.capacity
        for name in Transitions._fields:
            getattr(self.transitions, name)[indices] = getattr(transitions, name)
        self.added += len(indices)

    def sample(self, count: int, random: np.random.Generator) -> Transitions:
        """Draw `count` transitions uniformly, with replacement."""
        indices = random.integers(len(self), size=count)
        return Transitions._make(stored[indices] for stored in self.transitions)
