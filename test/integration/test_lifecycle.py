"""The planner's lifecycle: configure creates, activate enables, deactivate stops,
cleanup frees.
"""

import gc
import re
import shutil
import signal
import threading
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from client import TIMEOUT, generated_map, initial_pose, plan_request, wait_for
from integration.robot import ERROR, GOAL, NUMBERS, START, WARN, Robot, ask_for_plan
from lifecycle_msgs.msg import State, Transition, TransitionEvent
from lifecycle_msgs.srv import (
    ChangeState,
    GetAvailableStates,
    GetAvailableTransitions,
    GetState,
)
from nav_msgs.srv import GetPlan
from processes import cpu_seconds
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode
from rclpy.utilities import try_shutdown

from ddqn_planner.nodes.lifecycle import ManagedNode
from ddqn_planner.nodes.parameters import PLANNER_PARAMETERS
from ddqn_planner.nodes.planner_node import PlannerNode
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.nodes.trainer_node import TrainerNode

LABELS = ("configure", "activate", "deactivate", "cleanup", "shutdown")
OF_CONFIGURED = {"planner/get_plan", "plan", "map", "goal_pose"}


def start(robot: Robot) -> None:
    robot.start()
    robot.set_map(robot.stamped_map())
    robot.assert_works()


def wait_for_created(robot: Robot, expected: set[str]) -> None:
    """Wait until the planner has these of the topics and services of a configured
    one.
    """

    def created() -> bool:
        entities = robot.client.entities("planner")
        return (
            bool(entities)
            and {name for _, name, _ in entities} & OF_CONFIGURED == expected
        )

    wait_for("what a planner in its state has", created)


@pytest.fixture(scope="module")
def managed(run_robot: Any, model: Path) -> Iterator[Robot]:
    """The user of a planner that most tests share."""
    with run_robot("/managed", {"autostart": False, "model": str(model)}) as robot:
        yield robot


@pytest.fixture
def robot(managed: Robot) -> Robot:
    """The user of the shared planner, which is unconfigured."""
    for label in ("deactivate", "cleanup"):
        managed.transition(label)
    managed.node.forget_log()
    managed.clear()
    assert managed.state == "unconfigured"
    return managed


def test_each_transition_creates_enables_stops_and_frees(robot: Robot) -> None:
    node = robot.node

    def assert_not_active() -> None:
        robot.clear()
        assert robot.get_plan(robot.pose(START), robot.pose(GOAL)).poses == []
        robot.wait_for_reason("the node is not active", {"status": "NOT_ACTIVE"})

    def assert_works_without_a_goal() -> None:
        assert robot.transition("activate")
        robot.assert_works()
        assert robot.plans.messages() == []

    for _ in range(2):
        wait_for_created(robot, set())
        remedy = "the node is not active; configure and activate it"
        assert robot.wait_for_reason(remedy).level == WARN
        assert robot.transition("configure")
        assert robot.state == "inactive"
        wait_for_created(robot, OF_CONFIGURED)
        robot.set_map(robot.stamped_map())  # a map is taken, requests are not
        robot.send_start(robot.pose(START))
        assert_not_active()
        node.wait_for_log("no plan: the node is not active")  # for the request
        node.forget_log()
        robot.send_goal(robot.pose(GOAL))
        node.wait_for_log("no plan: the node is not active")  # so the goal has come
        assert_works_without_a_goal()  # it was refused
        assert robot.state == "active"
        robot.begin()
        assert robot.transition("deactivate")
        robot.send_start(robot.pose((1, 0)))
        robot.set_map(robot.stamped_map())
        assert_not_active()
        assert_works_without_a_goal()  # it was dropped
        assert all(map(robot.transition, ("deactivate", "cleanup")))
        node.forget_log()


def test_no_request_for_a_transition_ends_the_planner(robot: Robot) -> None:
    start(robot)
    labels = "configure", "activate", "cleanup", "no_such", "transition_error", "ü" * 99
    assert not any(map(robot.transition, labels))
    assert not any(
        robot.transition(number=n) for n in (0, 1, 2, 3, 5, 6, 8, 10, 60, 62, 77, 255)
    )
    robot.node.wait_for_log(
        "'configure' refused: the node has deactivate, shutdown when active"
    )
    robot.node.wait_for_log("transition 255 refused")
    assert robot.state == "active"
    robot.assert_works()
    assert robot.transition(number=Transition.TRANSITION_DEACTIVATE)
    assert robot.state == "inactive"


