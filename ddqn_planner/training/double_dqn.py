"""Double DQN: the target y and the loss of the online network θ; θ⁻ is the target network.

Dimensions: B = a batch, A = 8 actions.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

Network = Callable[[Tensor], Tensor]
"""From states (B, ...) to Q (B, 8)."""


def double_dqn_target(
    reward_B: Tensor, discount_B: Tensor, next_q_selection_BA: Tensor, next_q_evaluation_BA: Tensor
) -> Tensor:
    """Return y = r + γ Q(s', argmax_a Q(s', a; selection); evaluation): (B,) float32.

    The selection network selects the next action, the evaluation network gives its value. The
    discount is γ, or 0 after a terminal transition.
    """
    greedy_B1 = next_q_selection_BA.argmax(dim=1, keepdim=True)
    return reward_B + discount_B * next_q_evaluation_BA.gather(1, greedy_B1).squeeze(1)


def double_dqn_loss(
    online: Network,
    target: Network,
    kind: str,
    state_B: Tensor,
    action_B: Tensor,
    reward_B: Tensor,
    next_state_B: Tensor,
    discount_B: Tensor,
) -> Tensor:
    """Return the mean squared temporal-difference error of a batch, a scalar.

    Which networks select and evaluate the next action, `kind` says. "double_dqn" (van Hasselt et
    al. 2016, equation 4): θ and θ⁻. "dqn" (Mnih et al. 2015): θ⁻ does both. "printed", the paper's
    target as printed: θ does both.
    """
    selection = target if kind == "dqn" else online
    evaluation = online if kind == "printed" else target
    with torch.no_grad():
        next_q = selection(next_state_B), evaluation(next_state_B)
        y_B = double_dqn_target(reward_B, discount_B, *next_q)
    q_B = online(state_B).gather(1, action_B.unsqueeze(1)).squeeze(1)
    return functional.mse_loss(q_B, y_B)
