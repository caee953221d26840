"""What RViz shows of a field, and that nothing is computed for nobody."""

import cmath
import math
import time
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
from nav_msgs.msg import OccupancyGrid
from rclpy.serialization import serialize_message
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from ddqn_planner.grid import (
    MOVES,
    Cell,
    GridMap,
    MoveRule,
    legal_moves,
    shortest_distances,
)
from ddqn_planner.nodes.display import MAX_ARROWS, policy_message, value_message
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


def exact_field(grid: GridMap, goal: Cell) -> QField:
    """Return a field whose policy goes down the exact distances."""
    exact = shortest_distances(grid, goal, MoveRule.ROBOT_SAFE)
    distances = np.pad(exact, 1, constant_values=np.inf)
    beside = [np.roll(distances, (-dy, -dx), (0, 1))[1:-1, 1:-1] for dx, dy in MOVES]
    q = -(np.array(beside) + np.hypot(*MOVES.T).reshape(-1, 1, 1)).astype(np.float32)
    return QField(goal, q, legal_moves(grid.occupancy, MoveRule.ROBOT_SAFE))


def arrows_of(marker: Marker) -> np.ndarray:
    """Return (arrows, 6, 2): the ends of shaft and barbs, metres."""
    return np.array([(point.x, point.y) for point in marker.points]).reshape(-1, 6, 2)


@pytest.mark.parametrize(
    "origin", [(0.0, 0.0, 0.0), (-1.0, 2.0, 0.7), (3.0, 0.0, -2.5)]
)
def test_each_free_cell_has_its_greedy_arrow(
    small_values: np.ndarray, origin: tuple[float, float, float]
) -> None:
    grid = GridMap.from_occupancy_values(small_values, 0.5, origin)
    field = exact_field(grid, (5, 5))
    (marker,) = policy_message(field, grid, HEADER).markers
    assert (marker.type, marker.action) == (Marker.LINE_LIST, Marker.ADD)
    assert marker.header.frame_id == "map"
    assert marker.pose.orientation.w == 1.0
    assert min(marker.scale.x, marker.color.a) > 0
    found = set()
    for tail, tip, tip_1, barb_1, tip_2, barb_2 in (
        arrows_of(marker) @ [1, 1j]
    ).tolist():
        assert [tip_1, tip_2] == pytest.approx([tip, tip])
        middle = (tail + tip) / 2
        x, y = cell = grid.world_to_cell(middle.real, middle.imag)
        assert middle == pytest.approx(complex(*grid.cell_to_world(cell)))
        found.add(cell)
        # A barb lies behind the tip, and the two are mirrored.
        ahead = cmath.rect(1.0, origin[2] + field.policy[y, x] * math.pi / 4)
        along, *barbs = (
            (point / ahead) for point in (tip - tail, barb_1 - tip, barb_2 - tip)
        )
        assert along == pytest.approx(abs(along))
        assert barbs[0] == pytest.approx(barbs[1].conjugate())
        assert barbs[0].real < 0 != barbs[0].imag
    assert found == set(grid.free_cells()) - {(5, 5)}


@pytest.mark.parametrize("shape", [(100, 100), (150, 250), (1, 30000)])
def test_large_maps_have_no_more_arrows_than_the_bound(shape: tuple[int, int]) -> None:
    grid = GridMap(np.zeros(shape, bool), 0.05)
    q = np.random.default_rng(0).random((8, *shape), np.float32)
    field = QField((0, 0), q, legal_moves(grid.occupancy, MoveRule.ROBOT_SAFE))
    message = policy_message(field, grid, HEADER)
    arrows = arrows_of(message.markers[0])
    assert MAX_ARROWS / 2 <= len(arrows) <= MAX_ARROWS
    assert len(serialize_message(message)) > 24 * 6 * len(arrows)


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
display.policy_message = told("a policy is shown", display.policy_message)
"""
"""What a planner runs first: it says what it computes, and while there is a file it fails."""


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
        policies = client.subscribe(MarkerArray, "planner/policy", LATCHED)
        arrows = 6 * int((hall == 0).sum() - 1)  # their points

        def wait_for(goal: Cell, arrows: int = arrows) -> None:
            values.wait(lambda value: value.data[goal[1] * 20 + goal[0]] == 100)
            found = policies.wait(
                lambda message: len(message.markers[0].points) == arrows
            )
            (marker,) = found.markers
            assert (marker.header.frame_id, marker.ns, marker.id) == (
                "map",
                "policy",
                0,
            )

        wait_for((4, 4))
        # Once a goal, not once a plan.
        robot.send_start(robot.pose((1, 0)))
        robot.wait_for_path((1, 0), (4, 4))
        robot.send_goal(robot.pose((3, 6)))
        wait_for((3, 6))
        assert sum(value.data[4 * 20 + 4] == 100 for value in values.messages()) == 1
        # Nothing of a goal without a field.
        values.clear()
        policies.clear()
        robot.send_goal(robot.pose((10, 2)))
        value = values.wait(lambda value: set(value.data) == {-1})
        assert (value.info.width, value.header.frame_id) == (20, "map")
        deleted = policies.wait(
            lambda message: message.markers[0].action == Marker.DELETE
        )
        (marker,) = deleted.markers
        assert (marker.ns, marker.id, len(marker.points)) == ("policy", 0, 0)
        # The map's changes are shown too.
        robot.send_goal(robot.pose((3, 6)))
        robot.send_map(robot.map_with(np.s_[13:, 0], 100))
        wait_for((3, 6), arrows - 2 * 6)
        # A field that is not shown does not end the node.
        gap.touch()
        robot.send_goal(robot.pose((4, 4)))
        for name in ("value", "policy"):
            node.wait_for_log(f"no {name} is shown .AssertionError.*give a smaller map")
        gap.unlink()
        robot.send_goal(robot.pose((3, 3)))
        wait_for((3, 3), arrows - 2 * 6)
