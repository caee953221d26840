"""Measure how much sooner a robot arrives that remembers how long places took, in many worlds."""

import argparse
import itertools
import os
import sys
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

# Before NumPy is imported. On a busy machine, several threads are ten times as slow as one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import driving_worlds as worlds
import numpy as np
from driving_worlds import KINDS, RULE, SPEED, STATIONS, Float64, World, drive, path_seconds
from figures import draw_slowness, draw_times, save_figure
from random_maps import generate_map
from tables import median_and_range, table, write_report
from trainings import in_parallel, make_folder, parser_of

from ddqn_planner import Experience, GridMap, Planner, inflate, load_map
from ddqn_planner.cli import exit_code
from ddqn_planner.grid import Cell
from ddqn_planner.grid.arguments import MAX_SLOWNESS
from ddqn_planner.grid.noise import random_requests

MISSIONS: Final = 150
MOVED_AT: Final = 100  # the mission before which all slow zones move
QUICK_MISSIONS: Final = 60
FAULT_EVERY: Final = 900.0  # seconds of driving: four faults per hour, one of each kind on average
ROBOT_RADIUS: Final = 0.2  # metres, on maps from files
STAGES: Final = ((0, 20), (20, 50), (50, 100), (100, 110), (120, 140))
BARS: Final = ("1.08", "1.04", "1.02")  # what the learning planner should stay below at first
SMOOTHED: Final = 10  # missions that a point of the curve averages
VISITED: Final = 0.95  # uncertainty of a cell below which the robot was near
BEST, LEARNED, SHORTEST = "best possible", "learned", "shortest path"
LAST, MEAN = "last time per cell", "mean per cell"
PLANNERS: Final = (LEARNED, SHORTEST, LAST, MEAN)


@dataclass(frozen=True)
class Job:
    """A world (a kind of generated map, or a map file) and how the robot drives in it."""

    kind: str
    seed: int
    missions: int
    faults: bool = False  # then without the baselines


@dataclass(frozen=True)
class Result:
    """The missions of a job: the expected seconds of each planner's route, and what was learned."""

    seconds: dict[str, Float64]
    forecast: Float64  # (M, 4): measured seconds, the expected time, and its bounds
    world: World
    experience: Experience
    clock: float  # at the end

    def ratio(self, planner: str, first: int, end: int, over: str = BEST) -> float:
        """Return the total time over that of another planner, over some missions."""
        return float(self.seconds[planner][first:end].sum() / self.seconds[over][first:end].sum())


class CellTimes:
    """What the baselines remember: the last or the mean slowness of each cell."""

    def __init__(self, grid: GridMap, is_mean: bool) -> None:
        self.grid, self.is_mean = grid, is_mean
        self.slowness, self.count = np.ones(grid.occupancy.shape), np.zeros(grid.occupancy.shape)

    def record(self, cells: Sequence[Cell], slowness: Float64) -> None:
        """Learn from a drive."""
        x, y = np.asarray(cells).T
        self.count[y, x] = self.count[y, x] * self.is_mean + 1
        self.slowness[y, x] += (slowness - self.slowness[y, x]) / self.count[y, x]

    def apply(self) -> GridMap:
        """Return a map whose moves cost what was seen."""
        slowness = np.clip(self.slowness, 1, MAX_SLOWNESS).astype(np.float32)
        return self.grid.with_slowness(slowness, self.grid.resolution / SPEED)


