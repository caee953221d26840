from __future__ import annotations

import itertools
import os
import queue
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path as FilePath
from typing import Any

import pytest
from client import wait_for
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Pose, PoseStamped, PoseWithCovarianceStamped
from hypothesis import given
from integration.messages import HEADERS, POSES, maps, some_parameters
from nav_msgs.msg import OccupancyGrid, Path
from nav_msgs.srv import GetPlan
from rcl_interfaces.srv import (
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.parameter import Parameter
from rclpy.time import Time
from std_msgs.msg import Float32, Header, String
from std_srvs.srv import Trigger

from ddqn_planner.grid import MOVES, GridMap, MoveRule, legal_moves
from ddqn_planner.model import load_model
from ddqn_planner.nodes import trainer_node
from ddqn_planner.nodes.conversions import occupancy_message, quaternion
from ddqn_planner.nodes.parameters import TRAINER_PARAMETERS
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.training.environment import Scenario, paper_scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.run import TrainingRun
from ddqn_planner.training.trainer import Trainer

TIMEOUT = 120.0
ENDLESS = {"steps": 10**9, "filters": 4, "learning_starts": 100}


NAMESPACE = "/training"
"""Of the trainer that the tests share."""

DEFAULTS = {
    name: declared.default
    for name, declared in TRAINER_PARAMETERS.items()
    if not declared.read_only
} | {entry.name: entry.default for entry in fields(HyperParameters)}

OFTEN = """
from rclpy.node import Node

create_timer = Node.create_timer

def create_fast_timer(node, period, *arguments, **options):
    return create_timer(node, min(period, 0.1), *arguments, **options)

Node.create_timer = create_fast_timer
"""
"""What a trainer runs first (as its ``sitecustomize``): the tests wait for many diagnostics."""


@pytest.fixture
def namespace(request: pytest.FixtureRequest) -> str:
    """A namespace for a test with a node of its own."""
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


def publish_map(
    client: Any, values: Any, resolution: float = 1.0, frame: str = "map", listeners: int = 1
) -> None:
    header = Header(frame_id=frame)
    message = occupancy_message(values, resolution, (0.0, 0.0, 0.0), header)
    client.publish("map", message, LATCHED, listeners)


def set_up(node: Any, client: Any, values: Any, listeners: int = 1) -> None:
    """Publish the map, a start and a goal to so many nodes, and wait until the trainer has them."""
    node.forget_log()
    publish_map(client, values, listeners=listeners)
    node.wait_for_log("map of 6 x 6 cells")
    initial_pose = PoseWithCovarianceStamped(header=Header(frame_id="map"))
    initial_pose.pose.pose = stamped(0.5, 0.5).pose
    client.publish("initialpose", initial_pose, listeners=listeners)
    client.publish("goal_pose", stamped(5.5, 5.5), listeners=listeners)
    node.wait_for_log(r"the start is cell \(0, 0\)")
    node.wait_for_log(r"the goal is cell \(5, 5\)")


def wait_for_state(listener: Listener, **expected: str) -> dict[str, str]:
    """Return the first diagnostics of the shared trainer that hold the expected texts."""
    while True:
        (status,) = listener.next().status
        if status.name != f"{NAMESPACE}/trainer: training":
            continue
        values = {entry.key: entry.value for entry in status.values}
        values["message"] = status.message
        if all(text in values.get(key, "") for key, text in expected.items()):
            return values


def start_training(client: Any) -> str:
    answer = client.call(Trigger, "trainer/start")
    assert answer.success, answer.message
    return str(answer.message)


def refusal(client: Any) -> str:
    """Return why ~/start refuses."""
    answer = client.call(Trigger, "trainer/start")
    assert not answer.success
    return str(answer.message)


@pytest.fixture(scope="module")
def shared_trainer(
    run_node: Any, make_client: Any, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Any]:
    """A trainer for many tests, and its client: to start one takes seconds."""
    folder = tmp_path_factory.mktemp("often")
    (folder / "sitecustomize.py").write_text(OFTEN)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
        with run_node("trainer_node", {}, namespace=NAMESPACE) as node:
            client = make_client(NAMESPACE)
            assert "no map" in refusal(client)
            yield node, client


@pytest.fixture
def trainer(shared_trainer: Any, small_values: Any, tmp_path: FilePath) -> Iterator[Any]:
    """The shared trainer and its client; it has a map, a start, a goal, and does nothing."""
    node, client = shared_trainer
    configure(client, tmp_path / "run", **DEFAULTS)
    set_up(node, client, small_values)
    yield node, client
    node.forget_log()
    if "saves and stops" in client.call(Trigger, "trainer/stop").message:
        node.wait_for_log("the training stopped")


def configure(client: Any, folder: FilePath, **parameters: Any) -> None:
    """Set parameters of the shared trainer; the next test has their defaults again."""
    parameters["output_folder"] = str(folder)
    result = set_atomically(client, *(message_of(*item) for item in parameters.items()))
    assert result.successful, result.reason


def test_a_training_can_be_watched_saved_stopped_resumed_and_replayed(
    trainer: Any, small_values: Any, tmp_path: FilePath
) -> None:
    node, client = trainer
    configure(client, tmp_path, **ENDLESS, replay_period=0.002, move_rule="robot_safe")
    rewards = Listener(client, Float32, "trainer/average_reward")
    episodes = Listener(client, Path, "trainer/episode")
    saved = client.subscribe(String, "trainer/model_saved", LATCHED)
    diagnostics = Listener(client, DiagnosticArray, "/diagnostics")

    assert "from step 0" in start_training(client)
    assert "training already" in refusal(client)
    assert -10.0 <= rewards.next().data <= 10.0

    legal = legal_moves(GridMap(small_values > 0).occupancy, MoveRule.ROBOT_SAFE)
    episode = episodes.next()
    assert episode.header.frame_id == "map"
    cells = [(int(p.pose.position.x), int(p.pose.position.y)) for p in episode.poses]
    moves = MOVES.tolist()
    for (x, y), (next_x, next_y) in itertools.pairwise(cells):
        assert legal[moves.index([next_x - x, next_y - y]), y, x]

    assert client.call(Trigger, "trainer/save").success
    # The model of an earlier training is latched.
    path = saved.wait(lambda message: FilePath(message.data).parent == tmp_path).data
    _, metadata = load_model(path)
    assert metadata.steps > 0
    assert metadata.map_fingerprint == GridMap(small_values > 0).fingerprint

    assert client.call(Trigger, "trainer/stop").success
    stopped = wait_for_state(diagnostics, state="stopped", folder=str(tmp_path))
    steps = int(stopped["steps"].split()[0])
    assert f"from step {steps} " in start_training(client)
    client.call(Trigger, "trainer/stop")
    node.wait_for_log("the training stopped(.|\n)*the training stopped")

    replay = client.call(Trigger, "trainer/replay")
    assert replay.success, replay.message
    lengths: list[int] = []
    while len(lengths) < 3 or lengths[-3:-1] != [1, 2]:
        lengths.append(len(episodes.next().poses))


def test_episodes_are_drawn_on_the_map_of_their_own_training(
    trainer: Any, small_values: Any, tmp_path: FilePath
) -> None:
    node, client = trainer
    configure(client, tmp_path / "run", **ENDLESS, replay_period=0.001)
    episodes = Listener(client, Path, "trainer/episode")
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
    configure(client, tmp_path / "earlier")
    assert client.call(Trigger, "trainer/replay").success
    while next_episode()[0] != "site":
        pass


def test_a_replay_is_not_mixed_with_the_training_and_stop_says_what_it_stopped(
    trainer: Any, tmp_path: FilePath
) -> None:
    node, client = trainer
    configure(client, tmp_path, **ENDLESS, episode_interval=1)

    def stop() -> str:
        answer = client.call(Trigger, "trainer/stop")
        assert answer.success
        return str(answer.message)

    episodes = Listener(client, Path, "trainer/episode")
    diagnostics = Listener(client, DiagnosticArray, "/diagnostics")
    assert stop() == "no training was running"
    start_training(client)
    episodes.next()
    assert client.call(Trigger, "trainer/replay").success
    answered = time.time_ns()
    while Time.from_msg((first := episodes.next()).header.stamp).nanoseconds <= answered:
        pass  # what the training published before
    of_run = {"state": "training", "folder": str(tmp_path)}
    count = int(wait_for_state(diagnostics, **of_run)["episodes"])
    lengths = [len(first.poses), *(len(episodes.next().poses) for _ in range(40))]
    while int(wait_for_state(diagnostics, **of_run)["episodes"]) < count + 20:
        pass
    lengths += [len(episodes.next().poses) for _ in range(20)]
    assert all(b in (1, a + 1) for a, b in itertools.pairwise(lengths)), lengths

    assert "; the replay was stopped" in stop()
    node.wait_for_log("the training stopped")
    assert client.call(Trigger, "trainer/replay").success
    assert stop() == "no training was running; the replay was stopped"
    assert stop() == "no training was running"


def test_the_log_says_when_a_training_starts_and_what_is_saved(
    trainer: Any, tmp_path: FilePath
) -> None:
    node, client = trainer
    configure(client, tmp_path, steps=300, filters=4)
    start_training(client)
    node.wait_for_log(f"training in {tmp_path} from step 0 to 300")
    node.wait_for_log(f"step 300 is saved in {tmp_path}/checkpoint.safetensors")
    node.wait_for_log("the training finished")
    assert node.log.count("is saved in") == 1


def test_a_signal_saves_a_checkpoint_that_a_new_process_continues(
    run_node: Any, make_client: Any, namespace: str, tmp_path: FilePath
) -> None:
    client, folder = make_client(namespace), tmp_path / "run"
    parameters = {**ENDLESS, "output_folder": str(folder), "map_file": "dilemma"}

    def train(steps: int) -> None:
        rewards = Listener(client, Float32, "trainer/average_reward")
        assert f"from step {steps} " in start_training(client)
        rewards.next()

    with run_node("trainer_node", parameters, namespace=namespace):
        train(0)
    steps = Trainer.load_checkpoint(folder / "checkpoint.safetensors", [paper_scenario()]).steps
    assert steps > 0
    with run_node("trainer_node", parameters, namespace=namespace) as node:
        train(steps)
        folder.rename(folder.with_name("moved"))
        folder.symlink_to("nowhere/else")  # nobody can write there, not even root
        assert node.stop(signal.SIGTERM) == 0
    assert node.log.count("cannot save") == 1


def test_a_planner_that_follows_the_trainer_plans_with_each_model_it_saves(
    run_node: Any, trainer: Any, small_values: Any, tmp_path: FilePath
) -> None:
    node, client = trainer
    configure(
        client,
        tmp_path,
        steps=1500,
        filters=16,
        learning_rate=0.003,
        learning_starts=100,
        p_r=1.0,
        update_interval=2,
        target_interval=100,
        epsilon_steps=1000,
        max_episode_steps=40,
        move_rule="robot_safe",
        seed=1,
    )
    saved = tmp_path / "model.safetensors"
    request = GetPlan.Request(start=stamped(0.5, 0.5), goal=stamped(5.5, 5.5))
    with run_node("planner_node", {"follow_trainer": True}, namespace=NAMESPACE):
        plans = client.subscribe(Path, "plan", LATCHED)
        set_up(node, client, small_values, listeners=2)
        start_training(client)
        asked = [time.time_ns()]

        def has_its_model() -> bool:
            time.sleep(0.05)
            asked.append(time.time_ns())
            return bool(client.get_parameter("planner", "model") == str(saved))

        wait_for("its model", has_its_model)

        def is_with_its_model(plan: Path) -> bool:
            return Time.from_msg(plan.header.stamp).nanoseconds > asked[-2]

        # The planner plans for the active goal again with each model, until one is good enough.
        plans.wait(lambda plan: plan.poses and is_with_its_model(plan))
        wait_for("plan", lambda: client.call(GetPlan, "planner/get_plan", request).plan.poses)


BAD = {
    "odom": ("goal_pose", stamped(0.5, 0.5, "odom")),
    "nan": ("goal_pose", stamped(float("nan"), 0.5)),
    "(99, 0)": ("goal_pose", stamped(99.0, 0.5)),
    "(1, 1)": ("goal_pose", stamped(1.5, 1.5)),
    "resolution": ("map", OccupancyGrid(header=Header(frame_id="map"))),
}


def test_bad_input_is_refused_by_name_and_the_training_continues(
    trainer: Any, tmp_path: FilePath
) -> None:
    _, client = trainer
    configure(client, tmp_path, **ENDLESS)
    start_training(client)
    diagnostics = Listener(client, DiagnosticArray, "/diagnostics")
    for named, (topic, message) in BAD.items():
        client.publish(topic, message, LATCHED if topic == "map" else 10)
        before = wait_for_state(diagnostics, state="training", message=named)
        after = wait_for_state(diagnostics, state="training")
        assert before["goal"] == after["goal"] == "(5.5, 5.5)"
        while int(after["steps"].split()[0]) <= int(before["steps"].split()[0]):
            after = wait_for_state(diagnostics, state="training")


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"network": "perceptron"}, "network is 'perceptron'; give one of paper, propagation"),
        ({"environments": 8, "replay_capacity": 4}, "environments is 8; .* at most .* 4"),
        ({"map_file": "no_such_map.yaml"}, "no_such_map"),
    ],
)
def test_a_node_does_not_start_with_an_invalid_parameter(
    log_of_refused_start: Any, parameters: dict[str, Any], reason: str
) -> None:
    log = log_of_refused_start(trainer_node.main, parameters)
    assert re.search(reason, log)
    assert "Traceback" not in log


