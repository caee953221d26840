"""Goal iii (section 5.3, Fig. 9): maps with new obstacles, most of them never trained on.

The paper leaves two things open: where the new obstacles lie (`Noise`), and whether its network has
a hidden layer after the convolution. All four combinations are trained.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any, Final, NamedTuple

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
from ddqn_planner.grid import Cell, Noise, legal_moves, scatter_obstacles
from ddqn_planner.planning import Plan, Planner, PlanStatus, shortest_path
from ddqn_planner.planning.search import search
from ddqn_planner.training.environment import Scenario, paper_scenario
from ddqn_planner.training.hyper_parameters import HyperParameters

TITLE = "Goal iii: noisy maps"

TRAINING_MAPS, TEST_MAPS = 100, 200
PAPER: Final = replace(PROFILES["paper"], steps=120_000, replay_capacity=120_000, filters=32)
"""The profile paper for many maps: the steps are the paper's, memory and filters ours."""
NOISE_SEED = 0
EVALUATION_INTERVAL = 1_000

TAUGHT_UPDATES = 10_000

COLUMNS = (
    "new obstacles",
    "walks",
    "training maps solved",
    "training, any move",
    "test maps solved",
    "test, any move",
    "mean length / optimum, test",
    "worst",
    "distinct walks, test",
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


def noisy_maps(training: int, test: int, noise: Noise, seed: int = NOISE_SEED) -> NoisyMaps:
    """Draw distinct noisy maps around the shortest path of goal i.

    Parameters
    ----------
    training, test : int
        How many of each; the training maps do not depend on the number of test maps.
    noise : Noise
    seed : int
    """
    scenario = paper_scenario()
    path = shortest_path(scenario.grid, scenario.start, scenario.goal, MOVE_RULE)
    random = np.random.default_rng(seed)
    scenarios: dict[str, Scenario] = {}
    rejected = repeated = 0
    while len(scenarios) < training + test:
        grid, thrown_away = scatter_obstacles(scenario.grid, path, MOVE_RULE, random, noise)
        rejected += thrown_away
        repeated += grid.fingerprint in scenarios
        scenarios.setdefault(grid.fingerprint, replace(scenario, grid=grid))
    drawn = list(scenarios.values())
    return NoisyMaps(drawn[:training], drawn[training:], rejected, repeated)


def drawn_maps(settings: Settings, noise: Noise) -> NoisyMaps:
    """Return the noisy maps of the experiment."""
    counts = (4, 6) if settings.quick else (TRAINING_MAPS, TEST_MAPS)
    return noisy_maps(*counts, noise)


def readings(settings: Settings) -> dict[str, tuple[Noise, HyperParameters]]:
    """Return the readings of the paper that are asked for, by the names of their trainings."""
    return {
        f"paper/{noise.value}/hidden_{units}": (noise, replace(PAPER, hidden_units=units))
        for noise, units in product(settings.noise, settings.hidden_units)
    }


def best_name(noise: Noise) -> str:
    """Return the name of the trainings of the profile best on the noisy maps."""
    return f"best/{noise.value}"


def taught_name(name: str) -> str:
    """Return the name under which the network of a reading is taught."""
    return f"{name}/taught"


def trainings(settings: Settings) -> list[Training]:
    """Return the trainings on the training maps: each reading, and the profile best."""
    wanted = readings(settings) | {
        best_name(noise): (noise, PROFILES["best"]) for noise in settings.noise
    }
    return [
        training
        for name, (noise, parameters) in wanted.items()
        for training in settings.trainings(
            name,
            settings.shorten(parameters),
            drawn_maps(settings, noise).training,
            EVALUATION_INTERVAL,
        )
    ]


def taught(settings: Settings) -> list[Training]:
    """Return what the networks are taught, see `ddqn_planner.experiments.taught`.

    Only near the path: obstacles on it alone can be avoided by one fixed walk.
    """
    return [
        training
        for name, (noise, parameters) in readings(settings).items()
        if noise is Noise.NEAR_PATH
        for training in settings.trainings(
            taught_name(name),
            settings.shorten(replace(parameters, steps=TAUGHT_UPDATES)),
            drawn_maps(settings, noise).training,
        )
    ]


def fixed_walk(maps: Sequence[Scenario]) -> tuple[Cell, ...]:
    """Return a walk from start to end that is free in many of the maps at once.

    It looks at no map when it is walked, so what it solves is no achievement: a network must solve
    more, or walk less far. It is the cheapest path of the paper's map where a cell costs 1, and 1
    more for each of the maps in which it is a new obstacle.

    Parameters
    ----------
    maps : sequence of Scenario
        Noisy maps, see `noisy_maps`.

    Returns
    -------
    tuple of (x, y)
    """
    paper = paper_scenario()
    occupied = sum(scenario.grid.occupancy.astype(np.float32) for scenario in maps)
    end = np.zeros(paper.grid.occupancy.shape, dtype=np.bool_)
    end[paper.goal[1], paper.goal[0]] = True
    legal = legal_moves(paper.grid.occupancy, MOVE_RULE)
    return search(paper.start, end, legal, np.float32(1) + occupied, MOVE_RULE)


def report(settings: Settings) -> str:
    """Write the table and the figure of goal iii, and return its Markdown."""
    in_parallel(teach, taught(settings), settings.out)
    rows, drawn = [], []
    for noise in settings.noise:
        maps = drawn_maps(settings, noise)
        rows += [[noise.value, *row] for row in _rows(settings, maps, noise)]
        drawn.append(
            f"{noise.value}: {len(maps.training)} training and {len(maps.test)} test maps, all "
            f"different; {maps.rejected} draws were thrown away because they closed every way, "
            f"{maps.repeated} because they repeated a map."
        )
    write_csv(settings.out / "goal_3.csv", COLUMNS, rows)
    _draw(settings)
    figure = "![Fig. 9: the first three test maps of each reading](goal_3.png)"
    return "\n\n".join([*drawn, table(COLUMNS, rows), figure])


def _rows(settings: Settings, maps: NoisyMaps, noise: Noise) -> list[list[str]]:
    best, rows = best_name(noise), []
    for name, (of_noise, parameters) in readings(settings).items():
        if of_noise is noise:
            network = _network(parameters.hidden_units)
            rows += [
                (network, name, "kept.safetensors"),
                (f"{network}, last network", name, "model.safetensors"),
            ]
            if noise is Noise.NEAR_PATH:
                label = f"{network}, taught the best moves"
                rows.append((label, taught_name(name), "model.safetensors"))
    rows.append(("best", best, "kept.safetensors"))
    walk = fixed_walk(maps.training)
    walks = [[_on_map(walk, scenario) for scenario in some] for some in (maps.training, maps.test)]
    return [
        *(
            [label, *_measured(settings.planners(name, file), maps), *_cost(settings, name)]
            for label, name, file in rows
        ),
        [
            "one fixed walk",
            *_columns([(walks[0], walks[0])], [(walks[1], walks[1])], maps),
            "-",
            "-",
        ],
    ]


def _network(hidden_units: int) -> str:
    return f"paper, {hidden_units} hidden units" if hidden_units else "paper"


def _on_map(walk: tuple[Cell, ...], scenario: Scenario) -> Plan:
    """Return the plan that a walk is on a map: trapped where a cell of it is occupied."""
    if all(map(scenario.grid.is_free, walk)):
        return Plan(PlanStatus.SUCCEEDED, walk)
    return Plan(PlanStatus.ROLLOUT_TRAPPED)


def _measured(planners: Sequence[Planner], maps: NoisyMaps) -> list[str]:
    training = [walk_from_starts(planner, maps.training) for planner in planners]
    test = [walk_from_starts(planner, maps.test) for planner in planners]
    return _columns(training, test, maps)


Walks = tuple[list[Plan], list[Plan]]
"""By legal moves, and by the greatest Q of all moves: a walk per map."""


def _columns(training: Sequence[Walks], test: Sequence[Walks], maps: NoisyMaps) -> list[str]:
    """Return the cells of the table for the walks of each seed."""
    optimum = [optimal_length(scenario) for scenario in maps.test]
    ratios = [
        [walk.length / least for walk, least in zip(walks, optimum, strict=True) if walk.cells]
        for walks, _ in test
    ]
    return [
        spread([solved(walks) for walks, _ in training]),
        spread([solved(unmasked) for _, unmasked in training]),
        spread([solved(walks) for walks, _ in test]),
        spread([solved(unmasked) for _, unmasked in test]),
        spread([mean(of_seed) for of_seed in ratios], 4),
        spread([worst(of_seed) for of_seed in ratios], 4),
        spread([len({walk.cells for walk in walks if walk.cells}) for walks, _ in test]),
    ]


def _cost(settings: Settings, trained: str) -> list[str]:
    ends = [run[-1] for run in settings.evaluations(trained) if run]
    if not ends:
        return ["-", "-"]
    return [spread([end.step for end in ends]), spread([end.seconds for end in ends], 1)]


def _draw(settings: Settings) -> None:
    rows = len(settings.noise)
    figure, panels = plt.subplots(
        rows, 3, figsize=(12, 4.2 * rows), layout="constrained", squeeze=False
    )
    legend: dict[str, Any] = {}
    for noise, row in zip(settings.noise, panels, strict=True):
        planners = {
            _network(parameters.hidden_units): name
            for name, (of_noise, parameters) in readings(settings).items()
            if of_noise is noise
        } | {"best": best_name(noise)}
        loaded = {
            label: settings.planners(name, "kept.safetensors")[0]
            for label, name in planners.items()
        }
        for axes, scenario in zip(row, drawn_maps(settings, noise).test, strict=False):
            draw_map(axes, scenario, noise.value)
            draw_new_obstacles(axes, scenario.grid, paper_scenario().grid)
            for number, (label, planner) in enumerate(loaded.items()):
                plan = planner.plan(scenario.grid, scenario.start, scenario.goal)
                draw_walk(axes, plan.cells, number, label)
            handles, labels = axes.get_legend_handles_labels()
            legend |= dict(zip(labels, handles, strict=True))
    figure.legend([*legend.values()], [*legend], loc="outside lower center", ncols=len(legend))
    save(figure, settings.out / "goal_3.png")
