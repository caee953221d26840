"""The model for any map: the paper's goals with it unseen, and what each idea does for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.benchmarks.evaluation import evaluate
from ddqn_planner.experiments import goal_1, goal_3
from ddqn_planner.experiments.profiles import MOVE_RULE
from ddqn_planner.experiments.report import Settings, mean, spread
from ddqn_planner.experiments.tables import table
from ddqn_planner.experiments.trainings import Training, solved, walk_from_starts
from ddqn_planner.files import write_csv
from ddqn_planner.grid import OCCUPIED, UNKNOWN, GridMap, MoveRule, legal_moves, move_costs
from ddqn_planner.grid.generators import generate_map, random_costs
from ddqn_planner.model import AnyMapQNetwork
from ddqn_planner.planning import Planner
from ddqn_planner.training.any_map import ANY_MAP, RULES, random_scenarios
from ddqn_planner.training.environment import paper_scenario

TITLE = "The model for any map"

PAPERS_REWARD: Final = {"reward": "paper", "goal_reward": 10.0}
VARIANTS: Final[dict[str, dict[str, Any]]] = {
    "all": {},
    "DQN's target": {"target": "dqn"},
    "the printed target": {"target": "printed"},
    "given initial cells (p_r = 0)": {"p_r": 0.0},
    "the paper's reward": PAPERS_REWARD,
    "plain reward (α = β = 0)": {**PAPERS_REWARD, "alpha": 0.0, "beta": 0.0},
}
"""What each changes in `ANY_MAP`."""

STEPS: Final = (25_600, 256_000)
"""Environment steps of the trainings of the ablation: a tenth of a minute, and a minute."""

HELD_OUT: Final = ("maze", "rooms", "corridors", "dead_ends", "office")
SIDE: Final = 48

ABLATION = (
    "variant",
    "steps",
    "moves judged wrongly, of 4,096",
    "error of the cost multiplier",
    "starts solved, any move",
    "mean length / optimum",
    "mean cost / optimum, random costs",
)


def name(variant: str, steps: int) -> str:
    """Return the name of the trainings of a variant."""
    return f"any_map/{list(VARIANTS).index(variant)}/{steps}"


def trainings(settings: Settings) -> list[Training]:
    """Return the trainings of the ablation. Each seed has maps of its own."""
    return [
        Training(
            name(variant, steps),
            settings.shorten(replace(ANY_MAP, steps=steps, **changes)),
            tuple(random_scenarios(seed)),
            seed,
            evaluation_interval=10**9,
        )
        for variant, changes in VARIANTS.items()
        for steps in STEPS
        for seed in range(settings.seeds)
    ]


def report(settings: Settings) -> str:
    """Return the Markdown of both tables, and write them."""
    header, row = zero_shot(settings)
    write_csv(settings.out / "any_map_zero_shot.csv", header, [row])
    rows = [
        [variant, f"{steps:,}", *_row(settings.planners(name(variant, steps)))]
        for variant in VARIANTS
        for steps in STEPS
    ]
    write_csv(settings.out / "any_map_ablation.csv", ABLATION, rows)
    return f"{table(header, [row])}\n\n{table(ABLATION, rows)}"


def zero_shot(settings: Settings) -> tuple[list[str], list[str]]:
    """Return a table of the paper's goals with the shipped model, which never saw their maps."""
    shipped = Planner.load("any_map")
    planner = Planner(shipped.network, replace(shipped.metadata, move_rule=MOVE_RULE))
    scenario = paper_scenario()
    field = planner.q_field(scenario.grid, scenario.goal)
    # The given start, goal i, is one of the starts.
    starts = evaluate(field, scenario.grid, MOVE_RULE)
    any_move = evaluate(field.unmasked(), scenario.grid, MOVE_RULE)
    noisy = {}
    for noise in settings.noise:
        maps = goal_3.drawn_maps(settings, noise)
        for which, some in (("first", maps.training), ("test", maps.test)):
            legal, unmasked = walk_from_starts(planner, some)
            counts = f"{solved(legal)} ({solved(unmasked)}) of {len(legal)}"
            noisy[f"goal iii, {noise.value}, {which} maps (any move)"] = counts
    plan, seconds = goal_1.timed_plan(planner, scenario)
    return [
        "goal i, length",
        "goal ii with the given start, solved (any move)",
        "mean length / optimum",
        *noisy,
        "planning time, ms",
    ], [
        f"{plan.length:.2f}",
        f"{starts.solved} ({any_move.solved}) of {starts.starts}",
        f"{starts.mean_ratio:.4f}",
        *noisy.values(),
        f"{1e3 * seconds:.2f}",
    ]