def set_atomically(client: Any, *parameters: Any) -> Any:
    request = SetParametersAtomically.Request(parameters=list(parameters))
    return client.call(SetParametersAtomically, "trainer/set_parameters_atomically", request).result


def message_of(name: str, value: Any) -> Any:
    return Parameter(name, value=value).to_parameter_msg()


def test_an_invalid_value_is_refused_with_its_reason_and_nothing_is_half_set(trainer: Any) -> None:
    _, client = trainer
    good = [message_of("replay_capacity", 3000), message_of("epsilon_end", 0.2)]
    assert set_atomically(client, *good).successful
    for name, value, reason in (
        ("move_rule", "diagonal", "give one of .*robot_safe"),
        ("target", "", "give one of double_dqn"),
        ("output_folder", "", "name a folder"),
        ("map_file", "office", "read-only"),
        ("gamma", 1.0 + 1e-7, "must lie in 0.0 to 1.0"),
        ("gamma", float("nan"), "out of range"),
        ("seed", -1, "out of range"),
        ("seed", 1.0, "type"),
        ("environments", 4000, "at most replay_capacity, 3000"),
        ("", 1, "no name"),
        ("colour", 1, "undeclared"),
    ):
        bad = message_of(name, value)
        for parameters in ([message_of("epsilon_end", 0.3), bad], [bad, good[1]], [bad]):
            result = set_atomically(client, *parameters)
            assert not result.successful
            assert re.search(reason, result.reason), result.reason
        assert client.get_parameter("trainer", "epsilon_end") == 0.2
    both = message_of("environments", 4096), message_of("replay_capacity", 4096)
    assert set_atomically(client, *both).successful  # they limit one another


