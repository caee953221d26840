"""Goal ii (section 5.2, Fig. 8): from every free cell; and the printed target."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final

import goal_1
import matplotlib.pyplot as plt
import numpy as np
from figures import draw_curves, draw_map, save_figure
from matplotlib.colors import BoundaryNorm, ListedColormap
from numpy.typing import NDArray
from printed_target import PrintedTrainer
from tables import mean_and_worst, median_and_range, table
from trainings import MOVE_RULE, PROFILES, SCENARIO, Settings, Training

from ddqn_planner import Planner, QField
from ddqn_planner.grid import MOVES, Cell, legal_moves
from ddqn_planner.model import PropagationQNetwork
from ddqn_planner.training.double_dqn import next_q
from ddqn_planner.training.environment import GridVectorEnvironment
from ddqn_planner.training.evaluation import length_ratios
from ddqn_planner.training.propagation import PropagationLearner

# The paper's dilemma on its rebuilt map: the start and ten more cells.
START_DEAD_END: Final[frozenset[Cell]] = frozenset(
    {
        (6, 6),
        (4, 6),
        (4, 7),
        (4, 8),
        (5, 6),
        (5, 7),
        (5, 8),
        (6, 7),
        (6, 8),
        (7, 6),
        (7, 7),
    }
)
# The folder of each target's trainings.
TARGETS: Final[dict[str, str]] = {
    "Double DQN": "paper/both",  # the trainings of goal i
    "DQN": "paper/target_dqn",
    "printed": "paper/target_printed",
}
COLUMNS = (
    "profile | solved, of 286 | without action masking | of the dilemma's 10 | "
    "mean length / optimum | worst"
)
TARGET_COLUMNS = (
    "target | seeds solved from the start | starts solved "
    "| over-estimation, last 10 % | worst"
)
BORDER: Final[dict[str, Any]] = {"color": "black", "linewidth": 2.5, "zorder": 3}


def starts_of_paper() -> NDArray[np.bool_]:
    """Return the free cells except start and end: (H, W), 286 of the paper's."""
    starts = ~SCENARIO.grid.occupancy
    for x, y in (SCENARIO.start, SCENARIO.goal):
        starts[y, x] = False
    return starts


STARTS: Final = starts_of_paper()


def count_solved(ratios: Sequence[NDArray[np.float64]], starts: Any) -> str:
    """Return how many of the starts each seed solves.

    `starts` is an index into `length_ratios`.
    """
    counts = [int(np.isfinite(ratio[starts]).sum()) for ratio in ratios]
    return median_and_range(counts)


def trained_field(planner: Planner) -> QField:
    """Return a propagation network's Q field as the loss trained it.

    It contains the reward and γ.
    """
    network = planner.network
    assert isinstance(network, PropagationQNetwork)
    occupancy = SCENARIO.grid.occupancy
    environment = GridVectorEnvironment([SCENARIO], PROFILES["propagation"])
    # Four copies: weights, target network, and two moments of the optimiser.
    parts = [
        {name: tensor.copy() for name, tensor in network.tensors.items()}
        for _ in range(4)
    ]
    rule = partial(next_q, "double_dqn")
    learner = PropagationLearner(network, parts, environment, rule)
    cells = np.arange(occupancy.size)
    q_CA = learner.q_values(np.zeros_like(cells), cells)
    q_AHW = q_CA.T.reshape(len(MOVES), *occupancy.shape)
    return QField(SCENARIO.goal, q_AHW, legal_moves(occupancy, MOVE_RULE))


def q_fields(settings: Settings, name: str) -> list[QField]:
    """Return each seed's Q field of the paper's map."""
    return [
        planner.q_field(SCENARIO.grid, SCENARIO.goal)
        for planner in settings.planners(name)
    ]


def ratios_of(fields: Sequence[QField]) -> list[NDArray[np.float64]]:
    """Return the ratios of lengths of each field: (H, W), infinity where unsolved."""
    return [length_ratios(field, SCENARIO.grid, MOVE_RULE) for field in fields]


