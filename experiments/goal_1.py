"""Goal i (section 5.1, Fig. 7) and the ablation (Fig. 6).

The robot goes from the given start to the given end.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from figures import draw_curves, draw_map, draw_path, save_figure
from numpy.typing import NDArray
from tables import median_and_range, table
from trainings import (
    MOVE_RULE,
    PROFILES,
    SCENARIO,
    Evaluations,
    Settings,
    Training,
    read_csv,
)

from ddqn_planner import MoveRule, Plan, Planner
from ddqn_planner.grid import Cell, path_length, shortest_path

# Plain Double DQN, each improvement alone, and both: what each sets.
VARIANTS: Final[dict[str, dict[str, Any]]] = {
    "plain": {"p_r": 0.0, "alpha": 0.0, "beta": 0.0},
    "initialisation": {"alpha": 0.0, "beta": 0.0},
    "reward": {"p_r": 0.0},
    "both": {},
}
TIMES = 50  # how often each planner is timed
BINS = 50  # intervals of the curves of the average reward

CONVERGENCE = (
    "seeds solved (without action masking) | steps until solved for good | "
    "steps until shortest for good | length"
)


def trainings(
    settings: Settings, variants: Sequence[str] = ("both",)
) -> list[Training]:
    """Return the trainings of both profiles on the paper's map.

    Their names are "profile/variant".
    """
    parameters_of = {
        f"{profile}/{name}": replace(parameters, **VARIANTS[name])
        for profile, parameters in PROFILES.items()
        for name in variants
    }
    return settings.trainings(parameters_of, [SCENARIO])


def convergence_row(runs: Sequence[Evaluations]) -> list[str]:
    """Return the cells of `CONVERGENCE` for the evaluations of each seed."""
    optimum = path_length(
        shortest_path(SCENARIO.grid, SCENARIO.start, SCENARIO.goal, MOVE_RULE)
    )
    last_evaluations = [run[-1] for run in runs]
    n_solved = sum(int(last["solved"]) for last in last_evaluations)
    n_unmasked = sum(int(last["solved_unmasked"]) for last in last_evaluations)
    steps_to_solved = [first_step_for_good(run, run["solved"] == 1) for run in runs]
    steps_to_shortest = [
        first_step_for_good(run, run["length"] <= optimum + 1e-6) for run in runs
    ]
    lengths = [last["length"] for last in last_evaluations if last["solved"]]
    return [
        f"{n_solved} ({n_unmasked}) of {len(runs)}",
        median_and_range(steps_to_solved),
        median_and_range(steps_to_shortest),
        median_and_range(lengths, 2),
    ]


def first_step_for_good(run: Evaluations, holds: NDArray[np.bool_]) -> float:
    """Return the step from which on a condition holds; infinity if it never does.

    The array has a truth value for each evaluation of the run.
    """
    if holds.all():
        return float(run["step"][0])
    last_failure = int(np.flatnonzero(~holds)[-1])
    if last_failure == len(holds) - 1:
        return np.inf
    return float(run["step"][last_failure + 1])


def report(settings: Settings) -> str:
    """Return the tables of goal i, and write its figure."""
    rows = []
    paths: dict[str, Sequence[Cell]] = {}
    for profile in PROFILES:
        runs = settings.evaluations(f"{profile}/both")
        timed_plans = [
            timed_plan(planner) for planner in settings.planners(f"{profile}/both")
        ]
        milliseconds = median_and_range(
            [timed.milliseconds for timed in timed_plans], 1
        )
        rows.append([profile, *convergence_row(runs), milliseconds])
        plans = [timed.plan for timed in timed_plans]
        plans.sort(key=lambda plan: plan.length or np.inf)  # without a path last
        paths[f"{profile}, median seed"] = plans[len(plans) // 2].cells
    for rule in (MoveRule.CORNER_CUTTING, MoveRule.ROBOT_SAFE):
        shortest = shortest_path(SCENARIO.grid, SCENARIO.start, SCENARIO.goal, rule)
        paths[f"shortest, {rule.value}"] = shortest
    figure = draw_paths(paths)
    caption = "As the paper's Fig. 7: the paths of goal i"
    markdown = save_figure(figure, settings.out / "goal_1.png", caption)
    return f"{table(f'profile | {CONVERGENCE} | planning, ms', rows)}\n\n{markdown}"


def draw_paths(paths: dict[str, Sequence[Cell]]) -> Any:
    """Draw each path on a map of its own, with its length."""
    figure, panels = plt.subplots(
        1, len(paths), figsize=(15, 4.2), layout="constrained"
    )
    for number, (axes, name) in enumerate(zip(panels, paths, strict=True)):
        cells = paths[name]
        length = f"{path_length(cells):.2f} cells" if cells else "trapped"
        draw_map(axes, SCENARIO, f"{name}: {length}")
        draw_path(axes, cells, number, name)
    return figure


class TimedPlan(NamedTuple):
    """A plan, and the median of the times that it took."""

    plan: Plan
    milliseconds: float


def timed_plan(planner: Planner) -> TimedPlan:
    """Return a planner's plan and its time, which includes a new field."""
    times = []
    for _ in range(TIMES):
        began = time.perf_counter()
        new_planner = Planner(planner.network, planner.metadata)  # without a Q field
        plan = new_planner.plan(SCENARIO.grid, SCENARIO.start, SCENARIO.goal)
        times.append(1e3 * (time.perf_counter() - began))
    return TimedPlan(plan, float(np.median(times)))


