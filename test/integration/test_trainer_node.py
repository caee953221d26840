from __future__ import annotations

import csv
import itertools
import os
import queue
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path as FilePath
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Pose, PoseStamped, PoseWithCovarianceStamped
from hypothesis import given
from integration.messages import HEADERS, POSES, maps, some_parameters
from nav_msgs.msg import OccupancyGrid, Path
from nav_msgs.srv import GetPlan
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.parameter import Parameter
from rclpy.time import Time
from std_msgs.msg import Float32, Header, String
from std_srvs.srv import Trigger

from ddqn_planner.grid import MOVES, GridMap, MoveRule, legal_moves, read_map_file
from ddqn_planner.model import load_model
from ddqn_planner.nodes import trainer_node
from ddqn_planner.nodes.conversions import occupancy_message, quaternion
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.run import TrainingRun
from ddqn_planner.training.trainer import Trainer

TIMEOUT = 120.0
ENDLESS = {"steps": 10**9, "filters": 4, "learning_starts": 100}


@pytest.fixture
def namespace(request: pytest.FixtureRequest) -> str:
    """A namespace for each test: lasting topics of one test do not reach the next."""
    return "/" + re.sub(r"\W+", "_", request.node.name).strip("_")


class Listener:
    """The messages of a topic, in order."""

    def __init__(self, client: Any, message_type: type, topic: str, qos: Any = 100) -> None:
        self._messages: queue.SimpleQueue[Any] = queue.SimpleQueue()
        client.node.create_subscription(message_type, topic, self._messages.put, qos)

    def next(self) -> Any:
        return self._messages.get(timeout=TIMEOUT)


def stamped(x: float, y: float, frame: str = "map") -> PoseStamped:
    message = PoseStamped(header=Header(frame_id=frame))
    message.pose.position.x, message.pose.position.y = x, y
    message.pose.orientation = quaternion(0.0)
    return message


def publish_map(client: Any, values: Any, resolution: float = 1.0, frame: str = "map") -> None:
    header = Header(frame_id=frame)
    message = occupancy_message(values, resolution, (0.0, 0.0, 0.0), header)
    client.publish("map", message, LATCHED)


def set_up(
    client: Any, values: Any, start: PoseStamped, goal: PoseStamped, listeners: int = 1
) -> None:
    """Publish the map, the start and the goal to so many nodes."""
    publish_map(client, values)
    initial_pose = PoseWithCovarianceStamped(header=start.header)
    initial_pose.pose.pose = start.pose
    client.publish("initialpose", initial_pose, listeners=listeners)
    client.publish("goal_pose", goal, listeners=listeners)


def wait_for_state(listener: Listener, namespace: str, **expected: str) -> dict[str, str]:
    """Return the first diagnostics of a namespace's trainer that hold the expected texts."""
    while True:
        (status,) = listener.next().status
        if status.name != f"{namespace}/trainer: training":
            continue
        values = {entry.key: entry.value for entry in status.values}
        values["message"] = status.message
        if all(text in values.get(key, "") for key, text in expected.items()):
            return values


def start_training(client: Any) -> str:
    """Call ~/start until the poses, which come by other topics, have arrived too."""
    for _ in range(100):
        response = client.call(Trigger, "trainer/start")
        if response.success:
            return str(response.message)
        assert "unknown" in response.message or "no map" in response.message
        time.sleep(0.05)
    raise AssertionError(response.message)


