"""Goal ii (section 5.2, Fig. 8): from every free cell; and the printed target."""

from collections.abc import Sequence
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
# The free cells except start and end: (H, W) bool, the paper's 286.
STARTS = ~SCENARIO.grid.occupancy
STARTS[SCENARIO.start[::-1]] = STARTS[SCENARIO.goal[::-1]] = False


def count_solved(ratios: Sequence[NDArray[np.float64]], starts: Any) -> str:
    """Return how many of the starts each seed solves.

    `starts` is an index into `length_ratios`.
    """
    return median_and_range([int(np.isfinite(ratio[starts]).sum()) for ratio in ratios])


def trained_field(planner: Planner) -> QField:
    """Return a propagation network's Q field as the loss trained it.

    It contains the reward and γ.
    """
    occupancy = SCENARIO.grid.occupancy
    environment = GridVectorEnvironment([SCENARIO], PROFILES["propagation"])
    network, cells = planner.network, np.arange(occupancy.size)
    assert isinstance(network, PropagationQNetwork)
    parts = [
        {name: tensor.copy() for name, tensor in network.tensors.items()}
        for _ in range(4)
    ]
    learner = PropagationLearner(
        network, parts, environment, partial(next_q, "double_dqn")
    )
    q_CA = learner.q_values(np.zeros_like(cells), cells)
    q_AHW = q_CA.T.reshape(len(MOVES), *occupancy.shape)
    return QField(SCENARIO.goal, q_AHW, legal_moves(occupancy, MOVE_RULE))


def _fields(settings: Settings, name: str) -> list[QField]:
    """Return each seed's Q field of the paper's map."""
    return [p.q_field(SCENARIO.grid, SCENARIO.goal) for p in settings.planners(name)]


def _ratios(fields: Sequence[QField]) -> list[NDArray[np.float64]]:
    return [length_ratios(field, SCENARIO.grid, MOVE_RULE) for field in fields]


def report(settings: Settings) -> str:
    """Return the table of goal ii, and write its figure."""
    fields = {profile: _fields(settings, f"{profile}/both") for profile in PROFILES}
    trained = [*map(trained_field, settings.planners("propagation/both"))]
    fields["propagation, Q as trained"] = trained
    x, y = np.transpose(sorted(START_DEAD_END - {SCENARIO.start}))
    rows, ratios = [], {}
    for label, of_seeds in fields.items():
        masked, unmasked = (
            _ratios(of_seeds),
            _ratios([field.unmasked() for field in of_seeds]),
        )
        solved = count_solved(masked, STARTS), count_solved(unmasked, STARTS)
        lengths = mean_and_worst(
            [ratio[STARTS & np.isfinite(ratio)] for ratio in masked]
        )
        rows.append([label, *solved, count_solved(masked, (y, x)), *lengths])
        ratios[label] = masked
    return f"{table(COLUMNS, rows)}\n\n{_draw(settings, ratios)}"


def _draw(settings: Settings, ratios: dict[str, list[NDArray[np.float64]]]) -> str:
    """Colour each cell by the number of seeds that solve it."""
    figure, panels = plt.subplots(
        1, len(PROFILES), figsize=(11, 5), layout="constrained"
    )
    seeds = settings.seeds
    colours = ListedColormap(plt.get_cmap("RdYlBu")(np.linspace(0.08, 0.92, seeds + 1)))
    norm = BoundaryNorm(np.arange(seeds + 2) - 0.5, seeds + 1)
    free = ~SCENARIO.grid.occupancy
    free[SCENARIO.goal[::-1]] = False
    border = {"color": "black", "linewidth": 2.5, "zorder": 3}
    for axes, profile in zip(panels, PROFILES, strict=True):
        solved = np.sum([np.isfinite(ratio) for ratio in ratios[profile]], axis=0)
        image = axes.imshow(
            np.where(free, solved, np.nan), cmap=colours, norm=norm, origin="lower"
        )
        draw_map(axes, SCENARIO, f"profile {profile}")
        for x, y in START_DEAD_END:
            for side in (-1, 1):
                if (x + side, y) not in START_DEAD_END:
                    axes.vlines(x + side / 2, y - 0.5, y + 0.5, **border)
                if (x, y + side) not in START_DEAD_END:
                    axes.hlines(y + side / 2, x - 0.5, x + 0.5, **border)
    label = "seeds that solve the start"
    figure.colorbar(image, ax=panels, label=label, ticks=range(seeds + 1), shrink=0.8)
    return save_figure(
        figure, settings.out / "goal_2.png", "As the paper's Fig. 8: starts by outcome"
    )


def target_trainings(settings: Settings) -> list[Training]:
    """Return the trainings of the profile paper with each target."""
    parameters = PROFILES["paper"]
    by_name = {
        TARGETS["Double DQN"]: parameters,
        TARGETS["DQN"]: replace(parameters, target="dqn"),
    }
    printed = {TARGETS["printed"]: parameters}
    return [
        *settings.trainings(by_name, [SCENARIO]),
        *settings.trainings(printed, [SCENARIO], trainer_class=PrintedTrainer),
    ]


def target_report(settings: Settings) -> str:
    """Return the table of the targets, and write their figure."""
    rows = []
    runs = {label: settings.evaluations(folder) for label, folder in TARGETS.items()}
    estimates = {
        label: [run["overestimation"] for run in of] for label, of in runs.items()
    }
    for label, errors in estimates.items():
        late = [float(error[-max(len(error) // 10, 1) :].mean()) for error in errors]
        row = [
            label,
            f"{sum(int(run['solved'][-1]) for run in runs[label])} of {settings.seeds}",
            count_solved(_ratios(_fields(settings, TARGETS[label])), STARTS),
            median_and_range(late, 2),
            median_and_range([error.max() for error in errors], 2),
        ]
        rows.append(row)
    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 4), layout="constrained")
    steps = runs["Double DQN"][0]["step"]
    draw_curves(left, steps, estimates, "environment steps", "mean of max Q - V*")
    left.set_yscale("symlog")
    left.axhline(0, color="black", linewidth=0.8)
    figure.legend(loc="outside lower center", ncols=len(TARGETS))
    goal_1.draw_shares(right, runs)
    drawn = save_figure(figure, settings.out / "targets.png", "Over-estimation of Q")
    return f"{table(TARGET_COLUMNS, rows)}\n\n{drawn}"
