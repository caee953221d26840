"""What a node can hear, and what it forgets when the clock jumps back: real nodes over DDS."""

from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Time
from client import wait_for
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from integration.robot import GOAL, START, odometry
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock


def test_odometry_counts_while_it_comes(run_robot: Any, model: Path) -> None:
    def set_clock(seconds: int) -> None:
        robot.clear()
        client.publish("/clock", Clock(clock=Time(sec=seconds)))
        robot.diagnostics.wait(lambda message: message.header.stamp.sec == seconds)

    def plans() -> bool:
        return bool(robot.get_plan(PoseStamped(), robot.pose(GOAL)).poses)

    parameters = {
        "model": str(model),
        "start_source": "odometry",
        "use_sim_time": True,
        "qos_overrides./listening/map.subscription.durability": "volatile",
    }
    with run_robot("/listening", parameters) as robot:
        client, node = robot.client, robot.node
        client.publisher(OccupancyGrid, "map", QoSProfile(depth=1))
        robot.set_map(robot.stamped_map())
        client.publisher(Odometry, "odom", qos_profile_sensor_data)  # as many drivers publish it
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

        (heard,) = (it for it in client.node.subscriptions if it.topic_name == "/diagnostics")
        client.run(client.node.destroy_subscription, heard)  # its thread may hold it
        second = client.node.create_publisher(Odometry, "odom", 10)
        name = client.node.get_fully_qualified_name()
        expected = rf"/odom has 2 publishers \({name}, {name}\), so the robot's place may jump"
        node.wait_for_log("odom has 2 publishers")  # though nobody reads the diagnostics
        robot.diagnostics = client.subscribe(DiagnosticArray, "/diagnostics")
        assert robot.wait_for_reason(expected).level == DiagnosticStatus.WARN
        assert node.log.count("has 2 publishers") == 1
        client.node.destroy_publisher(second)
        robot.clear()
        robot.wait_for_reason("^((?!publishers).)*$")
