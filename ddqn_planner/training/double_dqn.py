"""Double DQN: the target and the update of the online network."""

from __future__ import annotations

import torch
from torch import Tensor, nn


def double_dqn_target(
    reward_B: Tensor, discount_B: Tensor, next_q_online_BA: Tensor, next_q_target_BA: Tensor
) -> Tensor:
    """Return r + γ Q(s', argmax_a Q(s', a; θ); θ⁻), van Hasselt et al. 2016, equation 4.

    The paper prints its target without θ⁻ on the outer Q; evaluating the online network's choice
    with the target network is what makes it Double DQN.

    Parameters
    ----------
    reward_B : (B,) float32
    discount_B : (B,) float32
        γ, or 0 after a terminal transition.
    next_q_online_BA, next_q_target_BA : (B, 8) float32
        Q of the next state by the online (θ) and the target network (θ⁻).

    Returns
    -------
    (B,) float32
    """
    greedy_B1 = next_q_online_BA.argmax(dim=1, keepdim=True)
    return reward_B + discount_B * next_q_target_BA.gather(1, greedy_B1).squeeze(1)


def double_dqn_loss(
    online: nn.Module,
    target: nn.Module,
    observation_BHW: Tensor,
    action_B: Tensor,
    reward_B: Tensor,
    next_observation_BHW: Tensor,
    discount_B: Tensor,
) -> Tensor:
    """Return the mean squared temporal-difference error of a batch, a scalar."""
    with torch.no_grad():
        y_B = double_dqn_target(
            reward_B, discount_B, online(next_observation_BHW), target(next_observation_BHW)
        )
    q_B = online(observation_BHW).gather(1, action_B.unsqueeze(1)).squeeze(1)
    return nn.functional.mse_loss(q_B, y_B)