def run(job: Job) -> Result:
    """Drive the missions of a job."""
    if job.kind in KINDS:
        world = worlds.generated_world(job.kind, job.seed)
    else:
        of_file = inflate(load_map(job.kind), ROBOT_RADIUS)
        world = worlds.make_world(of_file, np.random.default_rng([job.seed, 1]))
    grid, planner = world.grid, Planner.load("any_map")
    missions, noise, faults, moved = (np.random.default_rng([job.seed, n]) for n in range(4))
    experience = Experience(SPEED)
    memories = {LAST: CellTimes(grid, False), MEAN: CellTimes(grid, True)}
    seconds = defaultdict[str, list[float]](list)
    forecast: list[tuple[float, ...]] = []
    clock, next_fault = 0.0, FAULT_EVERY / 2
    for mission in range(job.missions):
        if mission == MOVED_AT:
            world.always = worlds.slow_zones(grid, moved)
        start, goal = (world.stations[i] for i in missions.choice(STATIONS, 2, replace=False))
        maps = {BEST: world.known(clock), LEARNED: experience.apply(grid)}
        if not job.faults:
            maps |= {SHORTEST: grid} | {name: memory.apply() for name, memory in memories.items()}
        routes = {name: planner.plan(on, start, goal, RULE).cells for name, on in maps.items()}
        for name, cells in routes.items():
            seconds[name].append(path_seconds(cells, world.slowness(clock), grid))
        seen = measured = drive(routes[LEARNED], world, clock, noise)
        forecast.append((measured.duration, *experience.expected_time(grid, routes[LEARNED])))
        if job.faults and clock >= next_fault:
            seen, next_fault = worlds.with_faults(measured, faults), next_fault + FAULT_EVERY
        experience.record(seen.seconds, seen.positions)
        for name, memory in memories.items():
            if name in routes:
                memory.record(routes[name], drive(routes[name], world, clock, noise).slowness)
        clock += measured.duration
    arrays = {name: np.array(values) for name, values in seconds.items()}
    return Result(arrays, np.array(forecast), world, experience, clock)


