"""What the printed target does: the paper's equation leaves θ⁻ out."""

from __future__ import annotations

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from figures import draw_curves, evaluation_curve, save_figure, share_curve
from goal_2 import count_solved, free_starts
from profiles import MOVE_RULE, PROFILES
from settings import Settings, median_and_range
from tables import write_table
from trainings import Training

from ddqn_planner.training.environment import paper_scenario
from ddqn_planner.training.evaluation import length_ratios

TITLE = "What the printed target does"

TARGETS = {
    "double_dqn": ("Double DQN", "paper/both"),
    "dqn": ("DQN", "paper/target_dqn"),
    "printed": ("printed", "paper/target_printed"),
}
"""Label and name of the trainings with each target; Double DQN's are those of goal i."""

COLUMNS = (
    "target",
    "seeds solved from the start",
    "starts solved",
    "over-estimation, last 10 %",
    "worst",
)


def trainings(settings: Settings) -> list[Training]:
    """Return the trainings of the profile paper with each target."""
    paper = PROFILES["paper"]
    parameters_of = {name: replace(paper, target=target) for target, (_, name) in TARGETS.items()}
    return settings.trainings(parameters_of, [paper_scenario()])


def report(settings: Settings) -> str:
    """Write the table and the figure of the targets, and return its Markdown."""
    scenario = paper_scenario()
    starts = free_starts(scenario)
    rows = []
    for label, name in TARGETS.values():
        runs = settings.evaluations(name)
        fields = [p.q_field(scenario.grid, scenario.goal) for p in settings.planners(name)]
        ratios = [length_ratios(field, scenario.grid, MOVE_RULE) for field in fields]
        late = [[e.overestimation for e in run[-max(len(run) // 10, 1) :]] for run in runs]
        rows.append(
            [
                label,
                f"{sum(run[-1].solved for run in runs)} of {len(runs)}",
                count_solved(ratios, starts),
                median_and_range([float(np.mean(values)) for values in late], 2),
                median_and_range([max(e.overestimation for e in run) for run in runs], 2),
            ]
        )
    return f"{write_table(settings.out / 'targets.csv', COLUMNS, rows)}\n\n{_draw(settings)}"


def _draw(settings: Settings) -> str:
    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 4), layout="constrained")
    runs = {label: settings.evaluations(name) for label, name in TARGETS.values()}
    estimates = {label: evaluation_curve(r, "overestimation") for label, r in runs.items()}
    draw_curves(left, estimates, "mean of max Q - V*")
    left.set_yscale("symlog")
    left.axhline(0, color="black", linewidth=0.8)
    figure.legend(loc="outside lower center", ncols=len(TARGETS))
    shares = {label: share_curve(r) for label, r in runs.items()}
    draw_curves(right, shares, "share of seeds solved from the start")
    return save_figure(figure, settings.out / "targets.png", "Over-estimation of Q")
