"""Goal i (section 5.1, Fig. 7) and the ablation (Fig. 6): from the given start to the given end."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from figures import draw_curves, draw_map, draw_path, save_figure
from numpy.typing import NDArray
from settings import PROFILES, VARIANTS, Settings, optimal_length
from tables import median_and_range, table, write_table
from trainings import Evaluations, Training

from ddqn_planner.grid import Cell, MoveRule, legal_moves, path_length
from ddqn_planner.planning import Planner
from ddqn_planner.planning.search import search
from ddqn_planner.training.environment import Scenario, paper_scenario

TIMES = 50
"""How often each planner is timed."""

BINS = 50
"""Intervals of the curves of the average reward."""

CONVERGENCE = (
    "seeds solved at the end (without action masking)",
    "steps until solved for good",
    "episodes",
    "seconds",
    "steps until shortest for good",
    "final length",
)


def trainings(settings: Settings, variants: Sequence[str] = ("both",)) -> list[Training]:
    """Return the trainings of both profiles on the paper's map, by the name "profile/variant"."""
    parameters_of = {
        f"{profile}/{name}": replace(parameters, **VARIANTS[name])
        for profile, parameters in PROFILES.items()
        for name in variants
    }
    return settings.trainings(parameters_of, [paper_scenario()])


def ablation_trainings(settings: Settings) -> list[Training]:
    """Return the trainings of every variant: plain Double DQN, each improvement alone, both."""
    return trainings(settings, tuple(VARIANTS))


def convergence_row(runs: Sequence[Evaluations]) -> list[str]:
    """Return the cells of `CONVERGENCE` for the evaluations of each seed."""
    optimum = optimal_length(paper_scenario())
    reached = [first_kept(run["solved"] == 1) for run in runs]
    shortest = [first_kept(run["length"] <= optimum + 1e-6) for run in runs]

    def column(name: str, first: Sequence[int | None], digits: int = 0) -> str:
        at = [np.inf if n is None else run[name][n] for run, n in zip(runs, first, strict=True)]
        return median_and_range(at, digits)

    ends = [run[-1] for run in runs]
    solved, unmasked = (sum(int(end[key]) for end in ends) for key in ("solved", "solved_unmasked"))
    return [
        f"{solved} ({unmasked}) of {len(ends)}",
        column("step", reached),
        column("episodes", reached),
        column("seconds", reached, 1),
        column("step", shortest),
        median_and_range([end["length"] for end in ends if end["solved"]], 2),
    ]


def first_kept(holds: NDArray[np.bool_]) -> int | None:
    """Return the place from which on a condition holds to the end; None if there is none."""
    first = int(np.flatnonzero(~holds)[-1]) + 1 if not holds.all() else 0
    return first if first < len(holds) else None


def report(settings: Settings) -> str:
    """Write the tables and the figure of goal i, and return its Markdown."""
    runs = {profile: settings.evaluations(f"{profile}/both") for profile in PROFILES}
    convergence = [[profile, *convergence_row(runs[profile])] for profile in PROFILES]
    speeds = [[profile, *_speeds(profile, runs[profile])] for profile in PROFILES]
    scenario = paper_scenario()
    paths, times = _paths_and_times(settings, scenario)
    figure, panels = plt.subplots(1, len(paths), figsize=(15, 4.2), layout="constrained")
    for number, (axes, (planner, cells)) in enumerate(zip(panels, paths.items(), strict=True)):
        length = f"{path_length(cells):.2f} cells" if cells else "trapped"
        draw_map(axes, scenario, f"{planner}: {length}")
        draw_path(axes, cells, number, planner)
    header = ["planner", "length, cells", "planning time, ms"]
    return "\n\n".join(
        [
            write_table(settings.out / "goal_1.csv", ["profile", *CONVERGENCE], convergence),
            table(["profile", "steps/s", "updates/s", "replay ratio"], speeds),
            write_table(settings.out / "goal_1_planning.csv", header, times),
            save_figure(figure, settings.out / "goal_1.png", "Fig. 7: the paths of goal i"),
        ]
    )


def _speeds(profile: str, runs: Sequence[Evaluations]) -> list[str]:
    ends, batch = [run[-1] for run in runs], PROFILES[profile].batch_size
    return [
        median_and_range([end["step"] / end["seconds"] for end in ends]),
        median_and_range([end["updates"] / end["seconds"] for end in ends]),
        median_and_range([batch * end["updates"] / end["step"] for end in ends], 1),
    ]


