from __future__ import annotations

from math import sqrt

import pytest

from ddqn_planner.grid import MOVES
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.reward import free_cell_reward


@pytest.mark.parametrize(
    ("alpha", "beta", "expected"),
    [
        (1.0, 0.0, sqrt(10) - 2),  # d_re falls from sqrt(3² + 1²) to 2
        (0.0, 1.0, (2 - sqrt(2)) - sqrt(2)),  # d_rs grows from sqrt(2) to 2, by a move of sqrt(2)
        (0.6, 0.4, 0.6 * (sqrt(10) - 2) + 0.4 * (2 - 2 * sqrt(2))),
        (0.0, 0.0, 0.0),
    ],
)
def test_a_diagonal_move_is_rewarded_as_section_4_2_says(
    alpha: float, beta: float, expected: float
) -> None:
    parameters = HyperParameters(alpha=alpha, beta=beta)
    reward = free_cell_reward((3, 5), start=(0, 0), goal=(4, 0), parameters=parameters)
    right_and_down = MOVES.tolist().index([1, -1])
    assert reward[right_and_down, 1, 1] == pytest.approx(expected, abs=1e-6)
