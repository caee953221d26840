"""Double DQN: replay memory, and the gradient of the online network θ; θ⁻ is the target network."""

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

Q: TypeAlias = NDArray[np.float32]

# Dimensions: B = a batch, A = 8 actions.


class Transitions(NamedTuple):
    """B transitions as arrays, (B,) each; cells are numbers y * W + x on the scenario's map."""

    scenario: NDArray[np.int64]
    cell: NDArray[np.int64]
    action: NDArray[np.int64]
    reward: NDArray[np.float32]
    next_cell: NDArray[np.int64]
    discount: NDArray[np.float32]  # γ, or 0 where the move terminated the episode


class ReplayBuffer:
    """The last `capacity` transitions, in a ring."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.added = 0
        self.transitions = Transitions._make(
            np.zeros(
                capacity, np.float32 if name in ("reward", "discount") else np.int64
            )
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


def double_dqn_gradient(
    kind: str, batch: Transitions, target_BA: Q, online_2BA: Q
) -> Q:
    """Return the gradient of the mean squared temporal-difference error by Q of states: (B, 8)."""
    # Given is Q of the next states by θ⁻, and Q of the states and then the next ones by θ.
    q_BA, online_BA = np.split(online_2BA, 2)
    # Double DQN (van Hasselt et al. 2016, equation 4) selects the next action with θ and evaluates
    # it with θ⁻. DQN (Mnih et al. 2015) does both with θ⁻, the paper's target as printed with θ.
    selection_BA = target_BA if kind == "dqn" else online_BA
    evaluation_BA = online_BA if kind == "printed" else target_BA
    each = np.arange(len(q_BA))
    y_B = (
        batch.reward + batch.discount * evaluation_BA[each, selection_BA.argmax(axis=1)]
    )
    gradient_BA = np.zeros_like(q_BA)
    gradient_BA[each, batch.action] = 2 / len(q_BA) * (q_BA[each, batch.action] - y_B)
    return gradient_BA
