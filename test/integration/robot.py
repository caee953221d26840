"""A planner node as its user sees it, and what is to be said of its paths."""

import itertools
import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from client import Client, initial_pose, map_message, pose, values_of, wait_for_map
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from exact_segments import is_legal
from geometry_msgs.msg import PoseStamped, Quaternion
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from nav_msgs.srv import GetPlan
from networks import turning_planner
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Header

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.model import save_model
from ddqn_planner.nodes.diagnostics import seconds
from ddqn_planner.nodes.parameters import PLANNER_PARAMETERS
from ddqn_planner.nodes.quality import LATCHED

START, GOAL = (0, 0), (5, 5)
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
RESOLUTION, ORIGIN, GOAL_YAW = 0.5, (-1.0, 2.0, 0.5), 1.2

NUMBERS = itertools.count(
    1
)  # stamps of maps and yaws of goals, to tell one from another

ALL = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""The last message of a latched topic, and every one after it."""


class Robot:
    """A planner node and what its user sees and does."""

    def __init__(
        self, client: Client, values: np.ndarray, model: Any, node: Any = None
    ) -> None:
        self.client, self.values, self.model, self.node = client, values, model, node
        self.name = f"{client.node.get_namespace().rstrip('/')}/planner"
        self.plans = client.subscribe(Path, "plan", ALL)
        self.value = client.subscribe(OccupancyGrid, "planner/value", ALL)
        self.diagnostics = client.subscribe(DiagnosticArray, "/diagnostics")
        self.grid = self.grid_of(values)

    def set(self, **values: Any) -> None:
        """Set parameters, which the planner must take."""
        results = self.client.set_parameters("planner", **values)
        assert all(result.successful for result in results), results

    def change(self, **values: Any) -> None:
        """Set parameters, and wait until the active goal has its new plan."""
        self.plans.clear()
        self.set(**values)
        self.plans.wait()

    def refuse(self, **values: Any) -> str:
        """Set a parameter, which the planner must refuse; return its reason."""
        (result,) = self.client.set_parameters("planner", **values)
        assert not result.successful
        return str(result.reason)

    def reset(self, **values: Any) -> None:
        """Set what has not its default, or these values."""
        declared = {
            name: it for name, it in PLANNER_PARAMETERS.items() if not it.read_only
        }
        wanted = {name: it.default for name, it in declared.items()}
        wanted |= {"model": str(self.model), **values}
        request = GetParameters.Request(names=[*wanted])
        found = self.client.call(
            GetParameters, "planner/get_parameters", request
        ).values
        are = dict(zip(wanted, map(parameter_value_to_python, found), strict=True))
        self.set(
            **{name: value for name, value in wanted.items() if are[name] != value}
        )

    @staticmethod
    def grid_of(
        values: np.ndarray, origin: tuple[float, float, float] = ORIGIN
    ) -> GridMap:
        return GridMap.from_occupancy_values(values, RESOLUTION, origin)

    def map_message(self) -> OccupancyGrid:
        return map_message(self.values, self.grid)

    def send_map(self, message: OccupancyGrid | None = None) -> None:
        self.client.publish("map", message or self.map_message(), LATCHED)

    def pose(
        self, cell: Cell, yaw: float = 0.0, grid: GridMap | None = None
    ) -> PoseStamped:
        return pose(grid or self.grid, cell, yaw, offset=0.05)

    def send_start(self, stamped: PoseStamped) -> None:
        self.client.publish("initialpose", initial_pose(stamped))

    def send_goal(self, stamped: PoseStamped) -> None:
        self.client.publish("goal_pose", stamped)

    def get_plan(self, start: PoseStamped, goal: PoseStamped) -> Path:
        return self.client.get_plan(start, goal)

    def last_plan(self) -> Path:
        """Return the plan that was published last, which the topic keeps for late
        subscribers.
        """
        self.get_plan(self.pose(START), self.pose(START))  # what came before it is done
        return self.client.subscribe(Path, "plan", LATCHED).wait()

    def wait_for_path(
        self,
        start: Cell,
        goal: Cell,
        grid: GridMap | None = None,
        yaw: float | None = None,
    ) -> Path:
        """Wait for a plan between two cells, to this yaw, and check all that can be
        said of it.
        """
        grid = grid or self.grid
        # A goal that is told as `pose` does, or sent otherwise, or has moved.
        ends = [
            (point_of(self.pose(cell, grid=grid)), grid.cell_to_world(cell))
            for cell in (start, goal)
        ]

        def is_asked_for(path: Path) -> bool:
            points = points_of(path)
            if not points:
                return False
            last = yaw_of(path.poses[-1].pose.orientation)
            is_there = [
                any(math.dist(point, place) < 1e-6 for place in places)
                for point, places in zip((points[0], points[-1]), ends, strict=True)
            ]
            return all(is_there) and bool(
                np.isclose(last, last if yaw is None else yaw)
            )

        path: Path = self.plans.wait(is_asked_for)
        check_path(path, grid)
        return path

    def wait_for_reason(self, pattern: str, values: Any = None) -> DiagnosticStatus:
        """Wait until the diagnostics of this node say something, and have such
        values.
        """
        expected = (values or {}).items()

        def says(message: DiagnosticArray) -> bool:
            (status,), name = message.status, f"{self.name}: plan"
            is_said = status.name == name and bool(re.search(pattern, status.message))
            return is_said and expected <= values_of(status).items()

        return self.diagnostics.wait(says).status[0]

    def assert_works(self) -> None:
        """See that a good request has its plan: the node lives, and has its map and
        model.
        """
        path = self.get_plan(self.pose(START), self.pose(GOAL))
        check_path(path, self.grid)
        assert points_of(path)[0] == point_of(self.pose(START))

    def wait_until_received(self) -> None:
        """Wait until what was sent has come: the answer to a request comes after it."""
        self.client.get_parameter("planner", "use_sim_time")

    def wait_for_map(self, message: OccupancyGrid) -> None:
        """Wait until the planner has a map: its diagnostics name its stamp."""
        wait_for_map(self.diagnostics, message.header.stamp, self.name)

    def stamped_map(self, values: np.ndarray | None = None) -> OccupancyGrid:
        """Return the message of the map, or of other values, with a stamp of its
        own.
        """
        return map_message(
            self.values if values is None else values, self.grid, next(NUMBERS)
        )

    def map_with(self, box: Any, value: int) -> OccupancyGrid:
        """Return the message of the map with another value in some cells, indexed by
        [y, x].
        """
        values = self.values.copy()
        values[box] = value
        return self.stamped_map(values)

    def set_map(self, message: OccupancyGrid) -> None:
        """Send a map with a stamp of its own, and wait until the planner has it."""
        self.send_map(message)
        self.wait_for_map(message)

    def plan_on(
        self, message: OccupancyGrid, reason: str = "^a path of "
    ) -> DiagnosticStatus:
        """Send a map, and wait until the plan for the active goal is one on it."""
        self.send_map(message)
        stamp = seconds(message.header.stamp)
        return self.wait_for_reason(reason, {"planned on the map of (s)": stamp})

    def begin(self, start: Cell = START, goal: Cell = GOAL, **parameters: Any) -> None:
        """Reset, send a map, a start and a goal, and wait until there is a plan with
        all.
        """
        self.reset(**parameters)
        self.clear()
        message, yaw = self.stamped_map(), next(NUMBERS) % 3000 / 1000
        # Else an earlier map may have the plan: no topic waits for another.
        self.set_map(message)
        self.send_start(self.pose(start))
        # Else it may come after the goal, and have a plan of its own.
        self.wait_until_received()
        self.send_goal(self.pose(goal, yaw))
        self.wait_for_path(start, goal, yaw=yaw)
        planned_on = seconds(message.header.stamp)
        self.wait_for_reason(
            "^a path of [^;]*$", {"planned on the map of (s)": planned_on}
        )
        self.clear()

    def transition(self, label: str = "", number: int = 0) -> bool:
        """Do what a lifecycle manager does; return whether the planner did it."""
        request = ChangeState.Request(transition=Transition(id=number, label=label))
        return self.client.call(ChangeState, "planner/change_state", request).success

    def start(self) -> None:
        assert all(map(self.transition, ("configure", "activate")))

    @property
    def state(self) -> str:
        return self.client.call(GetState, "planner/get_state").current_state.label

    def clear(self) -> None:
        for recorder in (self.plans, self.value, self.diagnostics):
            recorder.clear()


def ask_for_plan(robot: Robot) -> Any:
    """Set an active goal; return the future of another plan."""
    robot.send_start(robot.pose(START))
    robot.send_goal(robot.pose(GOAL))
    plans = robot.client.service(GetPlan, "planner/get_plan")
    plan = plans.call_async(
        GetPlan.Request(start=robot.pose(START), goal=robot.pose(GOAL))
    )
    robot.wait_until_received()
    return plan


@contextmanager
def repeating(client: Client, publish: Callable[[], None]) -> Iterator[None]:
    timer = client.node.create_timer(0.02, publish)
    try:
        yield
    finally:
        client.node.destroy_timer(timer)


def point_of(stamped: PoseStamped) -> tuple[float, float]:
    return stamped.pose.position.x, stamped.pose.position.y


def points_of(path: Path) -> list[tuple[float, float]]:
    return [(pose.pose.position.x, pose.pose.position.y) for pose in path.poses]


def odometry(robot: Robot, cell: Cell, frame: str = "map") -> Odometry:
    message = Odometry(header=Header(frame_id=frame, stamp=Time(sec=next(NUMBERS))))
    message.child_frame_id = "base_link"
    message.pose.pose = robot.pose(cell).pose
    return message


def yaw_of(rotation: Quaternion) -> float:
    return 2 * math.atan2(rotation.z, rotation.w)


def check_path(
    path: Path, grid: GridMap, move_rule: MoveRule = MoveRule.ROBOT_SAFE
) -> None:
    """Check that a path turns at cell centres, on legal segments, densely, looking
    ahead.
    """
    assert path.header.frame_id == "map"
    assert all(pose.header == path.header for pose in path.poses)
    points = points_of(path)
    yaws = [math.atan2(y - v, x - u) for (u, v), (x, y) in pairwise(points)]
    for stamped, yaw, step in zip(path.poses, yaws, pairwise(points), strict=False):
        assert math.dist(*step) <= grid.resolution * (1 + 1e-6)
        assert math.cos(yaw_of(stamped.pose.orientation) - yaw) == pytest.approx(1.0)
    corners = corners_of(path)
    cells = [grid.world_to_cell(x, y) for x, y in corners]
    centres = [grid.cell_to_world(cell) for cell in cells]
    assert np.allclose(centres[1:-1], corners[1:-1], atol=1e-6)
    assert all(is_legal(*segment, grid, move_rule) for segment in pairwise(cells))


def corners_of(path: Path) -> list[tuple[float, float]]:
    """Return the first and last points of a path, and those where it turns."""
    points = points_of(path)
    yaws = [math.atan2(y - v, x - u) for (u, v), (x, y) in pairwise(points)]
    turns = [
        point
        for point, step in zip(points[1:], pairwise(yaws), strict=False)
        if turned(step)
    ]
    return [*points[:1], *turns, *points[-1:]] if len(points) > 1 else points


def turned(yaws: tuple[float, float]) -> bool:
    return math.cos(yaws[0] - yaws[1]) < 1 - 1e-9


def changed(message: Any, field: str, value: Any) -> Any:
    target = message
    *parents, name = field.split(".")
    for parent in parents:
        target = getattr(target, parent)
    setattr(target, name, value)
    return message


def constant_model(path: FilePath, size: int, steps: int) -> None:
    """Write a model that always goes to -x, or where it cannot, to +x: it turns round
    for ever.
    """
    planner = turning_planner(size)
    save_model(path, planner.network, replace(planner.metadata, steps=steps))
