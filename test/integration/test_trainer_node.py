from __future__ import annotations

import itertools
import math
import re
import resource
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
from client import Client, initial_pose, map_message, pose, values_of, wait_for
from geometry_msgs.msg import PoseStamped
from hypothesis import given
from integration.messages import STAMPED_POSES, maps, some_parameters
from integration.robot import changed
from integration.user import SOON, User, limited
from map_files import save_map
from nav_msgs.msg import OccupancyGrid
from rcl_interfaces.srv import ListParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from std_msgs.msg import Float32
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker, MarkerArray

from ddqn_planner.grid import MOVES, GridMap, MapFile, MoveRule, legal_moves
from ddqn_planner.model import load_model
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.nodes.trainer_node import PARAMETERS

# Not at full speed, at which it takes a core from the other tests.
ENDLESS = {"steps": 10**9, "filters": 4, "learning_starts": 100, "pace": 5000.0}
START, GOAL = (0, 0), (5, 5)
NAMESPACE = "/training"  # of the trainer that most tests share
DEFAULTS = {name: it.default for name, it in PARAMETERS.items() if not it.read_only}


class Trainee(User):
    """The user of a node that trains."""

    def __init__(self, client: Client, node: Any, values: np.ndarray) -> None:
        super().__init__(client, "training", "trainer/model_saved")
        self.node, self.values, self.grid = node, values, GridMap(values > 0)
        self.rewards = client.subscribe(Float32, "trainer/average_reward", 100)

    def set_up(self) -> None:
        """Send a map, a start and a goal, and wait until the trainer has them."""
        self.node.forget_log()
        self.client.publish("map", map_message(self.values, self.grid), LATCHED)
        self.node.wait_for_log("map of 6 x 6 cells")
        self.client.publish("initialpose", initial_pose(pose(self.grid, START)))
        self.client.publish("goal_pose", pose(self.grid, GOAL))
        self.node.wait_for_log(r"the start is cell \(0, 0\)")
        self.node.wait_for_log(r"the goal is cell \(5, 5\)")

    def try_to_set(self, *parameters: Any) -> Any:
        request = SetParametersAtomically.Request(parameters=[*parameters])
        service = SetParametersAtomically, "trainer/set_parameters_atomically"
        return self.client.call(*service, request).result

    def configure(self, folder: FilePath, **parameters: Any) -> None:
        """Set parameters; the next test has their defaults again."""
        parameters["output_folder"] = str(folder)
        result = self.try_to_set(*(message_of(*item) for item in parameters.items()))
        assert result.successful, result.reason

    def train_on(self, **patterns: str) -> dict[str, str]:
        """Return the next state, once the training has made steps since."""
        before = self.state(**patterns)
        wait_for("steps", lambda: self.state(**patterns)["steps"] != before["steps"])
        return before

    def stop(self) -> None:
        self.node.forget_log()
        if "saves and stops" in self.call("stop"):
            self.node.wait_for_log("the training stopped")

    def lengths(self) -> list[int]:
        """Return how many poses each episode had that came."""
        return [len(path.poses) for path in self.episodes.messages()]


def message_of(name: str, value: Any) -> Any:
    return Parameter(name, value=value).to_parameter_msg()


@pytest.fixture(scope="module")
def shared_user(
    run_node: Any, make_client: Any, small_values: np.ndarray
) -> Iterator[Trainee]:
    """The user of a trainer that most tests share: to start one takes seconds."""
    with run_node("trainer_node", {}, namespace=NAMESPACE, sitecustomize=SOON) as node:
        user = Trainee(make_client(NAMESPACE), node, small_values)
        assert "no map" in user.refusal()
        yield user


@pytest.fixture
def user(shared_user: Trainee, tmp_path: FilePath) -> Iterator[Trainee]:
    """The user of the shared trainer, which has a map, a start, a goal, and does
    nothing.
    """
    shared_user.configure(tmp_path / "run", **DEFAULTS)
    shared_user.set_up()
    for recorder in (shared_user.rewards, shared_user.episodes, shared_user.saved):
        recorder.clear()
    yield shared_user
    shared_user.stop()


def test_a_paced_training_can_be_followed_and_stopped(
    user: Trainee, tmp_path: FilePath
) -> None:
    markers = user.client.subscribe(MarkerArray, "trainer/episode_markers", 20)
    user.configure(
        tmp_path / "run", steps=10**9, filters=4, pace=100.0, episode_interval=1
    )
    begin = time.monotonic()
    user.call("start")  # may answer after the first steps
    marker = markers.wait().markers[0]
    assert (marker.ns, marker.type) == ("episodes", Marker.LINE_STRIP)
    assert len(marker.points) > 1
    wait_for("200 steps", lambda: int(user.state()["steps"].split()[0]) >= 200)
    assert time.monotonic() - begin > 1.9  # without a pace, 200 steps take milliseconds
    user.configure(tmp_path / "run", pace=0.001)
    user.stop()  # at once, although the next step is due in a quarter of an hour


