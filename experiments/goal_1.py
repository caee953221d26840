"""Goal i (section 5.1, Fig. 7): from the given start to the given end, compared with A*."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import matplotlib.pyplot as plt
import numpy as np
from figures import draw_map, draw_path, save_figure
from profiles import PROFILES, VARIANTS
from settings import Settings, first_kept, median_and_range, optimal_length
from tables import table, write_table
from trainings import Training, TrainingEvaluation

from ddqn_planner.grid import Cell, MoveRule, legal_moves, path_length
from ddqn_planner.planning import Planner
from ddqn_planner.planning.search import search
from ddqn_planner.training.environment import Scenario, paper_scenario

TITLE = "Goal i: from the given start"

TIMES = 50
"""How often each planner is timed."""

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


def convergence_row(runs: Sequence[Sequence[TrainingEvaluation]]) -> list[str]:
    """Return the cells of `CONVERGENCE` for the evaluations of each seed."""
    optimum = optimal_length(paper_scenario())
    ends = [run[-1] for run in runs]
    reached = [first_kept(run, lambda e: e.solved == 1) for run in runs]
    shortest = [first_kept(run, lambda e: e.length <= optimum + 1e-6) for run in runs]

    def column(first: Sequence[TrainingEvaluation | None], name: str, digits: int = 0) -> str:
        return median_and_range([getattr(e, name) if e else np.inf for e in first], digits)

    unmasked = sum(end.solved_unmasked for end in ends)
    return [
        f"{sum(end.solved for end in ends)} ({unmasked}) of {len(ends)}",
        column(reached, "step"),
        column(reached, "episodes"),
        column(reached, "seconds", 1),
        column(shortest, "step"),
        median_and_range([end.length for end in ends if end.solved], 2),
    ]


def report(settings: Settings) -> str:
    """Write the tables and the figure of goal i, and return its Markdown."""
    runs = {profile: settings.evaluations(f"{profile}/both") for profile in PROFILES}
    convergence = [[profile, *convergence_row(runs[profile])] for profile in PROFILES]
    speeds = [[profile, *_speeds(profile, runs[profile])] for profile in PROFILES]
    scenario = paper_scenario()
    paths, times = _paths_and_times(settings, scenario)
    return "\n\n".join(
        [
            write_table(settings.out / "goal_1.csv", ["profile", *CONVERGENCE], convergence),
            table(["profile", "steps/s", "updates/s", "replay ratio"], speeds),
            write_table(
                settings.out / "goal_1_planning.csv",
                ["planner", "length, cells", "planning time, ms"],
                times,
            ),
            _draw(settings, scenario, paths),
        ]
    )


def _speeds(profile: str, runs: Sequence[Sequence[TrainingEvaluation]]) -> list[str]:
    ends, batch = [run[-1] for run in runs], PROFILES[profile].batch_size
    return [
        median_and_range([end.step / end.seconds for end in ends]),
        median_and_range([end.updates / end.seconds for end in ends]),
        median_and_range([batch * end.updates / end.step for end in ends], 1),
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


def _draw(settings: Settings, scenario: Scenario, paths: dict[str, Sequence[Cell]]) -> str:
    figure, panels = plt.subplots(1, len(paths), figsize=(15, 4.2), layout="constrained")
    for number, (axes, (planner, cells)) in enumerate(zip(panels, paths.items(), strict=True)):
        length = f"{path_length(cells):.2f} cells" if cells else "trapped"
        draw_map(axes, scenario, f"{planner}: {length}")
        draw_path(axes, cells, number, planner)
    return save_figure(figure, settings.out / "goal_1.png", "Fig. 7: the paths of goal i")
