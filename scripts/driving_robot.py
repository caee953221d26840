"""A simulated robot with two driven wheels, as a ROS node, in a world whose slowness nobody tells.

It follows the last `plan`, and publishes `odom` and, where tf2_ros is installed, a transform. Slow
zones, a carpet on which wheels slip, a door, and crowds that come and go by the hour slow it down.
Its time runs faster than the clock: the stamps are simulated.

    python scripts/driving_robot.py --ros-args -p world:=office -p seed:=1 -p speed_up:=30.0
"""

from __future__ import annotations

import math
import sys
import time

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from rclpy.node import Node
from std_msgs.msg import Header

from ddqn_planner.experiments.driving_worlds import NOISE, SPEED, World, generated_world
from ddqn_planner.nodes.conversions import quaternion
from ddqn_planner.nodes.runtime import LATCHED, STEADY, spin_until_shutdown

STEP = 0.2
"""Simulated seconds from one pose to the next."""

MORNING = 3000.0
"""When the simulated time begins, seconds: ten minutes later the first crowd goes."""

LOOK_AHEAD = 0.4
"""Metres from the robot to the point of the path that it drives to."""

TURN_RATE = 2.0
"""Radians per second."""

ARRIVED = 0.15
"""Metres."""


class Robot:
    """A robot that follows paths by pure pursuit.

    Parameters
    ----------
    world : World
    seed : int
        Of the noise of its speed.
    """

    def __init__(self, world: World, seed: int) -> None:
        self.world = world
        self.now = MORNING
        self.x, self.y = world.grid.cell_to_world(world.stations[0])
        self.yaw = 0.0
        self._random = np.random.default_rng([seed, 7])
        self._path = np.empty((0, 2))
        self._cell, self._noise = (-1, -1), 1.0

    def follow(self, path: NDArray[np.float64]) -> None:
        """Follow a path from now on, (N, 2) in metres; an empty one stops the robot."""
        self._path = path

    def step(self) -> None:
        """Drive for `STEP` seconds."""
        self.now += STEP
        left = STEP
        while left > 1e-9 and len(self._path):
            left -= self._move(left)

    def _move(self, seconds: float) -> float:
        """Turn, or drive in an arc; return how long it took."""
        away = np.hypot(*(self._path - (self.x, self.y)).T)
        nearest = int(away.argmin())
        self._path, away = self._path[nearest:], away[nearest:]
        if away[-1] < ARRIVED and len(self._path) <= 2 / self.world.grid.resolution:
            self._path = self._path[:0]
            return seconds
        ahead = np.flatnonzero(away >= LOOK_AHEAD)
        aim_x, aim_y = self._path[ahead[0] if len(ahead) else -1]
        bearing = math.atan2(aim_y - self.y, aim_x - self.x) - self.yaw
        bearing = math.remainder(bearing, 2 * math.pi)
        if abs(bearing) > math.pi / 4:
            turn = min(abs(bearing), TURN_RATE * seconds)
            self.yaw += math.copysign(turn, bearing)
            return turn / TURN_RATE
        seconds = min(seconds, 0.05)
        metres = self._speed() * seconds
        distance = max(math.dist((aim_x, aim_y), (self.x, self.y)), 0.05)
        self.yaw += 2 * math.sin(bearing) / distance * metres
        self.x += metres * math.cos(self.yaw)
        self.y += metres * math.sin(self.yaw)
        return seconds

    def _speed(self) -> float:
        grid = self.world.grid
        cell = grid.world_to_cell(self.x, self.y)
        if cell != self._cell:
            self._cell = cell
            self._noise = math.exp(self._random.normal(0, NOISE) - NOISE**2 / 2)
        if not grid.is_free(cell):
            return SPEED
        return SPEED / (float(self.world.slowness(self.now)[cell[1], cell[0]]) * self._noise)


class RobotNode(Node):
    """The robot's topics."""

    def __init__(self) -> None:
        super().__init__("robot")
        defaults = {"world": "office", "seed": 1, "speed_up": 30.0}
        world, seed, speed_up = (
            self.declare_parameter(name, default).value for name, default in defaults.items()
        )
        self._robot = Robot(generated_world(str(world), int(seed)), int(seed))
        self._speed_up = float(speed_up)
        self._began = time.monotonic()
        self._odometry = self.create_publisher(Odometry, "odom", 100)
        self._broadcaster = None
        try:
            from tf2_ros import TransformBroadcaster

            self._broadcaster = TransformBroadcaster(self)
        except ImportError:
            self.get_logger().info("no transforms: tf2_ros is not installed")
        self.create_subscription(Path, "plan", self._on_plan, LATCHED)
        self.create_timer(0.02, self._on_timer, clock=STEADY)

    def _on_plan(self, message: Path) -> None:
        positions = [(it.pose.position.x, it.pose.position.y) for it in message.poses]
        self._robot.follow(np.array(positions).reshape(-1, 2))

    def _on_timer(self) -> None:
        until = MORNING + (time.monotonic() - self._began) * self._speed_up
        while self._robot.now + STEP <= until:
            self._robot.step()
            self._publish()

    def _publish(self) -> None:
        robot = self._robot
        whole = int(robot.now)
        stamp = Time(sec=whole, nanosec=int((robot.now - whole) * 1e9))
        header = Header(stamp=stamp, frame_id="map")
        odometry = Odometry(header=header, child_frame_id="base_link")
        odometry.pose.pose.position.x, odometry.pose.pose.position.y = robot.x, robot.y
        odometry.pose.pose.orientation = quaternion(robot.yaw)
        self._odometry.publish(odometry)
        if self._broadcaster is not None:
            transform = TransformStamped(header=header, child_frame_id="base_link")
            moved = transform.transform.translation
            moved.x, moved.y = robot.x, robot.y
            transform.transform.rotation = odometry.pose.pose.orientation
            self._broadcaster.sendTransform(transform)


if __name__ == "__main__":
    sys.exit(spin_until_shutdown(RobotNode))