def test_a_training_is_seen_saved_resumed_and_replayed(
    user: Trainee, tmp_path: FilePath
) -> None:
    options = {"replay_period": 0.02, "episode_interval": 1, "move_rule": "robot_safe"}
    user.configure(tmp_path, **ENDLESS, **options)
    assert user.call("stop") == "no training was running"
    assert "from step 0" in user.call("start")
    assert "training already" in user.refusal()
    assert -10.0 <= user.rewards.wait().data <= 10.0

    legal = legal_moves(user.grid.occupancy, MoveRule.ROBOT_SAFE)
    episode = user.episodes.wait()
    assert episode.header.frame_id == "map"
    cells = [(int(p.pose.position.x), int(p.pose.position.y)) for p in episode.poses]
    for (x, y), there in itertools.pairwise(np.array(cells)):
        assert legal[MOVES.tolist().index([*(there - (x, y))]), y, x]

    user.call("save")
    path = FilePath(user.saved.wait().data)
    assert path.parent == tmp_path
    _, metadata = load_model(path)
    assert metadata.steps > 0
    assert metadata.map_fingerprint == user.grid.fingerprint

    # The episodes of the training do not mix with a replay, which goes step by step.
    user.call("replay")
    user.episodes.clear()
    count = int(user.state(state="training", folder=str(tmp_path))["episodes"])
    wait_for("episodes", lambda: int(user.state()["episodes"]) > count + 20)
    wait_for("replay", lambda: len(user.lengths()) > 60)
    assert all(b in (1, a + 1) for a, b in itertools.pairwise(user.lengths()))

    assert "; the replay was stopped" in user.call("stop")
    steps = user.state(state="stopped", folder=str(tmp_path))["steps"].split()[0]
    assert f"from step {steps} " in user.call("start")
    user.stop()
    user.episodes.clear()
    user.call("replay")
    wait_for(
        "an episode step by step", lambda: (1, 2) in itertools.pairwise(user.lengths())
    )
    assert user.call("stop") == "no training was running; the replay was stopped"
    assert user.call("stop") == "no training was running"


def test_a_map_that_is_too_large_is_told_before_the_training(
    user: Trainee, tmp_path: FilePath
) -> None:
    user.configure(tmp_path / "run", steps=2, filters=1, learning_starts=1)
    large = np.zeros((81, 81), np.int8)
    user.client.publish("map", map_message(large, GridMap(large > 0)), LATCHED)
    user.node.wait_for_log("map of 81 x 81 cells")
    user.call("start")
    warning = "a map of 81 x 81 cells is too large for the paper's network, .*any_map"
    user.node.wait_for_log(rf"(?s){warning}.*training in {tmp_path}")


def test_episodes_are_drawn_on_their_own_map(user: Trainee, tmp_path: FilePath) -> None:
    user.configure(tmp_path / "run", **ENDLESS, replay_period=0.001)

    def assert_drawn_on_its_own_map() -> None:
        user.episodes.clear()
        wait_for("episodes", lambda: len(user.episodes.messages()) >= 20)
        for episode in user.episodes.messages():
            places = [(p.pose.position.x, p.pose.position.y) for p in episode.poses]
            assert episode.header.frame_id == "map"
            assert {round(c % 1.0, 3) for xy in places for c in xy} == {
                0.5
            }  # within a cell

    user.call("start")
    assert_drawn_on_its_own_map()
    other = map_message(user.values, GridMap(user.values > 0, resolution=0.25))
    user.client.publish("map", changed(other, "header.frame_id", "site"), LATCHED)
    user.node.wait_for_log("6 x 6 cells(.|\n)*6 x 6 cells")
    assert_drawn_on_its_own_map()
    user.stop()
    user.call("replay")
    assert_drawn_on_its_own_map()
    # This process has not seen that training: the last map is the best guess.
    (tmp_path / "run").rename(tmp_path / "earlier")
    user.configure(tmp_path / "earlier")
    user.call("replay")
    user.episodes.wait(lambda episode: episode.header.frame_id == "site")


