"""The replay buffer, and one update of each network beside the same written down from
equations.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from printed_target import PrintedTrainer
from torch import Tensor
from torch_layers import in_torch, propagation_layers
from torch_learner import TorchLearner

from ddqn_planner.grid import LENGTHS, MOVES, Cell, GridMap, MoveRule
from ddqn_planner.grid.arguments import as_seed
from ddqn_planner.model import AnyMapQNetwork
from ddqn_planner.model.move_costs import patches
from ddqn_planner.robot.motions import make_motions
from ddqn_planner.training.compiled_learner import adam, draw_batch, training_of
from ddqn_planner.training.double_dqn import NextQ, ReplayBuffer, Transitions
from ddqn_planner.training.environment import (
    GridVectorEnvironment,
    Scenario,
    paper_scenario,
)
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.robot import RobotTrainer
from ddqn_planner.training.trainer import Learner, Trainer

TARGETS = {
    "double_dqn": (Trainer, "double_dqn"),
    "dqn": (Trainer, "dqn"),
    "printed": (PrintedTrainer, "double_dqn"),
}

Q = dict[Scenario, dict[Cell, Tensor]]
"""Q(s, a) of all actions, (8,), for the robot in each cell of a scenario's map."""


@given(st.integers(1, 8), st.lists(st.integers(1, 8), max_size=12))
def test_the_buffer_holds_the_last_transitions_whole(
    capacity: int, batches: list[int]
) -> None:
    buffer, added = ReplayBuffer(capacity), 0
    for count in batches:
        numbers = np.arange(added, added + min(count, capacity))
        buffer.add(Transitions(*[numbers] * 6))
        added += len(numbers)
    assert len(buffer) == min(added, capacity)
    if added:
        sample = buffer.sample(100 * capacity, np.random.default_rng(0))
        assert set(sample.cell) == set(range(max(0, added - capacity), added))
        for values in sample:
            np.testing.assert_array_equal(values, sample.cell)


def part(trainer: Trainer) -> None:
    """Let the two networks of a trainer differ, so that the targets do."""
    random = np.random.default_rng(0)
    for tensor in trainer.learned.target.values():
        tensor += random.normal(0, 0.3, tensor.shape).astype(np.float32)


class Recording:
    """A learner that keeps the batches of its updates."""

    def __init__(self, learner: Learner | None) -> None:
        assert learner is not None
        self.q_values, self.settle = learner.q_values, learner.settle
        self.learner, self.batches = learner, list[Transitions]()

    def update(self, batch: Transitions, number: int, learning_rate: float) -> None:
        self.batches.append(batch)
        self.learner.update(batch, number, learning_rate)


