"""Goal iii (section 5.3, Fig. 9): maps with new obstacles, most of them never trained on.

The paper leaves two things open: where the new obstacles lie (`Noise`), and whether its network has
a hidden layer after the convolution. All four combinations are trained.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import matplotlib.pyplot as plt
import numpy as np
from figures import draw_map, draw_path, save_figure
from matplotlib.patches import Rectangle
from settings import PROFILES, Settings, optimal_length
from tables import mean_and_worst, median_and_range, table
from trainings import MOVE_RULE, Training, in_parallel, rollouts, solved, train_supervised

from ddqn_planner.grid import Cell, Noise, legal_moves, scatter_obstacles, shortest_path
from ddqn_planner.planning import Plan, PlanStatus
from ddqn_planner.planning.paths import search
from ddqn_planner.training.environment import Scenario, paper_scenario
from ddqn_planner.training.hyper_parameters import HyperParameters

TRAINING_MAPS, TEST_MAPS = 100, 200
PAPER: Final = replace(PROFILES["paper"], steps=120_000, replay_capacity=120_000, filters=32)
"""The profile paper for many maps: the steps are the paper's, memory and filters ours."""
NOISE_SEED = 0
EVALUATION_INTERVAL = 1_000
SUPERVISED_UPDATES = 10_000

COLUMNS = (
    "new obstacles",
    "planner",
    "training maps solved",
    "test maps solved",
    "without action masking",
    "mean length / optimum",
    "worst",
)


NoisyMaps = tuple[list[Scenario], list[Scenario]]
"""Training maps and test maps, all different."""


def noisy_maps(training: int, test: int, noise: Noise, seed: int = NOISE_SEED) -> NoisyMaps:
    """Draw different maps with new obstacles on or next to the shortest path of goal i.

    The training maps do not depend on the number of test maps.
    """
    scenario = paper_scenario()
    path = shortest_path(scenario.grid, scenario.start, scenario.goal, MOVE_RULE)
    random = np.random.default_rng(seed)
    scenarios: dict[str, Scenario] = {}
    while len(scenarios) < training + test:
        grid, _ = scatter_obstacles(scenario.grid, path, MOVE_RULE, random, noise)
        scenarios.setdefault(grid.fingerprint, replace(scenario, grid=grid))
    drawn = list(scenarios.values())
    return drawn[:training], drawn[training:]


def drawn_maps(settings: Settings, noise: Noise) -> NoisyMaps:
    """Return the noisy maps of the experiment."""
    counts = (4, 6) if settings.quick else (TRAINING_MAPS, TEST_MAPS)
    return noisy_maps(*counts, noise)


def networks(settings: Settings) -> dict[str, tuple[str, HyperParameters]]:
    """Return the folder and the parameters of each network, by its label in the table."""
    papers = {
        f"paper, {units} hidden units" if units else "paper": (
            f"paper/hidden_{units}",
            replace(PAPER, hidden_units=units),
        )
        for units in settings.hidden_units
    }
    return papers | {"propagation": ("propagation", PROFILES["propagation"])}


def trainings(settings: Settings) -> list[Training]:
    """Return the trainings of each network on the training maps of each noise."""
    return [
        training
        for noise in settings.noise
        for training in settings.trainings(
            {f"{noise.value}/{folder}": p for folder, p in networks(settings).values()},
            drawn_maps(settings, noise)[0],
            EVALUATION_INTERVAL,
        )
    ]


def supervised_trainings(settings: Settings) -> list[Training]:
    """Return the trainings for `train_supervised`: the paper's networks on maps near the path.

    Obstacles on the path alone can be avoided by one fixed path.
    """
    if Noise.NEAR_PATH not in settings.noise:
        return []
    parameters_of = {
        f"near_path/{folder}/supervised": replace(parameters, steps=SUPERVISED_UPDATES)
        for folder, parameters in networks(settings).values()
        if parameters.network == "paper"
    }
    return settings.trainings(parameters_of, drawn_maps(settings, Noise.NEAR_PATH)[0])


