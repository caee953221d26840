"""A simulated robot follows the last `plan` in a world of unknown slowness."""

import math
import sys
from pathlib import Path as FilePath

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from numpy.typing import NDArray
from rclpy.node import Node
from std_msgs.msg import Header

from ddqn_planner.experience.drives import ARRIVAL_DISTANCE
from ddqn_planner.nodes.clocks import STEADY
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.nodes.spinning import spin_until_shutdown

sys.path.insert(0, str(FilePath(__file__).resolve().parents[1] / "experiments"))
from client import RobotPoses
from driving_worlds import NOISE, SPEED, World, generated_world

WORLD = "office-mixture"
SEED = 9
SPEED_UP = 40.0  # simulated seconds per second
STEP = 0.2  # simulated seconds from one pose to the next
MORNING = 3000.0
"""Seconds at which the simulated time begins: the first crowd goes 10 minutes later."""
JOIN_DISTANCE = 2.0
"""Metres from which the robot drives to the nearest point of a new path."""
SIGHT = 0.005
"""Metres between the points of a straight line that are tried for obstacles."""
PATIENCE = 60.0
"""Simulated seconds that the robot stands before it asks for a path again."""
LONGEST_STRETCH = 0.05
"""Simulated seconds that the robot drives at one speed."""


class Robot:
    """A robot that follows paths from point to point.

    The seed is that of the noise of its speed.
    """

    def __init__(self, world: World, seed: int) -> None:
        self.world = world
        self.now = MORNING
        self.x, self.y = world.grid.cell_to_world(world.stations[0])
        self.yaw = 0.0
        self._random = np.random.default_rng([seed, 7])
        self._path = np.empty((0, 2))
        self._cell = (-1, -1)  # where the noise was drawn
        self._noise = 1.0

    @property
    def is_driving(self) -> bool:
        """Whether it has a path that it can follow."""
        return len(self._path) > 0

    def header(self) -> Header:
        """Return the header of its pose."""
        stamp = Time(sec=int(self.now), nanosec=int(self.now % 1 * 1e9))
        return Header(stamp=stamp, frame_id="map")

    def follow(self, path: NDArray[np.float64]) -> None:
        """Follow a path from now on, (N, 2) in metres; an empty one stops the robot."""
        distances = np.hypot(*(path - (self.x, self.y)).T)
        for index in distances.argsort():
            if distances[index] <= JOIN_DISTANCE and self._sees(path[index]):
                self._path = path[index:]
                return
        self._path = path[len(path) :]

    def step(self) -> None:
        """Drive for `STEP` seconds."""
        self.now += STEP
        seconds_left = STEP
        while seconds_left > 1e-9 and self.is_driving:
            offset = self._path[0] - (self.x, self.y)
            distance = math.hypot(*offset)
            speed = self._speed()
            metres = min(distance, speed * min(seconds_left, LONGEST_STRETCH))
            if metres < distance:
                self.x, self.y = (self.x, self.y) + metres / distance * offset
            else:
                self.x, self.y = self._path[0]
                self._path = self._path[1:]
            if distance > 0:
                self.yaw = math.atan2(offset[1], offset[0])
            seconds_left -= metres / speed

    def _sees(self, point: NDArray[np.float64]) -> bool:
        """Return whether a straight line leads to a point without an obstacle."""
        grid = self.world.grid
        position = (self.x, self.y)
        points = int(math.dist(position, point) / SIGHT) + 2
        line = np.linspace(position, point, points)
        cells = {grid.world_to_cell(x, y) for x, y in line}
        cells.discard(grid.world_to_cell(*position))  # a robot on an obstacle may leave
        return all(grid.is_free(cell) for cell in cells)

    def _speed(self) -> float:
        """Return the speed where the robot is, with a noise of its own in each cell."""
        cell = self.world.grid.world_to_cell(self.x, self.y)
        if cell != self._cell:
            self._cell = cell
            self._noise = math.exp(self._random.normal(0, NOISE) - NOISE**2 / 2)
        x, y = cell
        slowness = float(self.world.slowness(self.now)[y, x])
        return SPEED / (slowness * self._noise)


class RobotNode(Node):
    """The robot's topics: `plan` in, `odom` out.

    Where tf2_ros is installed, a transform goes out, too.
    """

    def __init__(self) -> None:
        super().__init__("robot")
        self._robot = Robot(generated_world(WORLD, SEED), SEED)
        self._poses = RobotPoses(self)
        self._goal: PoseStamped | None = None
        self._seconds_without_path = 0.0
        self._goals = self.create_publisher(PoseStamped, "goal_pose", 10)
        self.create_subscription(PoseStamped, "goal_pose", self._on_goal, 10)
        self.create_subscription(Path, "plan", self._on_plan, LATCHED)
        self.create_timer(STEP / SPEED_UP, self._step, clock=STEADY)

    def _on_plan(self, message: Path) -> None:
        positions = []
        for stamped in message.poses:
            position = stamped.pose.position
            positions.append((position.x, position.y))
        self._robot.follow(np.array(positions).reshape(-1, 2))

    def _on_goal(self, message: PoseStamped) -> None:
        self._goal = message
        self._seconds_without_path = 0.0

    def _step(self) -> None:
        robot = self._robot
        robot.step()
        self._poses.publish(robot.header(), robot.x, robot.y, robot.yaw)
        if robot.is_driving:
            self._seconds_without_path = 0.0
        else:
            self._seconds_without_path += STEP
        if self._goal is not None and self._seconds_without_path > PATIENCE:
            self._seconds_without_path = 0.0
            self._send_again(self._goal)

    def _send_again(self, goal: PoseStamped) -> None:
        """Send the goal again, unless the robot stands there."""
        position = goal.pose.position
        distance = math.dist((position.x, position.y), (self._robot.x, self._robot.y))
        if distance > ARRIVAL_DISTANCE:
            warning = "standing without a path; the goal is sent again"
            self.get_logger().warning(warning)
            self._goals.publish(goal)


if __name__ == "__main__":
    sys.exit(spin_until_shutdown(RobotNode))
