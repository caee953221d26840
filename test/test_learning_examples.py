import importlib
import re
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
import single_file_ddqn
import torch
from single_file_ddqn import PaperReward, QNetwork, ReplayBuffer, double_dqn_loss

from ddqn_planner.gymnasium_registration import ENVIRONMENT
from ddqn_planner.training import HyperParameters, Scenario
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