def fixed_path(maps: Sequence[Scenario]) -> tuple[Cell, ...]:
    """Return a path from start to end that is free in many of the maps at once.

    It does not depend on the map at hand, so a network must solve more maps, or find shorter
    paths, to show that it sees the map. It is the cheapest path of the paper's map if a cell costs
    1, and 1 more for each of the maps in which it is a new obstacle.
    """
    paper = paper_scenario()
    occupied = sum(scenario.grid.occupancy.astype(np.float32) for scenario in maps)
    legal = legal_moves(paper.grid.occupancy, MOVE_RULE)
    return search(paper.start, paper.goal, legal, np.float32(1) + occupied, MOVE_RULE)


def report(settings: Settings) -> str:
    """Return the table of goal iii, and write its figure."""
    in_parallel(train_supervised, supervised_trainings(settings), settings.backend)
    rows = []
    for noise in settings.noise:
        training, test = drawn_maps(settings, noise)
        models = {}
        for label, (folder, parameters) in networks(settings).items():
            name = f"{noise.value}/{folder}"
            models[label] = settings.planners(name, "kept.safetensors")
            if parameters.network == "paper" and noise is Noise.NEAR_PATH:
                models[f"{label}, supervised"] = settings.planners(f"{name}/supervised")
        for label, planners in models.items():
            plans = [rollouts(planner, [*training, *test]) for planner in planners]
            rows.append([noise.value, label, *_columns(plans, test)])
        fixed = _on_maps(fixed_path(training), [*training, *test])
        rows.append([noise.value, "one fixed path", *_columns([(fixed, fixed)], test)])
    return f"{table(COLUMNS, rows)}\n\n{_draw(settings)}"


def _on_maps(path: tuple[Cell, ...], scenarios: Sequence[Scenario]) -> list[Plan]:
    """Return the path as a plan on each map: trapped if a cell of it is occupied."""
    solved, trapped = Plan(PlanStatus.SUCCEEDED, np.array(path)), Plan(PlanStatus.ROLLOUT_TRAPPED)
    return [solved if all(map(s.grid.is_free, path)) else trapped for s in scenarios]


def _columns(
    of_seeds: Sequence[tuple[list[Plan], list[Plan]]], test: Sequence[Scenario]
) -> list[str]:
    """Return cells of the table for each seed's `rollouts`: the last are those on the test maps."""
    optimum = [optimal_length(scenario) for scenario in test]
    on_test = [(masked[-len(test) :], unmasked[-len(test) :]) for masked, unmasked in of_seeds]
    ratios = [
        [plan.length / least for plan, least in zip(plans, optimum, strict=True) if plan.cells]
        for plans, _ in on_test
    ]
    return [
        median_and_range([solved(masked[: -len(test)]) for masked, _ in of_seeds]),
        median_and_range([solved(masked) for masked, _ in on_test]),
        median_and_range([solved(unmasked) for _, unmasked in on_test]),
        *mean_and_worst(ratios),
    ]


def _draw(settings: Settings) -> str:
    """Draw the first three test maps of each noise, with the paths of the first seed."""
    size = (12, 4.2 * len(settings.noise))
    figure, panels = plt.subplots(
        len(settings.noise), 3, figsize=size, layout="constrained", squeeze=False
    )
    before, legend = paper_scenario().grid.occupancy, dict[str, Any]()
    for noise, row in zip(settings.noise, panels, strict=True):
        planners = {
            label: settings.planners(f"{noise.value}/{folder}", "kept.safetensors")[0]
            for label, (folder, _) in networks(settings).items()
        }
        for axes, scenario in zip(row, drawn_maps(settings, noise)[1], strict=False):
            draw_map(axes, scenario, noise.value)
            for y, x in np.argwhere(scenario.grid.occupancy & ~before):
                cell = Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor="#E69F00", edgecolor="black")
                axes.add_patch(cell)
            for number, (label, planner) in enumerate(planners.items()):
                plan = planner.plan(scenario.grid, scenario.start, scenario.goal)
                draw_path(axes, plan.cells, number, label)
            handles, labels = axes.get_legend_handles_labels()
            legend |= dict(zip(labels, handles, strict=True))
    figure.legend([*legend.values()], [*legend], loc="outside lower center", ncols=len(legend))
    caption = "Fig. 9: the first three test maps of each reading"
    return save_figure(figure, settings.out / "goal_3.png", caption)
