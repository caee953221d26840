"""Goal ii (section 5.2, Fig. 8): from every free cell to the given end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import goal_1
import matplotlib.pyplot as plt
import numpy as np
import torch
from figures import draw_border, draw_map, draw_share, save_figure
from numpy.typing import NDArray
from profiles import MOVE_RULE, PROFILES, START_DEAD_END
from settings import Settings, mean_and_worst, median_and_range
from tables import write_table
from trainings import Training

from ddqn_planner.grid import MOVES, legal_moves
from ddqn_planner.planning import Planner, QField
from ddqn_planner.training.encoders import PropagationEncoder
from ddqn_planner.training.environment import GridVectorEnvironment, Scenario, paper_scenario
from ddqn_planner.training.evaluation import length_ratios
from ddqn_planner.training.networks import PropagationModule

TITLE = "Goal ii: from every free cell"

COLUMNS = (
    "profile",
    "starts",
    "solved",
    "solved without action masking",
    "of the dilemma's 10",
    "mean length / optimum",
    "worst",
)


def trainings(settings: Settings) -> list[Training]:
    """Return the trainings of goal i: goal ii asks more of the same networks."""
    return goal_1.trainings(settings)


def free_starts(scenario: Scenario) -> NDArray[np.bool_]:
    """Return the free cells except start and end: (H, W) bool, the paper's 286."""
    starts = ~scenario.grid.occupancy
    for x, y in (scenario.start, scenario.goal):
        starts[y, x] = False
    return starts


def count_solved(ratios: Sequence[NDArray[np.float64]], starts: Any) -> str:
    """Return how many of the starts, an index into `length_ratios`, each seed solves."""
    return median_and_range([int(np.isfinite(ratio[starts]).sum()) for ratio in ratios])


def trained_field(planner: Planner, scenario: Scenario) -> QField:
    """Return the Q field of a propagation network as the loss trained it: with reward and γ."""
    environment = GridVectorEnvironment([scenario], MOVE_RULE, PROFILES["propagation"])
    module = PropagationModule.from_numpy(planner.network)
    cells = np.arange(scenario.grid.occupancy.size)
    states = PropagationEncoder(environment, module).states(np.zeros_like(cells), cells)
    with torch.inference_mode():
        q_CA = module(states)
    q_AHW = q_CA.T.reshape(len(MOVES), *scenario.grid.occupancy.shape).numpy()
    return QField(scenario.goal, q_AHW, legal_moves(scenario.grid.occupancy, MOVE_RULE))


def report(settings: Settings) -> str:
    """Write the table and the figure of goal ii, and return its Markdown."""
    scenario = paper_scenario()
    planners = {profile: settings.planners(f"{profile}/both") for profile in PROFILES}
    fields = {
        profile: [planner.q_field(scenario.grid, scenario.goal) for planner in of_seeds]
        for profile, of_seeds in planners.items()
    }
    fields["propagation, Q as trained"] = [
        trained_field(planner, scenario) for planner in planners["propagation"]
    ]
    ratios = {
        label: [length_ratios(field, scenario.grid, MOVE_RULE) for field in of_seeds]
        for label, of_seeds in fields.items()
    }
    rows = [[label, *_row(fields[label], ratios[label], scenario)] for label in fields]
    table = write_table(settings.out / "goal_2.csv", COLUMNS, rows)
    return f"{table}\n\n{_draw(settings, scenario, ratios)}"


def _row(
    fields: list[QField], ratios: list[NDArray[np.float64]], scenario: Scenario
) -> list[object]:
    starts = free_starts(scenario)
    x, y = np.transpose(sorted(START_DEAD_END - {scenario.start}))
    unmasked = [length_ratios(field.unmasked(), scenario.grid, MOVE_RULE) for field in fields]
    return [
        int(starts.sum()),
        count_solved(ratios, starts),
        count_solved(unmasked, starts),
        count_solved(ratios, (y, x)),
        *mean_and_worst([ratio[starts & np.isfinite(ratio)] for ratio in ratios]),
    ]


def _draw(
    settings: Settings, scenario: Scenario, ratios: dict[str, list[NDArray[np.float64]]]
) -> str:
    figure, panels = plt.subplots(1, len(PROFILES), figsize=(11, 5), layout="constrained")
    free = ~scenario.grid.occupancy
    free[scenario.goal[::-1]] = False
    for axes, profile in zip(panels, PROFILES, strict=True):
        solved = np.sum([np.isfinite(ratio) for ratio in ratios[profile]], axis=0)
        image = draw_share(axes, np.where(free, solved, np.nan), settings.seeds)
        draw_map(axes, scenario, f"profile {profile}")
        draw_border(axes, START_DEAD_END)
    label, ticks = "seeds that solve the start", range(settings.seeds + 1)
    figure.colorbar(image, ax=panels, label=label, ticks=ticks, shrink=0.8)
    return save_figure(figure, settings.out / "goal_2.png", "Fig. 8: starts by outcome")
