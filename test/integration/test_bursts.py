"""Requests that come at once: each is answered."""

from collections.abc import Callable
from typing import Any

import pytest
from load import BurstClients, GoalBursts, burst_requests
from nav_msgs.srv import GetMap

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("clients", [1, 20])
def test_each_request_of_a_burst_has_its_plan(robot: Any, clients: int) -> None:
    with BurstClients(clients, service="/robot/planner/get_plan") as asking:
        requests = burst_requests(robot.grid, [(5, 5)], 200)
        answers = asking.burst(requests)
    assert len(answers) == 200
    assert all(answer is not None and answer.plan.poses for answer in answers)


def test_each_request_of_a_burst_has_its_map(run_node: Callable[..., Any]) -> None:
    with (
        run_node("map_server_node", {}, namespace="/burst"),
        BurstClients(1, GetMap, "/burst/map_server/map") as asking,
    ):
        answers = asking.burst([GetMap.Request()] * 200)
    assert all(answer is not None and answer.map.info.width == 20 for answer in answers)


def test_each_goal_of_a_burst_has_a_result(robot: Any) -> None:
    pytest.importorskip("nav2_msgs.action", reason="nav2_msgs is not on PyPI")
    with GoalBursts("/robot/compute_path_to_pose", "/robot/planner") as asking:
        assert asking.burst(burst_requests(robot.grid, [(5, 5)], 200)) == 200
