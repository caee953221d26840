"""The replay buffer, and one update of each network beside the same written down from equations."""

import copy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from ddqn_planner.grid import (
    LENGTHS,
    MOVES,
    Cell,
    GridMap,
    MoveRule,
)
from ddqn_planner.model import AnyMapQNetwork
from ddqn_planner.model.move_costs import patches
from ddqn_planner.model.shared_background import evaluate, look
from ddqn_planner.training.double_dqn import ReplayBuffer, Transitions
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.networks import AnyMapModule, PaperModule
from ddqn_planner.training.shared_background import adam, differentiate
from ddqn_planner.training.trainer import Trainer

Q = Callable[[Scenario, Cell], Tensor]
"""Q(s, a) of all actions, (8,), for the robot in a cell of a scenario's map."""


@given(st.integers(1, 8), st.lists(st.integers(1, 8), max_size=12))
def test_the_buffer_holds_the_last_transitions_whole(capacity: int, batches: list[int]) -> None:
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


def about_to_update(scenarios: list[Scenario], parameters: HyperParameters) -> Trainer:
    """A trainer that has seen some steps; its two networks differ, it made no update yet."""
    parameters = replace(parameters, learning_starts=10**6, environments=5, max_episode_steps=7)
    trainer = Trainer(scenarios, MoveRule.CORNER_CUTTING, parameters, seed=1)
    for _ in trainer.run(60):
        pass
    torch.manual_seed(0)
    for weight in trainer._target.parameters():
        weight.add_(0.3 * torch.randn_like(weight))
    trainer._target.settle(trainer.environment)
    return trainer


def next_batch(trainer: Trainer) -> Transitions:
    random = copy.deepcopy(trainer._sampling)
    return trainer._replay.sample(trainer.parameters.batch_size, random)


