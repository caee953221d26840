"""Goal i (section 5.1, Fig. 7): from the given start to the given end, beside A*."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TypeVar

import matplotlib.pyplot as plt
import numpy as np
from pathfinding.core.diagonal_movement import DiagonalMovement
from pathfinding.core.grid import Grid
from pathfinding.finder.a_star import AStarFinder

from ddqn_planner.experiments.figures import draw_map, draw_walk, save
from ddqn_planner.experiments.profiles import PROFILES, variant
from ddqn_planner.experiments.report import Settings, first_kept, optimal_length, spread
from ddqn_planner.experiments.tables import table
from ddqn_planner.experiments.trainings import Training, TrainingEvaluation
from ddqn_planner.files import write_csv
from ddqn_planner.grid import Cell, MoveRule, path_length
from ddqn_planner.planning import Plan, Planner
from ddqn_planner.training.environment import Scenario, paper_scenario

TITLE = "Goal i: from the given start"

Result = TypeVar("Result")

DIAGONALS = {
    MoveRule.CORNER_CUTTING: DiagonalMovement.always,
    MoveRule.ROBOT_SAFE: DiagonalMovement.only_when_no_obstacle,
}
"""The move rules in the words of the library ``pathfinding``."""

TIMES = 50
"""How often each planner is timed."""


def name(profile: str, of_variant: str = "both") -> str:
    """Return the name of the trainings of a profile on the paper's map."""
    return f"{profile}/{of_variant}"


def trainings(settings: Settings, variants: Sequence[str] = ("both",)) -> list[Training]:
    """Return the trainings of both profiles on the paper's map."""
    return [
        training
        for profile in PROFILES
        for of_variant in variants
        for training in settings.trainings(
            name(profile, of_variant),
            variant(settings.profile(profile), of_variant),
            [paper_scenario()],
        )
    ]


def convergence_row(evaluations: Sequence[Sequence[TrainingEvaluation]]) -> list[str]:
    """Return the cells of a table: what the greedy path from the start became, over the seeds."""
    optimum = optimal_length(paper_scenario())
    ends = [run[-1] for run in evaluations]
    unmasked = sum(end.solved_unmasked for end in ends)
    reached = [first_kept(run, lambda e: e.solved == 1) for run in evaluations]
    best = [first_kept(run, lambda e: e.length <= optimum + 1e-6) for run in evaluations]
    return [
        f"{sum(end.solved for end in ends)} ({unmasked}) of {len(ends)}",
        spread([first.step if first else np.inf for first in reached]),
        spread([first.episodes if first else np.inf for first in reached]),
        spread([first.seconds if first else np.inf for first in reached], 1),
        spread([first.step if first else np.inf for first in best]),
        spread([end.length for end in ends if end.solved], 2),
    ]


CONVERGENCE = (
    "seeds solved at the end (any move)",
    "steps until solved for good",
    "episodes",
    "seconds",
    "steps until shortest for good",
    "final length",
)


def report(settings: Settings) -> str:
    """Write the table and the figure of goal i, and return its Markdown."""
    scenario = paper_scenario()
    rows = [
        [profile, *convergence_row(settings.evaluations(name(profile)))] for profile in PROFILES
    ]
    speeds = [[profile, *_speed(settings, profile)] for profile in PROFILES]
    paths, times = _paths(settings, scenario)
    write_csv(settings.out / "goal_1.csv", ["profile", *CONVERGENCE], rows)
    write_csv(settings.out / "goal_1_planning.csv", *times)
    _draw(settings, scenario, paths)
    return "\n\n".join(
        [
            table(["profile", *CONVERGENCE], rows),
            table(["profile", "steps/s", "updates/s", "replay ratio"], speeds),
            table(*times),
            "![Fig. 7: the paths of goal i](goal_1.png)",
        ]
    )


def _speed(settings: Settings, profile: str) -> list[str]:
    ends = [run[-1] for run in settings.evaluations(name(profile))]
    batch = settings.profile(profile).batch_size
    return [
        spread([end.step / end.seconds for end in ends]),
        spread([end.updates / end.seconds for end in ends]),
        spread([batch * end.updates / end.step for end in ends], 1),
    ]


def _paths(
    settings: Settings, scenario: Scenario
) -> tuple[dict[str, Sequence[Cell]], tuple[list[str], list[list[str]]]]:
    """Return the path of each planner, and a table of lengths and planning times."""
    paths: dict[str, Sequence[Cell]] = {}
    rows = []
    for profile in PROFILES:
        planners = settings.planners(name(profile))
        plans, seconds = zip(*(timed_plan(planner, scenario) for planner in planners), strict=True)
        lengths = [plan.length if plan.cells else np.inf for plan in plans]
        middle = int(np.argsort(lengths)[len(lengths) // 2])
        paths[f"{profile}, median seed"] = plans[middle].cells
        milliseconds = spread([1e3 * s for s in seconds], 2)
        rows.append([profile, spread([n for n in lengths if np.isfinite(n)], 2), milliseconds])
    for rule in DIAGONALS:
        cells, s = _timed(lambda rule=rule: a_star(scenario, rule))  # type: ignore[misc]
        paths[f"A*, {rule.value}"] = cells
        rows.append([f"A*, {rule.value}", f"{path_length(cells):.2f}", f"{1e3 * s:.2f}"])
    return paths, (["planner", "length, cells", "planning time, ms"], rows)


def timed_plan(planner: Planner, scenario: Scenario) -> tuple[Plan, float]:
    """Return a planner's plan, and the median of its times with a new field, seconds."""

    def plan() -> Plan:
        fresh = Planner(planner.network, planner.metadata)  # it remembers no Q field
        return fresh.plan(scenario.grid, scenario.start, scenario.goal)

    return _timed(plan)


def _timed(function: Callable[[], Result]) -> tuple[Result, float]:
    """Return what a function returns, and the median of its times, seconds."""
    seconds = []
    for _ in range(TIMES):
        began = time.perf_counter()
        result = function()
        seconds.append(time.perf_counter() - began)
    return result, float(np.median(seconds))


def a_star(scenario: Scenario, move_rule: MoveRule) -> list[Cell]:
    """Return the path of the library ``pathfinding``'s A*."""
    grid = Grid(matrix=(~scenario.grid.occupancy).astype(int).tolist())
    finder = AStarFinder(diagonal_movement=DIAGONALS[move_rule])
    nodes, _ = finder.find_path(grid.node(*scenario.start), grid.node(*scenario.goal), grid)
    return [(node.x, node.y) for node in nodes]


def _draw(settings: Settings, scenario: Scenario, paths: dict[str, Sequence[Cell]]) -> None:
    figure, panels = plt.subplots(1, len(paths), figsize=(15, 4.2), layout="constrained")
    for number, (axes, (planner, cells)) in enumerate(zip(panels, paths.items(), strict=True)):
        length = f"{path_length(cells):.2f} cells" if cells else "trapped"
        draw_map(axes, scenario, f"{planner}: {length}")
        draw_walk(axes, cells, number, planner)
    save(figure, settings.out / "goal_1.png")
