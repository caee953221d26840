"""Goal iii (section 5.3, Fig. 9): new obstacles, most of them never trained on."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from blind_robot import BlindTrainer
from figures import draw_map, draw_path, save_figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from tables import mean_and_worst, median_and_range, table
from trainings import (
    MOVE_RULE,
    NOISE,
    PROFILES,
    SCENARIO,
    Settings,
    Training,
    rollouts,
)

from ddqn_planner import Planner
from ddqn_planner.grid import (
    Cell,
    path_length,
    scatter_obstacles,
    shortest_distances,
    shortest_path,
)
from ddqn_planner.planning.paths import search
from ddqn_planner.training.environment import GridVectorEnvironment, Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import Trainer

TRAINING_MAPS, TEST_MAPS, NOISE_SEED = 100, 200, 0
# The profile paper for many maps. The steps are the paper's, the rest is ours: a replay
# buffer that forgets none, more filters, and three values for these reasons.
PAPER: Final = replace(
    PROFILES["paper"],
    steps=120_000,
    replay_capacity=120_000,
    filters=32,
    # Weights that follow each map in turn forget the others: their average does not.
    weight_averaging=0.003,
    # The 32 filters of 100 windows can memorise 100 maps: small weights cannot.
    weight_decay=0.2,
    # Most transitions are far from any new obstacle, and soon known.
    priority=0.4,
)
EVALUATION_INTERVAL = 250
KEPT = "kept.safetensors"
COLUMNS = (
    "new obstacles | planner | training maps solved | test maps solved "
    "| mean length / optimum"
)


def noisy_maps(
    training: int, test: int, noise: str
) -> tuple[list[Scenario], list[Scenario]]:
    """Draw different training and test maps.

    New obstacles lie on goal i's path or near it.
    """
    path = shortest_path(SCENARIO.grid, SCENARIO.start, SCENARIO.goal, MOVE_RULE)
    random = np.random.default_rng(NOISE_SEED)
    scenarios: dict[str, Scenario] = {}
    while len(scenarios) < training + test:
        grid, _ = scatter_obstacles(
            SCENARIO.grid, path, MOVE_RULE, random, NOISE[noise]
        )
        scenarios.setdefault(grid.fingerprint, replace(SCENARIO, grid=grid))
    drawn = list(scenarios.values())
    return drawn[:training], drawn[training:]


def drawn_maps(settings: Settings, noise: str) -> tuple[list[Scenario], list[Scenario]]:
    """Return the noisy maps of the experiment."""
    return noisy_maps(
        *((4, 6) if settings.quick else (TRAINING_MAPS, TEST_MAPS)), noise
    )


class Variant(NamedTuple):
    """A network that is trained on the noisy maps."""

    folder: str  # of its trainings, in the folder of a kind of noise
    parameters: HyperParameters
    trainer_class: type[Trainer] = Trainer


def variants(settings: Settings) -> dict[str, Variant]:
    """Return each network by its label."""
    found = {}
    for units in settings.hidden_units:
        name = f"paper, {units} hidden units" if units else "paper"
        folder = f"paper/hidden_{units}"
        parameters = replace(PAPER, hidden_units=units)
        found[name] = Variant(folder, parameters)
        found[f"{name}, blind"] = Variant(f"{folder}_blind", parameters, BlindTrainer)
    return {**found, "propagation": Variant("propagation", PROFILES["propagation"])}


def _rows(settings: Settings, noise: str) -> Iterator[list[object]]:
    """Yield the row of each planner on the maps with a kind of noise."""
    training, test = drawn_maps(settings, noise)
    maps = [*training, *test]
    lengths = {}  # of each planner: (seeds, maps), NaN where it is trapped
    for label, (folder, parameters, trainer_class) in variants(settings).items():
        environment = trainer_class.environment_class(maps, parameters)
        planners = settings.planners(f"{noise}/{folder}", KEPT)
        lengths[label] = _lengths(planners, environment)
    path = fixed_path(training)
    is_free = [all(map(scenario.grid.is_free, path)) for scenario in maps]
    lengths["one fixed path"] = np.where([is_free], path_length(path), np.nan)
    optimum = np.array([_optimum(scenario) for scenario in test])
    for label, lengths_of_seeds in lengths.items():
        solved = np.isfinite(lengths_of_seeds)
        counts = [
            median_and_range(part.sum(axis=1).tolist())
            for part in np.split(solved, [len(training)], axis=1)
        ]
        test_ratios = lengths_of_seeds[:, len(training) :] / optimum
        ratios = [ratio[np.isfinite(ratio)] for ratio in test_ratios]
        yield [noise, label, *counts, mean_and_worst(ratios)[0]]


def _lengths(
    planners: Sequence[Planner], maps: GridVectorEnvironment
) -> NDArray[np.float64]:
    """Return the length of each seed's rollout on each map: (seeds, maps)."""
    return np.array([rollouts(planner, maps)[0] for planner in planners])


