from __future__ import annotations

import pytest
import torch

from ddqn_planner.training.double_dqn import double_dqn_target


def test_one_network_selects_and_the_other_evaluates() -> None:
    target = double_dqn_target(
        reward_B=torch.tensor([1.0, -10.0]),
        discount_B=torch.tensor([0.9, 0.0]),
        next_q_selection_BA=torch.tensor([[0.0, 5.0, 1.0], [7.0, 0.0, 0.0]]),
        next_q_evaluation_BA=torch.tensor([[100.0, 2.0, 3.0], [50.0, 0.0, 0.0]]),
    )
    assert target.tolist() == pytest.approx([1.0 + 0.9 * 2.0, -10.0])
