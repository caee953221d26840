from __future__ import annotations

import time
from collections import Counter

import numpy as np
import pytest
from networks import turning_network

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.model import ModelMetadata
from ddqn_planner.planning import Plan, PlanMethod, Planner, PlanRequest, PlanStatus, QField
from ddqn_planner.planning.planner import last_step

RULE = MoveRule.ROBOT_SAFE


def turning_planner() -> Planner:
    """Return one that goes to -x, or where it cannot, to +x: its greedy steps are trapped."""
    network = turning_network(6)
    metadata = ModelMetadata("paper", network.sizes, MoveRule.ROBOT_SAFE, 0.9, "", 1, 0, "")
    return Planner(network, metadata)


@pytest.mark.parametrize("method", PlanMethod)
@pytest.mark.parametrize("tolerance", [0.0, 3.0])
@pytest.mark.parametrize("field_is_known", [False, True])
@pytest.mark.parametrize("goal", [(5, 5), (5, 0)])
def test_no_path_is_rolled_out_twice(
    method: PlanMethod,
    tolerance: float,
    field_is_known: bool,
    goal: Cell,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    planner, grid = turning_planner(), GridMap(np.zeros((6, 6)))
    if field_is_known:
        planner.q_field(grid, goal)
    rollout, rollouts = QField.rollout, Counter[Cell]()

    def counted(field: QField, start: Cell) -> Plan:
        rollouts[field.goal] += 1
        return rollout(field, start)

    monkeypatch.setattr(QField, "rollout", counted)
    planner.plan(grid, (0, 0), goal, method=method, tolerance=tolerance)
    assert rollouts == {goal: 1}


def test_the_time_between_two_steps_does_not_count() -> None:
    planner, grid = turning_planner(), GridMap(np.zeros((6, 6)))
    steps = planner.steps(PlanRequest(grid, (0, 0), (5, 5), RULE, PlanMethod.ASTAR_FALLBACK))
    began = time.perf_counter()
    for _ in range(2):
        assert next(steps) is None
        time.sleep(0.2)
    plan = last_step(steps)
    waited = 1e3 * (time.perf_counter() - began)
    assert plan.field_ms + plan.rollout_ms < waited - 400


def test_a_field_grows_in_steps_between_which_others_are_answered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    occupancy = np.zeros((40, 40), dtype=np.bool_)
    occupancy[20, :39] = True
    grid, planner = GridMap(occupancy), Planner.load("any_map")
    whole = planner.plan(grid, (0, 0), (0, 39))
    closed = occupancy.copy()
    closed[20] = True
    monkeypatch.setattr("ddqn_planner.planning.planner.VISITS", 20)
    planner = Planner.load("any_map")
    steps = planner.steps(PlanRequest(grid, (0, 0), (0, 39), RULE))
    waited = 0
    for plan in steps:
        waited += plan is None
        assert planner.plan(grid, (waited % 40, 0), (5, 5)).status is PlanStatus.SUCCEEDED
    assert waited > 10
    assert plan == whole
    given_up = planner.steps(PlanRequest(grid, (0, 0), (1, 39), RULE))
    assert next(given_up) is next(given_up) is None
    given_up.close()  # type: ignore[attr-defined]
    assert planner.plan(grid, (0, 0), (1, 39)).status is PlanStatus.SUCCEEDED
    assert planner.plan(GridMap(closed), (0, 0), (0, 39)).status is PlanStatus.NO_PATH
