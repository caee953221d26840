from __future__ import annotations

import pytest
import torch
from torch import nn

from ddqn_planner.training.double_dqn import double_dqn_loss, double_dqn_target


def test_one_network_selects_and_the_other_evaluates() -> None:
    target = double_dqn_target(
        reward_B=torch.tensor([1.0, -10.0]),
        discount_B=torch.tensor([0.9, 0.0]),
        next_q_selection_BA=torch.tensor([[0.0, 5.0, 1.0], [7.0, 0.0, 0.0]]),
        next_q_evaluation_BA=torch.tensor([[100.0, 2.0, 3.0], [50.0, 0.0, 0.0]]),
    )
    assert target.tolist() == pytest.approx([1.0 + 0.9 * 2.0, -10.0])


def test_the_loss_moves_the_online_network_alone() -> None:
    online, target = nn.Linear(2, 3), nn.Linear(2, 3)
    loss = double_dqn_loss(
        online,
        target,
        "double_dqn",
        torch.ones(4, 2),
        torch.tensor([0, 1, 2, 0]),
        torch.zeros(4),
        torch.ones(4, 2),
        torch.full((4,), 0.9),
    )
    loss.backward()
    assert online.weight.grad is not None
    assert target.weight.grad is None
    best = online(torch.ones(2)).argmax()
    y = 0.9 * target(torch.ones(2))[best].item()
    errors = [online(torch.ones(2))[a].item() - y for a in (0, 1, 2, 0)]
    assert loss.item() == pytest.approx(sum(error**2 for error in errors) / 4, rel=1e-5)
