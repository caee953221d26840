"""Double DQN: replay memory, and the gradient of the loss by Q.

θ is the online network, θ⁻ the target network.
Dimensions: B = a batch, A = 8 actions.
"""

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

Q: TypeAlias = NDArray[np.float32]


class Transitions(NamedTuple):
    """B transitions; cells are numbers y * W + x on the scenario's map."""

    scenario: NDArray[np.int64]  # (B,), as all others: the number of a map
    cell: NDArray[np.int64]
    action: NDArray[np.int64]
    reward: NDArray[np.float32]
    next_cell: NDArray[np.int64]
    discount: NDArray[np.float32]  # γ, or 0 where the move terminated the episode


class ReplayBuffer:
    """The last `capacity` transitions, in a ring."""

    def __init__(self, capacity: int) -> None:
        """Make an empty buffer for `capacity` transitions."""
        self.capacity = capacity
        self.added = 0  # the number of transitions that were ever added
        # (capacity,) each: the ring, of which the first `len(self)` elements are in
        # use.
        self.transitions = Transitions(
            scenario=np.zeros(capacity, np.int64),
            cell=np.zeros(capacity, np.int64),
            action=np.zeros(capacity, np.int64),
            reward=np.zeros(capacity, np.float32),
            next_cell=np.zeros(capacity, np.int64),
            discount=np.zeros(capacity, np.float32),
        )
        # The absolute error of each transition when it was drawn last, for priorities.
        self.error = np.zeros(capacity, np.float32)

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    def add(self, transitions: Transitions) -> None:
        """Add B transitions, B <= capacity; they replace the oldest ones."""
        indices = (self.added + np.arange(len(transitions.cell))) % self.capacity
        for name, stored in self.transitions._asdict().items():
            stored[indices] = getattr(transitions, name)
        self.added += len(indices)

    def sample(self, count: int, random: np.random.Generator) -> Transitions:
        """Draw `count` transitions uniformly, with replacement."""
        indices = random.integers(len(self), size=count)
        return Transitions._make(stored[indices] for stored in self.transitions)


class NextQ(NamedTuple):
    """The two Q of the next states that a target uses."""

    selection: Q  # (B, 8): its greatest value selects the next action
    evaluation: Q  # (B, 8): its value of this action is that of the next state


def next_q(target: str, online_BA: Q, target_BA: Q) -> NextQ:
    """Return the Q of the next states that a target uses.

    `online_BA` is Q of the next states by θ, and `target_BA` by θ⁻.
    Double DQN (van Hasselt et al. 2016, equation 4) selects the next action with θ and
    evaluates it with θ⁻. DQN (Mnih et al. 2015) does both with θ⁻.
    """
    if target == "dqn":
        return NextQ(selection=target_BA, evaluation=target_BA)
    return NextQ(selection=online_BA, evaluation=target_BA)


def double_dqn_gradient(batch: Transitions, q_BA: Q, next_q: NextQ) -> Q:
    """Return the gradient of the mean squared temporal-difference error by Q: (B, 8).

    `q_BA` is Q of the batch's B states by θ, and `next_q` has Q of its next states. The
    gradient is 0 for actions that were not taken.
    """
    rows = np.arange(len(q_BA))
    next_action_B = next_q.selection.argmax(axis=1)
    next_value_B = next_q.evaluation[rows, next_action_B]
    y_B = batch.reward + batch.discount * next_value_B
    error_B = q_BA[rows, batch.action] - y_B
    gradient_BA = np.zeros_like(q_BA)
    gradient_BA[rows, batch.action] = 2 / len(q_BA) * error_B
    return gradient_BA
