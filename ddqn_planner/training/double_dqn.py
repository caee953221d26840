"""Double DQN: the target and the update of the online network."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional


def double_dqn_target(
    reward_B: Tensor, discount_B: Tensor, next_q_choose_BA: Tensor, next_q_judge_BA: Tensor
) -> Tensor:
    """Return r + γ Q(s', argmax_a Q(s', a; choose); judge).

    One network chooses the next action, one judges it. Double DQN (van Hasselt et al. 2016,
    equation 4) lets the online network θ choose and the target network θ⁻ judge. In DQN (Mnih et
    al. 2015) θ⁻ does both, in the paper's target as it is printed, without θ⁻, θ does both.

    Parameters
    ----------
    reward_B : (B,) float32
    discount_B : (B,) float32
        γ, or 0 after a terminal transition.
    next_q_choose_BA, next_q_judge_BA : (B, 8) float32
        Q of the next state by the network that chooses, and by the one that judges.

    Returns
    -------
    (B,) float32
    """
    greedy_B1 = next_q_choose_BA.argmax(dim=1, keepdim=True)
    return reward_B + discount_B * next_q_judge_BA.gather(1, greedy_B1).squeeze(1)


def double_dqn_loss(
    online: Callable[[Tensor], Tensor],
    choose: Callable[[Tensor], Tensor],
    judge: Callable[[Tensor], Tensor],
    state_B: Tensor,
    action_B: Tensor,
    reward_B: Tensor,
    next_state_B: Tensor,
    discount_B: Tensor,
) -> Tensor:
    """Return the mean squared temporal-difference error of a batch, a scalar.

    Parameters
    ----------
    online, choose, judge : callable
        From states (B, ...) to Q (B, 8): by θ, which learns, and by the two networks of
        `double_dqn_target`.
    state_B, next_state_B : (B, ...)
        What the callables take.
    action_B : (B,) int64
    reward_B, discount_B : (B,) float32
        See `double_dqn_target`.
    """
    with torch.no_grad():
        y_B = double_dqn_target(reward_B, discount_B, choose(next_state_B), judge(next_state_B))
    q_B = online(state_B).gather(1, action_B.unsqueeze(1)).squeeze(1)
    return functional.mse_loss(q_B, y_B)
