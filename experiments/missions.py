"""Does a robot that remembers how long driving took arrive sooner? Missions in generated worlds."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from driving_worlds import (
    KINDS,
    SPEED,
    STATIONS,
    World,
    drive,
    generated_world,
    make_world,
    path_seconds,
    slow_zones,
    with_faults,
)
from numpy.typing import NDArray
from random_maps import generate_map

from ddqn_planner.experience import Experience
from ddqn_planner.grid import Cell, GridMap, MoveRule, inflate, load_map
from ddqn_planner.grid.arguments import MAX_SLOWNESS
from ddqn_planner.grid.noise import random_requests
from ddqn_planner.planning import Planner

Float64 = NDArray[np.float64]

MISSIONS: Final = 150
MOVED_AT: Final = 100
"""The mission before which all slow zones move."""
QUICK_MISSIONS: Final = 60
FAULT_EVERY: Final = 900.0
"""Seconds of driving from one fault to the next: four per hour, one of each kind on average."""
ROBOT_RADIUS: Final = 0.2
"""Metres, on maps from files."""

STAGES: Final = {"1 to 20": (0, 20), "21 to 50": (20, 50), "51 to 100": (50, 100)}
RECOVERED: Final = (140, 150)
"""Missions in which the robot has driven 40 after the slow zones moved."""

LEARNED: Final = "learned"
SHORTEST: Final = "shortest path"
LAST: Final = "last time per cell"
MEAN: Final = "mean per cell"
PLANNERS: Final = (LEARNED, SHORTEST, LAST, MEAN)


@dataclass(frozen=True)
class Job:
    """A world and how the robot drives in it."""

    kind: str
    """A kind of generated map, or a map file."""
    seed: int
    missions: int
    faults: bool = False
    baselines: bool = True

    def world(self) -> World:
        """Return the world, always the same."""
        if self.kind in KINDS:
            return generated_world(self.kind, self.seed)
        random = np.random.default_rng([self.seed, 1])
        return make_world(inflate(load_map(self.kind), ROBOT_RADIUS), random)


@dataclass(frozen=True)
class Result:
    """The missions of a job.

    Parameters
    ----------
    job : Job
    best : (M,) float64
        Expected seconds of the planner that knows.
    seconds : dict of (M,) float64
        Those of the planners.
    forecast : (M, 4) float64
        Measured seconds of the learning planner's drives, and its expected time with its bounds.
    """

    job: Job
    best: Float64
    seconds: dict[str, Float64]
    forecast: Float64

    def ratio(self, planner: str, first: int, end: int) -> float:
        """Return the total time over that of the planner that knows, over some missions."""
        return float(self.seconds[planner][first:end].sum() / self.best[first:end].sum())


class CellTimes:
    """What the baselines remember: the last or the mean slowness of each cell."""

    def __init__(self, grid: GridMap, is_mean: bool) -> None:
        self.grid, self.is_mean = grid, is_mean
        self.sum, self.count = np.ones(grid.occupancy.shape), np.zeros(grid.occupancy.shape)

    def record(self, cells: Sequence[Cell], slowness: Float64) -> None:
        """Learn from a drive."""
        x, y = np.asarray(cells).T
        self.sum[y, x] = slowness + (self.sum[y, x] * (self.count[y, x] > 0) * self.is_mean)
        self.count[y, x] = self.count[y, x] * self.is_mean + 1

    def apply(self) -> GridMap:
        """Return a map whose moves cost what was seen."""
        mean = self.sum / np.maximum(self.count, 1)
        slowness = np.clip(mean, 1, MAX_SLOWNESS).astype(np.float32)
        return self.grid.with_slowness(slowness, self.grid.resolution / SPEED)


def run(job: Job) -> Result:
    """Drive the missions of a job."""
    world, planner = job.world(), Planner.load("any_map")
    grid = world.grid
    missions, noise, faults, moved = (np.random.default_rng([job.seed, n]) for n in range(4))
    experience = Experience(SPEED)
    memories = {LAST: CellTimes(grid, False), MEAN: CellTimes(grid, True)}
    best: list[float] = []
    seconds: dict[str, list[float]] = {name: [] for name in PLANNERS}
    forecast: list[tuple[float, ...]] = []
    clock, next_fault = 0.0, FAULT_EVERY / 2
    for mission in range(job.missions):
        if mission == MOVED_AT:
            world.always = slow_zones(grid, moved)
        start, goal = (world.stations[i] for i in missions.choice(STATIONS, 2, replace=False))
        truth = world.slowness(clock)

        def planned(on: GridMap, start: Cell = start, goal: Cell = goal) -> tuple[Cell, ...]:
            return planner.plan(on, start, goal, MoveRule.ROBOT_SAFE).cells

        best.append(path_seconds(planned(world.known(clock)), truth, grid))
        cells = planned(experience.apply(grid))
        seconds[LEARNED].append(path_seconds(cells, truth, grid))
        measured = drive(cells, world, clock, noise)
        forecast.append((measured.duration, *experience.expected_time(grid, cells)))
        seen = measured
        if job.faults and clock >= next_fault:
            seen, next_fault = with_faults(measured, faults), next_fault + FAULT_EVERY
        experience.record(seen.seconds, seen.positions)
        if job.baselines:
            seconds[SHORTEST].append(path_seconds(planned(grid), truth, grid))
            for name, memory in memories.items():
                cells = planned(memory.apply())
                seconds[name].append(path_seconds(cells, truth, grid))
                memory.record(cells, drive(cells, world, clock, noise).slowness)
        clock += measured.duration
    arrays = {name: np.array(values) for name, values in seconds.items() if values}
    return Result(job, np.array(best), arrays, np.array(forecast))


def jobs_of(kinds: Sequence[str], seeds: int, quick: bool) -> list[Job]:
    """Return the jobs of an experiment: each world once as it is, and once with faults."""
    missions = QUICK_MISSIONS if quick else MISSIONS
    with_faults = min(missions, MOVED_AT)
    return [
        job
        for kind in kinds
        for seed in range(seeds)
        for job in (Job(kind, seed, missions), Job(kind, seed, with_faults, True, False))
    ]


def update_times(rounds: int = 20) -> Float64:
    """Return how long it takes to learn from 1,000 poses on 1000 x 1000 cells, and to plan again.

    Returns
    -------
    (N, 3) float64
        Milliseconds of the processor: of `Experience.record`, of `Experience.apply`, and of
        `Planner.plan` toward a goal of which the field of the last map is known.
    """
    random = np.random.default_rng(0)
    occupancy = generate_map("office", (1000, 1000), random)
    grid, planner = GridMap(occupancy, 0.05), Planner.load("any_map")
    world = make_world(grid, random)
    requests = random_requests(world.grid.occupancy, MoveRule.ROBOT_SAFE, 6, random)
    goal, experience, clock = requests[0][1], Experience(SPEED), 0.0
    times = []
    for number in range(rounds + 5):
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
        times.append(1e3 * np.diff(began))
    return np.array(times[5:])


def map_files(folder: Path) -> list[str]:
    """Return the ROS maps of a folder; a ValueError without one."""
    files = sorted(map(str, folder.rglob("*.yaml")))
    if not files:
        raise ValueError(f"{folder}: found no ROS map (.yaml); check the path")
    return files
