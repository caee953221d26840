"""Double DQN: experience replay, and the loss of the online network θ; θ⁻ is the target network."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

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


def double_dqn_loss(
    online: nn.Module,
    target: nn.Module,
    kind: str,
    batch: Transitions,
    state_B: Tensor,
    next_state_B: Tensor,
) -> Tensor:
    """Return the mean squared temporal-difference error of a batch, a scalar."""
    numbers = batch.action, batch.reward, batch.discount
    action_B, reward_B, discount_B = map(torch.from_numpy, numbers)
    # Double DQN (van Hasselt et al. 2016, equation 4) selects the next action with θ and evaluates
    # it with θ⁻. DQN (Mnih et al. 2015) does both with θ⁻, the paper's target as printed with θ.
    selection = target if kind == "dqn" else online
    evaluation = online if kind == "printed" else target
    with torch.no_grad():
        greedy_B1 = selection(next_state_B).argmax(dim=1, keepdim=True)
        next_q_B = evaluation(next_state_B).gather(1, greedy_B1).squeeze(1)
        y_B = reward_B + discount_B * next_q_B
    q_B = online(state_B).gather(1, action_B.unsqueeze(1)).squeeze(1)
    return functional.mse_loss(q_B, y_B)
