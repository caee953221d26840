"""What a node can hear, and what it forgets when the clock jumps back: real nodes over DDS."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from client import wait_for
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from integration.robot import GOAL, START, Robot, odometry
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from ddqn_planner.nodes import planner_node
from ddqn_planner.nodes.listening import best_effort

NUMBERS = itertools.count()


@pytest.fixture
def robot(make_client: Callable[[str], Any], small_values: np.ndarray, model: Path) -> Robot:
    namespace = f"/listening{next(NUMBERS)}"
    return Robot(make_client(namespace), small_values, model, f"{namespace}/planner")


@pytest.fixture
def run(run_node: Any, robot: Robot, model: Path) -> Callable[..., Any]:
    """Return a function that runs a planner which asks odometry where the robot is."""

    def run(parameters: dict[str, Any]) -> Any:
        parameters = {"model": str(model), "start_source": "odometry", **parameters}
        namespace = robot.client.node.get_namespace()
        return run_node("planner_node", parameters, namespace=namespace)

    return run


def test_odometry_counts_while_it_comes_and_until_the_clock_jumps_back(
    run: Any, robot: Robot
) -> None:
    client = robot.client

    def set_clock(seconds: int) -> None:
        robot.clear()
        client.publish("/clock", Clock(clock=Time(sec=seconds)))
        robot.diagnostics.wait(lambda message: message.header.stamp.sec == seconds)

    def plans() -> bool:
        return bool(robot.get_plan(PoseStamped(), robot.pose(GOAL)).poses)

    remedy = f"qos_overrides.{client.node.resolve_topic_name('map')}.subscription.durability"
    with run({"use_sim_time": True, remedy: "volatile"}) as node:
        client.publisher(OccupancyGrid, "map", QoSProfile(depth=1))
        robot.set_map(robot.stamped_map())
        client.publisher(Odometry, "odom", best_effort(10))  # as many drivers publish it
        client.publisher(Clock, "/clock")
        client.wait_for_discovery("planner")
        for began in (1000, 500):
            set_clock(began)
            assert not plans()
            client.publish("odom", odometry(robot, START))
            wait_for("plan", plans)
            set_clock(began + 2)
            assert plans()
            set_clock(began + 3)
            assert not plans()
            robot.wait_for_reason(r"nothing came on /\w+/odom for 3 s; publish it more often")
            client.publish("odom", odometry(robot, START))
            wait_for("plan", plans)
        assert node.log.count("the clock jumped by -503 s") == 1

        robot.clear()
        second, name = client.node.create_publisher(Odometry, "odom", 10), robot_name(client)
        expected = rf"/odom has 2 publishers \({name}, {name}\), so the robot's place may jump"
        assert robot.wait_for_reason(expected).level == DiagnosticStatus.WARN
        assert node.log.count("has 2 publishers") == 1
        client.node.destroy_publisher(second)
        robot.clear()
        robot.wait_for_reason("^((?!publishers).)*$")


def robot_name(client: Any) -> str:
    """Return the name of the node which publishes all that the planner hears."""
    return str(client.node.get_fully_qualified_name())


def test_what_cannot_be_heard_is_said_with_the_remedy_which_helps(
    run: Any, robot: Robot, log_of_refused_start: Any
) -> None:
    client = robot.client
    topic = client.node.resolve_topic_name("map")
    remedy = f"qos_overrides.{topic}.subscription.durability"
    map_publisher = client.publisher(OccupancyGrid, "map", QoSProfile(depth=1), listeners=0)
    with run({}) as node:
        expected = (
            f"no map was received .*; nothing of {robot_name(client)} is "
            f"received on {topic}: its durability is volatile, and transient_local is asked for; "
            f"let it publish so, or start this node with the parameter {remedy}:=volatile"
        )
        assert robot.wait_for_reason(expected).level == DiagnosticStatus.WARN
        # A publisher may be discovered before its node, and named as unknown until then.
        assert node.log.count(f"nothing of {robot_name(client)} ") == 1
        assert "New publisher discovered" not in node.log  # rclpy's words, without the remedy
        client.node.destroy_publisher(map_publisher)
        robot.wait_for_reason("no map was received [^;]*; start a map server$")
    bad = {"qos_overrides./map.subscription.durability": "flighty"}
    log = log_of_refused_start(planner_node.main, bad)
    assert "cannot start: cannot subscribe to /map (" in log
    assert "`flighty`" in log
