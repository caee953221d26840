import importlib
import re
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import single_file_ddqn
import torch
from single_file_ddqn import PaperReward, QNetwork, ReplayBuffer, double_dqn_loss

from ddqn_planner import Planner
from ddqn_planner.gymnasium_registration import ENVIRONMENT
from ddqn_planner.training import HyperParameters, Scenario, TrainingRecord
from ddqn_planner.training.double_dqn import (
    NextQ,
    Transitions,
    double_dqn_gradient,
)


def test_the_reward_of_the_single_file_is_that_of_the_package(paper: Scenario) -> None:
    parameters = HyperParameters(p_r=1.0, max_episode_steps=20)
    reward = PaperReward(paper, parameters.alpha, parameters.beta)
    options: dict[str, Any] = {"scenario": paper, "parameters": parameters}
    table = gymnasium.make_vec(ENVIRONMENT, 40, **options)
    function = gymnasium.make_vec(ENVIRONMENT, 40, **options, reward=reward)
    environments = (table, function)
    for environment in environments:
        environment.reset(seed=1)
    actions = np.random.default_rng(0).integers(8, size=(40, 40))
    for action in actions:
        expected, rewards = (item.step(action)[1] for item in environments)
        np.testing.assert_allclose(rewards, expected, atol=1e-6)


def test_the_loss_of_the_single_file_is_that_of_the_package() -> None:
    torch.manual_seed(0)
    online, target = (QNetwork(6, 7, filters=2) for _ in range(2))
    random = np.random.default_rng(0)
    replay = ReplayBuffer(8, (6, 7))
    for number in range(10):  # more than it holds
        first, second = random.random((2, 6, 7), np.float32)
        replay.add(first, number % 8, float(number), second, number % 3 == 0)
    batch = replay.sample(5, random)
    with torch.no_grad():
        q = online(replay.observation[batch]).numpy()
        next_q = NextQ(
            selection=online(replay.next_observation[batch]).numpy(),
            evaluation=target(replay.next_observation[batch]).numpy(),
        )
    unused = np.arange(5)
    transitions = Transitions(
        scenario=unused,
        cell=unused,
        action=replay.action[batch].numpy(),
        reward=replay.reward[batch].numpy(),
        next_cell=unused,
        discount=np.float32(0.9) * (1 - replay.terminated[batch].numpy()),
    )
    # The gradient of the mean of the squared errors is 2 / B times the error.
    error = double_dqn_gradient(transitions, q, next_q).sum(axis=1) * 5 / 2
    loss = double_dqn_loss(online, target, replay, batch, gamma=0.9)
    assert float(loss.detach()) == pytest.approx(np.square(error).mean(), rel=1e-5)


def test_the_single_file_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(single_file_ddqn, "MAX_EPISODE_STEPS", 5)
    options = ["--steps=40", "--learning-starts=30", "--evaluation-interval=40"]
    monkeypatch.setattr(sys, "argv", ["single_file_ddqn.py", *options])
    single_file_ddqn.main()
    assert re.match(r"step 40: \d+ of 287 starts solved", capsys.readouterr().out)


@pytest.fixture(scope="module")
def programs() -> list[str]:
    """Return the programs of docs/training.md."""
    page = (Path(__file__).resolve().parents[1] / "docs" / "training.md").read_text()
    return re.findall(r"^```python\n(.*?)^```", page, re.M | re.S)


def test_the_own_map_of_the_page_is_trained_and_saved(
    programs: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (program,) = (text for text in programs if "TrainingRecord" in text)
    brief = program.replace("steps=20_000", "steps=600, filters=1")
    assert brief != program
    pictures: list[str] = []  # which other tests draw
    for name in ("save_picture", "save_film"):
        monkeypatch.setattr(TrainingRecord, name, lambda _, path: pictures.append(path))
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(brief, names)
    assert pictures == ["own_map.png", "own_map.gif"]
    assert [point.step for point in names["record"].curve] == [0, 200, 400, 600]
    scenario = names["scenario"]
    planner = Planner.load("own_map.safetensors")
    planner.plan(scenario.grid, scenario.start, scenario.goal)


def test_the_own_reward_of_the_page_is_that_of_the_shortest_path(
    programs: list[str],
) -> None:
    (program,) = (text for text in programs if "def reward" in text)
    names: dict[str, Any] = {}
    exec(program, names)
    environment = names["env"]
    environment.reset(options={"start": (16, 19)})
    east = 0
    _, reward, terminated, _, info = environment.step(east)
    assert (reward, terminated, info["outcome"]) == (100, True, "reached_goal")


def test_the_own_network_of_the_page_learns_in_the_single_file(
    programs: list[str],
) -> None:
    (program,) = (text for text in programs if "class QNetwork" in text)
    names = dict(vars(single_file_ddqn))
    exec(program, names)
    torch.manual_seed(0)
    online, target = (names["QNetwork"](6, 7) for _ in range(2))
    replay = ReplayBuffer(1, (6, 7))
    observation = np.ones((6, 7), np.float32)
    replay.add(observation, 3, 1.0, observation, False)
    batch = replay.sample(1, np.random.default_rng(0))
    before: Any = double_dqn_loss(online, target, replay, batch, gamma=0.9)
    before.backward()
    with torch.no_grad():
        for weight in online.parameters():
            weight -= 1e-3 * weight.grad
    after = double_dqn_loss(online, target, replay, batch, gamma=0.9)
    assert 0 < after < before


def test_the_example_of_stable_baselines_3_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    monkeypatch.delitem(sys.modules, "sb3_dqn", raising=False)
    with pytest.raises(SystemExit, match="; pip install stable-baselines3"):
        importlib.import_module("sb3_dqn")


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("demo_training", ["many"]),
        ("demo_training", ["-1"]),
        ("body_film", ["robots.txt"]),
        ("body_film", ["no_such_folder/robots.gif"]),
        ("demo", ["office"]),
        ("demo_driving", ["0"]),
    ],
)
def test_an_example_explains_its_arguments(
    name: str, wrong: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    if name in ("demo", "demo_driving"):
        pytest.importorskip("rclpy")
    program = importlib.import_module(name)
    with pytest.raises(SystemExit, match=r"^0$"):
        program.main(["--help"])
    assert "usage: " in capsys.readouterr().out
    with pytest.raises(SystemExit, match=r"^2$"):
        program.main(wrong)
    assert "error: " in capsys.readouterr().err


def test_stable_baselines_3_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("stable_baselines3")
    import sb3_dqn

    options = ["--steps=40", "--interval=40", "--plain"]
    monkeypatch.setattr(sys, "argv", ["sb3_dqn.py", *options])
    sb3_dqn.main()
    assert re.match(r"step 40: \d+ of 287 starts solved", capsys.readouterr().out)