def test_a_planner_follows_what_is_saved(
    user: Trainee, run_node: Any, tmp_path: FilePath
) -> None:
    folder = tmp_path / "run"
    user.configure(folder, steps=300, filters=4)
    user.call("start")
    user.node.wait_for_log(f"training in {folder} from step 0 to 300")
    user.node.wait_for_log(f"step 300 is saved in {folder}/checkpoint.safetensors")
    user.node.wait_for_log("the training finished")
    assert user.node.log.count("is saved in") == 1
    shutil.rmtree(folder)  # another computer's planner cannot read it
    with run_node("planner_node", {"follow_trainer": True}, namespace=NAMESPACE):
        its = {"model file": "trainer/model", "model training steps": "300"}
        user.diagnostics.wait(
            lambda array: its.items() <= values_of(array.status[0]).items()
        )


def test_bad_input_is_refused_by_name(user: Trainee, tmp_path: FilePath) -> None:
    user.configure(tmp_path, **ENDLESS)
    user.call("start")
    for field, value, named in (
        ("header.frame_id", "odom", "odom"),
        ("pose.position.x", math.nan, "nan"),
        ("pose.position.x", 99.0, r"\(99, 1\)"),
        ("pose.position.x", 1.5, r"\(1, 1\)"),
    ):
        user.client.publish("goal_pose", changed(pose(user.grid, (0, 1)), field, value))
        assert user.train_on(state="training", message=named)["goal"] == "(5.5, 5.5)"
    user.client.publish("map", OccupancyGrid(), LATCHED)
    user.train_on(state="training", message="the map's")


def test_a_goal_that_no_path_reaches_is_refused(
    user: Trainee, tmp_path: FilePath
) -> None:
    walled = user.values.copy()
    walled[:, 3] = 100
    user.node.forget_log()
    user.client.publish("map", map_message(walled, user.grid), LATCHED)
    user.node.wait_for_log("map of 6 x 6 cells")  # else a start may overtake it
    assert re.search(r"no path .* \(0, 0\) .* \(5, 5\)", user.refusal())
    assert not (tmp_path / "run").exists()
    user.client.publish("goal_pose", pose(user.grid, START))
    wait_for("refusal", lambda: "start and goal are both (0, 0)" in user.refusal())


def test_an_invalid_value_is_refused_with_its_reason_and_nothing_is_half_set(
    user: Trainee,
) -> None:
    good = message_of("replay_capacity", 3000), message_of("epsilon_end", 0.2)
    assert user.try_to_set(*good).successful
    for name, value, reason in (
        ("move_rule", "diagonal", "give one of .*robot_safe"),
        ("output_folder", "", "name a folder"),
        ("map_file", "office", "read-only"),
        ("gamma", math.nan, "gamma is nan; give 0 to 1"),
        ("seed", 1.5, "seed is 1.5, a number; give a whole number"),
        ("environments", 4000, "at most replay_capacity, 3000"),
    ):
        bad = message_of(name, value)
        for parameters in (
            [message_of("epsilon_end", 0.3), bad],
            [bad, good[1]],
            [bad],
        ):
            result = user.try_to_set(*parameters)
            assert not result.successful
            assert re.search(reason, result.reason), result.reason
        assert user.client.get_parameter("trainer", "epsilon_end") == 0.2
    both = message_of("environments", 4096), message_of("replay_capacity", 4096)
    assert user.try_to_set(*both).successful  # they limit one another


def test_a_full_disk_is_logged_once(user: Trainee, tmp_path: FilePath) -> None:
    user.configure(tmp_path, **ENDLESS)
    user.call("start")
    user.call("save")
    model = FilePath(user.saved.wait().data)
    before = model.read_bytes()
    # The writes fail in their middle.
    with limited(user.node.process, resource.RLIMIT_FSIZE, len(before) - 10):
        for _ in range(3):
            user.call("save")
            failing = user.state(message=f"cannot save to {tmp_path} .*make room")
        assert user.train_on(message="make room")["state"] == "training"
        assert model.read_bytes() == before
    user.saved.clear()
    user.call("save")
    user.node.wait_for_log("saved again")
    assert load_model(user.saved.wait().data)[1].steps > int(
        failing["steps"].split()[0]
    )
    user.state(state="training", message="training")
    assert user.node.log.count("cannot save") == 1
    assert user.node.log.count("saved again") == 1