@contextmanager
def full_disk(process: Any, folder: FilePath) -> Iterator[None]:
    """Let the writes of a running process fail in their middle, as on a full disk."""
    limits = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)
    size = (folder / "model.safetensors").stat().st_size - 10
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (size, limits[1]))
    yield
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, limits)


def test_a_full_disk_is_logged_once_and_the_training_continues(
    trainer: Any, tmp_path: FilePath
) -> None:
    (node, client), folder = trainer, tmp_path / "run"
    configure(client, folder, **ENDLESS)
    saved = client.subscribe(String, "trainer/model_saved", LATCHED)
    diagnostics = Listener(client, DiagnosticArray, "/diagnostics")

    def save() -> None:
        assert client.call(Trigger, "trainer/save").success

    start_training(client)
    save()
    model = FilePath(saved.wait(lambda message: str(folder) in message.data).data)
    with full_disk(node.process, folder):
        before = model.read_bytes()
        save()
        failing = wait_for_state(diagnostics, message=f"cannot save to {folder} (")
        for _ in range(3):
            save()
            after = wait_for_state(diagnostics, message="make room")
        while int(after["steps"].split()[0]) <= int(failing["steps"].split()[0]):
            after = wait_for_state(diagnostics, message="make room")
        assert after["state"] == "training"
        assert model.read_bytes() == before
    saved.clear()
    save()
    node.wait_for_log("saved again")
    assert load_model(saved.wait().data)[1].steps > int(failing["steps"].split()[0])
    wait_for_state(diagnostics, state="training", message="training")
    assert node.log.count("cannot save") == 1
    assert node.log.count("saved again") == 1