def _optimum(scenario: Scenario) -> float:
    """Return the length of the shortest path of a map."""
    distances = shortest_distances(scenario.grid, scenario.goal, MOVE_RULE)
    x, y = SCENARIO.start
    return float(distances[y, x])


def trainings(settings: Settings) -> list[Training]:
    """Return the trainings of each network on the training maps of each noise."""
    jobs = []
    for noise in settings.noise:
        maps, _ = drawn_maps(settings, noise)
        for folder, parameters, trainer_class in variants(settings).values():
            jobs += settings.trainings(
                {f"{noise}/{folder}": parameters},
                maps,
                EVALUATION_INTERVAL,
                trainer_class,
            )
    return jobs


def fixed_path(maps: Sequence[Scenario]) -> tuple[Cell, ...]:
    """Return the cheapest path by the number of maps that occupy its cells.

    A cell costs 1, and 1 more for each map in which it is occupied.
    """
    occupied = sum(scenario.grid.occupancy.astype(np.float32) for scenario in maps)
    grid = SCENARIO.grid.with_layers(slowness=np.float32(1) + occupied)
    return search(SCENARIO.start, SCENARIO.goal, grid, MOVE_RULE)


def report(settings: Settings) -> str:
    """Return the table of goal iii, and write its figure."""
    rows = [row for noise in settings.noise for row in _rows(settings, noise)]
    return f"{table(COLUMNS, rows)}\n\n{_draw(settings)}"


def _draw(settings: Settings) -> str:
    """Draw the first seed's paths on the first three test maps of each noise."""
    count = len(settings.noise)
    figure, panels = plt.subplots(
        count, 3, figsize=(12, 4.2 * count), layout="constrained", squeeze=False
    )
    before, legend = SCENARIO.grid.occupancy, dict[str, Any]()
    for noise, row in zip(settings.noise, panels, strict=True):
        planners = {
            label: settings.planners(f"{noise}/{variant.folder}", KEPT)[0]
            for label, variant in variants(settings).items()
            if variant.trainer_class is Trainer  # a planner sees all obstacles
        }
        for axes, scenario in zip(row, drawn_maps(settings, noise)[1], strict=False):
            draw_map(axes, scenario, noise)
            for y, x in np.argwhere(scenario.grid.occupancy & ~before):
                cell = Rectangle(
                    (x - 0.5, y - 0.5), 1, 1, facecolor="#E69F00", edgecolor="black"
                )
                axes.add_patch(cell)
            for number, (label, planner) in enumerate(planners.items()):
                plan = planner.plan(scenario.grid, scenario.start, scenario.goal)
                draw_path(axes, plan.cells, number, label)
            handles, labels = axes.get_legend_handles_labels()
            legend |= dict(zip(labels, handles, strict=True))
    figure.legend(
        [*legend.values()], [*legend], loc="outside lower center", ncols=len(legend)
    )
    caption = "As the paper's Fig. 9: the first three test maps of each reading"
    return save_figure(figure, settings.out / "goal_3.png", caption)
