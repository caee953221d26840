"""A client of the nodes, the messages to them, and the check of a planner's answers."""

import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, suppress
from itertools import pairwise, takewhile
from subprocess import Popen
from typing import Any, TypeVar

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from nav_msgs.srv import GetPlan
from numpy.typing import NDArray
from random_maps import Random, generate_map
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy._rclpy_pybind11 import RCLError
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import NodeNameNonExistentError
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import QoSProfile
from std_msgs.msg import Header

from ddqn_planner.grid import OCCUPIED, Cell, GridMap, MapFile, MoveRule, read_map_file
from ddqn_planner.grid.noise import random_requests
from ddqn_planner.nodes.conversions import occupancy_message, quaternion
from ddqn_planner.nodes.diagnostics import seconds
from ddqn_planner.resources import find_map

SAME_CROSSING = 1e-9  # of a segment: two crossings so near to each other are one
RULE = MoveRule.ROBOT_SAFE  # of the planner's default model
TIMEOUT = 120.0  # seconds that anything may take on a loaded machine
# With Fast DDS each client of a service hears the answers to all clients. One that is
# slow to read them loses its own from the usual queue of ten.
SERVICE_QUALITY = QoSProfile(depth=1000)

T = TypeVar("T")


def wait_for(
    what: str,
    answer: Callable[[], T | None],
    children: Iterable[Popen[bytes]] = (),
    timeout: float = TIMEOUT,
) -> T:
    """Wait for the first answer that is true, and return it.

    RuntimeError if a child process ends before, TimeoutError if it takes too long.
    """
    deadline = time.monotonic() + timeout
    while not (found := answer()):
        for child in children:
            if child.poll() is not None:
                raise RuntimeError(f"{child.args!r} ended during the wait for: {what}")
        if time.monotonic() > deadline:
            raise TimeoutError(f"no {what} within {timeout:.0f} s")
        time.sleep(0.002)
    return found


class Recorder:
    """The messages of a topic since the last `clear`: all, or the last `keep`."""

    def __init__(self, keep: int | None = None) -> None:
        self._arrived = threading.Condition()
        self._messages: deque[Any] = deque(maxlen=keep)
        self._since = 0

    def add(self, message: Any, info: dict[str, Any]) -> None:
        """Note a message that was published after the last `clear`."""
        with self._arrived:
            if info["source_timestamp"] >= self._since:
                self._messages.append(message)
                self._arrived.notify_all()

    def clear(self) -> None:
        """Forget what came, and what is still on its way."""
        with self._arrived:
            self._messages.clear()
            self._since = time.time_ns()

    def messages(self) -> list[Any]:
        """Return what came since the last `clear`, in order."""
        with self._arrived:
            return [*self._messages]

    def find(self, predicate: Callable[[Any], Any] = lambda message: True) -> Any:
        """Return the first message for which the predicate holds, or None."""
        return next(filter(predicate, self.messages()), None)

    def wait(
        self,
        predicate: Callable[[Any], Any] = lambda message: True,
        timeout: float = TIMEOUT,
    ) -> Any:
        """Return the first message for which the predicate holds.

        TimeoutError if none comes.
        """
        with self._arrived:
            found = self._arrived.wait_for(lambda: self.find(predicate), timeout)
            if found is None:
                raise TimeoutError(
                    f"no such message; there came {[*self._messages][-3:]}"
                )
            return found


def ask(service: Any, request: Any, timeout: float = TIMEOUT) -> Any:
    """Return the answer to a request to a service, or raise TimeoutError."""
    answers, future = queue.SimpleQueue[Any](), service.call_async(request)
    future.add_done_callback(answers.put)
    try:
        return answers.get(timeout=timeout).result()
    except queue.Empty:
        service.remove_pending_request(future)
        raise TimeoutError(
            f"no answer from {service.srv_name} within {timeout:.0f} s"
        ) from None


