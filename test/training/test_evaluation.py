import numpy as np
import pytest

from ddqn_planner.grid import GridMap, MoveRule, legal_moves
from ddqn_planner.planning import QField
from ddqn_planner.training.evaluation import evaluate, length_ratios

RULE = MoveRule.ROBOT_SAFE
GRID = GridMap(np.array([[0, 0, 0, 1, 0], [0, 0, 0, 1, 0]]))


def field_of(actions: list[list[int]]) -> QField:
    """The field toward (2, 0) that prefers one action in each cell."""
    q = np.zeros((8, *GRID.occupancy.shape), dtype=np.float32)
    for y, x in np.ndindex(GRID.occupancy.shape):
        q[actions[y][x], y, x] = 1
    return QField((2, 0), q, legal_moves(GRID.occupancy, RULE))


def test_a_detour_counts_with_its_length_and_a_trapped_rollout_is_left_out() -> None:
    # (0, 1) goes by (0, 0), (1, 1) and (2, 1) go to each other; nothing joins (4, 0) to the goal.
    field = field_of([[0, 0, 0, 0, 0], [6, 0, 4, 0, 0]])
    detour = 3 / (1 + 2**0.5)
    ratios = [[1, 1, np.nan, np.nan, np.nan], [detour, np.inf, np.inf, np.nan, np.nan]]
    np.testing.assert_allclose(length_ratios(field, GRID, RULE), ratios)
    evaluation = evaluate(field, GRID, RULE)
    assert (evaluation.starts, evaluation.solved) == (5, 3)
    assert evaluation.mean_ratio == pytest.approx((2 + detour) / 3)
    assert evaluation.worst_ratio == pytest.approx(detour)
    # Nobody reaches the goal.
    evaluation = evaluate(field_of([[2, 2, 0, 0, 0], [6, 6, 4, 0, 0]]), GRID, RULE)
    assert evaluation == pytest.approx((5, 0, np.nan, np.nan), nan_ok=True)