def test_a_training_can_be_watched_saved_stopped_resumed_and_replayed(
    run_node: Any, make_client: Any, namespace: str, small_values: Any, tmp_path: FilePath
) -> None:
    client = make_client(namespace)
    parameters = {**ENDLESS, "output_folder": str(tmp_path / "run"), "replay_period": 0.002}
    with run_node("trainer_node", {**parameters, "move_rule": "robot_safe"}, namespace=namespace):
        rewards = Listener(client, Float32, "trainer/average_reward")
        episodes = Listener(client, Path, "trainer/episode")
        saved = Listener(client, String, "trainer/model_saved", LATCHED)
        diagnostics = Listener(client, DiagnosticArray, "/diagnostics")

        refused = client.call(Trigger, "trainer/start")
        assert not refused.success
        assert "no map" in refused.message

        set_up(client, small_values, stamped(0.5, 0.5), stamped(5.5, 5.5))
        assert "from step 0" in start_training(client)
        assert not client.call(Trigger, "trainer/start").success
        assert -10.0 <= rewards.next().data <= 10.0

        legal = legal_moves(GridMap(small_values > 0).occupancy, MoveRule.ROBOT_SAFE)
        episode = episodes.next()
        assert episode.header.frame_id == "map"
        cells = [(int(p.pose.position.x), int(p.pose.position.y)) for p in episode.poses]
        moves = MOVES.tolist()
        for (x, y), (next_x, next_y) in itertools.pairwise(cells):
            assert legal[moves.index([next_x - x, next_y - y]), y, x]

        assert client.call(Trigger, "trainer/save").success
        _, metadata = load_model(saved.next().data)
        assert metadata.steps > 0
        assert metadata.map_fingerprint == GridMap(small_values > 0).fingerprint

        assert client.call(Trigger, "trainer/stop").success
        stopped = wait_for_state(diagnostics, namespace, state="stopped")
        steps = int(stopped["steps"].split()[0])
        assert f"from step {steps}" in start_training(client)
        client.call(Trigger, "trainer/stop")
        wait_for_state(diagnostics, namespace, state="stopped")

        replay = client.call(Trigger, "trainer/replay")
        assert replay.success, replay.message
        lengths = []
        while len(lengths) < 3 or lengths[-3:-1] != [1, 2]:
            lengths.append(len(episodes.next().poses))


def test_episodes_are_drawn_on_the_map_of_their_own_training(
    run_node: Any, make_client: Any, namespace: str, small_values: Any, tmp_path: FilePath
) -> None:
    client = make_client(namespace)
    parameters = {**ENDLESS, "output_folder": str(tmp_path / "run"), "replay_period": 0.001}
    with run_node("trainer_node", parameters, namespace=namespace) as node:
        episodes = Listener(client, Path, "trainer/episode")
        set_up(client, small_values, stamped(0.5, 0.5), stamped(5.5, 5.5))
        start_training(client)

        def next_episode() -> tuple[str, set[float]]:
            """Return the frame, and the places within a cell of all poses."""
            episode = episodes.next()
            coordinates = [(p.pose.position.x, p.pose.position.y) for p in episode.poses]
            return episode.header.frame_id, {round(c % 1.0, 3) for xy in coordinates for c in xy}

        assert next_episode() == ("map", {0.5})
        publish_map(client, small_values, 0.25, "site")
        node.wait_for_log("6 x 6 cells(.|\n)*6 x 6 cells")
        for _ in range(20):
            assert next_episode() == ("map", {0.5})
        client.call(Trigger, "trainer/stop")
        node.wait_for_log("the training stopped")
        assert client.call(Trigger, "trainer/replay").success
        for _ in range(20):
            assert next_episode() == ("map", {0.5})
        # This process has not seen that training: the last map is the best guess.
        (tmp_path / "run").rename(tmp_path / "earlier")
        client.set_parameters("trainer", output_folder=str(tmp_path / "earlier"))
        assert client.call(Trigger, "trainer/replay").success
        while next_episode()[0] != "site":
            pass


def test_a_replay_is_not_mixed_with_the_training_and_stop_says_what_it_stopped(
    run_node: Any, make_client: Any, namespace: str, small_values: Any, tmp_path: FilePath
) -> None:
    client = make_client(namespace)
    parameters = {**ENDLESS, "output_folder": str(tmp_path / "run"), "episode_interval": 1}
    with run_node("trainer_node", parameters, namespace=namespace) as node:

        def stop() -> str:
            answer = client.call(Trigger, "trainer/stop")
            assert answer.success
            return str(answer.message)

        episodes = Listener(client, Path, "trainer/episode")
        diagnostics = Listener(client, DiagnosticArray, "/diagnostics")
        assert stop() == "no training was running"
        set_up(client, small_values, stamped(0.5, 0.5), stamped(5.5, 5.5))
        start_training(client)
        episodes.next()
        assert client.call(Trigger, "trainer/replay").success
        answered = time.time_ns()
        while Time.from_msg((first := episodes.next()).header.stamp).nanoseconds <= answered:
            pass  # what the training published before
        count = int(wait_for_state(diagnostics, namespace, state="training")["episodes"])
        lengths = [len(first.poses), *(len(episodes.next().poses) for _ in range(40))]
        while int(wait_for_state(diagnostics, namespace)["episodes"]) < count + 20:
            pass
        lengths += [len(episodes.next().poses) for _ in range(20)]
        assert all(b in (1, a + 1) for a, b in itertools.pairwise(lengths)), lengths

        assert "; the replay was stopped" in stop()
        node.wait_for_log("the training stopped")
        assert client.call(Trigger, "trainer/replay").success
        assert stop() == "no training was running; the replay was stopped"
        assert stop() == "no training was running"


