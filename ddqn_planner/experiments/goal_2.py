"""Goal ii (section 5.2, Fig. 8): from every free cell to the given end."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import torch
from numpy.typing import NDArray

from ddqn_planner.experiments import goal_1
from ddqn_planner.experiments.figures import draw_border, draw_map, draw_share, save
from ddqn_planner.experiments.profiles import MOVE_RULE, PROFILES, START_DEAD_END
from ddqn_planner.experiments.report import Settings, mean, spread, worst
from ddqn_planner.experiments.tables import table
from ddqn_planner.experiments.trainings import Training
from ddqn_planner.files import write_csv
from ddqn_planner.grid import MOVES, legal_moves
from ddqn_planner.planning import Planner
from ddqn_planner.planning.evaluation import length_ratios
from ddqn_planner.planning.q_field import QField
from ddqn_planner.training.encoders import PropagationEncoder
from ddqn_planner.training.environment import GridVectorEnvironment, Scenario, paper_scenario
from ddqn_planner.training.networks import PropagationModule

TITLE = "Goal ii: from every free cell"

COLUMNS = (
    "starts",
    "solved",
    "solved, any move",
    "of the dilemma's 10",
    "mean length / optimum",
    "worst",
)


def trainings(settings: Settings) -> list[Training]:
    """Return the trainings of goal i: goal ii asks more of the same networks."""
    return goal_1.trainings(settings)


def free_starts(scenario: Scenario) -> NDArray[np.bool_]:
    """Return the free cells besides start and end: (H, W) bool, the paper's 286."""
    starts = ~scenario.grid.occupancy
    for x, y in (scenario.start, scenario.goal):
        starts[y, x] = False
    return starts


def planned_field(planner: Planner, scenario: Scenario) -> QField:
    """Return the Q field that the planner walks in."""
    return planner.q_field(scenario.grid, scenario.goal)


def trained_field(planner: Planner, scenario: Scenario) -> QField:
    """Return the Q field of a propagation network as the loss trained it: with reward and γ."""
    environment = GridVectorEnvironment([scenario], MOVE_RULE, PROFILES["best"])
    encoder = PropagationEncoder(environment)
    module = PropagationModule.from_numpy(planner.network)
    encoder.update_target(module)
    cells = np.arange(scenario.grid.occupancy.size)
    with torch.inference_mode():
        q_CA = encoder.q(module, encoder.states(np.zeros_like(cells), cells))
    q_AHW = q_CA.T.reshape(len(MOVES), *scenario.grid.occupancy.shape).numpy()
    return QField(scenario.goal, q_AHW, legal_moves(scenario.grid.occupancy, MOVE_RULE))


def report(settings: Settings) -> str:
    """Write the table and the figure of goal ii, and return its Markdown."""
    scenario = paper_scenario()
    fields = {
        label: [field(planner, scenario) for planner in settings.planners(goal_1.name(profile))]
        for label, profile, field in (
            ("paper", "paper", planned_field),
            ("best", "best", planned_field),
            ("best, Q as trained", "best", trained_field),
        )
    }
    ratios = {
        label: [length_ratios(field, scenario.grid, MOVE_RULE) for field in of_seeds]
        for label, of_seeds in fields.items()
    }
    rows = [[label, *_row(fields[label], ratios[label], scenario)] for label in fields]
    write_csv(settings.out / "goal_2.csv", ["profile", *COLUMNS], rows)
    _draw(settings, scenario, {profile: ratios[profile] for profile in PROFILES})
    return f"{table(['profile', *COLUMNS], rows)}\n\n![Fig. 8: starts by outcome](goal_2.png)"


def _row(
    fields: list[QField], ratios: list[NDArray[np.float64]], scenario: Scenario
) -> list[object]:
    starts = free_starts(scenario)
    x, y = np.transpose(sorted(START_DEAD_END - {scenario.start}))
    unmasked = [length_ratios(field.unmasked(), scenario.grid, MOVE_RULE) for field in fields]
    lengths = [ratio[starts & np.isfinite(ratio)] for ratio in ratios]
    return [
        int(starts.sum()),
        spread([len(of_seed) for of_seed in lengths]),
        spread([int(np.isfinite(ratio[starts]).sum()) for ratio in unmasked]),
        spread([int(np.isfinite(ratio[y, x]).sum()) for ratio in ratios]),
        spread([mean(of_seed) for of_seed in lengths], 4),
        spread([worst(of_seed) for of_seed in lengths], 4),
    ]


def _draw(
    settings: Settings, scenario: Scenario, ratios: dict[str, list[NDArray[np.float64]]]
) -> None:
    figure, panels = plt.subplots(1, len(ratios), figsize=(11, 5), layout="constrained")
    for axes, (profile, of_seeds) in zip(panels, ratios.items(), strict=True):
        solved = np.sum([np.isfinite(ratio) for ratio in of_seeds], axis=0)
        free = ~scenario.grid.occupancy
        free[scenario.goal[::-1]] = False
        image = draw_share(axes, np.where(free, solved, np.nan), settings.seeds)
        draw_map(axes, scenario, f"profile {profile}")
        draw_border(axes, START_DEAD_END)
    figure.colorbar(
        image,
        ax=panels,
        label="seeds that solve the start",
        ticks=range(settings.seeds + 1),
        shrink=0.8,
    )
    save(figure, settings.out / "goal_2.png")
