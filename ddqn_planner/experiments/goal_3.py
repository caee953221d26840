"""Goal iii (section 5.3, Fig. 9): maps with new obstacles, most of them never trained on."""

from __future__ import annotations

from dataclasses import replace
from typing import Final, NamedTuple

import matplotlib.pyplot as plt
import numpy as np

from ddqn_planner.experiments.figures import draw_map, draw_new_obstacles, draw_walk, save
from ddqn_planner.experiments.profiles import MOVE_RULE, PROFILES
from ddqn_planner.experiments.report import Settings, mean, optimal_length, spread, worst
from ddqn_planner.experiments.tables import table
from ddqn_planner.experiments.taught import teach
from ddqn_planner.experiments.trainings import (
    Training,
    in_parallel,
    solved,
    walk_from_starts,
)
from ddqn_planner.files import write_csv
from ddqn_planner.grid import scatter_obstacles
from ddqn_planner.planning import Planner, shortest_path
from ddqn_planner.training.environment import Scenario, paper_scenario

TITLE = "Goal iii: noisy maps"

TRAINING_MAPS, TEST_MAPS = 100, 200
PAPER: Final = replace(PROFILES["paper"], steps=120_000, replay_capacity=120_000, filters=32)
"""The profile paper for many maps: the steps are the paper's, memory and filters ours."""
NOISE_SEED = 0

TAUGHT = "paper/taught"
TAUGHT_UPDATES = 20_000

COLUMNS = (
    "training maps solved",
    "training, any move",
    "test maps solved",
    "test, any move",
    "mean length / optimum, test",
    "worst",
    "steps",
    "seconds",
)


class NoisyMaps(NamedTuple):
    """Maps with new obstacles on or next to the path of goal i, no two of them alike."""

    training: list[Scenario]
    test: list[Scenario]
    rejected: int
    """Draws thrown away because they closed every way."""
    repeated: int
    """Draws thrown away because that map was there already."""


def noisy_maps(training: int, test: int, seed: int = NOISE_SEED) -> NoisyMaps:
    """Draw distinct noisy maps around the shortest path of goal i.

    Parameters
    ----------
    training, test : int
        How many of each; the training maps do not depend on the number of test maps.
    seed : int
    """
    scenario = paper_scenario()
    path = shortest_path(scenario.grid, scenario.start, scenario.goal, MOVE_RULE)
    random = np.random.default_rng(seed)
    scenarios: dict[str, Scenario] = {}
    rejected = repeated = 0
    while len(scenarios) < training + test:
        grid, thrown_away = scatter_obstacles(scenario.grid, path, MOVE_RULE, random)
        rejected += thrown_away
        repeated += grid.fingerprint in scenarios
        scenarios.setdefault(grid.fingerprint, replace(scenario, grid=grid))
    drawn = list(scenarios.values())
    return NoisyMaps(drawn[:training], drawn[training:], rejected, repeated)


def drawn_maps(settings: Settings) -> NoisyMaps:
    """Return the noisy maps of the experiment."""
    return noisy_maps(4, 6) if settings.quick else noisy_maps(TRAINING_MAPS, TEST_MAPS)


def name(profile: str) -> str:
    """Return the name of the trainings of a profile on the noisy maps."""
    return f"{profile}/noisy"


def trainings(settings: Settings) -> list[Training]:
    """Return the trainings of both profiles on the training maps."""
    maps = drawn_maps(settings).training
    return [
        *settings.trainings(name("paper"), settings.shorten(PAPER), maps, 1_000),
        *settings.trainings(name("best"), settings.profile("best"), maps, 1_000),
    ]


def taught(settings: Settings) -> list[Training]:
    """Return what the paper's network is taught, see `ddqn_planner.experiments.taught`."""
    parameters = settings.shorten(replace(PAPER, steps=TAUGHT_UPDATES))
    return settings.trainings(TAUGHT, parameters, drawn_maps(settings).training)


def report(settings: Settings) -> str:
    """Write the table and the figure of goal iii, and return its Markdown."""
    maps = drawn_maps(settings)
    in_parallel(teach, taught(settings), settings.out)
    optimum = [optimal_length(scenario) for scenario in maps.test]
    rows = [
        [label, *_row(settings.planners(trained, file), maps, optimum), *_cost(settings, trained)]
        for label, trained, file in (
            ("paper", name("paper"), "kept.safetensors"),
            ("paper, last network", name("paper"), "model.safetensors"),
            ("best", name("best"), "kept.safetensors"),
            ("best, last network", name("best"), "model.safetensors"),
            ("paper's network, taught the best moves", TAUGHT, "model.safetensors"),
        )
    ]
    write_csv(settings.out / "goal_3.csv", ["profile", *COLUMNS], rows)
    _draw(settings, maps)
    return "\n\n".join(
        [
            f"{len(maps.training)} training and {len(maps.test)} test maps, all different; "
            f"{maps.rejected} draws were thrown away because they closed every way, "
            f"{maps.repeated} because they repeated a map.",
            table(["profile", *COLUMNS], rows),
            "![Fig. 9: the first six test maps](goal_3.png)",
        ]
    )


def _row(planners: list[Planner], maps: NoisyMaps, optimum: list[float]) -> list[str]:
    training = [walk_from_starts(planner, maps.training) for planner in planners]
    test = [walk_from_starts(planner, maps.test) for planner in planners]
    ratios = [
        [walk.length / best for walk, best in zip(walks, optimum, strict=True) if walk.cells]
        for walks, _ in test
    ]
    return [
        spread([solved(walks) for walks, _ in training]),
        spread([solved(unmasked) for _, unmasked in training]),
        spread([solved(walks) for walks, _ in test]),
        spread([solved(unmasked) for _, unmasked in test]),
        spread([mean(of_seed) for of_seed in ratios], 4),
        spread([worst(of_seed) for of_seed in ratios], 4),
    ]


def _cost(settings: Settings, trained: str) -> list[str]:
    ends = [run[-1] for run in settings.evaluations(trained) if run]
    if not ends:
        return ["-", "-"]
    return [spread([end.step for end in ends]), spread([end.seconds for end in ends], 1)]


def _draw(settings: Settings, maps: NoisyMaps) -> None:
    figure, panels = plt.subplots(2, 3, figsize=(12, 8.4), layout="constrained")
    planners = {
        profile: settings.planners(name(profile), "kept.safetensors")[0] for profile in PROFILES
    }
    for axes, scenario in zip(panels.flat, maps.test, strict=False):
        plans = {
            profile: planner.plan(scenario.grid, scenario.start, scenario.goal)
            for profile, planner in planners.items()
        }
        words = [
            f"{profile} {plan.length:.2f}" if plan.cells else f"{profile} trapped"
            for profile, plan in plans.items()
        ]
        draw_map(axes, scenario, ", ".join(words))
        draw_new_obstacles(axes, scenario.grid, paper_scenario().grid)
        for number, (profile, plan) in enumerate(plans.items()):
            draw_walk(axes, plan.cells, number, f"profile {profile}, seed 0")
    handles = [
        handle
        for axes in panels.flat
        for handle in zip(*axes.get_legend_handles_labels(), strict=True)
    ]
    legend = {label: handle for handle, label in handles}
    figure.legend(legend.values(), legend.keys(), loc="outside lower center", ncols=2)
    save(figure, settings.out / "goal_3.png")