def ablation_report(settings: Settings) -> str:
    """Return the table of the ablation, and write its curves."""
    rows = []
    figure, panels = plt.subplots(
        2, len(PROFILES), figsize=(13, 7.5), layout="constrained"
    )
    for (upper, lower), profile in zip(panels.T, PROFILES, strict=True):
        names = {variant: f"{profile}/{variant}" for variant in VARIANTS}
        runs = {variant: settings.evaluations(name) for variant, name in names.items()}
        for variant, runs_of_variant in runs.items():
            rows.append([profile, variant, *convergence_row(runs_of_variant)])
        last_step = runs["both"][0]["step"][-1]
        edges = np.linspace(0, last_step, BINS + 1)
        middle = (edges[:-1] + edges[1:]) / 2
        rewards = {
            variant: mean_rewards(settings.folders(name), edges)
            for variant, name in names.items()
        }
        draw_curves(
            upper, middle, rewards, "environment steps", "average reward per step"
        )
        draw_shares(lower, runs)
        upper.set_title(f"profile {profile}", loc="left")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(VARIANTS))
    caption = "As the paper's Fig. 6: average reward per step, and solved seeds"
    markdown = save_figure(figure, settings.out / "ablation.png", caption)
    return f"{table(f'profile | variant | {CONVERGENCE}', rows)}\n\n{markdown}"


def draw_shares(axes: Any, runs: dict[str, list[Evaluations]]) -> None:
    """Draw the share of the seeds that are solved from the start, over the steps."""
    shares = {}
    for name, seeds in runs.items():
        share = np.mean([run["solved"] for run in seeds], axis=0)
        shares[name] = [share]
    steps = next(iter(runs.values()))[0]["step"]
    draw_curves(
        axes, steps, shares, "environment steps", "share of seeds solved from the start"
    )
    axes.set_ylim(-0.05, 1.05)


def mean_rewards(
    folders: Sequence[Path], edges: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Return each seed's mean reward of the episodes that ended in each interval.

    NaN where no episode ended.
    """
    seeds = []
    for folder in folders:
        rows = read_csv(folder / "episodes.csv")
        total, _ = np.histogram(rows["step"], edges, weights=rows["average_reward"])
        count, _ = np.histogram(rows["step"], edges)
        mean = total / np.maximum(count, 1)
        seeds.append(np.where(count > 0, mean, np.nan))
    return seeds