def test_what_cannot_be_started_has_a_remedy(user: Trainee, tmp_path: FilePath) -> None:
    broken, file = tmp_path / "broken", tmp_path / "file"
    broken.mkdir()
    (broken / "checkpoint.safetensors").write_bytes(b"no checkpoint")
    (broken / "episodes.csv").write_bytes(b"\0\xff,'\n" * 1000)
    file.touch()
    for folder, reason, of_replay in (
        (broken, "remove it to train anew", "no episode"),
        (
            file,
            "set output_folder to a folder that can be written",
            "call ~/start first",
        ),
        (tmp_path, "no training; give a new or empty folder", "call ~/start first"),
    ):
        user.configure(folder)
        assert reason in user.refusal()
        assert of_replay in user.call("replay", succeeds=False)
    # Less memory than the replay buffer needs.
    user.configure(tmp_path / "run", replay_capacity=10**7)
    pages = int(FilePath(f"/proc/{user.node.process.pid}/statm").read_text().split()[0])
    with limited(user.node.process, resource.RLIMIT_AS, pages * 4096 + 10**8):
        assert re.search(
            "the memory; take .* smaller .* replay_capacity", user.refusal()
        )
    user.configure(tmp_path / "run", replay_capacity=1000)
    user.call("start")


def test_without_its_libraries_a_start_is_refused_and_the_node_lives(
    run_node: Any, make_client: Any, tmp_path: FilePath
) -> None:
    missing = "No module named 'torch'"
    torch = f'raise ModuleNotFoundError("{missing}", name="torch")'
    parameters = {"map_file": "dilemma", "output_folder": str(tmp_path / "run")}
    with run_node(
        "trainer_node", parameters, namespace="/without", torch=torch
    ) as node:
        user = Trainee(make_client("/without"), node, np.zeros((1, 1), np.int8))
        assert f"needs another library: {missing}; pip install torch" in user.refusal()
        assert "call ~/start first" in user.call("replay", succeeds=False)
    assert "Traceback" not in node.log


@pytest.mark.hypothesis
def test_nothing_that_comes_in_ends_the_node(user: Trainee, tmp_path: FilePath) -> None:
    user.configure(tmp_path, **ENDLESS)
    names = user.client.call(ListParameters, "trainer/list_parameters").result.names
    user.call("start")
    set_one_by_one = user.client.service(SetParameters, "trainer/set_parameters")
    set_together = user.client.service(
        SetParametersAtomically, "trainer/set_parameters_atomically"
    )
    save = user.client.service(Trigger, "trainer/save")

    @given(maps(), STAMPED_POSES, some_parameters(names))
    def fuzz(grid: OccupancyGrid, stamped: PoseStamped, some: list[Any]) -> None:
        user.client.publish("map", grid, LATCHED)
        user.client.publish("initialpose", initial_pose(stamped))
        user.client.publish("goal_pose", stamped)
        # At once: one after another they would wait for the training each time.
        answers = [
            set_one_by_one.call_async(SetParameters.Request(parameters=some)),
            set_together.call_async(SetParametersAtomically.Request(parameters=some)),
            save.call_async(Trigger.Request()),
        ]
        wait_for("answers", lambda: all(answer.done() for answer in answers))
        one_by_one, together, saved = (answer.result() for answer in answers)
        assert len(one_by_one.results) == len(some)
        results = [*one_by_one.results, together.result]
        assert all(result.successful or result.reason for result in results)
        assert saved.success, saved.message

    fuzz()
    for service in ("stop", "replay", "start"):
        user.client.call(Trigger, f"trainer/{service}")
    user.client.set_parameters("trainer", use_sim_time=False)
    assert "Traceback" not in user.node.log


def test_a_signal_saves_a_checkpoint_that_a_new_process_continues(
    shared_user: Trainee, run_node: Any, make_client: Any, tmp_path: FilePath
) -> None:
    """The last test, as it ends the trainer of the others."""
    user, folder, map_file = shared_user, tmp_path / "run", tmp_path / "map.yaml"
    user.configure(folder, **DEFAULTS | ENDLESS)
    user.set_up()
    user.rewards.clear()
    user.call("start")
    user.rewards.wait()
    assert user.node.stop() == 0
    steps = load_model(folder / "model.safetensors")[1].steps
    assert steps > 0
    save_map(MapFile(user.values, 1.0, (0.0, 0.0, 0.0), START, GOAL), map_file)
    parameters = {**ENDLESS, "output_folder": str(folder), "map_file": str(map_file)}
    with run_node("trainer_node", parameters, namespace="/continued") as node:
        user = Trainee(make_client("/continued"), node, user.values)
        assert f"from step {steps} " in user.call("start")
        user.rewards.wait()
        folder.rename(folder.with_name("moved"))
        folder.symlink_to("nowhere/else")  # nobody can write there, not even root
        assert node.stop(signal.SIGTERM) == 0
    assert node.log.count("cannot save") == 1
