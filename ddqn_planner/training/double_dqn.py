"""Double DQN: the target and the update of the online network."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional


def double_dqn_target(
    reward_B: Tensor, discount_B: Tensor, next_q_selection_BA: Tensor, next_q_evaluation_BA: Tensor
) -> Tensor:
    """Return r + γ Q(s', argmax_a Q(s', a; selection); evaluation).

    The selection network selects the next action, the evaluation network gives its value. In Double
    DQN (van Hasselt et al. 2016, equation 4) these are the online network θ and the target network
    θ⁻. In DQN (Mnih et al. 2015) both are θ⁻. In the paper's target as printed both are θ.

    Parameters
    ----------
    reward_B : (B,) float32
    discount_B : (B,) float32
        γ, or 0 after a terminal transition.
    next_q_selection_BA, next_q_evaluation_BA : (B, 8) float32
        Q of the next state by the two networks.

    Returns
    -------
    (B,) float32
    """
    greedy_B1 = next_q_selection_BA.argmax(dim=1, keepdim=True)
    return reward_B + discount_B * next_q_evaluation_BA.gather(1, greedy_B1).squeeze(1)


def double_dqn_loss(
    online: Callable[[Tensor], Tensor],
    selection: Callable[[Tensor], Tensor],
    evaluation: Callable[[Tensor], Tensor],
    state_B: Tensor,
    action_B: Tensor,
    reward_B: Tensor,
    next_state_B: Tensor,
    discount_B: Tensor,
) -> Tensor:
    """Return the mean squared temporal-difference error of a batch, a scalar.

    Parameters
    ----------
    online, selection, evaluation : callable
        From states (B, ...) to Q (B, 8): by θ, which learns, and by the two networks of
        `double_dqn_target`.
    state_B, next_state_B : (B, ...)
        What the callables take.
    action_B : (B,) int64
    reward_B, discount_B : (B,) float32
        See `double_dqn_target`.
    """
    with torch.no_grad():
        y_B = double_dqn_target(
            reward_B, discount_B, selection(next_state_B), evaluation(next_state_B)
        )
    q_B = online(state_B).gather(1, action_B.unsqueeze(1)).squeeze(1)
    return functional.mse_loss(q_B, y_B)
