"""Starts the map server and the planner, asks for a path over ROS, and shows it, on two maps.

Both nodes are processes of their own, in a ROS domain of their own. Start and goal are published
as `ros2 topic pub` would. No process is left behind, also when this one is interrupted.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import rclpy
from client import pose
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Path
from nav_msgs.srv import GetPlan
from processes import claim_ros_domain, executable, running
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from ddqn_planner.grid import MoveRule, path_length, read_map_file
from ddqn_planner.nodes.conversions import grid_from_message
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.pictures.picture import MAX_TEXT_WIDTH, draw_text, save_picture
from ddqn_planner.planning import shortest_distances
from ddqn_planner.resources import find_map
from ddqn_planner.training.environment import Scenario


@dataclass(frozen=True)
class Case:
    """A map, and the shipped model that plans on it."""

    map_name: str
    model: str
    move_rule: MoveRule
    title: str
    picture: str


CASES = (
    Case("dilemma", "dilemma", MoveRule.CORNER_CUTTING, "The paper's network", "demo.png"),
    Case("office", "any_map", MoveRule.ROBOT_SAFE, "A map never seen", "demo_office.png"),
)

TIMEOUT = 60.0
"""Seconds to wait for any one answer."""

Children = list[subprocess.Popen[bytes]]
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


@contextmanager
def client() -> Iterator[Client]:
    """Give a client in a ROS domain of its own, spun in the background."""
    # Ctrl-C stays a KeyboardInterrupt.
    with claim_ros_domain():
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = Client()
        thread = threading.Thread(target=_spin, args=(node,), daemon=True)
        thread.start()
        try:
            yield node
        finally:
            rclpy.try_shutdown()
            thread.join()


def _spin(node: Node) -> None:
    with suppress(ExternalShutdownException):
        rclpy.spin(node)


def wait_for(what: str, answer: Callable[[], T | None], children: Children) -> T:
    """Return the first answer that is true; give up when a node has died or time is out."""
    deadline = time.monotonic() + TIMEOUT
    while not (found := answer()):
        if any(child.poll() is not None for child in children):
            raise RuntimeError(f"a node ended while the demo waited for {what}")
        if time.monotonic() > deadline:
            raise TimeoutError(f"no {what} within {TIMEOUT:.0f} s")
        time.sleep(0.002)
    return found


def request_plan(node: Client, children: Children, scenario: Scenario) -> Path:
    """Publish start and goal, and return the plan that comes back."""
    message = wait_for("map", lambda: node.heard.get("map"), children)
    grid = grid_from_message(message)
    for publisher in (node.start, node.goal):
        wait_for("planner", publisher.get_subscription_count, children)
    start = pose(grid, scenario.start)
    initial_pose = PoseWithCovarianceStamped(header=start.header)
    initial_pose.pose.pose = start.pose
    node.start.publish(initial_pose)
    node.goal.publish(pose(grid, scenario.goal))

    def plan_heard() -> Path | None:
        plan = node.heard.get("plan")
        return plan if plan and plan.poses else None

    return wait_for("plan", plan_heard, children)


def diagnosed(node: Client) -> dict[str, str] | None:
    """Return what the planner said of a successful request in its last diagnostics."""
    for status in getattr(node.heard.get("/diagnostics"), "status", ()):
        values = {entry.key: entry.value for entry in status.values}
        if values.get("status") == "SUCCEEDED":
            return values
    return None


def show(node: Client, plan: Path, children: Children, case: Case, seconds: float) -> None:
    """Print the path and its times, and draw it."""
    grid = grid_from_message(node.heard["map"])
    cells = [grid.world_to_cell(p.pose.position.x, p.pose.position.y) for p in plan.poses]
    start, goal = cells[0], cells[-1]
    optimum = shortest_distances(grid, goal, case.move_rule)[start[1], start[0]]
    times = wait_for("diagnostics", lambda: diagnosed(node), children)
    if grid.width <= MAX_TEXT_WIDTH:
        print(draw_text(grid, cells))
        print("path: " + " ".join(f"({x}, {y})" for x, y in cells))
    else:
        print(f"{grid.width} x {grid.height} cells, path of {len(cells)} from {start} to {goal}")
    length = path_length(cells, case.move_rule)
    print(f"length {length:.2f} cells, optimum {optimum:.2f} under {case.move_rule.value}")
    print(
        f"Q field computed in {float(times['field time (ms)']):.1f} ms, path walked in "
        f"{float(times['rollout time (ms)']):.2f} ms; first plan {seconds:.1f} s after the nodes "
        "were started"
    )
    value = wait_for("value field", lambda: node.heard.get("planner/value"), children)
    values = np.array(value.data, dtype=np.float32).reshape(grid.height, grid.width)
    values[values < 0] = np.nan
    title = f"{case.title}: {length:.2f} cells"
    save_picture(case.picture, grid, cells, values, title, "value field, 100 at the goal")
    print(f"picture: {case.picture}\n", flush=True)


def run(node: Client, case: Case) -> None:
    """Start both nodes, ask for a path, show it, and end them."""
    map_file = read_map_file(find_map(case.map_name))
    assert map_file.start is not None
    assert map_file.goal is not None
    scenario = Scenario(map_file.grid(), map_file.start, map_file.goal)
    node.heard.clear()
    began = time.monotonic()
    map_server = ("map_server_node", f"yaml_filename:={case.map_name}.yaml")
    planner = ("planner_node", f"model:={case.model}")
    with ExitStack() as stack:
        children = [
            stack.enter_context(running(executable(name), "--ros-args", "-p", parameter))
            for name, parameter in (map_server, planner)
        ]
        plan = request_plan(node, children, scenario)
        show(node, plan, children, case, time.monotonic() - began)


def main() -> int:
    """Run the demo; return its exit code."""
    # A shell starts what it runs in the background with SIGINT ignored, and so would the nodes be.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    with client() as node:
        for case in CASES:
            run(node, case)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
