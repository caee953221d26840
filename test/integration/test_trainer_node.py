from __future__ import annotations

import itertools
import queue
import re
import signal
import time
from pathlib import Path as FilePath
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Path
from nav_msgs.srv import GetPlan
from std_msgs.msg import Float32, Header, String
from std_srvs.srv import Trigger

from ddqn_planner.grid import MOVES, GridMap, MoveRule, legal_moves, read_map_file
from ddqn_planner.model import load_model
from ddqn_planner.nodes.conversions import occupancy_message, quaternion
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import Trainer

TIMEOUT = 20.0
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


def set_up(
    client: Any, values: Any, start: PoseStamped, goal: PoseStamped, listeners: int = 1
) -> None:
    """Publish the map, the start and the goal to so many nodes."""
    header = Header(frame_id="map")
    client.publish("map", occupancy_message(values, 1.0, (0.0, 0.0, 0.0), header), LATCHED)
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


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_a_checkpoint_from_which_a_new_process_goes_on(
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
def test_bad_input_is_refused_by_name_and_the_training_goes_on(
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
def training(
    run_node: Any, make_client: Any, small_values: Any, tmp_path_factory: pytest.TempPathFactory
) -> Any:
    """A trainer that trains, and its diagnostics."""
    namespace = "/training"
    client = make_client(namespace)
    folder = tmp_path_factory.mktemp("training")
    with run_node("trainer_node", {**ENDLESS, "output_folder": str(folder)}, namespace=namespace):
        diagnostics = Listener(client, DiagnosticArray, "/diagnostics")
        set_up(client, small_values, stamped(0.5, 0.5), stamped(5.5, 5.5))
        start_training(client)
        yield client, diagnostics, namespace


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


def test_an_unknown_network_is_refused_with_those_that_there_are(
    run_node: Any, make_client: Any, namespace: str, small_values: Any, tmp_path: FilePath
) -> None:
    client = make_client(namespace)
    parameters = {"network": "perceptron", "output_folder": str(tmp_path / "run")}
    with run_node("trainer_node", parameters, namespace=namespace):
        set_up(client, small_values, stamped(0.5, 0.5), stamped(5.5, 5.5))
        with pytest.raises(AssertionError, match="'perceptron'; give one of paper, propagation"):
            start_training(client)
    assert not (tmp_path / "run").exists()


def test_a_map_file_that_cannot_be_read_ends_the_start_with_its_reason(run_node: Any) -> None:
    with (
        pytest.raises(AssertionError, match="no_such_map"),
        run_node("trainer_node", {"map_file": "no_such_map.yaml"}) as node,
    ):
        assert node.process.wait(TIMEOUT) == 1
