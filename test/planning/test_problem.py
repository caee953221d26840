from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from networks import turning_network

from ddqn_planner.grid import GridMap, MoveRule
from ddqn_planner.model import ModelMetadata
from ddqn_planner.planning import PlanMethod, Planner, PlanStatus
from ddqn_planner.planning.problem import Problem, search_on, solve


def turning_planner() -> Planner:
    """Return one that goes to -x, or where it cannot, to +x: its greedy steps are trapped."""
    network = turning_network(6)
    metadata = ModelMetadata("paper", network.sizes, MoveRule.ROBOT_SAFE, 0.9, "", 1, 0, "")
    return Planner(network, metadata)


@pytest.mark.parametrize("simplified", [False, True])
def test_a_search_goes_on_from_what_the_trapped_steps_found(
    simplified: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid, rule = GridMap(np.zeros((6, 6))), MoveRule.ROBOT_SAFE
    guided = Problem(
        turning_planner(), grid, (0, 0), (5, 5), rule, PlanMethod.ASTAR_FALLBACK, 0.0, simplified
    )
    trapped = solve(replace(guided, method=PlanMethod.GREEDY))
    assert trapped.plan.status is PlanStatus.ROLLOUT_TRAPPED
    whole = solve(guided)
    for name in ("route", "q_field", "known_field", "follow"):
        monkeypatch.delattr(Planner, name)
    found = search_on(guided, trapped)
    assert (found.plan, found.cells, found.goal) == (whole.plan, whole.cells, whole.goal)
    assert found.plan.method is PlanMethod.ASTAR_FALLBACK
    assert found.field_ms == trapped.field_ms
    assert found.rollout_ms > trapped.rollout_ms
    assert len(found.cells) == (2 if simplified else 6)
