"""The ablation (Fig. 6): plain Double DQN, each improvement alone, both."""

from __future__ import annotations

import csv

import goal_1
import matplotlib.pyplot as plt
import numpy as np
from figures import Curve, draw_curves, save_figure, share_curve
from profiles import PROFILES, VARIANTS
from settings import Settings
from tables import write_table
from trainings import Training

TITLE = "Goal i: the ablation"

BINS = 50
"""Intervals of the curves of the average reward."""


def trainings(settings: Settings) -> list[Training]:
    """Return the trainings of every variant of both profiles."""
    return goal_1.trainings(settings, tuple(VARIANTS))


def report(settings: Settings) -> str:
    """Write the table and the curves of the ablation, and return its Markdown."""
    rows = [
        [profile, variant, *goal_1.convergence_row(settings.evaluations(f"{profile}/{variant}"))]
        for profile in PROFILES
        for variant in VARIANTS
    ]
    header = ["profile", "variant", *goal_1.CONVERGENCE]
    return f"{write_table(settings.out / 'ablation.csv', header, rows)}\n\n{_draw(settings)}"


def _draw(settings: Settings) -> str:
    figure, panels = plt.subplots(2, len(PROFILES), figsize=(13, 7.5), layout="constrained")
    for column, profile in enumerate(PROFILES):
        names = {variant: f"{profile}/{variant}" for variant in VARIANTS}
        steps = settings.shorten(PROFILES[profile]).steps
        rewards = {v: _reward_curve(settings, name, steps) for v, name in names.items()}
        solved = {v: share_curve(settings.evaluations(name)) for v, name in names.items()}
        draw_curves(panels[0, column], rewards, "average reward per step of an episode")
        draw_curves(panels[1, column], solved, "share of seeds solved from the start")
        panels[0, column].set_title(f"profile {profile}", loc="left")
        panels[1, column].set_ylim(-0.05, 1.05)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(VARIANTS))
    caption = "Fig. 6: average reward per step, and solved seeds"
    return save_figure(figure, settings.out / "ablation.png", caption)


def _reward_curve(settings: Settings, name: str, steps: int) -> Curve:
    """Return the mean over the episodes that ended in each interval, for each seed."""
    edges = np.linspace(0, steps, BINS + 1)
    seeds = []
    for folder in settings.folders(name):
        with (folder / "episodes.csv").open(newline="", encoding="utf-8") as file:
            rows = [(int(r["step"]), float(r["average_reward"])) for r in csv.DictReader(file)]
        step, reward = np.array(rows, dtype=np.float64).reshape(-1, 2).T
        total, _ = np.histogram(step, edges, weights=reward)
        count, _ = np.histogram(step, edges)
        seeds.append(np.where(count > 0, total / np.maximum(count, 1), np.nan))
    return (edges[:-1] + edges[1:]) / 2, np.array(seeds)
