"""A bare rclpy service that returns a ready path: what the planner node is compared with."""

import sys
from contextlib import suppress

import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from nav_msgs.srv import GetPlan
from rclpy.executors import ExternalShutdownException


def answer(_: GetPlan.Request, response: GetPlan.Response) -> GetPlan.Response:
    """Return a path of as many poses as the first argument says."""
    response.plan = PATH
    return response


PATH = Path(poses=[PoseStamped() for _ in range(int(sys.argv[1]))])
with suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.init()
    node = rclpy.create_node("bare")
    node.create_service(GetPlan, "~/get_plan", answer)
    rclpy.spin(node)
