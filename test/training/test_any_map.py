from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
from hypothesis import given
from hypothesis import strategies as st
from random_maps import generate_map

from ddqn_planner import GridMap, MoveRule, Planner
from ddqn_planner.cli import main
from ddqn_planner.grid import UNKNOWN, Cell
from ddqn_planner.grid.noise import random_costs
from ddqn_planner.training.any_map import ANY_MAP, MAPS, RULES, random_scenarios
from ddqn_planner.training.evaluation import Evaluation, evaluate
from ddqn_planner.training.trainer import Trainer

BRIEF = 192_000
"""Environment steps that are enough to learn every move, and the cost multipliers roughly."""


@pytest.fixture(scope="module")
def planner() -> Planner:
    trainer = Trainer(random_scenarios(seed=0), MoveRule.ROBOT_SAFE, ANY_MAP, seed=0)
    for _ in trainer.run(BRIEF):
        pass
    return trainer.planner()


def evaluation_of(planner: Planner, grid: GridMap, rule: MoveRule) -> Evaluation:
    goal = grid.free_cells()[-1]
    return evaluate(planner.q_field(grid, goal, rule).unmasked(), grid, rule)


@pytest.mark.slow
@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("kind", ["maze", "rooms", "corridors", "dead_ends", "office"])
def test_training_on_small_random_maps_learns_the_moves_on_other_types_and_sizes_of_maps(
    planner: Planner, kind: str, rule: MoveRule
) -> None:
    grid = GridMap(generate_map(kind, (40, 50), np.random.default_rng(1)))
    evaluation = evaluation_of(planner, grid, rule)  # without action masking
    assert evaluation.solved == evaluation.starts > 100
    assert evaluation.worst_ratio < 1.3


@pytest.mark.slow
@pytest.mark.parametrize("rule", RULES)
def test_costs_and_unknown_cells_are_learned_with_them(planner: Planner, rule: MoveRule) -> None:
    random = np.random.default_rng(2)
    occupancy = generate_map("random_20", (30, 30), random)
    cost = np.where(random.random((30, 30)) < 0.2, UNKNOWN, random_costs(occupancy, random))
    with_costs = GridMap(occupancy, cost=cost.astype(np.int8))
    evaluation = evaluation_of(planner, with_costs, rule)
    assert evaluation.solved == evaluation.starts > 100
    # A planner that does not see the costs takes the shortest path, which costs more.
    goal = with_costs.free_cells()[-1]
    blind = evaluate(planner.q_field(GridMap(occupancy), goal, rule), with_costs, rule)
    assert evaluation.mean_ratio < (1 + blind.mean_ratio) / 2


@given(st.integers(0, 1000))
def test_the_maps_to_train_on_are_those_of_the_seed(seed: int) -> None:
    scenarios, again = random_scenarios(seed, maps=8), random_scenarios(seed, maps=8)
    for scenario, same in zip(scenarios, again, strict=True):
        assert scenario.grid.fingerprint == same.grid.fingerprint
        assert (scenario.start, scenario.goal) == (same.start, same.goal)
        start: Cell = scenario.start
        assert scenario.move_rule is not None
        joined = scenario.grid.reachable([scenario.goal], scenario.move_rule)
        assert joined[start[1], start[0]]
    assert {scenario.move_rule for scenario in scenarios} == set(RULES)
    other = random_scenarios(seed + 1, maps=8)
    assert scenarios[0].grid.fingerprint != other[0].grid.fingerprint


def test_the_maps_to_train_on_have_costs_of_every_sort() -> None:
    grids = [scenario.grid for scenario in random_scenarios(seed=0)]
    costs = [grid.cost for grid in grids]
    assert len(costs) == MAPS
    filled = [grid.occupancy.mean() for grid in grids]
    assert min(filled) < 0.15
    assert max(filled) > 0.55
    alike = [
        int(grid.cost[~grid.occupancy].max())
        for grid in grids
        if grid.cost is not None and len(np.unique(grid.cost[~grid.occupancy])) == 1
    ]
    assert len(alike) > MAPS / 8
    assert min(alike) < 10
    assert max(alike) > 90
    assert any(cost is None for cost in costs)
    assert any(cost is not None and (cost == UNKNOWN).any() for cost in costs)
    assert any(cost is not None and len(np.unique(cost)) > 20 for cost in costs)


def command(out: Path, *arguments: str) -> list[str]:
    steps = ["--maps", "64", "--steps", "12800", "--learning-starts", "1000"]
    return ["train-any-map", "--out", str(out), *steps, *arguments]


def weights(folder: Path) -> dict[str, bytes]:
    tensors = safetensors.torch.load_file(folder / "model.safetensors")
    return {name: tensor.numpy().tobytes() for name, tensor in tensors.items()}


def test_the_command_continues_where_it_stopped_and_gives_the_same_model(tmp_path: Path) -> None:
    longer = ["--steps", "19200"]
    # In a process of its own: nothing of it is left except its files.
    stopped = [sys.executable, "-m", "ddqn_planner.cli", *command(tmp_path / "cut")]
    subprocess.run(stopped, check=True)
    for folder in ("cut", "at_once"):
        assert main(command(tmp_path / folder, *longer)) == 0
    assert weights(tmp_path / "cut") == weights(tmp_path / "at_once")


def test_one_seed_gives_one_model() -> None:
    models = []
    for _ in range(2):
        parameters = replace(ANY_MAP, learning_starts=1_000)
        trainer = Trainer(random_scenarios(3, maps=32), MoveRule.ROBOT_SAFE, parameters, seed=3)
        for _ in trainer.run(6_400):
            pass
        models.append({k: v.numpy().tobytes() for k, v in trainer.network.state_dict().items()})
    assert models[0] == models[1]