def mean_squared_error(
    trainer: Trainer, batch: Transitions, online: Q, selection: Q, evaluation: Q
) -> Tensor:
    """Mean of (y - Q(s, a; online))², y of the target, and γ = 0 at an end."""
    width = trainer.environment.shape[1]
    errors = []
    for number, cell, action, reward, next_cell, discount in zip(*batch, strict=True):
        scenario = trainer.scenarios[number]
        state, next_state = ((int(c) % width, int(c) // width) for c in (cell, next_cell))
        with torch.no_grad():
            best = selection(scenario, next_state).argmax()
            y = reward + discount * evaluation(scenario, next_state)[best]
        errors.append((y - online(scenario, state)[action]) ** 2)
    return torch.stack(errors).mean()


def check_update(trainer: Trainer, loss: Tensor, before: list[Tensor], tolerance: float) -> None:
    """Check gradients, and weights after Adam's first step: w - rate * g / (|g| + ε)."""
    expected = torch.autograd.grad(loss, before)
    trainer._update()
    assert trainer.updates == 1
    rate = trainer.parameters.learning_rate
    scale = max(float(gradient.abs().max()) for gradient in expected)
    for weight, gradient, old in zip(trainer.network.parameters(), expected, before, strict=True):
        assert weight.grad is not None
        torch.testing.assert_close(weight.grad, gradient, rtol=tolerance, atol=tolerance * scale)
        step = rate * weight.grad / (weight.grad.abs() + 1e-8)
        torch.testing.assert_close(weight.detach(), (old - step).detach())


@pytest.mark.parametrize("target", ["double_dqn", "dqn", "printed"])
def test_an_update_of_the_papers_network_is_the_equations(small: Scenario, target: str) -> None:
    scenarios = [small, replace(small, grid=GridMap(small.grid.occupancy[::-1]))]
    trainer = about_to_update(scenarios, HyperParameters(target=target, filters=4))
    network = copy.deepcopy(trainer.network)
    assert isinstance(network, PaperModule)

    def q_of(network: nn.Module) -> Q:
        def q(scenario: Scenario, cell: Cell) -> Tensor:
            observation = torch.where(torch.tensor(scenario.grid.occupancy), -0.1, 0.0)
            observation[scenario.goal[::-1]] = 1.0
            observation[cell[::-1]] = 3.0
            answer: Tensor = network(PaperModule.windows(observation[None]))[0]
            return answer

        return q

    online, target_q = q_of(network), q_of(copy.deepcopy(trainer._target))
    selection = target_q if target == "dqn" else online
    evaluation = online if target == "printed" else target_q
    batch = next_batch(trainer)
    assert {0, 1} == set(batch.scenario)
    assert {0.0, np.float32(0.95)} == set(batch.discount)
    loss = mean_squared_error(trainer, batch, online, selection, evaluation)
    check_update(trainer, loss, list(network.parameters()), tolerance=1e-4)


@pytest.mark.parametrize("units", [0, 6])
@pytest.mark.parametrize("target", ["double_dqn", "dqn", "printed"])
def test_compiled_training_is_that_of_torch(
    small: Scenario, tmp_path: Path, target: str, units: int
) -> None:
    walls = small.grid.occupancy
    scenarios = [replace(small, grid=GridMap(other)) for other in (walls, walls[::-1], walls & 0)]
    brief = {"learning_rate": 0.001, "learning_starts": 20, "target_interval": 10}
    brief |= {"epsilon_steps": 60, "environments": 3, "max_episode_steps": 7, "filters": 4}
    parameters = HyperParameters(target=target, hidden_units=units, **brief)
    trainers = [Trainer(scenarios, MoveRule.ROBOT_SAFE, parameters, seed=2) for _ in range(2)]
    compiled, in_torch = trainers
    in_torch._player = None
    one, other = ([e for ended in t.run(90) for e in ended] for t in (compiled, in_torch))
    assert one == other
    assert compiled.updates == in_torch.updates > 60
    check_same(compiled, in_torch)
    in_torch.save_checkpoint(tmp_path / "checkpoint")
    compiled = Trainer.load_checkpoint(tmp_path / "checkpoint", scenarios)
    one, other = ([e for ended in t.run(180) for e in ended] for t in (compiled, in_torch))
    assert one == other
    check_same(compiled, in_torch)


def check_same(compiled: Trainer, in_torch: Trainer) -> None:
    expected = in_torch._tensors()
    for name, tensor in compiled._tensors().items():
        # The mean: Adam makes much of the rounding of a gradient that is nearly 0.
        error = (tensor.double() - expected[name].double()).abs().mean()
        assert error <= 1e-3 * expected[name].double().abs().mean(), name


def test_weights_that_slept_wake_as_if_they_had_moved_all_the_time(small: Scenario) -> None:
    parameters = HyperParameters(hidden_units=6, filters=4)
    trainer = Trainer([small], MoveRule.ROBOT_SAFE, parameters, seed=2)
    online, _, gradient, *moments = trainer._player[1].args[1][2]
    weight = torch.tensor(online.weights)
    optimiser = torch.optim.Adam([weight], 0.01)
    for update in range(1, 701):
        if update in (1, 700):  # until the last one, Adam's mean of the first fades to 0
            look(online)
            evaluate(online, np.array([0]), np.array([0]))
            gradient.q[0] = 1
            differentiate(online, gradient, 1)
            assert gradient.layer.any(axis=1).sum() > gradient.awake.size // 4
        weight.grad = torch.tensor(gradient.weights)
        optimiser.step()
        adam(online, gradient, *moments, 0.01, update)
        assert not gradient.weights.any()
    torch.testing.assert_close(torch.tensor(online.weights), weight)


def test_an_update_of_the_network_for_any_map_counts_each_reward_once(small: Scenario) -> None:
    # Q(s, a) = p (r + γ V(s')) + (1 - p) r_o, r = -length * cost multiplier, V = max Q under θ⁻.
    cost = np.arange(20, dtype=np.int8).reshape(4, 5)
    walls = small.grid.occupancy
    scenarios = [
        replace(small, grid=GridMap(walls, cost=cost)),
        Scenario(GridMap(walls[::-1]), (4, 3), (0, 1), MoveRule.ROBOT_SAFE),
    ]
    settings = {"reward": "path_cost", "gamma": 0.5, "obstacle_reward": -20.0, "filters": 4}
    trainer = about_to_update(scenarios, HyperParameters(network="any_map", **settings))
    with torch.no_grad():  # a multiplier below 1 is clipped
        trainer.network.get_submodule("prices").bias[::2] = -1.0
    network, target_network = copy.deepcopy(trainer.network), copy.deepcopy(trainer._target)
    assert isinstance(network, AnyMapModule)
    lengths = torch.from_numpy(LENGTHS.astype(np.float32))

    def q_of(network: AnyMapModule, scenario: Scenario, value: Any) -> dict[Cell, Tensor]:
        seen = patches(scenario.grid.occupancy, scenario.grid.cost)
        rule = scenario.move_rule or MoveRule.CORNER_CUTTING
        features = torch.from_numpy(AnyMapQNetwork.features(seen, rule))
        p, multiplier = network.success(features), network.multiplier(features)
        answers = {}
        for number in range(20):
            x, y = number % 5, number // 5
            onward = torch.tensor([value.get((x + dx, y + dy), -20.0) for dx, dy in MOVES.tolist()])
            success = -lengths * multiplier[number] + 0.5 * onward
            answers[x, y] = p[number] * success + (1 - p[number]) * -20.0
        return answers

    online, evaluation = {}, {}
    for scenario in scenarios:
        value = {(x, y): -20.0 for x in range(5) for y in range(4)}
        with torch.no_grad():
            for _ in range(40):  # γ^40 is 1e-12
                q = q_of(target_network, scenario, value)
                value = {cell: float(q_A.max()) for cell, q_A in q.items()}
                value[scenario.goal] = 0.0
            evaluation[scenario] = q_of(target_network, scenario, value)
        online[scenario] = q_of(network, scenario, value)
    batch = next_batch(trainer)
    assert {0, 1} == set(batch.scenario)

    def first(s: Scenario, cell: Cell) -> Tensor:
        return online[s][cell]

    loss = mean_squared_error(trainer, batch, first, first, lambda s, cell: evaluation[s][cell])
    check_update(trainer, loss, list(network.parameters()), tolerance=2e-3)