def test_the_log_says_when_a_training_starts_and_what_is_saved(
    run_node: Any, make_client: Any, namespace: str, small_values: Any, tmp_path: FilePath
) -> None:
    client = make_client(namespace)
    parameters = {"steps": 300, "filters": 4, "output_folder": str(tmp_path / "run")}
    with run_node("trainer_node", parameters, namespace=namespace) as node:
        set_up(client, small_values, stamped(0.5, 0.5), stamped(5.5, 5.5))
        start_training(client)
        node.wait_for_log(f"training in {tmp_path}/run from step 0 to 300")
        node.wait_for_log(f"step 300 is saved in {tmp_path}/run/checkpoint.safetensors")
        node.wait_for_log("the training finished")
    assert node.log.count("is saved in") == 1


def test_a_folder_of_something_else_or_in_use_is_refused_and_left_as_it_is(
    run_node: Any, make_client: Any, namespace: str, small_values: Any, tmp_path: FilePath
) -> None:
    client = make_client(namespace)
    for name in ("episodes.csv", "model.safetensors"):
        (tmp_path / name).write_text("mine")
    used = tmp_path.with_name("used")
    scenario = Scenario(GridMap(small_values > 0), (0, 0), (5, 5))
    other = TrainingRun(used, [scenario], MoveRule.ROBOT_SAFE, HyperParameters(), seed=0)
    with run_node("trainer_node", {"output_folder": str(tmp_path)}, namespace=namespace):
        set_up(client, small_values, stamped(0.5, 0.5), stamped(5.5, 5.5))
        with pytest.raises(AssertionError, match="no training; give a new or empty folder"):
            start_training(client)
        client.set_parameters("trainer", output_folder=str(used))
        assert "another process trains" in client.call(Trigger, "trainer/start").message
    other.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["episodes.csv", "model.safetensors"]
    assert all(path.read_text() == "mine" for path in tmp_path.iterdir())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_a_checkpoint_that_a_new_process_continues(
    run_node: Any, make_client: Any, namespace: str, tmp_path: FilePath, number: int
) -> None:
    client = make_client(namespace)
    parameters = {
        **ENDLESS,
        "output_folder": str(tmp_path),
        "map_file": str(FilePath(__file__).resolve().parents[2] / "maps" / "dilemma.yaml"),
    }
    with run_node("trainer_node", parameters, namespace=namespace) as node:
        rewards = Listener(client, Float32, "trainer/average_reward")
        start_training(client)
        for _ in range(20):
            rewards.next()
        assert node.stop(number) == 0, node.log
    map_file_scenario = paper_scenario_of(parameters["map_file"])
    steps = Trainer.load_checkpoint(tmp_path / "checkpoint.safetensors", [map_file_scenario]).steps
    assert steps > 0
    with run_node("trainer_node", parameters, namespace=namespace):
        assert f"from step {steps} " in start_training(client)


def paper_scenario_of(map_file: Any) -> Scenario:
    read = read_map_file(map_file)
    assert read.start is not None
    assert read.goal is not None
    return Scenario(read.grid(), read.start, read.goal)


