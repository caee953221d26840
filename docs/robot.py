"""A simulated robot: it drives along `plan` and publishes `odom` in the map's frame."""

import math
from contextlib import suppress

import rclpy
from nav_msgs.msg import Odometry, Path
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

PERIOD = 0.05
"""Seconds between two steps."""


class Robot(Node):
    """Drives from pose to pose of the latest plan, at a constant speed."""

    def __init__(self) -> None:
        super().__init__("robot")
        self.x = self.declare_parameter("x", 0.775).value
        self.y = self.declare_parameter("y", 0.775).value
        self.speed = self.declare_parameter("speed", 1.0).value
        self.yaw = 0.0
        self.poses = []
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(Path, "plan", self.follow, latched)
        self.odometry = self.create_publisher(Odometry, "odom", 10)
        self.create_timer(PERIOD, self.step)

    def follow(self, plan: Path) -> None:
        """Take a new plan; an empty one stops the robot."""
        self.poses = [pose.pose.position for pose in plan.poses]

    def step(self) -> None:
        """Drive for one period, and publish the robot's pose."""
        metres = self.speed * PERIOD  # still to drive in this period
        while self.poses and metres > 0:
            target = self.poses[0]
            dx = target.x - self.x
            dy = target.y - self.y
            distance = math.hypot(dx, dy)
            if distance > 0:
                share = min(metres / distance, 1.0)
                self.x += share * dx
                self.y += share * dy
                self.yaw = math.atan2(dy, dx)
            if distance <= metres:
                self.poses.pop(0)
            metres -= distance
        message = Odometry(child_frame_id="base_link")
        message.header.frame_id = "map"
        message.header.stamp = self.get_clock().now().to_msg()
        message.pose.pose.position.x = self.x
        message.pose.pose.position.y = self.y
        message.pose.pose.orientation.z = math.sin(self.yaw / 2)
        message.pose.pose.orientation.w = math.cos(self.yaw / 2)
        self.odometry.publish(message)


if __name__ == "__main__":
    rclpy.init()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Robot())