def test_what_cannot_be_started_or_replayed_is_answered_with_the_remedy(
    trainer: Any, small_values: Any, tmp_path: FilePath
) -> None:
    node, client = trainer
    broken, used, other = (tmp_path / name for name in ("broken", "used", "other"))
    broken.mkdir()
    (broken / "checkpoint.safetensors").write_bytes(b"no checkpoint")
    (broken / "episodes.csv").write_bytes(b"\0\xff,'\n" * 1000)
    scenario = Scenario(GridMap(small_values > 0), (0, 0), (5, 5))
    training = TrainingRun(used, [scenario], MoveRule.ROBOT_SAFE, HyperParameters(), seed=0)
    different = Trainer([scenario], MoveRule.ROBOT_SAFE, HyperParameters(gamma=0.5), seed=0)
    different.save_checkpoint(other / "checkpoint.safetensors")
    before = (other / "checkpoint.safetensors").read_bytes()
    (tmp_path / "file").touch()
    unwritable = "set output_folder to a folder that can be written", "call ~/start first"
    for folder, reason, of_replay in (
        (broken, "remove it to train anew", "no episode"),
        (tmp_path / "file", *unwritable),
        (tmp_path / ("x" * 300), *unwritable),
        (tmp_path, "no training; give a new or empty folder", "call ~/start first"),
        (used, "another process trains", "no episode"),
        (other, r"gamma 0\.5 \(now 0\.95\)", "call ~/start first"),
    ):
        configure(client, folder, move_rule="robot_safe")
        assert re.search(reason, refusal(client))
        assert of_replay in client.call(Trigger, "trainer/replay").message
    training.close()
    assert (other / "checkpoint.safetensors").read_bytes() == before
    # Less memory than the replay buffer needs.
    configure(client, tmp_path / "run", replay_capacity=10**7)
    limits = resource.prlimit(node.process.pid, resource.RLIMIT_AS)
    used_bytes = int(FilePath(f"/proc/{node.process.pid}/statm").read_text().split()[0]) * 4096
    resource.prlimit(node.process.pid, resource.RLIMIT_AS, (used_bytes + 10**8, limits[1]))
    reason = refusal(client)
    resource.prlimit(node.process.pid, resource.RLIMIT_AS, limits)
    assert re.search("the memory; take .* smaller .* replay_capacity", reason)
    configure(client, tmp_path / "run", replay_capacity=1000)
    start_training(client)


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
    error = f'ModuleNotFoundError("{missing}", name="{library}")'
    (tmp_path / f"{library}.py").write_text(f"raise {error}")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    client = make_client(namespace)
    parameters = {"map_file": "dilemma", "output_folder": str(tmp_path / "run")}
    with run_node("trainer_node", parameters, namespace=namespace) as node:
        assert f"needs another library: {missing}; pip install torch gymnasium" in refusal(client)
        assert "call ~/start first" in client.call(Trigger, "trainer/replay").message
    assert "Traceback" not in node.log


@pytest.mark.hypothesis
def test_nothing_that_comes_in_ends_the_node(trainer: Any, tmp_path: FilePath) -> None:
    node, client = trainer
    configure(client, tmp_path, **ENDLESS)
    names = client.call(ListParameters, "trainer/list_parameters").result.names
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
    for service in ("stop", "replay", "start"):
        client.call(Trigger, f"trainer/{service}")
    client.set_parameters("trainer", use_sim_time=False)
    assert "Traceback" not in node.log
