"""A bare rclpy service that returns a ready path: the planner's yardstick.

The argument is the number of poses of the path.
"""

import sys
from contextlib import suppress

import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from nav_msgs.srv import GetPlan
from rclpy.executors import ExternalShutdownException

PATH = Path(poses=[PoseStamped() for _ in range(int(sys.argv[1]))])


def answer(_: GetPlan.Request, response: GetPlan.Response) -> GetPlan.Response:
    """Return the path."""
    response.plan = PATH
    return response


with suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.init()
    node = rclpy.create_node("bare")
    node.create_service(GetPlan, "~/get_plan", answer)
    rclpy.spin(node)