def _row(planners: Sequence[Planner]) -> list[str]:
    judged = [_judgement(planner) for planner in planners]
    lengths = [_walks(planner, with_costs=False) for planner in planners]
    costs = [_walks(planner, with_costs=True) for planner in planners]
    starts = lengths[0][1]
    return [
        spread([wrong for wrong, _ in judged]),
        spread([error for _, error in judged], 4),
        f"{spread([count for count, _, _ in lengths])} of {starts:,}",
        spread([ratio for _, _, ratio in lengths], 4),
        spread([ratio for _, _, ratio in costs], 4),
    ]


def _judgement(planner: Planner) -> tuple[int, float]:
    """Count the wrongly judged moves, and return the mean relative error of their costs.

    All 256 neighbourhoods of a free cell under both rules; for the costs, each with random costs.
    """
    network = planner.network
    assert isinstance(network, AnyMapQNetwork)
    wrong, errors = 0, []
    seen_B9 = _surroundings_of_a_free_cell()
    random = np.random.default_rng(0).integers(UNKNOWN, OCCUPIED, seen_B9.shape)
    costs_B9 = np.where(seen_B9 == OCCUPIED, OCCUPIED, random).astype(np.int8)
    for rule in RULES:
        truth = [_truth(values, rule) for values in costs_B9]
        legal_BA, multiplier_BA = map(np.stack, zip(*truth, strict=True))
        p_BA = network.success(network.features(seen_B9, rule))
        learned_BA = network.multiplier(network.features(costs_B9, rule))
        wrong += int(((p_BA > 0.5) != legal_BA).sum())
        errors.append(np.abs(learned_BA / multiplier_BA - 1)[legal_BA])
    return wrong, float(np.concatenate(errors).mean())


def _surroundings_of_a_free_cell() -> NDArray[np.int8]:
    """Return every surroundings without costs that a free cell can have: (256, 9) int8."""
    every = OCCUPIED * (np.arange(2**9)[:, None] >> np.arange(9) & 1)
    free: NDArray[np.int8] = every[every[:, 4] == 0].astype(np.int8)
    return free


def _truth(
    values: NDArray[np.int8], rule: MoveRule
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return legal moves from the centre of 3x3 cells, and their cost multipliers: (8,) both."""
    cells = values.reshape(3, 3)
    grid = GridMap(cells == OCCUPIED, cost=cells)
    cost_AHW = move_costs(grid.cost_multiplier, rule)
    return legal_moves(grid.occupancy, rule)[:, 1, 1], cost_AHW[:, 1, 1] / rule.lengths


def _walks(planner: Planner, with_costs: bool) -> tuple[int, int, float]:
    """Walk from every free cell of a map of each kind: solved, starts, mean over the optimum."""
    random = np.random.default_rng(0)
    count, starts, ratios = 0, 0, []
    for kind in HELD_OUT:
        occupancy = generate_map(kind, (SIDE, SIDE), random)
        grid = GridMap(occupancy, cost=random_costs(occupancy, random) if with_costs else None)
        goal = grid.free_cells()[-1]
        field = planner.q_field(grid, goal, MoveRule.ROBOT_SAFE).unmasked()
        evaluation = evaluate(field, grid, MoveRule.ROBOT_SAFE)
        count += evaluation.solved
        starts += evaluation.starts
        ratios.append(evaluation.mean_ratio)
    return count, starts, mean(ratios)