@pytest.mark.parametrize("network", ["paper", "propagation"])
def test_a_planner_that_follows_the_trainer_plans_with_each_model_it_saves(
    run_node: Any,
    make_client: Any,
    namespace: str,
    small_values: Any,
    tmp_path: FilePath,
    network: str,
) -> None:
    client = make_client(namespace)
    trainer_parameters = {
        "steps": 6000,
        "network": network,
        "learning_rate": 0.003,
        "p_r": 1.0,
        "update_interval": 2,
        "target_interval": 100,
        "epsilon_steps": 2000,
        "move_rule": "robot_safe",
        "output_folder": str(tmp_path),
    }
    planner = run_node("planner_node", {"follow_trainer": True}, namespace=namespace)
    with run_node("trainer_node", trainer_parameters, namespace=namespace), planner:
        plans = Listener(client, Path, "plan", LATCHED)
        set_up(client, small_values, stamped(0.5, 0.5), stamped(5.5, 5.5), listeners=2)
        start_training(client)
        # The planner plans for the active goal again with each model, until one is good enough.
        while not plans.next().poses:
            pass
        answer = client.call(
            GetPlan,
            "planner/get_plan",
            GetPlan.Request(start=stamped(0.5, 0.5), goal=stamped(5.5, 5.5)),
        )
        assert answer.plan.poses


@pytest.mark.parametrize(
    ("topic", "message", "named"),
    [
        ("goal_pose", stamped(0.5, 0.5, "odom"), "odom"),
        ("goal_pose", stamped(float("nan"), 0.5), "nan"),
        ("goal_pose", stamped(99.0, 0.5), "(99, 0)"),
        ("goal_pose", stamped(1.5, 1.5), "(1, 1)"),
        ("map", OccupancyGrid(header=Header(frame_id="map")), "resolution"),
    ],
)
def test_bad_input_is_refused_by_name_and_the_training_continues(
    training: Any, topic: str, message: Any, named: str
) -> None:
    client, diagnostics, namespace = training
    client.publish(topic, message, LATCHED if topic == "map" else 10)
    before = wait_for_state(diagnostics, namespace, state="training", message=named)
    after = wait_for_state(diagnostics, namespace, state="training")
    assert before["goal"] == after["goal"] == "(5.5, 5.5)"
    while int(after["steps"].split()[0]) <= int(before["steps"].split()[0]):
        after = wait_for_state(diagnostics, namespace, state="training")


@pytest.fixture(scope="module")
def trainer(
    run_node: Any, make_client: Any, small_values: Any, tmp_path_factory: pytest.TempPathFactory
) -> Any:
    """A trainer that can train, and its diagnostics."""
    namespace = "/training"
    client = make_client(namespace)
    folder = tmp_path_factory.mktemp("training")
    with run_node("trainer_node", {**ENDLESS, "output_folder": str(folder)}, namespace=namespace):
        diagnostics = Listener(client, DiagnosticArray, "/diagnostics")
        set_up(client, small_values, stamped(0.5, 0.5), stamped(5.5, 5.5))
        yield client, diagnostics, namespace


@pytest.fixture
def training(trainer: Any) -> Any:
    """A trainer that trains during the test, but not beside the tests after it."""
    client, diagnostics, namespace = trainer
    start_training(client)
    yield trainer
    client.call(Trigger, "trainer/stop")
    wait_for_state(diagnostics, namespace, state="stopped")


def test_a_folder_with_another_training_is_left_alone(
    run_node: Any, make_client: Any, namespace: str, small_values: Any, tmp_path: FilePath
) -> None:
    scenario = Scenario(GridMap(small_values > 0), (0, 0), (5, 5))
    trainer = Trainer([scenario], MoveRule.ROBOT_SAFE, HyperParameters(gamma=0.5), seed=0)
    trainer.save_checkpoint(tmp_path / "checkpoint.safetensors")
    before = (tmp_path / "checkpoint.safetensors").read_bytes()
    client = make_client(namespace)
    with run_node(
        "trainer_node",
        {"output_folder": str(tmp_path), "move_rule": "robot_safe"},
        namespace=namespace,
    ):
        set_up(client, small_values, stamped(0.5, 0.5), stamped(5.5, 5.5))
        with pytest.raises(AssertionError, match=r"gamma 0\.5 \(now 0\.95\)"):
            start_training(client)
    assert (tmp_path / "checkpoint.safetensors").read_bytes() == before


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"network": "perceptron"}, "network is 'perceptron'; give one of paper, propagation"),
        ({"move_rule": "diagonal"}, "move_rule is 'diagonal'; give one of .*robot_safe"),
        ({"output_folder": ""}, "output_folder is ''; name a folder"),
        ({"environments": 8, "replay_capacity": 4}, "environments is 8; .* at most .* 4"),
    ],
)
def test_a_node_does_not_start_with_an_invalid_parameter(
    log_of_refused_start: Any, parameters: dict[str, Any], reason: str
) -> None:
    log = log_of_refused_start(trainer_node.main, parameters)
    assert re.search(reason, log)
    assert "Traceback" not in log