class Client(ExitStack):
    """A node in a context of its own, spun in the background until the stack closes."""

    def __init__(self, namespace: str = "", name: str = "client") -> None:
        super().__init__()
        self._context = Context()
        self._context.init(args=[])
        self.node = rclpy.create_node(
            name,
            namespace=namespace,
            context=self._context,
            start_parameter_services=False,
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._services: dict[str, Any] = {}
        self._publishers: dict[str, Any] = {}
        thread = threading.Thread(target=self._spin, daemon=True)
        thread.start()
        # From the last to the first, when the stack closes.
        self.callback(self.node.destroy_node)
        self.callback(self._executor.shutdown)
        self.callback(thread.join)
        self.callback(self._context.try_shutdown)

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except (ExternalShutdownException, RCLError):  # at the end
            if self._context.ok():
                raise

    def run(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function in the thread that spins; return the future of its result."""
        return self._executor.create_task(function, *arguments)

    def service(self, service_type: Any, name: str) -> Any:
        """Return rclpy's client of a service once both sides are ready.

        There is one client for each service.
        """
        service = self._services.get(name) or self.node.create_client(
            service_type, name, qos_profile=SERVICE_QUALITY
        )
        wait_for(f"service {name}", service.service_is_ready)
        if name not in self._services:
            # The middleware drops the answer to a client that the node has not
            # discovered yet.
            self.wait_for_discovery(name.rpartition("/")[0])
            self._services[name] = service
        return service

    def wait_for_discovery(self, node: str) -> None:
        """Wait until a node has discovered all that this client has created so far."""
        # It discovers in the order of creation, so it knows the rest when it answers a
        # new client.
        probe = self.node.create_client(GetParameters, f"{node}/get_parameters")
        wait_for(f"parameters of {node}", probe.service_is_ready)
        answered = threading.Event()

        def asked() -> bool:
            probe.call_async(GetParameters.Request()).add_done_callback(
                lambda _: answered.set()
            )
            return answered.wait(1.0)

        wait_for(f"discovery by {node}", asked)
        self.run(self.node.destroy_client, probe)  # its thread may hold it

    def entities(self, node: str) -> set[tuple[str, str, str]]:
        """Return the topics and services of a node of this namespace.

        Each is a tuple of kind, name and type.
        """
        namespace = self.node.get_namespace()
        kinds = {
            "publishes": self.node.get_publisher_names_and_types_by_node,
            "subscribes": self.node.get_subscriber_names_and_types_by_node,
            "service": self.node.get_service_names_and_types_by_node,
        }
        with suppress(NodeNameNonExistentError):
            return {
                (kind, name.removeprefix(f"{namespace}/"), types[0])
                for kind, get in kinds.items()
                for name, types in get(node, namespace)
            }
        return set()

    def call(
        self, kind: Any, name: str, request: Any = None, timeout: float = TIMEOUT
    ) -> Any:
        """Wait for a service, call it, and return its response.

        TimeoutError if there is none.
        """
        return ask(self.service(kind, name), request or kind.Request(), timeout)

    def publisher(
        self, message_type: Any, topic: str, qos: Any = 10, listeners: int = 1
    ) -> Any:
        """Return a publisher, always the same one per topic, once so many listen."""
        if topic not in self._publishers:
            self._publishers[topic] = self.node.create_publisher(
                message_type, topic, qos
            )
        publisher = self._publishers[topic]
        wait_for(
            f"listener to {topic}",
            lambda: publisher.get_subscription_count() >= listeners,
        )
        return publisher

    def publish(
        self, topic: str, message: Any, qos: Any = 10, listeners: int = 1
    ) -> None:
        """Publish a message once so many listen."""
        self.publisher(type(message), topic, qos, listeners).publish(message)

    def publish_ends(self, request: GetPlan.Request) -> None:
        """Publish the start and the goal of a request."""
        self.publish("initialpose", initial_pose(request.start))
        self.publish("goal_pose", request.goal)

    def subscribe(
        self, kind: Any, topic: str, qos: Any = 10, keep: int | None = None
    ) -> Recorder:
        """Return what a topic brings from now on."""
        recorder = Recorder(keep)
        add: Any = (
            recorder.add
        )  # rclpy takes callbacks of two arguments, and does not say so
        self.node.create_subscription(kind, topic, add, qos)
        return recorder

    def get_plan(self, start: PoseStamped, goal: PoseStamped) -> Path:
        """Return the planner's answer."""
        request = GetPlan.Request(start=start, goal=goal)
        answer: GetPlan.Response = self.call(GetPlan, "planner/get_plan", request)
        return answer.plan

    def set_parameters(self, node: str, **values: Any) -> list[Any]:
        """Set parameters of a node; return a SetParametersResult for each."""
        messages = [
            Parameter(name, value=v).to_parameter_msg() for name, v in values.items()
        ]
        request = SetParameters.Request(parameters=messages)
        return list(self.call(SetParameters, f"{node}/set_parameters", request).results)

    def get_parameter(self, node: str, name: str) -> Any:
        """Return a parameter's value."""
        request = GetParameters.Request(names=[name])
        response = self.call(GetParameters, f"{node}/get_parameters", request)
        return parameter_value_to_python(response.values[0])


class RobotPoses:
    """Publishes a robot's poses as odometry.

    Where tf2_ros is installed, it sends a transform, too.
    """

    def __init__(self, node: Any) -> None:
        self._odometry = node.create_publisher(Odometry, "odom", 100)
        self._send_transform: Callable[[Any], Any] = lambda transform: None
        with suppress(ImportError):
            from tf2_ros import TransformBroadcaster

            self._send_transform = TransformBroadcaster(node).sendTransform

    def publish(self, header: Header, x: float, y: float, yaw: float = 0.0) -> None:
        """Publish a pose of `base_link` in the header's frame.

        The pose is in metres and radians.
        """
        odometry = Odometry(header=header, child_frame_id="base_link")
        transform = TransformStamped(header=header, child_frame_id="base_link")
        for place in (odometry.pose.pose.position, transform.transform.translation):
            place.x, place.y = x, y
        odometry.pose.pose.orientation = transform.transform.rotation = quaternion(yaw)
        self._odometry.publish(odometry)
        self._send_transform(transform)


def pose(
    grid: GridMap, cell: Cell, yaw: float = 0.0, offset: float = 0.0
) -> PoseStamped:
    """Return the pose of a cell's centre, or of a point `offset` m beside it.

    The pose is in the map frame.
    """
    message = PoseStamped(header=Header(frame_id="map"))
    x, y = grid.cell_to_world(cell)
    message.pose.position.x, message.pose.position.y = x + offset, y - offset
    message.pose.orientation = quaternion(yaw)
    return message


def initial_pose(start: PoseStamped) -> PoseWithCovarianceStamped:
    """Return a pose as `initialpose` takes it."""
    message = PoseWithCovarianceStamped(header=start.header)
    message.pose.pose = start.pose
    return message


def plan_request(grid: GridMap, start: Cell, goal: Cell) -> GetPlan.Request:
    """Return a request for a plan between two cells."""
    return GetPlan.Request(start=pose(grid, start), goal=pose(grid, goal))


def cell_of(grid: GridMap, stamped: PoseStamped) -> Cell:
    """Return the cell of a pose."""
    return grid.world_to_cell(stamped.pose.position.x, stamped.pose.position.y)


def cells_of(grid: GridMap, path: Path) -> list[Cell]:
    """Return the cells of a path, none if there is none."""
    return [cell_of(grid, stamped) for stamped in path.poses]


def map_message(
    values: NDArray[np.int8], grid: GridMap, stamp: int = 0
) -> OccupancyGrid:
    """Return a map as a message, stamped with a number of seconds."""
    header = Header(frame_id="map", stamp=Time(sec=stamp))
    return occupancy_message(values, grid.resolution, grid.origin, header)


def values_of(status: DiagnosticStatus) -> dict[str, str]:
    """Return the values of a diagnostic status."""
    return {entry.key: entry.value for entry in status.values}


def wait_for_map(diagnostics: Recorder, stamp: Time, node: str = "/planner") -> None:
    """Wait until the diagnostics of a planner name the stamp of its map."""

    def has_map(message: DiagnosticArray) -> bool:
        status = message.status[0]
        found = values_of(status).get("map stamp (s)")
        return status.name == f"{node}: plan" and found == seconds(stamp)

    diagnostics.wait(has_map)


class MapFixture:
    """A map, its message, and the check of an answer."""

    def __init__(self, map_file: MapFile) -> None:
        # A message holds the resolution in single precision.
        resolution = float(np.float32(map_file.resolution))
        self.values = map_file.values
        self.grid = MapFile(map_file.values, resolution, map_file.origin).grid()

    def message(self, stamp: int = 0) -> OccupancyGrid:
        """Return the map message, stamped with a number of seconds."""
        return map_message(self.values, self.grid, stamp)

    def requests(self, count: int, random: Random) -> list[GetPlan.Request]:
        """Draw requests with a path."""
        drawn = random_requests(self.grid.occupancy, RULE, count, random)
        return [plan_request(self.grid, *cells) for cells in drawn]

    def error(self, request: GetPlan.Request, plan: Path) -> str:
        """Say what is wrong with an answer; "" if nothing is.

        The robot cuts no corners.
        """
        grid = self.grid
        start = cell_of(grid, request.start)
        goal = cell_of(grid, request.goal)
        if not plan.poses:
            if self._is_possible(start, goal):
                return f"no path from {start} to {goal}, where there is one"
            return ""
        points = np.array([point_of(stamped) for stamped in plan.poses])
        ends = [point_of(request.start), point_of(request.goal)]
        if not np.array_equal(points[[0, -1]], ends):
            path = f"a path from {points[0]} to {points[-1]}"
            return f"{path}, asked was {start} to {goal}"
        if not self._is_legal(cells_passed(grid, points), start):
            return f"an illegal segment in {points.tolist()}"
        return ""

    def _is_possible(self, start: Cell, goal: Cell) -> bool:
        """Say whether a path joins two free cells."""
        if not (self.grid.is_free(start) and self.grid.is_free(goal)):
            return False
        x, y = goal
        return bool(self.grid.reachable([start], RULE)[y, x])

    def _is_legal(self, cells: Sequence[Cell], start: Cell) -> bool:
        """Say whether a robot may pass cells, one after another."""
        # A robot on an obstacle may leave it, and what is next to it.
        leaving = list(takewhile(lambda cell: not self.grid.is_free(cell), cells))
        free = cells[len(leaving) :]
        if not free or not all(map(self.grid.is_free, free)):
            return False
        if any(math.dist(cell, start) > 1 for cell in leaving):
            return False
        return all(
            self.grid.is_free((next_x, y)) and self.grid.is_free((x, next_y))
            for (x, y), (next_x, next_y) in pairwise(free)
        )


def point_of(stamped: PoseStamped) -> tuple[float, float]:
    """Return where a pose is."""
    return stamped.pose.position.x, stamped.pose.position.y


def cells_passed(grid: GridMap, points: NDArray[np.float64]) -> list[Cell]:
    """Return the cells of a path, and those of which it cuts a corner.

    A cell follows another diagonally only where the path passes their common corner.
    """
    corners = grid.in_cells(points)
    cells: list[Cell] = []
    for begin, end in pairwise([*corners, corners[-1]]):
        for x, y in _points_between_borders(begin, end):
            cell = (math.floor(x), math.floor(y))
            if cells[-1:] != [cell]:
                cells.append(cell)
    return cells


def _points_between_borders(
    begin: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return a point (x, y) in each cell that a segment passes: (N, 2)."""
    shares = [0.0, 1.0]  # of the segment where it crosses a border of cells
    for first, last in zip(begin.tolist(), end.tolist(), strict=True):
        low, high = sorted((first, last))
        borders = np.arange(math.floor(low) + 1, math.ceil(high))
        shares += ((borders - first) / (last - first)).tolist()
    crossings = np.sort(shares)
    # Where it crosses two borders at once, at a corner, there is no stretch between.
    is_stretch = np.diff(crossings) > SAME_CROSSING
    middle = ((crossings[1:] + crossings[:-1]) / 2)[is_stretch]
    if not middle.size:  # the segment is a point
        middle = np.array([0.5])
    points: NDArray[np.float64] = begin + middle[:, None] * (end - begin)
    return points


def generated_map(
    kind: str, side: int, resolution: float = 0.05, seed: Any = 0
) -> MapFixture:
    """Return a square map of a kind.

    It is always the same one, unless the seed is a generator, which moves on.
    """
    occupancy = generate_map(kind, (side, side), np.random.default_rng(seed))
    return MapFixture(MapFile(OCCUPIED * occupancy, resolution))


def shipped_maps() -> dict[str, MapFixture]:
    """Return two shipped maps, a small one and a large one."""
    return {
        name: MapFixture(read_map_file(find_map(name)))
        for name in ("dilemma", "office")
    }
