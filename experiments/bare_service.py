"""A bare rclpy service that returns a ready path: what planner/get_plan is compared with."""

import sys

import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from nav_msgs.srv import GetPlan
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.utilities import try_shutdown


def main() -> None:
    """Serve `bare/get_plan` with a path of as many poses as the first argument says."""
    rclpy.init()
    path = Path(poses=[PoseStamped() for _ in range(int(sys.argv[1]))])

    def answer(_: GetPlan.Request, response: GetPlan.Response) -> GetPlan.Response:
        response.plan = path
        return response

    node = Node("bare")
    node.create_service(GetPlan, "~/get_plan", answer)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        try_shutdown()


if __name__ == "__main__":
    main()
