"""Goal iii (section 5.3, Fig. 9): new obstacles, most of them never trained on."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Final

import matplotlib.pyplot as plt
import numpy as np
from figures import draw_map, draw_path, save_figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from scipy.special import softmax
from tables import mean_and_worst, median_and_range, table
from trainings import (
    MOVE_RULE,
    NOISE,
    PROFILES,
    SCENARIO,
    Settings,
    Training,
    in_parallel,
    rollouts,
)

from ddqn_planner import Planner
from ddqn_planner.files import write_atomically
from ddqn_planner.grid import (
    LENGTHS,
    Cell,
    legal_moves,
    neighbours,
    path_length,
    scatter_obstacles,
    shortest_distances,
    shortest_path,
)
from ddqn_planner.planning.paths import search
from ddqn_planner.training.compiled_learner import (
    adam,
    differentiate,
    evaluate,
    evaluate_common_windows,
    networks_of,
)
from ddqn_planner.training.environment import GridVectorEnvironment, Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import Trainer

TRAINING_MAPS, TEST_MAPS, NOISE_SEED = 100, 200, 0
# The profile paper for many maps: the steps are the paper's, memory and filters ours.
PAPER: Final = replace(
    PROFILES["paper"], steps=120_000, replay_capacity=120_000, filters=32
)
EVALUATION_INTERVAL = 1_000
SUPERVISED_UPDATES, SUPERVISED_BATCH, SUPERVISED_LEARNING_RATE = 10_000, 128, 0.003
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


def networks(settings: Settings) -> dict[str, tuple[str, HyperParameters]]:
    """Return the folder and the parameters of each network by its label."""
    found = {}
    for units in settings.hidden_units:
        label = f"paper, {units} hidden units" if units else "paper"
        found[label] = f"paper/hidden_{units}", replace(PAPER, hidden_units=units)
    return {**found, "propagation": ("propagation", PROFILES["propagation"])}


def _rows(settings: Settings, noise: str) -> Iterator[list[object]]:
    """Yield the row of each planner on the maps with a kind of noise."""
    training, test = drawn_maps(settings, noise)
    maps = GridVectorEnvironment([*training, *test], PAPER)
    lengths = {}  # of each planner: (seeds, maps), NaN where it is trapped
    for label, (folder, parameters) in networks(settings).items():
        name = f"{noise}/{folder}"
        lengths[label] = _lengths(settings.planners(name, KEPT), maps)
        # Obstacles on the path alone can be avoided by one fixed path.
        if parameters.network == "paper" and noise == "near_path":
            supervised = f"{name}/supervised"
            updates = replace(parameters, steps=SUPERVISED_UPDATES)
            jobs = settings.trainings({supervised: updates}, training)
            in_parallel(train_supervised, jobs, settings.backend)
            planners = settings.planners(supervised)
            lengths[f"{label}, supervised"] = _lengths(planners, maps)
    path = fixed_path(training)
    is_free = [all(map(scenario.grid.is_free, path)) for scenario in maps.scenarios]
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
        parameters = {
            f"{noise}/{folder}": parameters
            for folder, parameters in networks(settings).values()
        }
        maps, _ = drawn_maps(settings, noise)
        jobs += settings.trainings(parameters, maps, EVALUATION_INTERVAL)
    return jobs


def train_supervised(training: Training) -> None:
    """Train a network by cross-entropy, unless it was trained before.

    The labels are the moves of all shortest paths.
    """
    # What it fails to learn even then is a limit of the network, not of how it learns.
    path = training.folder / "model.safetensors"
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(training.scenarios, training.parameters, training.seed)
    best_SCA = np.stack([best_moves(scenario) for scenario in training.scenarios])
    scenario, cell = np.nonzero(best_SCA.any(axis=2))
    random = np.random.default_rng(training.seed)
    tensors = trainer.network.tensors
    zeros = ({name: np.zeros_like(t) for name, t in tensors.items()} for _ in range(3))
    e, parts = trainer.environment, [tensors, *zeros]
    windows, networks = networks_of(e.background, e.shape, parts, SUPERVISED_BATCH)
    network, gradient, *_ = networks
    moved = [each.weights for each in networks]
    steps = training.parameters.steps
    for number in range(steps):
        drawn = random.integers(len(cell), size=SUPERVISED_BATCH)
        evaluate_common_windows(network, windows)
        evaluate(network, windows, scenario[drawn], cell[drawn])
        # -log of the probability that softmax(Q) gives to the best moves, and its
        # gradient by Q
        best_BA = best_SCA[scenario[drawn], cell[drawn]]
        gradient.q[:] = softmax(network.q, axis=1)
        gradient.q[:] -= softmax(np.where(best_BA, network.q, -np.inf), axis=1)
        gradient.q[:] /= SUPERVISED_BATCH
        differentiate(network, windows, gradient, SUPERVISED_BATCH)
        rate = SUPERVISED_LEARNING_RATE * (1 - 0.95 * number / steps)
        adam(*moved, rate, number + 1)
    write_atomically(path, trainer.model_bytes())


def best_moves(scenario: Scenario) -> NDArray[np.bool_]:
    """Return the first moves of shortest paths: (C, 8) bool.

    A cell without a path has none.
    """
    occupancy = scenario.grid.occupancy
    distance = shortest_distances(scenario.grid, scenario.goal, MOVE_RULE).ravel()
    next_cell_AC = neighbours(occupancy.shape)  # the last number is off the map
    distance_of_next_AC = np.append(distance, np.inf)[next_cell_AC]
    onward_AC = distance_of_next_AC + LENGTHS[:, None]
    legal_AC = legal_moves(occupancy, MOVE_RULE).reshape(len(LENGTHS), -1)
    is_shortest_AC = np.isfinite(onward_AC) & (onward_AC <= distance + 1e-9)
    return np.array((legal_AC & is_shortest_AC).T)


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
            label: settings.planners(f"{noise}/{folder}", KEPT)[0]
            for label, (folder, _) in networks(settings).items()
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