def measured_worlds(kinds: Sequence[str], options: argparse.Namespace) -> list[list[Result]]:
    """Run each world as it is, and with faults; return the results of both."""
    missions = QUICK_MISSIONS if options.quick else MISSIONS
    drawn = itertools.product((False, True), kinds, range(options.seeds))
    jobs = [Job(kind, seed, missions, faults) for faults, kind, seed in drawn]
    results = in_parallel(run, jobs, options.backend, "world")
    return [results[: len(jobs) // 2], results[len(jobs) // 2 :]]


def measure(options: argparse.Namespace) -> int:
    """Run the experiment, write its tables, figures and ``report.md``, and print it."""
    maps = sorted(map(str, options.maps.rglob("*.yaml"))) if options.maps else []
    if options.maps and not maps:
        raise ValueError(f"{options.maps}: found no ROS map (.yaml); check the path")
    out = make_folder(options)
    plain, faulty = measured_worlds(KINDS, options)
    sections = {
        "Time over the best possible": _stages(plain, faulty),
        "From mission to mission": _curve(out / "curve.png", plain),
        "Expected times": _forecasts({"as it is": plain, "with faults": faulty}),
        "Speed": _times(),
        "True and learned slowness": _picture(out / "map.png"),
    }
    if maps:
        of_maps, faulty = measured_worlds(maps, options)
        sections["Maps from files"] = _stages(of_maps, faulty)
        plain += of_maps
    over = [result.ratio(LEARNED, 0, MOVED_AT, SHORTEST) for result in plain]
    sections["Learned over the shortest path, missions 1 to 100"] = (
        f"{median_and_range(over, 3)}; above 1 in {sum(r > 1 for r in over)} of {len(over)} worlds"
    )
    print(write_report(out, sections, options.page))
    print(f"saved {out / 'report.md'}")
    return 0


def _stages(plain: Sequence[Result], faulty: Sequence[Result]) -> str:
    """Return the time over the best possible: the median, and of what is learned the range."""
    of_rows = {name: (plain, name) for name in PLANNERS}
    of_rows["learned, with faults"] = (faulty, LEARNED)
    rows: list[list[str]] = []
    for row, (results, planner) in of_rows.items():
        reached = [stage for stage in STAGES if stage[0] < len(results[0].forecast)]
        ratios = ([result.ratio(planner, *stage) for result in results] for stage in reached)
        cells = (median_and_range(of_stage, 3) for of_stage in ratios)
        rows.append([row, *(cell if row == LEARNED else cell.split()[0] for cell in cells)])
    header = " | ".join(["missions", *(f"{first + 1} to {end}" for first, end in STAGES)])
    return table(header, [*rows, ["bar", *BARS]])


def _forecasts(both: Mapping[str, Sequence[Result]]) -> str:
    """Return how far the expected time of a mission was from the measured one, after 50."""
    rows = []
    for label, results in both.items():
        forecasts = [result.forecast[50:MOVED_AT] for result in results]
        measured, expected, low, high = np.concatenate(forecasts).T
        error = np.abs(expected / measured - 1).mean()
        inside = ((low <= measured) & (measured <= high)).mean()
        width = np.median((high - low) / expected)
        rows.append([label, len(measured), f"{error:.1%}", f"{inside:.1%}", f"{width:.1%}"])
    return table("drives | missions | MAPE | within the 90 % interval | width of it, median", rows)


def _times() -> str:
    """Return the CPU time to learn from 1,000 poses on 1000 x 1000 cells, and to plan again."""
    random = np.random.default_rng(0)
    occupancy = generate_map("office", (1000, 1000), random)
    grid, planner = GridMap(occupancy, 0.05), Planner.load("any_map")
    world = worlds.make_world(grid, random)
    requests = random_requests(world.grid.occupancy, RULE, 6, random)
    goal, experience, clock = requests[0][1], Experience(SPEED), 0.0
    times = []
    for number in range(25):
        cells = planner.plan(experience.apply(grid), requests[number % 6][0], goal).cells
        measured = drive(cells[:1001], world, clock, random)
        some = np.linspace(0, len(measured.seconds) - 1, 1000).astype(np.int64)
        clock += measured.duration
        began = [time.thread_time()]
        experience.record(measured.seconds[some], measured.positions[some])
        began.append(time.thread_time())
        applied = experience.apply(grid)
        began.append(time.thread_time())
        planner.plan(applied, cells[: len(cells) // 2 + 1][-1], goal)
        began.append(time.thread_time())
        steps = 1e3 * np.diff(began)
        times.append([*steps, steps.sum()])
    columns = zip(("record", "apply", "plan again", "all"), np.array(times[5:]).T, strict=True)
    rows = [[name, f"{np.median(ms):.1f}", f"{ms.max():.1f}"] for name, ms in columns]
    return table("1,000 poses on 1000 x 1000 cells | median [ms] | worst [ms]", rows)


def _curve(path: Path, plain: Sequence[Result]) -> str:
    seconds = {name: [result.seconds[name] for result in plain] for name in PLANNERS}
    best = [result.seconds[BEST] for result in plain]
    figure, axes = draw_times(seconds, best, SMOOTHED, banded=LEARNED)
    if len(best[0]) > MOVED_AT:
        axes.axvline(MOVED_AT, color="black", linewidth=1, linestyle=":")
        axes.text(MOVED_AT + 1, axes.get_ylim()[1], "all slow zones move", va="top", fontsize=9)
    return save_figure(figure, path, "Time over the best possible, from mission to mission")


def _picture(path: Path, missions: int = 50) -> str:
    """Draw the true and the learned slowness of a world, with the routes of a mission."""
    result, planner = run(Job("office", 1, missions)), Planner.load("any_map")
    world, experience, clock = result.world, result.experience, result.clock
    grid = world.grid
    truth = world.slowness(clock)

    def saved(ends: tuple[Cell, Cell]) -> float:
        of_routes = world.routes(planner, *ends, clock).values()
        shortest, best = (path_seconds(cells, truth, grid) for cells in of_routes)
        return shortest - best

    start, goal = max(itertools.combinations(world.stations, 2), key=saved)
    shortest, best = world.routes(planner, start, goal, clock).values()
    learned = planner.plan(experience.apply(grid), start, goal, RULE).cells
    routes = {"shortest": shortest, "learned": learned, "best possible": best}
    visited = experience.uncertainty(grid) < VISITED
    known = np.where(visited, experience.slowness(grid), np.nan)
    panels = {
        "what nobody told the robot: true slowness": (truth, routes),
        f"what it learned from {missions} missions (grey: never there)": (known, routes),
    }
    figure = draw_slowness(grid, world.stations, panels, (11, 5.6))
    return save_figure(figure, path, "True and learned slowness, and the routes")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; return the exit code."""
    parser = parser_of("driving.py", __doc__, "runs/driving")
    words = "measure on the ROS maps of a folder too"
    parser.add_argument("--maps", type=Path, metavar="FOLDER", help=words)
    options = parser.parse_args(arguments)
    return exit_code(parser.prog, lambda: measure(options))


if __name__ == "__main__":
    sys.exit(main())
