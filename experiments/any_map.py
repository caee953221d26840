"""The model for any map: the paper's goals, and what each idea contributes.

The model has never seen the paper's map.
"""

from dataclasses import replace
from typing import Any, Final

import goal_1
import goal_3
import numpy as np
from numpy.typing import NDArray
from printed_target import PrintedTrainer
from random_maps import generate_map
from tables import median_and_range, table
from trainings import MOVE_RULE, SCENARIO, Settings, Training, rollouts

from ddqn_planner import GridMap, MoveRule, Planner
from ddqn_planner.grid import LENGTHS, OCCUPIED, UNKNOWN, legal_moves, move_costs
from ddqn_planner.grid.noise import random_costs
from ddqn_planner.model import AnyMapQNetwork
from ddqn_planner.model.certificate import MOVE_RULES
from ddqn_planner.training.any_map import ANY_MAP, random_scenarios
from ddqn_planner.training.environment import GridVectorEnvironment
from ddqn_planner.training.evaluation import evaluate
from ddqn_planner.training.trainer import Trainer

PAPERS_REWARD: Final = {"reward": "paper", "goal_reward": 10.0}
PRINTED: Final = "the printed target"
# The changes to ANY_MAP of each variant; the number of its folder is its place.
VARIANTS: Final[dict[str, dict[str, Any]]] = {
    "all": {},
    "DQN's target": {"target": "dqn"},
    PRINTED: {},
    "given initial cells (p_r = 0)": {"p_r": 0.0},
    "the paper's reward": PAPERS_REWARD,
    "plain reward (α = β = 0)": {**PAPERS_REWARD, "alpha": 0.0, "beta": 0.0},
}
STEPS: Final = 128_000  # of the environment, for each training of the ablation
HELD_OUT: Final = ("maze", "rooms", "corridors", "dead_ends", "office")
SIDE: Final = 48
ABLATION = (
    "variant | moves classified wrongly, of 4,096 | error of the cost multiplier | "
    "starts solved, without action masking | mean length / optimum | "
    "mean cost / optimum, random costs"
)


def trainings(settings: Settings) -> list[Training]:
    """Return the trainings of the ablation. Each seed has maps of its own."""
    trainings: list[Training] = []
    for number, (variant, changes) in enumerate(VARIANTS.items()):
        parameters = replace(ANY_MAP, steps=STEPS, **changes)
        trainings += settings.trainings(
            {f"any_map/{number}": parameters},
            random_scenarios,
            evaluation_interval=10**9,
            trainer_class=PrintedTrainer if variant == PRINTED else Trainer,
        )
    return trainings


def report(settings: Settings) -> str:
    """Return the shipped model's results and the table of the ablation.

    The results are those of the paper's goals.
    """
    zero_shot = table(
        "the shipped model, which never saw these maps | ", _zero_shot(settings)
    )
    rows = []
    for number, name in enumerate(VARIANTS):
        planners = settings.planners(f"any_map/{number}")
        wrong, errors = zip(*map(move_errors, planners), strict=True)
        counts, starts, lengths = zip(
            *(_held_out(p, False) for p in planners), strict=True
        )
        _, _, costs = zip(*(_held_out(p, True) for p in planners), strict=True)
        found = f"{median_and_range(counts)} of {starts[0]:,}"
        of_costs, *ratios = (
            median_and_range(each, 4) for each in (errors, lengths, costs)
        )
        rows.append([name, median_and_range(wrong), of_costs, found, *ratios])
    return f"{zero_shot}\n\n{table(ABLATION, rows)}"