def test_an_unconfigured_planner_checks_parameters(
    robot: Robot, tmp_path: Path
) -> None:
    model = tmp_path / "model.safetensors"
    shutil.copy(robot.model, model)
    assert robot.refuse(model="no_such_model")
    robot.set(model=str(model), start_source="odometry")
    model.unlink()
    for reason in ("no model", "cannot be read as safetensors"):
        assert not robot.transition("configure")
        assert robot.state == "unconfigured"
        robot.node.wait_for_log(
            f"model refused: .*{reason}.*; or set the parameter 'model'"
        )
        assert robot.wait_for_reason(f"model refused: .*{reason}").level == ERROR
        wait_for_created(robot, set())
        model.write_text("a model")
    shutil.copy(robot.model, model)
    start(robot)
    robot.wait_for_reason("", {"model file": str(model), "state": "active"})
    robot.set(start_source="initialpose")


def test_the_planner_survives_transitions_among_requests(robot: Robot) -> None:
    node = robot.client.node
    plans = node.create_client(GetPlan, "planner/get_plan")
    messages = {"map": robot.map_message(), "goal_pose": robot.pose(GOAL)}
    messages["initialpose"] = initial_pose(robot.pose(START))
    for topic, message in messages.items():
        robot.client.publish(topic, message, LATCHED, listeners=0)
    request = GetPlan.Request(start=robot.pose(START), goal=robot.pose(GOAL))
    for label in ["configure", "activate", "deactivate", "cleanup"] * 3:
        for _ in range(20):
            plans.call_async(request)
            for topic, message in messages.items():
                robot.client.publish(topic, message, listeners=0)
        assert robot.transition(label)
    assert robot.state == "unconfigured"
    start(robot)


def test_a_stop_answers_what_waits(run_waiting: Any, load_gate: Path) -> None:
    with run_waiting("/stopped") as robot:
        robot.set_map(robot.stamped_map())
        robot.node.wait_for_log("a model waits")
        plan = ask_for_plan(robot)
        robot.wait_for_reason("the model is being loaded")
        assert robot.state == "inactive"  # it answers, but nothing yet
        assert robot.transition("cleanup")
        wait_for("plan", plan.done)
        assert plan.result().plan.poses == []
        load_gate.touch()
        start(robot)
        assert robot.plans.messages() == []
        assert robot.transition("shutdown")
        assert robot.state == "finalized"
        assert not any(map(robot.transition, LABELS))


def test_a_stop_breaks_the_bond(run_robot: Any, model: Path) -> None:
    status = pytest.importorskip("bond.msg", reason="bond is not on PyPI").Status
    with run_robot("/bonded", {"autostart": False, "model": str(model)}) as robot:
        bond = robot.client.subscribe(status, "bond")
        robot.start()
        bond.wait(lambda message: message.active)
        robot.node.forget_log()
        assert robot.node.stop(signal.SIGTERM) == 0
        bond.wait(lambda message: not message.active)
        assert robot.node.log == ""


def test_cleanup_frees_map_model_and_fields(make_robot: Any, model: Path) -> None:
    rclpy.init(args=["--ros-args", "-p", f"model:={model}", "-r", "__ns:=/freed"])
    node = PlannerNode()
    spinning = threading.Thread(target=rclpy.spin, args=[node])
    spinning.start()
    try:
        robot = make_robot("/freed")
        robot.begin()
        planner, grid = node.model_source.planner, node.map_source.ready().result()
        assert planner is not None
        freed = [weakref.ref(it) for it in (planner, grid, planner.q_field(grid, GOAL))]
        del planner, grid
        assert robot.transition("deactivate")
        assert all(reference() for reference in freed)
        assert robot.transition("cleanup")
        wait_for(
            "free memory", lambda: gc.collect() >= 0 and not any(it() for it in freed)
        )
        before = len([*node.guards])
        assert all(map(robot.transition, ("configure", "cleanup")))
        assert len([*node.guards]) == before
    finally:
        rclpy.shutdown()
        spinning.join()
        node.destroy_node()