def _paths_and_times(
    settings: Settings, scenario: Scenario
) -> tuple[dict[str, Sequence[Cell]], list[list[str]]]:
    """Return the path of each planner, and a row of length and planning time for each."""
    paths: dict[str, Sequence[Cell]] = {}
    rows = []
    for profile in PROFILES:
        plans, seconds = zip(
            *(timed_plan(planner, scenario) for planner in settings.planners(f"{profile}/both")),
            strict=True,
        )
        lengths = [path_length(cells) if cells else np.inf for cells in plans]
        paths[f"{profile}, median seed"] = plans[int(np.argsort(lengths)[len(lengths) // 2])]
        length = median_and_range([n for n in lengths if np.isfinite(n)], 2)
        rows.append([profile, length, median_and_range([1e3 * s for s in seconds], 2)])
    for rule in (MoveRule.CORNER_CUTTING, MoveRule.ROBOT_SAFE):
        cells, s = _timed(partial(a_star, scenario, rule))
        paths[f"A*, {rule.value}"] = cells
        rows.append([f"A*, {rule.value}", f"{path_length(cells):.2f}", f"{1e3 * s:.2f}"])
    return paths, rows


def timed_plan(planner: Planner, scenario: Scenario) -> tuple[Sequence[Cell], float]:
    """Return a planner's path, and the median of its times with a new field, seconds."""
    request = scenario.grid, scenario.start, scenario.goal
    # A new planner has no Q field yet.
    return _timed(lambda: Planner(planner.network, planner.metadata).plan(*request).cells)


def _timed(plan: Callable[[], Sequence[Cell]]) -> tuple[Sequence[Cell], float]:
    """Return a path, and the median of the times that it took, seconds."""
    seconds = []
    for _ in range(TIMES):
        began = time.perf_counter()
        cells = plan()
        seconds.append(time.perf_counter() - began)
    return cells, float(np.median(seconds))


def a_star(scenario: Scenario, move_rule: MoveRule) -> Sequence[Cell]:
    """Return a shortest path by A* with the octile distance to the goal as its heuristic."""
    grid, (goal_x, goal_y) = scenario.grid, scenario.goal
    y, x = np.indices(grid.occupancy.shape)
    dx, dy = np.abs(x - goal_x), np.abs(y - goal_y)
    octile = np.maximum(dx, dy) + (move_rule.lengths[1] - 1) * np.minimum(dx, dy)
    value, legal = -octile.astype(np.float32), legal_moves(grid.occupancy, move_rule)
    return search(scenario.start, scenario.goal, legal, grid.cost_multiplier, move_rule, value)


def ablation_report(settings: Settings) -> str:
    """Write the table and the curves of the ablation, and return its Markdown."""
    rows = []
    figure, panels = plt.subplots(2, len(PROFILES), figsize=(13, 7.5), layout="constrained")
    for (upper, lower), (profile, parameters) in zip(panels.T, PROFILES.items(), strict=True):
        runs = {variant: settings.evaluations(f"{profile}/{variant}") for variant in VARIANTS}
        rows += [[profile, variant, *convergence_row(of)] for variant, of in runs.items()]
        edges = np.linspace(0, settings.shorten(parameters).steps, BINS + 1)
        rewards = {v: _rewards(settings, f"{profile}/{v}", edges) for v in VARIANTS}
        middle = (edges[:-1] + edges[1:]) / 2
        draw_curves(upper, middle, rewards, "environment steps", "average reward per step")
        draw_shares(lower, runs)
        upper.set_title(f"profile {profile}", loc="left")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(VARIANTS))
    caption = "Fig. 6: average reward per step of an episode, and solved seeds"
    header = ["profile", "variant", *CONVERGENCE]
    table = write_table(settings.out / "ablation.csv", header, rows)
    return f"{table}\n\n{save_figure(figure, settings.out / 'ablation.png', caption)}"


def draw_shares(axes: Any, runs: dict[str, list[Evaluations]]) -> None:
    """Draw the share of the seeds that are solved from the start, over the steps."""
    steps = next(iter(runs.values()))[0]["step"]
    shares = {name: [np.mean([run["solved"] for run in of], axis=0)] for name, of in runs.items()}
    draw_curves(axes, steps, shares, "environment steps", "share of seeds solved from the start")
    axes.set_ylim(-0.05, 1.05)


def _rewards(
    settings: Settings, name: str, edges: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Return each seed's mean reward of the episodes that ended in each interval."""
    seeds = []
    for folder in settings.folders(name):
        path = folder / "episodes.csv"
        rows = np.genfromtxt(path, delimiter=",", names=True, ndmin=1, encoding="utf-8")
        total, _ = np.histogram(rows["step"], edges, weights=rows["average_reward"])
        count, _ = np.histogram(rows["step"], edges)
        seeds.append(np.where(count > 0, total / np.maximum(count, 1), np.nan))
    return seeds