def mean_squared_error(
    trainer: Trainer, batch: Transitions, online: Q, selection: Q, evaluation: Q
) -> Tensor:
    """Mean of (y - Q(s, a; online))², y of the target, and γ = 0 at an end."""
    width = trainer.environment.shape[1]
    errors = []
    for number, cell, action, reward, next_cell, discount in zip(*batch, strict=True):
        scenario = trainer.scenarios[number]
        state, next_state = (
            (int(c) % width, int(c) // width) for c in (cell, next_cell)
        )
        with torch.no_grad():
            best = selection[scenario][next_state].argmax()
            y = reward + discount * evaluation[scenario][next_state][best]
        errors.append((y - online[scenario][state][action]) ** 2)
    return torch.stack(errors).mean()


def check_update(trainer: Trainer, loss: Tensor, before: dict[str, Tensor]) -> None:
    """Check Adam's moments, and weights after its first step: w - rate * g / (|g| +
    ε).
    """
    expected = torch.autograd.grad(loss, list(before.values()))
    rate = trainer.parameters.learning_rate_at(trainer.steps)
    scale = max(float(gradient.abs().max()) for gradient in expected)
    learned = map(in_torch, trainer.learned)
    weights, _, mean, square = (tensors.values() for tensors in learned)
    for *found, gradient, old in zip(
        weights, mean, square, expected, before.values(), strict=True
    ):
        weight, moment, square_of = found
        slope = moment / (1 - 0.9)
        torch.testing.assert_close(slope, gradient, rtol=2e-3, atol=2e-3 * scale)
        torch.testing.assert_close(square_of, (1 - 0.999) * slope**2)
        step = rate * slope / (slope.abs() + 1e-8)
        torch.testing.assert_close(weight, (old - step).detach())


@pytest.mark.parametrize("units", [0, 6])
@pytest.mark.parametrize("target", [*TARGETS])
def test_compiled_training_is_that_of_torch(
    small: Scenario, tmp_path: Path, target: str, units: int
) -> None:
    walls = small.grid.occupancy
    scenarios = [
        replace(small, grid=GridMap(other)) for other in (walls, walls[::-1], walls & 0)
    ]
    brief = {"learning_rate": 0.001, "learning_starts": 20, "target_interval": 10}
    brief |= {
        "steps": 180,
        "weight_decay": 0.5,
        "epsilon_steps": 60,
        "environments": 3,
        "max_episode_steps": 7,
        "filters": 4,
    }
    trainer_class, target = TARGETS[target]
    parameters = HyperParameters(target=target, hidden_units=units, **brief)
    trainers = [trainer_class(scenarios, parameters, seed=2) for _ in range(2)]
    compiled, of_torch = trainers
    for trainer in trainers:
        part(trainer)
    TorchLearner(of_torch)
    one, other = (
        [e for progress in t.run(90) for e in progress.episodes]
        for t in (compiled, of_torch)
    )
    assert one == other
    assert compiled.updates == of_torch.updates > 60
    check_same(compiled, of_torch)
    of_torch.save_checkpoint(tmp_path / "checkpoint")
    compiled = trainer_class(scenarios, parameters, seed=2)
    compiled.restore(tmp_path / "checkpoint")
    one, other = (
        [e for progress in t.run(180) for e in progress.episodes]
        for t in (compiled, of_torch)
    )
    assert one == other
    check_same(compiled, of_torch)


def check_same(compiled: Trainer, of_torch: Trainer) -> None:
    expected = of_torch.arrays()
    for name, tensor in compiled.arrays().items():
        # The mean: Adam makes much of the rounding of a gradient that is nearly 0.
        error = np.abs(tensor - expected[name]).mean(dtype=np.float64)
        assert error <= 1e-3 * np.abs(expected[name]).mean(dtype=np.float64), name


def test_the_model_of_an_averaged_training_is_the_average_of_its_weights(
    small: Scenario,
) -> None:
    parameters = HyperParameters(
        filters=4, learning_starts=20, weight_averaging=0.1, steps=60
    )
    trainer = Trainer([small], parameters, seed=0)
    average = {name: 0.0 * part for name, part in trainer.network.tensors.items()}
    for _ in trainer.run(60, every=1):
        if trainer.updates:
            share = max(0.1, 1 / trainer.updates)
            for name, weights in trainer.network.tensors.items():
                average[name] = average[name] + share * (weights - average[name])
    assert trainer.updates == 40
    for name, weights in trainer.planner().network.tensors.items():
        np.testing.assert_allclose(weights, average[name], rtol=1e-4, atol=1e-6)


def test_transitions_are_drawn_by_the_power_of_their_errors(small: Scenario) -> None:
    parameters = HyperParameters(priority=0.5, replay_capacity=4, batch_size=4000)
    replay = ReplayBuffer(4)
    numbers = np.arange(4)
    replay.add(Transitions(*[numbers] * 6))
    replay.error[:] = [0.0, 0.9, 9.9, 99.0]
    environment = GridVectorEnvironment([small], parameters)
    tensors = Trainer([small], parameters, seed=0).network.tensors
    parts = [{name: part.copy() for name, part in tensors.items()} for _ in range(4)]
    learning = training_of(parts, {}, environment, replay, NextQ).learning
    draw_batch(learning, np.random.default_rng(0), 4)
    np.testing.assert_array_equal(learning.drawn, learning.batch.cell)
    share = np.bincount(learning.batch.cell) / 4000
    # Errors of 10 and more are drawn alike; the smallest chance is that of 0.1.
    chance = np.sqrt([0.1, 1.0, 10.0, 10.0])
    np.testing.assert_allclose(share, chance / chance.sum(), atol=0.03)


def test_weights_whose_gradients_fade_move_as_those_of_torch() -> None:
    random = np.random.default_rng(0)
    weights, gradient = random.normal(size=(2, 200)).astype(np.float32)
    gradient[::7] = 0  # of features that are off
    slopes, mean, square = np.zeros((3, 200), np.float32)
    weight = torch.tensor(weights)
    optimiser = torch.optim.Adam([weight], 0.01)
    for update in range(1, 701):
        if update in (1, 700):  # until the last one, the first one's mean fades to 0
            slopes[:] = gradient
        weight.grad = torch.tensor(slopes)
        optimiser.step()
        adam(weights, slopes, mean, square, 0.01, update)
        assert not slopes.any()
    torch.testing.assert_close(torch.tensor(weights), weight)


@pytest.mark.parametrize("target", [*TARGETS])
def test_an_update_is_the_equations_and_counts_each_reward_once(
    small: Scenario, target: str
) -> None:
    # Q(s, a) = p (r + γ V(s')) + (1 - p) r_o, r = -length * cost multiplier, V = max Q
    # under θ⁻.
    cost = np.arange(20, dtype=np.int8).reshape(4, 5)
    walls = small.grid.occupancy
    scenarios = [
        replace(
            small, grid=GridMap(walls, cost=cost), move_rule=MoveRule.CORNER_CUTTING
        ),
        Scenario(GridMap(walls[::-1]), (4, 3), (0, 1), MoveRule.ROBOT_SAFE),
    ]
    settings = {
        "reward": "path_cost",
        "gamma": 0.5,
        "obstacle_reward": -20.0,
        "filters": 4,
    }
    settings |= {"learning_starts": 60, "environments": 5, "update_interval": 5}
    trainer_class, name = TARGETS[target]
    parameters = HyperParameters("any_map", name, max_episode_steps=7, **settings)
    trainer = trainer_class(scenarios, parameters, seed=1)
    list(trainer.run(60))
    part(trainer)
    trainer.learner = learner = Recording(trainer.learner)
    learner.settle()
    trainer.network.tensors["prices.bias"][
        ::2
    ] = -1.0  # a multiplier below 1 is clipped
    before, target_weights = map(in_torch, trainer.learned[:2])
    for weight in before.values():
        weight.requires_grad_()
    lengths = torch.from_numpy(LENGTHS.astype(np.float32))

    def q_of(
        weights: dict[str, Tensor], scenario: Scenario, value: Any
    ) -> dict[Cell, Tensor]:
        seen = patches(scenario.grid.occupancy, scenario.grid.cost)
        features = torch.from_numpy(AnyMapQNetwork.features(seen, scenario.move_rule))
        p, multiplier = propagation_layers(weights, features)
        answers = {}
        for number in range(20):
            x, y = number % 5, number // 5
            onward = torch.tensor(
                [value.get((x + dx, y + dy), -20.0) for dx, dy in MOVES.tolist()]
            )
            success = -lengths * multiplier[number] + 0.5 * onward
            answers[x, y] = p[number] * success + (1 - p[number]) * -20.0
        return answers

    by_online, by_target = {}, {}
    for scenario in scenarios:
        value = {(x, y): -20.0 for x in range(5) for y in range(4)}
        with torch.no_grad():
            for _ in range(40):  # γ^40 is 1e-12
                q = q_of(target_weights, scenario, value)
                value = {cell: float(q_A.max()) for cell, q_A in q.items()}
                value[scenario.goal] = 0.0
            by_target[scenario] = q_of(target_weights, scenario, value)
        by_online[scenario] = q_of(before, scenario, value)
    list(trainer.run(65))
    assert trainer.updates == 1
    (batch,) = learner.batches
    assert len(batch.cell) == parameters.batch_size
    assert {0, 1} == set(batch.scenario)
    selection = by_target if target == "dqn" else by_online
    evaluation = by_online if target == "printed" else by_target
    loss = mean_squared_error(trainer, batch, by_online, selection, evaluation)
    check_update(trainer, loss, before)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("steps", 2.5, "steps is 2.5; give a whole number"),
        ("steps", True, "steps is True; it must lie in 1 to 1000000000"),
        ("steps", None, "steps is None; it must lie in"),
        ("gamma", "0.9", "gamma is '0.9'; it must lie in"),
        ("gamma", math.nan, "gamma is nan"),
        ("network", 5, "network is 5; give one of paper"),
        ("network", ["paper"], "give one of paper"),
    ],
)
def test_hyper_parameters_of_a_wrong_kind_are_named(
    name: str, value: Any, reason: str
) -> None:
    with pytest.raises(ValueError, match=reason):
        HyperParameters(**{name: value})


def test_more_environments_than_the_buffer_holds_are_named() -> None:
    with pytest.raises(ValueError, match="environments is 9; give at most replay_cap"):
        HyperParameters(environments=9, replay_capacity=8)


def test_hyper_parameters_are_plain_numbers() -> None:
    made = HyperParameters(steps=np.int64(7), batch_size=4.0, gamma=1)  # type: ignore[arg-type]
    assert [type(value) for value in (made.steps, made.batch_size, made.gamma)] == [
        int,
        int,
        float,
    ]
    assert made == HyperParameters(steps=7, batch_size=4, gamma=1.0)


@pytest.mark.parametrize("seed", [-1, 0.5, True, None, "0", 2**63, math.nan])
def test_a_seed_that_is_none_is_named(seed: Any) -> None:
    with pytest.raises(
        ValueError, match=r"the seed is .*; give a whole number, 0 to 9223"
    ):
        as_seed(seed)
    with pytest.raises(ValueError, match="the seed is"):
        Trainer([paper_scenario()], HyperParameters(), seed)
    with pytest.raises(ValueError, match="the seed is"):
        RobotTrainer("0.2", make_motions("differential", 0.5, 0.25), seed)