def test_a_planner_that_plans_leaves_the_graph_at_once(robot: Robot) -> None:
    """The last test, as it ends the planner of the others."""
    robot.start()
    rooms = generated_map("rooms", 500)
    robot.set_map(rooms.message(next(NUMBERS)))
    start, *goals = rooms.grid.free_cells()
    plans = robot.client.service(GetPlan, "planner/get_plan")
    requests = [plan_request(rooms.grid, start, goal) for goal in goals[-100:]]
    before = cpu_seconds(robot.node.process.pid)
    answers = [plans.call_async(request) for request in requests]
    wait_for(
        "fields under way", lambda: cpu_seconds(robot.node.process.pid) > before + 0.2
    )
    assert robot.node.stop(signal.SIGTERM) == 0
    assert not re.search("ERROR|Traceback", robot.node.log)
    name, graph = ("planner", "/managed"), robot.client.node
    wait_for(
        "farewell",
        lambda: name not in graph.get_node_names_and_namespaces(),
        timeout=10,
    )
    assert not all(answer.done() and answer.result().plan.poses for answer in answers)


SERVICES: dict[str, Any] = {
    "get_state": GetState,
    "get_available_states": GetAvailableStates,
    "get_available_transitions": GetAvailableTransitions,
    "get_transition_graph": GetAvailableTransitions,
}


def fields_of(message: Any) -> dict[str, Any]:
    """Return the values of a message's fields, lists in any one order."""
    values = {}
    for name in message.get_fields_and_field_types():
        value = getattr(message, name)
        values[name] = sorted(value, key=repr) if isinstance(value, list) else value
    return values


def heard_transitions(
    nodes: list[Any], listener: Any, executor: SingleThreadedExecutor
) -> list[list[tuple[State, State]]]:
    """Return a list for each node, to which its transitions are added as they come."""
    events: list[list[tuple[State, State]]] = [[] for _ in nodes]
    for node, seen in zip(nodes, events, strict=True):

        def hear(
            event: TransitionEvent, seen: list[tuple[State, State]] = seen
        ) -> None:
            seen.append((event.start_state, event.goal_state))

        name = f"/{node.get_name()}/transition_event"
        listener.create_subscription(TransitionEvent, name, hear, 100)
        while not listener.count_publishers(name):
            executor.spin_once(timeout_sec=0.05)
    return events


def test_the_lifecycle_is_that_of_rclpys_own_nodes() -> None:
    """Except for their answer to a transition that the state does not have: it ends a
    process.
    """
    rclpy.init(args=["--ros-args", "-p", "autostart:=false"])
    planner = PlannerNode()
    nodes = [planner, LifecycleNode("example")]
    listener, executor = rclpy.create_node("listener"), SingleThreadedExecutor()
    for node in (*nodes, listener):
        executor.add_node(node)
    events = heard_transitions(nodes, listener, executor)

    def ask(service: str, kind: Any, **request: Any) -> list[Any]:
        """Return what both nodes answer."""
        answers = []
        for node in nodes:
            client = listener.create_client(kind, f"/{node.get_name()}/{service}")
            while not client.service_is_ready():
                executor.spin_once(timeout_sec=0.05)
            future = client.call_async(kind.Request(**request))
            executor.spin_until_future_complete(future, TIMEOUT)
            answers.append(future.result())
            listener.destroy_client(client)
        return answers

    try:
        for label in ("", *LABELS):
            if label:
                ours, example = ask(
                    "change_state", ChangeState, transition=Transition(label=label)
                )
                assert ours.success
                assert example.success
            for service, kind in SERVICES.items():
                ours, example = ask(service, kind)
                assert fields_of(ours) == fields_of(example)
        assert planner.state == "finalized"
        while len(events[0]) < 2 * len(LABELS) or len(events[1]) < 2 * len(LABELS):
            executor.spin_once(timeout_sec=TIMEOUT)
        assert events[0] == events[1]
    finally:
        for node in (*nodes, listener):
            node.destroy_node()
        executor.shutdown()
        try_shutdown()


class Failing(ManagedNode):
    """A node that cannot be configured at first."""

    has_failed = False

    def configure(self) -> None:
        super().configure()
        if not self.has_failed:
            self.has_failed = True
            raise OSError("not yet")