def test_a_map_file_that_cannot_be_read_ends_the_start_with_its_reason(run_node: Any) -> None:
    with (
        pytest.raises(AssertionError, match="no_such_map"),
        run_node("trainer_node", {"map_file": "no_such_map.yaml"}) as node,
    ):
        assert node.process.wait(TIMEOUT) == 1


def set_atomically(client: Any, *parameters: Any) -> Any:
    request = SetParametersAtomically.Request(parameters=list(parameters))
    return client.call(SetParametersAtomically, "trainer/set_parameters_atomically", request).result


def message_of(name: str, value: Any) -> Any:
    return Parameter(name, value=value).to_parameter_msg()


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("move_rule", "diagonal", "give one of .*robot_safe"),
        ("network", "perceptron", "give one of paper"),
        ("target", "", "give one of double_dqn"),
        ("reward", "gold", "give one of paper"),
        ("output_folder", "", "name a folder"),
        ("map_file", "office", "read-only"),
        ("gamma", 1.0 + 1e-7, "must lie in 0.0 to 1.0"),
        ("gamma", float("nan"), "out of range"),
        ("seed", -1, "out of range"),
        ("seed", 1.0, "type"),
        ("environments", 4000, "at most replay_capacity, 3000"),
        ("", 1, "no name"),
        ("colour", 1, "undeclared"),
    ],
)
def test_an_invalid_value_is_refused_with_its_reason_and_nothing_is_half_set(
    trainer: Any, name: str, value: Any, reason: str
) -> None:
    client, _, _ = trainer
    good = [message_of("replay_capacity", 3000), message_of("epsilon_end", 0.2)]
    assert set_atomically(client, *good).successful
    for order in (1, -1):
        others = [message_of("epsilon_end", 0.3), message_of(name, value)]
        result = set_atomically(client, *others[::order])
        assert not result.successful
        assert re.search(reason, result.reason), result.reason
        assert client.get_parameter("trainer", "epsilon_end") == 0.2
    (result,) = client.call(
        SetParameters,
        "trainer/set_parameters",
        SetParameters.Request(parameters=[message_of(name, value)]),
    ).results
    assert not result.successful


def test_values_that_limit_one_another_can_be_set_together(trainer: Any) -> None:
    client, _, _ = trainer
    both = message_of("environments", 4096), message_of("replay_capacity", 4096)
    assert set_atomically(client, *both).successful
    both = message_of("replay_capacity", 50_000), message_of("environments", 1)
    assert set_atomically(client, *both).successful


def test_a_value_of_an_unknown_type_is_refused(trainer: Any) -> None:
    client, _, _ = trainer
    strange = ParameterMessage(name="seed", value=ParameterValue(type=77))
    assert "ParameterType" in set_atomically(client, strange).reason
    request = SetParameters.Request(parameters=[strange, message_of("seed", 7)])
    results = client.call(SetParameters, "trainer/set_parameters", request).results
    assert [result.successful for result in results] == [False, True]
    assert client.get_parameter("trainer", "seed") == 7


def test_each_parameter_says_what_may_be_set(trainer: Any) -> None:
    client, _, _ = trainer
    names = client.call(ListParameters, "trainer/list_parameters").result.names
    own = [name for name in names if name not in ("use_sim_time", "start_type_description_service")]
    request = DescribeParameters.Request(names=own)
    descriptors = client.call(DescribeParameters, "trainer/describe_parameters", request)
    assert {entry.name for entry in fields(HyperParameters)} <= set(own)
    for descriptor in descriptors.descriptors:
        assert descriptor.description
        limited = (
            descriptor.integer_range
            or descriptor.floating_point_range
            or descriptor.additional_constraints
        )
        unlimited = descriptor.type == ParameterType.PARAMETER_BOOL or descriptor.read_only
        assert bool(limited) != unlimited, descriptor.name