def report(settings: Settings) -> str:
    """Return the table of goal ii, and write its figure."""
    fields_by_label = {
        profile: q_fields(settings, f"{profile}/both") for profile in PROFILES
    }
    fields_by_label["propagation, Q as trained"] = [
        trained_field(planner) for planner in settings.planners("propagation/both")
    ]
    dilemma_x, dilemma_y = np.transpose(sorted(START_DEAD_END - {SCENARIO.start}))
    rows = []
    ratios_by_label = {}
    for label, fields in fields_by_label.items():
        ratios = ratios_of(fields)
        unmasked_ratios = ratios_of([field.unmasked() for field in fields])
        ratios_of_solved = [ratio[STARTS & np.isfinite(ratio)] for ratio in ratios]
        row = [
            label,
            count_solved(ratios, STARTS),
            count_solved(unmasked_ratios, STARTS),
            count_solved(ratios, (dilemma_y, dilemma_x)),
            *mean_and_worst(ratios_of_solved),
        ]
        rows.append(row)
        ratios_by_label[label] = ratios
    figure = draw_outcomes(ratios_by_label, settings.seeds)
    caption = "As the paper's Fig. 8: starts by outcome"
    markdown = save_figure(figure, settings.out / "goal_2.png", caption)
    return f"{table(COLUMNS, rows)}\n\n{markdown}"


def draw_outcomes(
    ratios_by_label: Mapping[str, Sequence[NDArray[np.float64]]], seeds: int
) -> Any:
    """Colour each cell by the number of seeds that solve it, in a panel per profile."""
    figure, panels = plt.subplots(
        1, len(PROFILES), figsize=(11, 5), layout="constrained"
    )
    shades = np.linspace(0.08, 0.92, seeds + 1)
    colours = ListedColormap(plt.get_cmap("RdYlBu")(shades))
    norm = BoundaryNorm(np.arange(seeds + 2) - 0.5, seeds + 1)
    is_counted = STARTS.copy()
    start_x, start_y = SCENARIO.start
    is_counted[start_y, start_x] = True
    for axes, profile in zip(panels, PROFILES, strict=True):
        is_solved = np.isfinite(ratios_by_label[profile])  # (seeds, H, W)
        counts = np.where(is_counted, is_solved.sum(axis=0), np.nan)
        image = axes.imshow(counts, cmap=colours, norm=norm, origin="lower")
        draw_map(axes, SCENARIO, f"profile {profile}")
        draw_border_of_dead_end(axes)
    label = "seeds that solve the start"
    figure.colorbar(image, ax=panels, label=label, ticks=range(seeds + 1), shrink=0.8)
    return figure


def draw_border_of_dead_end(axes: Any) -> None:
    """Draw a line around the cells of `START_DEAD_END`."""
    for x, y in START_DEAD_END:
        for side in (-1, 1):
            if (x + side, y) not in START_DEAD_END:
                axes.vlines(x + side / 2, y - 0.5, y + 0.5, **BORDER)
            if (x, y + side) not in START_DEAD_END:
                axes.hlines(y + side / 2, x - 0.5, x + 0.5, **BORDER)


def target_trainings(settings: Settings) -> list[Training]:
    """Return the trainings of the profile paper with each target."""
    parameters = PROFILES["paper"]
    targets_of_package = {
        TARGETS["Double DQN"]: parameters,
        TARGETS["DQN"]: replace(parameters, target="dqn"),
    }
    printed_target = {TARGETS["printed"]: parameters}
    return [
        *settings.trainings(targets_of_package, [SCENARIO]),
        *settings.trainings(printed_target, [SCENARIO], trainer_class=PrintedTrainer),
    ]


def target_report(settings: Settings) -> str:
    """Return the table of the targets, and write their figure."""
    rows = []
    runs_by_label = {}
    errors_by_label = {}
    for label, name in TARGETS.items():
        runs = settings.evaluations(name)
        errors = [run["overestimation"] for run in runs]
        n_solved = sum(int(run["solved"][-1]) for run in runs)
        late_errors = [
            float(error[-max(len(error) // 10, 1) :].mean()) for error in errors
        ]
        row = [
            label,
            f"{n_solved} of {settings.seeds}",
            count_solved(ratios_of(q_fields(settings, name)), STARTS),
            median_and_range(late_errors, 2),
            median_and_range([error.max() for error in errors], 2),
        ]
        rows.append(row)
        runs_by_label[label] = runs
        errors_by_label[label] = errors
    figure, (errors_axes, shares_axes) = plt.subplots(
        1, 2, figsize=(13, 4), layout="constrained"
    )
    steps = runs_by_label["Double DQN"][0]["step"]
    draw_curves(
        errors_axes, steps, errors_by_label, "environment steps", "mean of max Q - V*"
    )
    errors_axes.set_yscale("symlog")
    errors_axes.axhline(0, color="black", linewidth=0.8)
    figure.legend(loc="outside lower center", ncols=len(TARGETS))
    goal_1.draw_shares(shares_axes, runs_by_label)
    path = settings.out / "targets.png"
    markdown = save_figure(figure, path, "Over-estimation of Q")
    return f"{table(TARGET_COLUMNS, rows)}\n\n{markdown}"
