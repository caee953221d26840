"""A client of the nodes: spun in the background, and what it asks."""

from __future__ import annotations

import threading
from contextlib import suppress

import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.srv import GetPlan
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSProfile
from std_msgs.msg import Header

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.nodes.conversions import quaternion

SERVICE_QUALITY = QoSProfile(depth=1000)
"""Of a client that asks much. With Fast DDS each client of a service hears the answers to all, and
one that is slow to read them loses its own from the usual queue of ten."""


class BackgroundNode:
    """A node in a context of its own, spun in the background.

    Parameters
    ----------
    name, namespace : str
    """

    def __init__(self, name: str, namespace: str = "") -> None:
        self._context = rclpy.Context()
        self._context.init(args=[])
        self.node = rclpy.create_node(
            name, namespace=namespace, context=self._context, start_parameter_services=False
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop spinning, and destroy the node."""
        self._context.try_shutdown()
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            self._executor.spin()


def pose(grid: GridMap, cell: Cell) -> PoseStamped:
    """Return the pose of a cell's centre in the map frame."""
    message = PoseStamped(header=Header(frame_id="map"))
    message.pose.position.x, message.pose.position.y = grid.cell_to_world(cell)
    message.pose.orientation = quaternion(0.0)
    return message


def plan_request(grid: GridMap, start: Cell, goal: Cell) -> GetPlan.Request:
    """Return a request for a plan between two cells."""
    return GetPlan.Request(start=pose(grid, start), goal=pose(grid, goal))