@contextmanager
def full_disk(process: Any, folder: FilePath) -> Iterator[None]:
    """Let the writes of a running process fail in their middle, as on a full disk."""
    limits = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)
    size = (folder / "model.safetensors").stat().st_size - 10
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (size, limits[1]))
    yield
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, limits)


@contextmanager
def no_folder(_: Any, folder: FilePath) -> Iterator[None]:
    """Put a dangling link in a folder's place, into which nobody can write, not even root."""
    moved = folder.with_name("moved")
    folder.rename(moved)
    folder.symlink_to("nowhere/else")
    yield
    folder.unlink()
    moved.rename(folder)


@pytest.mark.parametrize("fault", [full_disk, no_folder])
def test_a_disk_error_is_logged_once_and_the_training_continues(
    run_node: Any,
    make_client: Any,
    namespace: str,
    small_values: Any,
    tmp_path: FilePath,
    fault: Any,
) -> None:
    client, folder = make_client(namespace), tmp_path / "run"
    parameters = {**ENDLESS, "output_folder": str(folder), "move_rule": "robot_safe"}
    with run_node("trainer_node", parameters, namespace=namespace) as node:
        saved = Listener(client, String, "trainer/model_saved", LATCHED)
        diagnostics = Listener(client, DiagnosticArray, "/diagnostics")
        set_up(client, small_values, stamped(0.5, 0.5), stamped(5.5, 5.5))
        start_training(client)
        client.call(Trigger, "trainer/save")
        saved.next()
        model, checkpoint = folder / "model.safetensors", folder / "checkpoint.safetensors"
        wait_until(checkpoint.exists)
        with fault(node.process, folder):
            client.call(Trigger, "trainer/save")
            failing = wait_for_state(diagnostics, namespace, message=f"cannot save to {folder} (")
            kept = folder if folder.exists() else folder.with_name("moved")
            before = [(kept / path.name).read_bytes() for path in (model, checkpoint)]
            for _ in range(3):
                client.call(Trigger, "trainer/save")
                after = wait_for_state(diagnostics, namespace, message="make room")
            assert int(after["steps"].split()[0]) > int(failing["steps"].split()[0])
            assert after["state"] == "training"
            assert [(kept / path.name).read_bytes() for path in (model, checkpoint)] == before
        client.call(Trigger, "trainer/save")
        wait_for_state(diagnostics, namespace, state="training", message="training")
        assert load_model(saved.next().data)[1].steps > 0
        size = (folder / "episodes.csv").stat().st_size
        wait_until(lambda: (folder / "episodes.csv").stat().st_size > size)
        assert node.stop() == 0
    assert node.log.count("cannot save") == 1
    assert node.log.count("saved again") == 1
    assert "Traceback" not in node.log
    scenario = Scenario(GridMap(small_values > 0), (0, 0), (5, 5))
    episodes = Trainer.load_checkpoint(checkpoint, [scenario]).episodes
    with (folder / "episodes.csv").open(newline="") as file:
        numbers = [int(row["episode"]) for row in csv.DictReader(file)]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == episodes
    assert list(folder.glob(".*")) == []


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_a_last_save_that_fails_is_logged_when_the_node_ends(
    run_node: Any, make_client: Any, namespace: str, small_values: Any, tmp_path: FilePath
) -> None:
    client, folder = make_client(namespace), tmp_path / "run"
    parameters = {**ENDLESS, "output_folder": str(folder)}
    with run_node("trainer_node", parameters, namespace=namespace) as node:
        set_up(client, small_values, stamped(0.5, 0.5), stamped(5.5, 5.5))
        start_training(client)
        with no_folder(node.process, folder):
            assert node.stop() == 0
    assert node.log.count("cannot save") == 1


