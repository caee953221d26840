"""The ablation (Fig. 6): plain Double DQN, each improvement alone, both."""

from __future__ import annotations

import csv

import matplotlib.pyplot as plt
import numpy as np

from ddqn_planner.experiments import goal_1
from ddqn_planner.experiments.figures import Curve, draw_curves, save
from ddqn_planner.experiments.profiles import PROFILES, VARIANTS
from ddqn_planner.experiments.report import Settings, share_curve
from ddqn_planner.experiments.tables import table
from ddqn_planner.experiments.trainings import Training
from ddqn_planner.files import write_csv

TITLE = "Goal i: the ablation"

BINS = 50
"""Intervals of the curves of the average reward."""


def trainings(settings: Settings) -> list[Training]:
    """Return the trainings of every variant of both profiles."""
    return goal_1.trainings(settings, tuple(VARIANTS))


def report(settings: Settings) -> str:
    """Write the table and the curves of the ablation, and return its Markdown."""
    rows = []
    for profile in PROFILES:
        for of_variant in VARIANTS:
            evaluations = settings.evaluations(goal_1.name(profile, of_variant))
            rows.append([profile, of_variant, *goal_1.convergence_row(evaluations)])
    header = ["profile", "variant", *goal_1.CONVERGENCE]
    write_csv(settings.out / "ablation.csv", header, rows)
    _draw(settings)
    return (
        f"{table(header, rows)}\n\n![Fig. 6: average reward a step, and solved seeds](ablation.png)"
    )


def _draw(settings: Settings) -> None:
    figure, panels = plt.subplots(2, len(PROFILES), figsize=(13, 7.5), layout="constrained")
    for column, profile in enumerate(PROFILES):
        rewards = {v: _reward_curve(settings, profile, v) for v in VARIANTS}
        solved = {v: share_curve(settings.evaluations(goal_1.name(profile, v))) for v in VARIANTS}
        draw_curves(panels[0, column], rewards, "average reward a step of an episode")
        draw_curves(panels[1, column], solved, "share of seeds solved from the start")
        panels[0, column].set_title(f"profile {profile}", loc="left")
        panels[1, column].set_ylim(-0.05, 1.05)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(VARIANTS))
    save(figure, settings.out / "ablation.png")


def _reward_curve(settings: Settings, profile: str, of_variant: str) -> Curve:
    """Return the mean over the episodes that ended in each interval, for each seed."""
    edges = np.linspace(0, settings.profile(profile).steps, BINS + 1)
    seeds = []
    for folder in settings.folders(goal_1.name(profile, of_variant)):
        with (folder / "episodes.csv").open(newline="", encoding="utf-8") as file:
            rows = [(int(r["step"]), float(r["average_reward"])) for r in csv.DictReader(file)]
        steps, rewards = np.array(rows, dtype=np.float64).reshape(-1, 2).T
        total, _ = np.histogram(steps, edges, weights=rewards)
        count, _ = np.histogram(steps, edges)
        seeds.append(np.where(count > 0, total / np.maximum(count, 1), np.nan))
    return (edges[:-1] + edges[1:]) / 2, np.array(seeds)
