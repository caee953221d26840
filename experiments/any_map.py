"""The model for any map: the paper's goals on their unseen map, and what each idea contributes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import goal_1
import goal_3
import numpy as np
from random_maps import generate_map
from settings import Settings
from tables import median_and_range, table
from trainings import MOVE_RULE, Training, rollouts, solved

from ddqn_planner.grid import (
    OCCUPIED,
    UNKNOWN,
    GridMap,
    MoveRule,
    legal_moves,
    move_costs,
    path_length,
)
from ddqn_planner.grid.noise import random_costs
from ddqn_planner.model import AnyMapQNetwork
from ddqn_planner.planning import Planner
from ddqn_planner.training.any_map import ANY_MAP, RULES, random_scenarios
from ddqn_planner.training.environment import paper_scenario
from ddqn_planner.training.evaluation import evaluate

PAPERS_REWARD: Final = {"reward": "paper", "goal_reward": 10.0}
VARIANTS: Final[dict[str, dict[str, Any]]] = {
    "all": {},
    "DQN's target": {"target": "dqn"},
    "the printed target": {"target": "printed"},
    "given initial cells (p_r = 0)": {"p_r": 0.0},
    "the paper's reward": PAPERS_REWARD,
    "plain reward (α = β = 0)": {**PAPERS_REWARD, "alpha": 0.0, "beta": 0.0},
}
"""The changes to `ANY_MAP` of each variant."""

STEPS: Final = 256_000
"""Environment steps of each training of the ablation."""

HELD_OUT: Final = ("maze", "rooms", "corridors", "dead_ends", "office")
SIDE: Final = 48

ABLATION = (
    "variant",
    "moves classified wrongly, of 4,096",
    "error of the cost multiplier",
    "starts solved, without action masking",
    "mean length / optimum",
    "mean cost / optimum, random costs",
)


def trainings(settings: Settings) -> list[Training]:
    """Return the trainings of the ablation. Each seed has maps of its own."""
    return [
        Training(
            folder,
            settings.shorten(replace(ANY_MAP, steps=STEPS, **changes)),
            tuple(random_scenarios(seed)),
            seed,
            evaluation_interval=10**9,
        )
        for variant, changes in VARIANTS.items()
        for seed, folder in enumerate(settings.folders(_folder(variant)))
    ]


def _folder(variant: str) -> str:
    return f"any_map/{list(VARIANTS).index(variant)}"


def report(settings: Settings) -> str:
    """Return the shipped model's results on the paper's goals, and the table of the ablation."""
    ablation = [[name, *_row(settings.planners(_folder(name)))] for name in VARIANTS]
    zero_shot = table(["the shipped model, which never saw these maps", ""], _zero_shot(settings))
    return f"{zero_shot}\n\n{table(ABLATION, ablation)}"


def _zero_shot(settings: Settings) -> list[list[str]]:
    shipped, scenario = Planner.load("any_map"), paper_scenario()
    planner = Planner(shipped.network, replace(shipped.metadata, move_rule=MOVE_RULE))
    cells, milliseconds = goal_1.timed_plan(planner, scenario)
    field = planner.q_field(scenario.grid, scenario.goal)
    # The given start, goal i, is one of the starts.
    starts = evaluate(field, scenario.grid, MOVE_RULE)
    unmasked = evaluate(field.unmasked(), scenario.grid, MOVE_RULE).solved
    rows = [
        ["goal i, length", f"{path_length(cells):.2f}"],
        ["planning time, ms", f"{milliseconds:.2f}"],
        ["goal ii (without action masking)", f"{starts.solved} ({unmasked}) of {starts.starts}"],
        ["goal ii, mean length / optimum", f"{starts.mean_ratio:.4f}"],
    ]
    for noise in settings.noise:
        training, test = goal_3.drawn_maps(settings, noise)
        plans, without_masking = rollouts(planner, [*training, *test])
        counts = f"{solved(plans)} ({solved(without_masking)}) of {len(plans)}"
        rows.append([f"goal iii, {noise.value} (without action masking)", counts])
    return rows


def _row(planners: Sequence[Planner]) -> list[str]:
    errors = [move_errors(planner) for planner in planners]
    lengths = [_held_out_rollouts(planner, with_costs=False) for planner in planners]
    costs = [_held_out_rollouts(planner, with_costs=True) for planner in planners]
    starts = lengths[0][1]
    return [
        median_and_range([wrong for wrong, _ in errors]),
        median_and_range([error for _, error in errors], 4),
        f"{median_and_range([count for count, _, _ in lengths])} of {starts:,}",
        median_and_range([ratio for _, _, ratio in lengths], 4),
        median_and_range([ratio for _, _, ratio in costs], 4),
    ]


def move_errors(planner: Planner) -> tuple[int, float]:
    """Count the moves classified wrongly, and return the mean relative error of their costs.

    All 256 3x3 patches with a free centre under both rules; for the costs, each with random costs.
    """
    network = planner.network
    assert isinstance(network, AnyMapQNetwork)
    wrong, errors = 0, []
    patches = OCCUPIED * (np.arange(2**9)[:, None] >> np.arange(9) & 1)
    patch_B9 = patches[patches[:, 4] == 0].astype(np.int8)
    random = np.random.default_rng(0).integers(UNKNOWN, OCCUPIED, patch_B9.shape)
    costs_B9 = np.where(patch_B9 == OCCUPIED, OCCUPIED, random).astype(np.int8)
    # One map of all patches: a centre's neighbours all lie in its own patch.
    cells = costs_B9.reshape(16, 16, 3, 3).swapaxes(1, 2).reshape(48, 48)
    grid = GridMap(cells == OCCUPIED, cost=cells)
    for rule in RULES:
        legal_BA = legal_moves(grid.occupancy, rule)[:, 1::3, 1::3].reshape(8, -1).T
        cost_BA = move_costs(grid.cost_multiplier, rule)[:, 1::3, 1::3].reshape(8, -1).T
        p_BA = network.success(network.features(patch_B9, rule))
        learned_BA = network.multiplier(network.features(costs_B9, rule))
        wrong += int(((p_BA > 0.5) != legal_BA).sum())
        errors.append(np.abs(learned_BA / (cost_BA / rule.lengths) - 1)[legal_BA])
    return wrong, float(np.concatenate(errors).mean())


def _held_out_rollouts(planner: Planner, with_costs: bool) -> tuple[int, int, float]:
    """Return solved starts, all starts and mean ratio of rollouts without action masking.

    The starts are all free cells of one map of each held-out kind.
    """
    random = np.random.default_rng(0)
    count, starts, ratios = 0, 0, []
    for kind in HELD_OUT:
        occupancy = generate_map(kind, (SIDE, SIDE), random)
        grid = GridMap(occupancy, cost=random_costs(occupancy, random) if with_costs else None)
        field = planner.q_field(grid, grid.free_cells()[-1], MoveRule.ROBOT_SAFE).unmasked()
        evaluation = evaluate(field, grid, MoveRule.ROBOT_SAFE)
        count += evaluation.solved
        starts += evaluation.starts
        ratios.append(evaluation.mean_ratio)
    return count, starts, float(np.nanmean(ratios))
