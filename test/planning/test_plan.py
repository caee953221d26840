import json
import pickle
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from ddqn_planner import Plan, PlanStatus

CELLS = ((0, 0), (1, 0), (2, 1))
PLAN = Plan(PlanStatus.SUCCEEDED, np.array(CELLS), cost=2.5, goal=(2, 1), field_ms=1.0)


def test_the_cells_of_a_plan_are_pairs_of_python_ints() -> None:
    assert PLAN.cells == CELLS
    assert json.loads(json.dumps(PLAN.cells)) == [[0, 0], [1, 0], [2, 1]]
    assert PLAN.path.dtype == np.int32
    assert PLAN.length == pytest.approx(1 + 2**0.5)
    nothing = Plan(PlanStatus.NO_PATH)
    assert (nothing.cells, nothing.path.shape, nothing.length) == ((), (0, 2), 0)


def test_plans_are_equal_whatever_time_they_took() -> None:
    assert Plan(PlanStatus.SUCCEEDED, np.array(CELLS), cost=2.5) != PLAN
    for same in (replace(PLAN, field_ms=7.0, rollout_ms=2.0), pickle.loads(pickle.dumps(PLAN))):
        assert same == PLAN
        assert hash(same) == hash(PLAN)
        assert same.cells == CELLS
    shorter = replace(PLAN, path=np.array(CELLS[:2]))
    assert shorter.cells == CELLS[:2]
    others = replace(PLAN, cost=2.6), replace(PLAN, goal=(0, 0)), replace(PLAN, move_rule="unit")
    for other in (shorter, replace(PLAN, status=PlanStatus.NO_PATH), *others, CELLS):
        assert other != PLAN


def test_a_plan_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        PLAN.path[0, 0] = 5
    with pytest.raises(FrozenInstanceError):
        PLAN.cost = 1.0  # type: ignore[misc]
    cells = np.array(CELLS, dtype=np.int32)
    assert Plan(PlanStatus.SUCCEEDED, cells).cells == CELLS
    cells[0, 0] = 5  # the array that was given stays writable