def test_a_transition_that_failed_can_be_tried_again() -> None:
    rclpy.init(args=[])
    node, executor = Failing("failing", PLANNER_PARAMETERS), SingleThreadedExecutor()
    executor.add_node(node)
    client = node.create_client(ChangeState, "~/change_state")
    assert client.wait_for_service(TIMEOUT)

    def change(label: str) -> bool:
        request = ChangeState.Request(transition=Transition(label=label))
        future = client.call_async(request)
        executor.spin_until_future_complete(future, TIMEOUT)
        return bool(future.result().success)

    try:
        states = []
        for label, succeeds in (
            ("configure", False),
            ("configure", True),
            ("activate", True),
        ):
            assert change(label) == succeeds
            states.append(node.state)
        assert states == ["unconfigured", "inactive", "active"]
    finally:
        node.destroy_node()
        executor.shutdown()
        try_shutdown()


@pytest.mark.parametrize("state", ["unconfigured", "inactive", "active", "finalized"])
def test_a_node_can_be_destroyed_after_the_shutdown_and_twice(
    state: str, model: Path
) -> None:
    rclpy.init(args=["--ros-args", "-p", "autostart:=false", "-p", f"model:={model}"])
    node = PlannerNode()
    for label in {"inactive": LABELS[:1], "active": LABELS[:2]}.get(state, ()):
        node.change(label)
    if state == "finalized":
        node.change("shutdown")
    assert node.state == state
    rclpy.shutdown()
    node.destroy_node()
    node.destroy_node()


def test_a_trainer_can_be_destroyed_twice_and_if_it_cannot_start(
    tmp_path: Path,
) -> None:
    arguments = [
        "--ros-args",
        "-p",
        f"output_folder:={tmp_path}",
        "-p",
        "learn_from:=driving",
    ]
    rclpy.init(args=arguments)
    node = TrainerNode()
    node.destroy_node()
    rclpy.shutdown()
    node.destroy_node()
    rclpy.init(args=[*arguments, "-p", "pose_source:=no_such"])
    with pytest.raises(ValueError, match="pose_source is 'no_such'"):
        TrainerNode()
    rclpy.shutdown()  # newer releases destroy what there is of the node


@pytest.mark.parametrize("case", ["good", "broken", "replaced"])
def test_requests_wait_for_the_first_map_and_model_and_another_one_set_meanwhile_stays(
    run_waiting: Any, model: Path, load_gate: Path, tmp_path: Path, case: str
) -> None:
    broken = tmp_path / "any_map.safetensors"
    broken.write_text("a model")
    first = str(broken) if case == "broken" else "any_map"
    with run_waiting(f"/waiting_{case}", {"model": first}) as robot:
        if case != "good":
            robot.set_map(robot.map_message())
        plan = ask_for_plan(robot)
        assert (
            robot.wait_for_reason("the model is being loaded", {"model": first}).level
            == WARN
        )
        assert robot.client.get_parameter("planner", "mode") == "greedy"
        assert not plan.done()
        assert robot.plans.messages() == []
        if case == "replaced":
            robot.set(model=str(model))
        load_gate.touch()
        if case == "good":
            robot.node.wait_for_log("planning with the model")
            assert not plan.done()
            robot.send_map()
        wait_for("plan", plan.done)
        assert bool(plan.result().plan.poses) == (case != "broken")
        if case == "broken":
            reason = "cannot be read as safetensors"
            assert (
                robot.wait_for_reason(
                    f"there is no model to plan with: .*{reason}"
                ).level
                == ERROR
            )
            robot.node.wait_for_log(f"model refused: .*{reason}.*set the parameter")
            return
        robot.wait_for_path(START, GOAL)
        assert all(path.poses for path in robot.plans.messages())
        if case == "replaced":
            robot.assert_works()
            robot.wait_for_reason("^a path of ", {"model file": str(model)})
        assert "refused" not in robot.node.log
        # Numba itself loads scipy.
        assert robot.node.heavy_libraries <= {"numba", "scipy"}


def test_a_planner_that_is_stopped_waits_for_no_model(run_waiting: Any) -> None:
    with run_waiting("/loads_for_ever") as robot:
        robot.node.wait_for_log("a model waits")
