"""What the printed target does: the paper's equation leaves θ⁻ out."""

from __future__ import annotations

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from ddqn_planner.benchmarks.evaluation import length_ratios
from ddqn_planner.experiments import goal_1
from ddqn_planner.experiments.figures import draw_curves, save
from ddqn_planner.experiments.goal_2 import free_starts, planned_field
from ddqn_planner.experiments.profiles import MOVE_RULE
from ddqn_planner.experiments.report import Settings, evaluation_curve, share_curve, spread
from ddqn_planner.experiments.tables import table
from ddqn_planner.experiments.trainings import Training
from ddqn_planner.files import write_csv
from ddqn_planner.training.environment import paper_scenario

TITLE = "What the printed target does"

TARGETS = {"double_dqn": "Double DQN", "dqn": "DQN", "printed": "printed"}

COLUMNS = ("seeds solved from the start", "starts solved", "over-estimation, last 10 %", "worst")


def name(target: str) -> str:
    """Return the name of the trainings with a target; Double DQN's are those of goal i."""
    return goal_1.name("paper") if target == "double_dqn" else f"paper/target_{target}"


def trainings(settings: Settings) -> list[Training]:
    """Return the trainings of the profile paper with each target."""
    return [
        training
        for target in TARGETS
        for training in settings.trainings(
            name(target), replace(settings.profile("paper"), target=target), [paper_scenario()]
        )
    ]


def report(settings: Settings) -> str:
    """Write the table and the figure of the targets, and return its Markdown."""
    scenario = paper_scenario()
    starts = free_starts(scenario)
    rows = []
    for target, words in TARGETS.items():
        runs = settings.evaluations(name(target))
        fields = [planned_field(p, scenario) for p in settings.planners(name(target))]
        ratios = [length_ratios(field, scenario.grid, MOVE_RULE)[starts] for field in fields]
        late = [[e.overestimation for e in run[-max(len(run) // 10, 1) :]] for run in runs]
        rows.append(
            [
                words,
                f"{sum(run[-1].solved for run in runs)} of {len(runs)}",
                spread([int(np.isfinite(ratio).sum()) for ratio in ratios]),
                spread([float(np.mean(values)) for values in late], 2),
                spread([max(e.overestimation for e in run) for run in runs], 2),
            ]
        )
    write_csv(settings.out / "targets.csv", ["target", *COLUMNS], rows)
    _draw(settings)
    return f"{table(['target', *COLUMNS], rows)}\n\n![Over-estimation of Q](targets.png)"


def _draw(settings: Settings) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 4), layout="constrained")
    runs = {words: settings.evaluations(name(target)) for target, words in TARGETS.items()}
    estimates = {words: evaluation_curve(r, "overestimation") for words, r in runs.items()}
    draw_curves(left, estimates, "mean of max Q - V*")
    left.set_yscale("symlog")
    left.axhline(0, color="black", linewidth=0.8)
    figure.legend(loc="outside lower center", ncols=len(TARGETS))
    shares = {words: share_curve(r) for words, r in runs.items()}
    draw_curves(right, shares, "share of seeds solved from the start")
    save(figure, settings.out / "targets.png")
