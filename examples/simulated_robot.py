"""A simulated robot that follows the last `plan`, in a world whose slowness nobody tells.

python examples/simulated_robot.py --ros-args -p world:=office -p seed:=1 -p speed_up:=30.0
"""

import math
import sys
import time
from pathlib import Path as FilePath

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from numpy.typing import NDArray
from rclpy.node import Node
from std_msgs.msg import Header

from ddqn_planner.experience.drives import ARRIVAL_DISTANCE
from ddqn_planner.nodes.runtime import LATCHED, STEADY, spin_until_shutdown

sys.path.insert(0, str(FilePath(__file__).resolve().parents[1] / "experiments"))
from client import RobotPoses
from driving_worlds import NOISE, SPEED, World, generated_world

STEP = 0.2  # simulated seconds from one pose to the next
MORNING = 3000.0  # when the simulated time begins, seconds: ten minutes later the first crowd goes
JOIN_DISTANCE = 2.0  # metres from which the robot drives to the nearest point of a new path
SIGHT = 0.005  # metres between the points at which a straight line is looked at for obstacles
# Simulated seconds that a process which was stalled catches up. A robot that was away for longer
# would have left the path that is planned for it.
MOST_BEHIND = 5.0
PATIENCE = 2.0  # seconds that the robot stands before it asks for a path again


class Robot:
    """A robot that follows paths from point to point; the seed is that of its speed's noise."""

    def __init__(self, world: World, seed: int) -> None:
        self.world = world
        self.now = MORNING
        self.x, self.y = world.grid.cell_to_world(world.stations[0])
        self.yaw = 0.0
        self._random = np.random.default_rng([seed, 7])
        self._path = np.empty((0, 2))
        self._cell, self._noise = (-1, -1), 1.0

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
        away = np.hypot(*(path - (self.x, self.y)).T)
        near = np.flatnonzero(away <= JOIN_DISTANCE)
        near = near[self._sees(path[near])]
        self._path = path[near[away[near].argmin()] :] if len(near) else path[:0]

    def step(self) -> None:
        """Drive for `STEP` seconds."""
        self.now += STEP
        left = STEP
        while left > 1e-9 and self.is_driving:
            ahead = self._path[0] - (self.x, self.y)
            away, speed = math.hypot(*ahead), self._speed()
            metres = min(away, speed * min(left, 0.05))
            if metres < away:
                self.x, self.y = np.array([self.x, self.y]) + metres / away * ahead
            else:
                (self.x, self.y), self._path = self._path[0], self._path[1:]
            if away:
                self.yaw = math.atan2(ahead[1], ahead[0])
            left -= metres / speed

    def _sees(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether a straight line leads to each point without an obstacle: (N,) bool."""
        grid, here = self.world.grid, np.array([self.x, self.y])
        metres = np.hypot(*(points - here).T).max(initial=0)
        share = np.linspace(0, 1, int(metres / SIGHT) + 2)[:, None, None]
        cells = np.floor((here + share * (points - here) - grid.origin[:2]) / grid.resolution)
        inside = ((cells >= 0) & (cells < (grid.width, grid.height))).all(axis=-1)
        x, y = np.moveaxis(cells.clip(0, (grid.width - 1, grid.height - 1)).astype(int), -1, 0)
        # A robot on an obstacle may leave.
        is_own = (cells == grid.world_to_cell(self.x, self.y)).all(axis=-1)
        sees: NDArray[np.bool_] = (inside & ~grid.occupancy[y, x] | is_own).all(axis=0)
        return sees

    def _speed(self) -> float:
        grid = self.world.grid
        cell = grid.world_to_cell(self.x, self.y)
        if cell != self._cell:
            self._cell = cell
            self._noise = math.exp(self._random.normal(0, NOISE) - NOISE**2 / 2)
        if not grid.is_free(cell):
            return SPEED
        return SPEED / (float(self.world.slowness(self.now)[cell[::-1]]) * self._noise)


class RobotNode(Node):
    """The robot's topics: `plan` in, `odom` and where tf2_ros is installed a transform out."""

    def __init__(self) -> None:
        super().__init__("robot")
        defaults = {"world": "office", "seed": 1, "speed_up": 30.0}
        world, seed, speed_up = (
            self.declare_parameter(name, default).value for name, default in defaults.items()
        )
        self._robot = Robot(generated_world(str(world), int(seed)), int(seed))
        self._speed_up = float(speed_up)
        self._began = self._waits_since = time.monotonic()
        self._poses = RobotPoses(self)
        self._goal: PoseStamped | None = None
        self._goals = self.create_publisher(PoseStamped, "goal_pose", 10)
        self.create_subscription(PoseStamped, "goal_pose", self._on_goal, 10)
        self.create_subscription(Path, "plan", self._on_plan, LATCHED)
        self.create_timer(0.02, self._on_timer, clock=STEADY)

    def _on_plan(self, message: Path) -> None:
        positions = [(it.pose.position.x, it.pose.position.y) for it in message.poses]
        self._robot.follow(np.array(positions).reshape(-1, 2))

    def _on_goal(self, message: PoseStamped) -> None:
        self._goal, self._waits_since = message, time.monotonic()

    def _on_timer(self) -> None:
        robot, now = self._robot, time.monotonic()
        behind = MORNING + (now - self._began) * self._speed_up - robot.now
        self._began += max(0.0, behind - MOST_BEHIND) / self._speed_up
        until = robot.now + min(behind, MOST_BEHIND)
        while robot.now + STEP <= until:  # the stamps are simulated: they run faster than the clock
            robot.step()
            self._poses.publish(robot.header(), robot.x, robot.y, robot.yaw)
        # Where it stands without a path that it can join, it sends the goal again.
        if self._goal is None or robot.is_driving:
            self._waits_since = now
        elif now - self._waits_since > PATIENCE:
            self._waits_since = now
            goal = self._goal.pose.position
            metres = math.dist((goal.x, goal.y), (robot.x, robot.y))
            if metres > ARRIVAL_DISTANCE:
                self.get_logger().warning(
                    f"standing at ({robot.x:.2f}, {robot.y:.2f}), {metres:.1f} m from the goal, "
                    "without a path; the goal is sent again"
                )
                self._goals.publish(self._goal)


if __name__ == "__main__":
    sys.exit(spin_until_shutdown(RobotNode))
