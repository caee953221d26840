"""When a learner from drives trains the prior; here node and test share a process."""

import time
from collections.abc import Coroutine, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy

from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.driving import Driving
from ddqn_planner.nodes.learning_node import MapInFrame
from ddqn_planner.nodes.trainer_node import TrainerNode

SPEED = 0.5  # m/s


@pytest.fixture
def driving(tmp_path: Path) -> Iterator[Driving]:
    parameters = {"output_folder": str(tmp_path), "learn_from": "driving"}
    settings = [f"{name}:={value}" for name, value in parameters.items()]
    rclpy.init(args=["--ros-args", "-p", settings[0], "-p", settings[1]])
    node = TrainerNode()
    node.map = MapInFrame(GridMap(np.zeros((80, 120), np.bool_), 0.25), "map")
    assert isinstance(node.learner, Driving)
    yield node.learner
    node.destroy_node()
    rclpy.shutdown()


def drive(driving: Driving, y: float, metres: float) -> None:
    """Let the robot drive along x, a distance from (2, y)."""
    (robot,) = driving.robots
    robot.recorder.forget()
    for x in np.arange(0.0, metres, 0.1):
        robot.recorder.add(1000.0 * y + x / SPEED, 2.0 + x, y)
    robot.recorder.end()


def test_the_prior_is_trained_again_when_drives_have_shown_a_tenth_more_places(
    driving: Driving, tmp_path: Path
) -> None:
    file = tmp_path / "experience.npz"

    def is_trained() -> bool:
        """Look for new places as the node does each second; training saves."""
        before = file.stat().st_mtime_ns
        wait_for_end(driving.train_prior())
        return file.stat().st_mtime_ns > before

    assert not is_trained()  # without a drive
    drive(driving, y=5.0, metres=20.0)
    assert is_trained()
    assert not is_trained()
    drive(driving, y=8.0, metres=1.5)
    assert not is_trained()
    drive(driving, y=11.0, metres=2.0)
    assert is_trained()
    assert not is_trained()
    driving.forget()
    assert not is_trained()
    drive(driving, y=5.0, metres=2.0)
    assert is_trained()


def wait_for_end(coroutine: Coroutine[Any, Any, None]) -> None:
    """Run a coroutine that awaits a worker alone."""
    while True:
        try:
            coroutine.send(None)
        except StopIteration:
            return
        time.sleep(0.005)  # in which the worker has Python for itself