def _zero_shot(settings: Settings) -> list[list[str]]:
    shipped = Planner.load("any_map")
    planner = Planner(shipped.network, replace(shipped.metadata, move_rule=MOVE_RULE))
    plan, milliseconds = goal_1.timed_plan(planner)
    field = planner.q_field(SCENARIO.grid, SCENARIO.goal)
    # The given start, goal i, is one of the starts.
    starts = evaluate(field, SCENARIO.grid, MOVE_RULE)
    unmasked = evaluate(field.unmasked(), SCENARIO.grid, MOVE_RULE).solved
    rows = [
        ["goal i, length", f"{plan.length:.2f}"],
        ["planning time, ms", f"{milliseconds:.2f}"],
        [
            "goal ii (without action masking)",
            f"{starts.solved} ({unmasked}) of {starts.starts}",
        ],
        ["goal ii, mean length / optimum", f"{starts.mean_ratio:.4f}"],
    ]
    for noise in settings.noise:
        training, test = goal_3.drawn_maps(settings, noise)
        maps = GridVectorEnvironment([*training, *test], ANY_MAP)
        solved, unmasked = np.isfinite(rollouts(planner, maps)).sum(axis=1)
        counts = f"{solved} ({unmasked}) of {len(maps.start)}"
        rows.append([f"goal iii, {noise} (without action masking)", counts])
    return rows


def move_errors(planner: Planner) -> tuple[int, float]:
    """Count the wrongly classified moves; measure the mean error of the costs.

    The moves are all of all 256 patches (3 x 3) with a free centre, under both rules.
    The error is relative to the true cost, in the same patches with random costs.
    """
    network = planner.network
    assert isinstance(network, AnyMapQNetwork)
    bits = np.arange(2**9)[:, None] >> np.arange(9) & 1  # (512, 9): all patches
    free_centre = bits[bits[:, 4] == 0]
    patch_B9 = (OCCUPIED * free_centre).astype(np.int8)
    random = np.random.default_rng(0).integers(UNKNOWN, OCCUPIED, patch_B9.shape)
    costs_B9 = np.where(patch_B9 == OCCUPIED, OCCUPIED, random).astype(np.int8)
    # One map of all patches: a centre's neighbours all lie in its own patch.
    cells = costs_B9.reshape(16, 16, 3, 3).swapaxes(1, 2).reshape(48, 48)
    grid = GridMap(cells == OCCUPIED, cost=cells)
    cost_BA = _of_centres(move_costs(grid.cost_multiplier))
    wrong = 0
    errors = []
    for rule in MOVE_RULES:
        legal_BA = _of_centres(legal_moves(grid.occupancy, rule))
        success_BA = network.success(network.features(patch_B9, rule))
        wrong += int(((success_BA > 0.5) != legal_BA).sum())
        multiplier_BA = network.multiplier(network.features(costs_B9, rule))
        error_BA = np.abs(multiplier_BA / (cost_BA / LENGTHS) - 1)
        errors.append(error_BA[legal_BA])
    return wrong, float(np.concatenate(errors).mean())


def _of_centres(value_AHW: NDArray[Any]) -> NDArray[Any]:
    """Return the values of the centres of a map's patches: (B, A)."""
    return np.array(value_AHW[:, 1::3, 1::3].reshape(8, -1).T)


def _held_out(planner: Planner, with_costs: bool) -> tuple[int, int, float]:
    """Measure rollouts without action masking on held-out maps.

    Return the number of solved starts, the number of starts and the mean ratio of
    lengths.
    """
    random = np.random.default_rng(0)
    count, starts, ratios = 0, 0, []
    for kind in HELD_OUT:
        occupancy = generate_map(kind, (SIDE, SIDE), random)
        grid = GridMap(
            occupancy, cost=random_costs(occupancy, random) if with_costs else None
        )
        field = planner.q_field(
            grid, grid.free_cells()[-1], MoveRule.ROBOT_SAFE
        ).unmasked()
        evaluation = evaluate(field, grid, MoveRule.ROBOT_SAFE)
        count += evaluation.solved
        starts += evaluation.starts
        ratios.append(evaluation.mean_ratio)
    return count, starts, float(np.nanmean(ratios))
