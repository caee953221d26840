"""Goal i (section 5.1, Fig. 7) and the ablation (Fig. 6).

The robot goes from the given start to the given end.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

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
    shortest_one = shortest_path(
        SCENARIO.grid, SCENARIO.start, SCENARIO.goal, MOVE_RULE
    )
    optimum, ends = path_length(shortest_one), [run[-1] for run in runs]
    solved, unmasked = (
        sum(int(end[key]) for end in ends) for key in ("solved", "solved_unmasked")
    )
    shortest = [first_kept(run, run["length"] <= optimum + 1e-6) for run in runs]
    return [
        f"{solved} ({unmasked}) of {len(ends)}",
        median_and_range([first_kept(run, run["solved"] == 1) for run in runs]),
        median_and_range(shortest),
        median_and_range([end["length"] for end in ends if end["solved"]], 2),
    ]


def first_kept(run: Evaluations, holds: NDArray[np.bool_]) -> float:
    """Return the step from which on a condition holds; infinity if it never does."""
    first = int(np.flatnonzero(~holds)[-1]) + 1 if not holds.all() else 0
    return float(run["step"][first]) if first < len(holds) else np.inf


def report(settings: Settings) -> str:
    """Return the tables of goal i, and write its figure."""
    rows = []
    paths: dict[str, Sequence[Cell]] = {}
    for profile in PROFILES:
        runs = settings.evaluations(f"{profile}/both")
        planned = [timed_plan(p) for p in settings.planners(f"{profile}/both")]
        milliseconds = median_and_range([took for _, took in planned], 1)
        rows.append([profile, *convergence_row(runs), milliseconds])
        by_length = sorted(
            (plan for plan, _ in planned), key=lambda p: p.length or np.inf
        )
        paths[f"{profile}, median seed"] = by_length[len(planned) // 2].cells
    for rule in (MoveRule.CORNER_CUTTING, MoveRule.ROBOT_SAFE):
        shortest = shortest_path(SCENARIO.grid, SCENARIO.start, SCENARIO.goal, rule)
        paths[f"shortest, {rule.value}"] = shortest
    figure, panels = plt.subplots(
        1, len(paths), figsize=(15, 4.2), layout="constrained"
    )
    for number, (axes, (planner, cells)) in enumerate(
        zip(panels, paths.items(), strict=True)
    ):
        length = f"{path_length(cells):.2f} cells" if cells else "trapped"
        draw_map(axes, SCENARIO, f"{planner}: {length}")
        draw_path(axes, cells, number, planner)
    drawn = save_figure(
        figure,
        settings.out / "goal_1.png",
        "As the paper's Fig. 7: the paths of goal i",
    )
    return f"{table(f'profile | {CONVERGENCE} | planning, ms', rows)}\n\n{drawn}"


def timed_plan(planner: Planner) -> tuple[Plan, float]:
    """Return a planner's plan, and the median of its times, milliseconds.

    Each time includes a new field.
    """
    times = []
    for _ in range(TIMES):
        began = time.perf_counter()
        fresh = Planner(planner.network, planner.metadata)  # it has no Q field yet
        plan = fresh.plan(SCENARIO.grid, SCENARIO.start, SCENARIO.goal)
        times.append(1e3 * (time.perf_counter() - began))
    return plan, float(np.median(times))


def ablation_report(settings: Settings) -> str:
    """Return the table of the ablation, and write its curves."""
    rows = []
    figure, panels = plt.subplots(
        2, len(PROFILES), figsize=(13, 7.5), layout="constrained"
    )
    for (upper, lower), profile in zip(panels.T, PROFILES, strict=True):
        runs = {
            variant: settings.evaluations(f"{profile}/{variant}")
            for variant in VARIANTS
        }
        rows += [
            [profile, variant, *convergence_row(of)] for variant, of in runs.items()
        ]
        edges = np.linspace(0, runs["both"][0]["step"][-1], BINS + 1)
        rewards = {
            v: _rewards(settings.folders(f"{profile}/{v}"), edges) for v in VARIANTS
        }
        middle = (edges[:-1] + edges[1:]) / 2
        draw_curves(
            upper, middle, rewards, "environment steps", "average reward per step"
        )
        draw_shares(lower, runs)
        upper.set_title(f"profile {profile}", loc="left")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(VARIANTS))
    caption = "As the paper's Fig. 6: average reward per step, and solved seeds"
    drawn = save_figure(figure, settings.out / "ablation.png", caption)
    return f"{table(f'profile | variant | {CONVERGENCE}', rows)}\n\n{drawn}"


def draw_shares(axes: Any, runs: dict[str, list[Evaluations]]) -> None:
    """Draw the share of the seeds that are solved from the start, over the steps."""
    steps = next(iter(runs.values()))[0]["step"]
    shares = {
        name: [np.mean([run["solved"] for run in of], axis=0)]
        for name, of in runs.items()
    }
    draw_curves(
        axes, steps, shares, "environment steps", "share of seeds solved from the start"
    )
    axes.set_ylim(-0.05, 1.05)


def _rewards(folders: Sequence[Path], edges: NDArray[Any]) -> list[NDArray[Any]]:
    """Return each seed's mean reward of the episodes that ended in each interval."""
    seeds = []
    for folder in folders:
        rows = read_csv(folder / "episodes.csv")
        total, _ = np.histogram(rows["step"], edges, weights=rows["average_reward"])
        count, _ = np.histogram(rows["step"], edges)
        seeds.append(np.where(count > 0, total / np.maximum(count, 1), np.nan))
    return seeds
