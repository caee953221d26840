"""The scripts of `make load` and `make soak`, at a small scale."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bursts import load_bursts
from client import Client, plan_request, pose
from load import load_goals, load_requests
from map_fixture import MapFixture
from nav_msgs.msg import Path as PathMessage
from soak import Work, growth, soak

from ddqn_planner.grid import Cell, MapFile


@pytest.mark.slow(seconds=20)
def test_every_answer_is_right_while_the_map_changes_and_goals_are_planned_in_order(
    run_node: Callable[..., Any], capfd: pytest.CaptureFixture[str]
) -> None:
    with run_node("planner_node") as node:
        assert load_requests(node.process.pid, requests=200, clients=4), capfd.readouterr().out
        assert load_goals(200), capfd.readouterr().out
        assert load_bursts((20, 50), (20,), 2), capfd.readouterr().out
    assert "Traceback" not in node.log


@pytest.mark.parametrize(
    ("start", "goal", "path", "error"),
    [
        ((0, 0), (1, 1), [(0, 0), (0, 1), (1, 1)], ""),
        ((0, 0), (0, 0), [(0, 0)], ""),
        ((0, 0), (2, 0), [], ""),
        ((1, 0), (0, 0), [], ""),
        ((0, 0), (9, 9), [], ""),
        ((0, 0), (1, 1), [], "where there is one"),
        ((0, 0), (1, 1), [(0, 0), (0, 1)], "asked was"),
        ((0, 0), (1, 1), [(0, 0), (1, 1)], "illegal move"),
        ((0, 0), (1, 1), [(0, 0), (1, 0), (1, 1)], "illegal move"),
        ((0, 0), (0, 2), [(0, 0), (0, 2)], "illegal move"),
        ((0, 0), (0, 1), [(0, 0), (-1, 0), (0, 1)], "illegal move"),
    ],
)
def test_the_check_of_an_answer_finds_each_error(
    start: Cell, goal: Cell, path: list[Cell], error: str
) -> None:
    values = np.array([[0, 100, 0], [0, 0, 100], [0, 100, 0]], dtype=np.int8)
    fixture = MapFixture(MapFile(values, 0.1, (1.0, 2.0, 0.3)))
    plan = PathMessage(poses=[pose(fixture.grid, cell) for cell in path])
    found = fixture.error(plan_request(fixture.grid, start, goal), plan)
    assert error in found
    assert bool(error) == bool(found)


@pytest.mark.slow
def test_mixed_work_with_bad_input_is_answered_and_sampled(
    run_node: Callable[..., Any], tmp_path: Path
) -> None:
    with (
        run_node("map_server_node") as map_server,
        run_node("planner_node") as planner,
        Client() as client,
    ):
        work = Work(client, tmp_path)
        work.bad_input()
        nodes = {"map_server_node": map_server.process, "planner_node": planner.process}
        samples = soak(nodes, work, minutes=0.05)
    assert work.lost == 0
    assert work.done.total() > 0
    assert all(memory and min(memory) > 0 for memory in samples.values())
    for node in (map_server, planner):
        assert "Traceback" not in node.log


def test_growth_leaves_out_the_warm_up() -> None:
    assert growth([1.0, 50.0, *7 * [100.0], 104.0]) == (100.0, 104.0, pytest.approx(0.04))
