"""The footprint that a costmap publishes, and the model that it chooses."""

import weakref
from types import SimpleNamespace
from typing import Any

import numpy as np
from geometry_msgs.msg import Point32, Polygon, PolygonStamped, TransformStamped
from hypothesis import given
from hypothesis import strategies as st
from networks import BODY, robot_planner
from std_msgs.msg import Header

from ddqn_planner import GridMap
from ddqn_planner.nodes.conversions import quaternion
from ddqn_planner.nodes.diagnostics import PlannerDiagnostics
from ddqn_planner.nodes.footprint_source import TOPIC, FootprintSource
from ddqn_planner.nodes.model_source import LoadedModel, ModelSource
from ddqn_planner.nodes.worker import Worker
from ddqn_planner.robot.cover import TOLERANCE
from ddqn_planner.robot.footprint import Corners, placed, read_footprint

CORNERS = [(0.5, 0.3), (-0.2, 0.3), (-0.2, -0.3), (0.5, -0.3), (0.6, 0.0)]
FOOTPRINT = read_footprint(CORNERS)


class Node:
    """As much of a planner's node as reads footprints and models."""

    def __init__(self) -> None:
        self.log: list[str] = []
        self.callbacks: dict[str, Any] = {}

    def value(self, name: str) -> Any:
        return {"robot_frame": "base_link", "follow_trainer": False}[name]

    def create_subscription(self, _: type, topic: str, callback: Any, __: Any) -> None:
        self.callbacks[topic] = callback

    def create_publisher(self, *_: Any) -> None:
        pass

    def create_guard_condition(self, _: Any) -> Any:
        return SimpleNamespace(trigger=lambda: None)

    def get_logger(self) -> Any:
        write = self.log.append
        return SimpleNamespace(info=write, warning=write, error=write)


class Transforms:
    """TF, which knows where the robot was in one second."""

    available = True
    listening_since = 0.0  # long ago

    def __init__(self) -> None:
        self.robot = np.zeros(3)

    def transform_at(self, header: Header, target: str) -> TransformStamped:
        if header.stamp.sec != 7:
            raise ValueError("no transform leads there")
        x, y, yaw = self.robot
        cos, sin = np.cos(yaw), np.sin(yaw)
        transform = TransformStamped()
        transform.header.frame_id = target
        transform.transform.translation.x = -cos * x - sin * y
        transform.transform.translation.y = sin * x - cos * y
        transform.transform.rotation = quaternion(-yaw)
        return transform


def message(corners: Corners, frame: str, second: int = 7) -> PolygonStamped:
    points = [Point32(x=x, y=y) for x, y in np.float32(corners).tolist()]
    stamped = PolygonStamped(polygon=Polygon(points=points))
    stamped.header.frame_id = frame
    stamped.header.stamp.sec = second
    return stamped


POSITIONS = st.floats(-1000, 1000)


@given(st.lists(st.tuples(POSITIONS, POSITIONS, st.floats(-9, 9)), min_size=2))
def test_a_footprint_is_told_once_wherever_the_robot_is(
    poses: list[tuple[float, float, float]],
) -> None:
    node: Any = Node()
    transforms: Any = Transforms()
    told: list[Corners] = []
    diagnostics = PlannerDiagnostics(node)
    FootprintSource(node, diagnostics, transforms, lambda: True, told.append)
    publish = node.callbacks[TOPIC]
    # A message without corners is refused also before the first footprint.
    publish(message(FOOTPRINT[:0], "base_link"))
    assert "fewer than three points" in diagnostics.refused[TOPIC]
    for pose in poses:
        transforms.robot = np.array(pose)
        publish(message(placed(FOOTPRINT, transforms.robot), "map"))
    publish(message(FOOTPRINT, "base_link"))
    (footprint,) = told
    assert np.abs(footprint - FOOTPRINT).max() < TOLERANCE / 2
    # What is wrong is refused with the reason, and the last footprint stays.
    for wrong, reason in (
        (message(FOOTPRINT, ""), "its frame is ''; publish it in 'base_link'"),
        (message(FOOTPRINT, "map", second=8), "no transform leads there"),
        (message(FOOTPRINT + 5e5, "map"), "where messages round to 0.031 m; publish"),
        (message(FOOTPRINT[:2], "base_link"), "fewer than three"),
        (message(FOOTPRINT * np.nan, "base_link"), "no numbers from"),
        (message(FOOTPRINT[[0, 2, 1, 3]], "base_link"), "sides of the footprint"),
    ):
        publish(wrong)
        assert reason in diagnostics.refused[TOPIC]
    publish(message(1.1 * FOOTPRINT, "base_link"))
    assert not diagnostics.refused
    assert len(told) == 2


def loaded(name: str, body: tuple[float, float, float]) -> LoadedModel:
    planner = robot_planner("differential", 0.1, body)
    return LoadedModel(planner.network, planner.metadata, name)


def test_a_planner_that_is_replaced_is_freed_with_its_fields() -> None:
    node: Any = Node()
    small, large = loaded("small", BODY), loaded("large", (0.4, 0.4, 0.3))
    source = ModelSource(node, PlannerDiagnostics(node), Worker(node))
    source.use(small)
    assert not source.needs_footprint
    source.use_bodies([large])
    front, back, side = BODY
    in_small = read_footprint([(front, side), (-back, side), (-back, -side)])
    grid = GridMap(np.zeros((30, 30)), 0.1)
    # Functions that are compiled for the first time hold what they were called with.
    robot_planner("differential", 0.1).plan_poses(grid, (1, 1, 0), (2, 2, 1))
    freed: list[weakref.ref[Any]] = []
    for footprint, name in 2 * [(in_small, "small"), (-in_small, "large")]:
        source.use_footprint(footprint)
        assert source.file == name
        assert [reference() for reference in freed] == [None] * len(freed)
        planner: Any = source.planner
        assert len(planner.plan_poses(grid, (1, 1, 0), (2, 2, 1)).poses)
        freed += map(weakref.ref, [planner, *planner.pose_planner.fields.kept])
        del planner
    assert not source.use_footprint(-in_small)  # the planner and its fields stay
    assert freed[-1]() is not None
    assert source.use_footprint(2 * in_small)  # which no model covers
    assert source.planner is None
    assert freed[-1]() is None
    source.use_bodies([])
    assert source.file == "small"