def test_what_cannot_be_started_or_replayed_is_answered_with_the_remedy(
    run_node: Any, make_client: Any, namespace: str, small_values: Any, tmp_path: FilePath
) -> None:
    client = make_client(namespace)
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "checkpoint.safetensors").write_bytes(b"no checkpoint")
    (broken / "episodes.csv").write_bytes(b"\0\xff,'\n" * 1000)
    (tmp_path / "file").touch()
    with run_node("trainer_node", {"output_folder": str(broken)}, namespace=namespace) as node:
        set_up(client, small_values, stamped(0.5, 0.5), stamped(5.5, 5.5))
        with pytest.raises(AssertionError, match="remove it to train anew"):
            start_training(client)
        assert "no episode" in client.call(Trigger, "trainer/replay").message
        for folder in (tmp_path / "file", tmp_path / ("x" * 300)):
            client.set_parameters("trainer", output_folder=str(folder))
            answer = client.call(Trigger, "trainer/start")
            assert not answer.success
            assert "set output_folder to a folder that can be written" in answer.message
            assert "call ~/start first" in client.call(Trigger, "trainer/replay").message
        # Less memory than the replay buffer needs.
        limits = resource.prlimit(node.process.pid, resource.RLIMIT_AS)
        used = int(FilePath(f"/proc/{node.process.pid}/statm").read_text().split()[0]) * 4096
        client.set_parameters("trainer", output_folder=str(tmp_path / "run"))
        client.set_parameters("trainer", replay_capacity=10**7)
        resource.prlimit(node.process.pid, resource.RLIMIT_AS, (used + 10**8, limits[1]))
        answer = client.call(Trigger, "trainer/start")
        assert not answer.success
        assert "smaller filters, batch_size, environments or replay_capacity" in answer.message
        client.set_parameters("trainer", replay_capacity=1000)
        assert client.call(Trigger, "trainer/start").success


def test_the_module_of_the_node_imports_no_torch() -> None:
    loaded = "import sys, ddqn_planner.nodes.trainer_node; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", loaded]).returncode == 0


@pytest.mark.parametrize("library", ["torch", "gymnasium"])
def test_without_its_libraries_a_start_is_refused_and_the_node_lives(
    library: str,
    run_node: Any,
    make_client: Any,
    namespace: str,
    tmp_path: FilePath,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    missing = f"No module named '{library}'"
    (tmp_path / f"{library}.py").write_text(f'raise ModuleNotFoundError("{missing}")')
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    client = make_client(namespace)
    parameters = {"map_file": "dilemma", "output_folder": str(tmp_path / "run")}
    with run_node("trainer_node", parameters, namespace=namespace) as node:
        answer = client.call(Trigger, "trainer/start")
        assert not answer.success
        assert f"needs another library ({missing})" in answer.message
        assert "call ~/start first" in client.call(Trigger, "trainer/replay").message
    assert "Traceback" not in node.log


@pytest.mark.hypothesis
def test_nothing_that_comes_in_ends_the_node(
    run_node: Any, make_client: Any, namespace: str, small_values: Any, tmp_path: FilePath
) -> None:
    client = make_client(namespace)
    parameters = {**ENDLESS, "output_folder": str(tmp_path / "run")}
    with run_node("trainer_node", parameters, namespace=namespace) as node:
        names = client.call(ListParameters, "trainer/list_parameters").result.names
        set_up(client, small_values, stamped(0.5, 0.5), stamped(5.5, 5.5))
        start_training(client)

        @given(maps(), POSES, HEADERS, some_parameters(names))
        def fuzz(grid: Any, pose: Pose, header: Header, some: list[Any]) -> None:
            client.publish("map", grid, LATCHED)
            initial_pose = PoseWithCovarianceStamped(header=header)
            initial_pose.pose.pose = pose
            client.publish("initialpose", initial_pose)
            client.publish("goal_pose", PoseStamped(header=header, pose=pose))
            request = SetParameters.Request(parameters=some)
            results = client.call(SetParameters, "trainer/set_parameters", request).results
            assert len(results) == len(some)
            result = set_atomically(client, *some)
            assert all(one.successful or one.reason for one in [*results, result])
            assert client.call(Trigger, "trainer/save").success

        fuzz()
        client.call(Trigger, "trainer/stop")
        client.call(Trigger, "trainer/replay")
        client.call(Trigger, "trainer/start")
    assert "Traceback" not in node.log
