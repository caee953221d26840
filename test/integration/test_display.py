"""What RViz shows of a field, and that nothing is computed for nobody."""

import math
import time
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
from nav_msgs.msg import OccupancyGrid
from std_msgs.msg import Header

from ddqn_planner.grid import (
    Cell,
    GridMap,
)
from ddqn_planner.nodes.display import (
    footprint_message,
    outlines_along,
    value_message,
)
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.planning import QField

HEADER = Header(frame_id="map")


SHOWN = [([0.0, 1.004, 1.996, 3.0], [0, 33, 67, 100]), ([0.0, 0.0], [100, 100])]
SHOWN += [([-3e38, 3e38], [0, 100]), ([np.nan, np.nan], [-1, -1])]


@pytest.mark.parametrize(("values", "percent"), SHOWN)
def test_values_are_percent_or_unknown(values: list[float], percent: list[int]) -> None:
    # Behind them an occupied cell, and one without a move.
    q = np.tile(np.array([*values, values[0], 9], np.float32), (8, 1, 1))
    legal = np.ones(q.shape, dtype=np.bool_)
    legal[:, 0, -1] = False
    occupancy = np.zeros(q.shape[1:], dtype=np.bool_)
    occupancy[0, -2] = True
    field = QField((len(values) - 1, 0), q, legal)
    message = value_message(field, GridMap(occupancy, 0.5), HEADER)
    assert message.data.tolist() == [*percent, -1, -1]
    assert message.info.resolution == 0.5
    assert message.header.frame_id == "map"


def test_a_body_is_drawn_each_quarter_of_a_metre_and_half_a_radian_of_a_turn() -> None:
    footprint = np.array([(0.5, 0.25), (-0.5, 0.25), (0.0, -0.5)])
    ahead = np.column_stack([np.arange(11) * 0.1, np.full(11, 2.0), np.zeros(11)])
    on_the_spot = np.array([(1.0, 2.0, yaw) for yaw in (0.3, 0.6, math.pi / 2)])
    outlines = outlines_along(np.vstack([ahead, on_the_spot]), footprint)
    # Along x at 0, 0.3, 0.5, 0.8 and 1.0 m, and 0.3 m of turning later.
    expected = [footprint + np.array([x, 2.0]) for x in (0.0, 0.3, 0.5, 0.8, 1.0)]
    np.testing.assert_allclose(outlines[:5], expected, atol=1e-9)
    turned = np.array([(0.75, 2.5), (0.75, 1.5), (1.5, 2.0)])
    np.testing.assert_allclose(outlines[-1], turned, atol=1e-9)
    marker = footprint_message(outlines, HEADER).markers[0]
    lines = np.array([(point.x, point.y) for point in marker.points]).reshape(-1, 2, 2)
    next_corners = np.roll(outlines, -1, axis=1)
    np.testing.assert_array_equal(lines[:, 0], outlines.reshape(-1, 2))
    np.testing.assert_array_equal(lines[:, 1], next_corners.reshape(-1, 2))


# Over DDS

TOLD = """
import os
import ddqn_planner.nodes.display as display
from ddqn_planner.grid.inflation import Inflation

def told(words, function):
    def say_and_call(*arguments):
        print(words, flush=True)
        assert not os.path.exists({gap!r})
        return function(*arguments)
    return say_and_call

Inflation.__call__ = told("a map is inflated", Inflation.__call__)
display.value_message = told("a value is shown", display.value_message)
"""
"""What a planner runs first: it says what it computes, and while there is a file it
fails.
"""


def test_what_nobody_asks_for_is_not_computed_and_what_somebody_sees_is_of_the_goal(
    run_robot: Any, hall: np.ndarray, tmp_path: FilePath
) -> None:
    gap = tmp_path / "gap"
    with run_robot("/seen", {}, hall, sitecustomize=TOLD.format(gap=str(gap))) as robot:
        client, node = robot.client, robot.node
        value = "/seen/planner/value"
        (seen,) = (
            each for each in client.node.subscriptions if each.topic_name == value
        )
        client.node.destroy_subscription(seen)
        for _ in range(2):
            robot.set_map(robot.stamped_map())
        assert "a map is inflated" not in node.log
        robot.send_start(robot.pose((0, 0)))
        for goal in ((3, 3), (4, 4)):
            robot.send_goal(robot.pose(goal))
            robot.wait_for_path((0, 0), goal)
        time.sleep(0.3)
        assert node.log.count("a map is inflated") == 1
        assert "is shown" not in node.log

        values = client.subscribe(OccupancyGrid, "planner/value", LATCHED)

        def wait_for(goal: Cell, occupied: Cell | None = None) -> None:
            def is_of_goal(value: OccupancyGrid) -> bool:
                at_goal = value.data[goal[1] * 20 + goal[0]]
                is_changed = (
                    occupied is None or value.data[occupied[1] * 20 + occupied[0]] == -1
                )
                return bool(at_goal == 100 and is_changed)

            assert values.wait(is_of_goal).header.frame_id == "map"

        wait_for((4, 4))
        # Once a goal, not once a plan.
        robot.send_start(robot.pose((1, 0)))
        robot.wait_for_path((1, 0), (4, 4))
        robot.send_goal(robot.pose((3, 6)))
        wait_for((3, 6))
        assert sum(value.data[4 * 20 + 4] == 100 for value in values.messages()) == 1
        # Nothing of a goal without a field.
        values.clear()
        robot.send_goal(robot.pose((10, 2)))
        value = values.wait(lambda value: set(value.data) == {-1})
        assert (value.info.width, value.header.frame_id) == (20, "map")
        # The map's changes are shown too.
        robot.send_goal(robot.pose((3, 6)))
        wait_for((3, 6))
        robot.send_map(robot.map_with(np.s_[13:, 0], 100))
        wait_for((3, 6), occupied=(0, 13))
        # A field that is not shown does not end the node.
        gap.touch()
        robot.send_goal(robot.pose((4, 4)))
        node.wait_for_log("no value is shown .AssertionError.*give a smaller map")
        gap.unlink()
        values.clear()
        robot.send_goal(robot.pose((3, 3)))
        wait_for((3, 3))
