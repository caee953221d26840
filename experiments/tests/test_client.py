import signal
import subprocess
from typing import Any

import numpy as np
import pytest
from client import MapFixture, plan_request, pose
from nav_msgs.msg import Path
from processes import running

from ddqn_planner.grid import Cell, MapFile


def test_the_check_of_an_answer_finds_each_error() -> None:
    values = np.array([[0, 100, 0], [0, 0, 100], [0, 100, 0]], dtype=np.int8)
    fixture = MapFixture(MapFile(values, 0.1, (1.0, 2.0, 0.3)))
    cases: list[tuple[Cell, Cell, list[Cell], str]] = [
        ((0, 0), (1, 1), [(0, 0), (0, 1), (1, 1)], ""),
        ((0, 0), (0, 0), [(0, 0)], ""),
        *(
            (start, goal, [], "")
            for start in ((0, 0), (1, 0))
            for goal in ((2, 0), (9, 9))
        ),
        ((0, 0), (1, 1), [], "where there is one"),
        ((0, 0), (1, 1), [(0, 0), (0, 1)], "asked was"),
        ((0, 0), (1, 1), [(0, 0), (1, 1)], "illegal segment"),
        ((0, 0), (2, 0), [(0, 0), (2, 0)], "illegal segment"),
        ((0, 0), (0, 1), [(0, 0), (-1, 0), (0, 1)], "illegal segment"),
    ]
    for start, goal, path, error in cases:
        plan = Path(poses=[pose(fixture.grid, cell) for cell in path])
        found = fixture.error(plan_request(fixture.grid, start, goal), plan)
        assert (error in found) if error else not found


def test_a_signal_while_a_node_is_started_ends_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    children = []

    def start(*arguments: Any, **options: Any) -> subprocess.Popen[bytes]:
        children.append(popen(*arguments, **options))
        signal.raise_signal(signal.SIGINT)
        return children[0]

    popen = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", start)
    with pytest.raises(KeyboardInterrupt), running("sleep", "60"):
        pass
    assert children[0].returncode == -signal.SIGTERM
