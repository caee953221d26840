"""A costmap, its updates, and poses in other frames over DDS."""

import array
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from client import cells_of, wait_for
from geometry_msgs.msg import PoseStamped, TransformStamped
from integration.robot import WARN, Robot, repeating
from std_msgs.msg import Header

from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.quality import LATCHED

DOORS = [(4, 30), (12, 30)]  # (x, y) of the cells in which a wall is open


@pytest.fixture(scope="module")
def robot(run_robot: Any) -> Iterator[Robot]:
    """Two rooms, and two doors that inflation has nearly closed."""
    costmap = np.zeros((20, 40), dtype=np.int8)
    costmap[:, 29:32] = 99
    costmap[:, 30] = 100
    for y, x in DOORS:
        costmap[y, x - 1 : x + 2] = 90
    parameters = {"map_type": "costmap", "map_timeout": 0.0}
    with run_robot(
        "/live", parameters, costmap, remaps=["map:=global_costmap/costmap"]
    ) as robot:
        robot.grid = GridMap(costmap >= 99, 0.5, (-1.0, 2.0, 0.0))
        publish_costmap(robot)
        robot.send_start(robot.pose((5, 5)))
        yield robot


def test_a_costmap_is_planned_on_where_the_same_values_as_a_map_leave_no_path(
    robot: Robot,
) -> None:
    robot.send_goal(robot.pose((35, 5)))
    robot.wait_for_path((5, 5), (35, 5))
    robot.set(map_type="map")
    robot.wait_for_reason("no path leads from")
    robot.set(map_type="costmap")
    robot.clear()
    robot.wait_for_reason("^a path of")
    assert robot.get_plan(robot.pose((5, 5)), robot.pose((29, 0))).poses == []
    robot.wait_for_reason(
        "the goal is occupied .* nearer to an obstacle than the costmap allows"
    )
    assert "give one of map, costmap" in robot.refuse(map_type="octree")


def stamp(path: Any) -> tuple[int, int]:
    return path.header.stamp.sec, path.header.stamp.nanosec


def publish_costmap(robot: Robot) -> None:
    robot.client.publish("global_costmap/costmap", robot.stamped_map(), LATCHED)


def test_a_costmap_that_stops_takes_its_path_back_until_it_comes_again(
    robot: Robot,
) -> None:
    # Nobody sets a parameter or asks while it is away, and it is not time to plan
    # again.
    robot.set(map_timeout=0.05, replan_period=3600.0)
    robot.clear()
    robot.send_goal(robot.pose((35, 5)))
    last = (0, 0)
    for _ in range(2):
        # As a costmap does: on a loaded machine the first may time out before it is
        # planned on.
        with repeating(robot.client, lambda: publish_costmap(robot)):
            path = robot.plans.wait(
                lambda path, at=last: path.poses and stamp(path) > at
            )
        last = stamp(path)
        empty = robot.plans.wait(
            lambda path, at=last: not path.poses and stamp(path) > at
        )
        last = stamp(empty)
        assert empty.header.frame_id == "map"
    wait_for(
        "refusal",
        lambda: not robot.get_plan(robot.pose((5, 5)), robot.pose((9, 9))).poses,
    )
    silent = "nothing came on /live/global_costmap/costmap for longer than"
    assert robot.wait_for_reason(silent, {"status": "MAP_TIMEOUT"}).level == WARN
    robot.set(map_timeout=0.0, replan_period=1.0)


def test_updates_close_and_open_doors(robot: Robot) -> None:
    map_msgs = pytest.importorskip("map_msgs.msg", reason="map_msgs is not on PyPI")
    stamps = itertools.count(10_000)

    def send(x: int, y: int, values: list[list[int]]) -> None:
        cells = np.array(values, dtype=np.int8)
        update = map_msgs.OccupancyGridUpdate(x=x, y=y)
        update.header = Header(frame_id="map", stamp=Time(sec=next(stamps)))
        update.height, update.width = (int(size) for size in cells.shape)
        update.data = array.array("b", cells.tobytes())
        robot.client.publish("global_costmap/costmap_updates", update)

    def is_passed(door: tuple[int, int]) -> Callable[[Any], bool]:
        return lambda path: door[::-1] in cells_of(robot.grid, path)

    robot.send_goal(robot.pose((35, 5)))
    robot.plans.wait(is_passed(DOORS[0]))
    robot.clear()
    send(29, 4, [[99, 100, 99]])
    robot.plans.wait(is_passed(DOORS[1]))
    robot.wait_for_reason(
        "^a path of", {"planned on the map of (s)": "10000.000000000"}
    )
    send(29, 12, [[99, 100, 99]])
    robot.plans.wait(lambda path: not path.poses)
    robot.clear()
    send(38, 0, [[0, 0, 0]])
    robot.wait_for_reason(
        "map_updates refused: .* is not inside", {"map updates refused": "1"}
    )
    send(29, 4, [[90, 90, 90]])
    robot.plans.wait(is_passed(DOORS[0]))
    robot.clear()
    robot.wait_for_reason("^a path of [^;]*$", {"map updates applied": "3"})


def test_poses_in_other_frames_are_transformed(robot: Robot) -> None:
    pytest.importorskip("tf2_ros", reason="tf2_ros is not on PyPI")
    from tf2_msgs.msg import TFMessage

    client, clock = robot.client, robot.client.node.get_clock()

    def in_frame(frame: str, x: float, y: float) -> PoseStamped:
        stamped = PoseStamped(header=Header(frame_id=frame, stamp=clock.now().to_msg()))
        stamped.pose.position.x, stamped.pose.position.y = x, y
        return stamped

    def send_transforms() -> None:
        message = TFMessage()
        for parent, child, x, y in (
            ("map", "odom", 5.0, 4.0),
            ("odom", "base", 0.0, 0.0),
        ):
            of_frame = TransformStamped(child_frame_id=child)
            of_frame.header = in_frame(parent, 0.0, 0.0).header
            of_frame.transform.translation.x, of_frame.transform.translation.y = x, y
            message.transforms.append(of_frame)
        client.publish("/tf", message, listeners=0)

    robot.set(transform_tolerance=60.0)
    with repeating(client, send_transforms):
        path = robot.get_plan(in_frame("odom", 0.1, 0.1), in_frame("base", 3.1, 2.1))
    cells = cells_of(robot.grid, path)
    expected = [robot.grid.world_to_cell(*point) for point in ((5.1, 4.1), (8.1, 6.1))]
    assert path.header.frame_id == "map"
    assert [cells[0], cells[-1]] == expected
    assert robot.get_plan(robot.pose((3, 3)), in_frame("moon", 0.0, 0.0)).poses == []
    none = "the goal's frame is 'moon', and no transform leads from .moon."
    robot.wait_for_reason(none, {"status": "TF_ERROR"})
