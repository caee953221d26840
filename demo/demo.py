"""Starts the map server and the planner, asks for a path over ROS, and shows it.

Both nodes are processes of their own, in a ROS domain of their own. Start and goal are published
as `ros2 topic pub` would. No process is left behind, also when this one is interrupted.
"""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Path
from nav_msgs.srv import GetPlan
from processes import own_ros_domain, running
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from ddqn_planner.grid import Cell, GridMap, MoveRule, path_length, read_map_file
from ddqn_planner.nodes.conversions import grid_from_message, quaternion
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.planning import shortest_distances
from ddqn_planner.planning.picture import draw_text, save_picture
from ddqn_planner.resources import find_resource

MAP = "dilemma.yaml"
PICTURE = "demo.png"
TIMEOUT = 60.0
"""Seconds to wait for any one answer."""

T = TypeVar("T")


class Client(Node):
    """Hears what the nodes publish, and asks them."""

    def __init__(self) -> None:
        super().__init__("demo")
        self.heard: dict[str, Any] = {}
        for message_type, topic, quality in (
            (OccupancyGrid, "map", LATCHED),
            (Path, "plan", LATCHED),
            (OccupancyGrid, "planner/value", LATCHED),
            (DiagnosticArray, "/diagnostics", 10),
        ):
            self.create_subscription(
                message_type, topic, lambda m, t=topic: self.heard.update({t: m}), quality
            )
        self.start = self.create_publisher(PoseWithCovarianceStamped, "initialpose", 10)
        self.goal = self.create_publisher(PoseStamped, "goal_pose", 10)
        self.get_plan = self.create_client(GetPlan, "planner/get_plan")


def wait_for(what: str, answer: Callable[[], T | None], children: list[Any]) -> T:
    """Return the first answer that is true; give up when a node has died or time is out."""
    deadline = time.monotonic() + TIMEOUT
    while not (found := answer()):
        if any(child.poll() is not None for child in children):
            raise RuntimeError(f"a node ended while the demo waited for {what}")
        if time.monotonic() > deadline:
            raise TimeoutError(f"no {what} within {TIMEOUT:.0f} s")
        time.sleep(0.002)
    return found


def pose(grid: GridMap, cell: Cell) -> PoseStamped:
    """Return the pose of a cell's centre in the map frame."""
    message = PoseStamped()
    message.header.frame_id = "map"
    message.pose.position.x, message.pose.position.y = grid.cell_to_world(cell)
    message.pose.orientation = quaternion(0.0)
    return message


def ask(client: Client, children: list[Any], began: float) -> None:
    """Ask for the path, print it, and draw it."""
    map_file = read_map_file(find_resource("maps", MAP))
    start, goal = map_file.start, map_file.goal
    assert start is not None
    assert goal is not None
    grid = grid_from_message(wait_for("map", lambda: client.heard.get("map"), children))
    for publisher in (client.start, client.goal):
        wait_for("planner", publisher.get_subscription_count, children)
    start_pose, goal_pose = pose(grid, start), pose(grid, goal)
    initial_pose = PoseWithCovarianceStamped(header=start_pose.header)
    initial_pose.pose.pose = start_pose.pose
    client.start.publish(initial_pose)
    client.goal.publish(goal_pose)

    def plan_heard() -> Path | None:
        plan = client.heard.get("plan")
        return plan if plan and plan.poses else None

    plan = wait_for("plan", plan_heard, children)
    first_plan_seconds = time.monotonic() - began
    value = wait_for("value field", lambda: client.heard.get("planner/value"), children)
    asked = time.perf_counter()
    answer = client.get_plan.call_async(GetPlan.Request(start=start_pose, goal=goal_pose))
    wait_for("answer of planner/get_plan", answer.done, children)
    round_trip_ms = 1e3 * (time.perf_counter() - asked)

    cells = [grid.world_to_cell(p.pose.position.x, p.pose.position.y) for p in plan.poses]
    rule = MoveRule.CORNER_CUTTING
    optimum = shortest_distances(grid, goal, rule)[start[1], start[0]]
    print(draw_text(grid, cells))
    print("path: " + " ".join(f"({x}, {y})" for x, y in cells))
    print(f"length {path_length(cells):.2f} cells, optimum {optimum:.2f} under {rule.value}")
    print(
        f"first plan {first_plan_seconds:.1f} s after the nodes were started; "
        f"asked again: {round_trip_ms:.1f} ms"
    )
    values = np.array(value.data, dtype=np.float32).reshape(grid.height, grid.width)
    values[values < 0] = np.nan
    title = f"Double DQN on the paper's map: {path_length(cells):.2f} cells"
    save_picture(PICTURE, grid, cells, values, title, "value field, 100 at the goal")
    print(f"picture: {PICTURE}")


def main() -> int:
    """Run the demo; return its exit code."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    with own_ros_domain():
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        client = Client()
        spinning = threading.Thread(target=rclpy.spin, args=(client,), daemon=True)
        spinning.start()
        try:
            began = time.monotonic()
            map_server = running("map_server_node", "--ros-args", "-p", f"yaml_filename:={MAP}")
            with map_server as server, running("planner_node") as planner:
                ask(client, [server, planner], began)
        finally:
            rclpy.try_shutdown()
            spinning.join(timeout=5)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
