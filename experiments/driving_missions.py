"""Missions of a robot in a world of `driving_worlds`, and what they took."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Final

import driving_worlds as worlds
import numpy as np
from driving_learners import LEARNERS
from driving_worlds import RATE, RULE, Drive, Float64, World, drive, path_seconds
from random_maps import Random

from ddqn_planner import Experience, Planner, inflate, load_map
from ddqn_planner.grid import Cell
from ddqn_planner.training.prior_training import prior_of

MOVED_AT: Final = 100
"""The mission before which all that is slow moves, in jobs where it moves."""
FAULT_PERIOD: Final = 900.0
"""Seconds of driving from one fault to the next; the four kinds are equally likely."""
TEACHING: Final = 50  # missions on one map, before the robot comes to another
ROBOT_RADIUS: Final = 0.2  # metres, on maps from files
MARKED: Final = 0.25  # metres from a path within which cells count as driven


@dataclass(frozen=True)
class Job:
    """A world, who drives in it, and how.

    The world is of a kind, or a map file with what is slow.
    """

    kind: str
    seed: int
    learner: str
    missions: int
    exploration: float | None = None
    is_faulty: bool = False
    is_moved: bool = False
    prior_from: str | None = None
    """The kind of world that teaches a prior; "" if it is driven without one."""


@dataclass(frozen=True)
class Result:
    """The seconds of a job's routes, and of the best and the shortest routes."""

    job: Job
    seconds: Float64
    best: Float64
    shortest: Float64
    forecast: Float64
    """(M, 5) seconds: measured, expected, least and greatest expected; new share."""

    def ratio(self, first: int, end: int) -> float:
        """Return the total time over the best possible, over some missions."""
        return float(self.seconds[first:end].sum() / self.best[first:end].sum())

    def over_shortest(self, first: int, end: int) -> float:
        """Return the total time over that of the shortest paths."""
        return float(self.seconds[first:end].sum() / self.shortest[first:end].sum())


@cache
def planner() -> Planner:
    """Load the planner, once in a process."""
    return Planner.load("any_map")


def world_of(job: Job) -> World:
    """Make the world of a job."""
    name, hidden = job.kind.rsplit("-", 1)
    if name.endswith(".yaml"):
        random = np.random.default_rng([job.seed, 1])
        world = worlds.make_world(inflate(load_map(name), ROBOT_RADIUS), hidden, random)
    else:
        world = worlds.generated_world(job.kind, job.seed)
    if job.prior_from is not None:  # the same law holds on both maps
        world.change(hidden, np.random.default_rng(job.seed))
    return world


def run(job: Job) -> Result:
    """Drive the missions of a job."""
    world = world_of(job)
    learner = LEARNERS[job.learner](world.grid)
    if job.prior_from:
        lesson = replace(job, kind=job.prior_from, prior_from="", missions=TEACHING)
        teacher = Experience(worlds.SPEED)
        taught_world = world_of(lesson)
        run_in(lesson, taught_world, teacher)
        places = teacher.evidence.places
        learner.prior = prior_of(taught_world.grid, places, teacher.prior)
    return run_in(job, world, learner)


def run_in(job: Job, world: World, learner: Any) -> Result:
    """Drive a job's missions in its world, with a learner."""
    return _Missions(job, world, learner).drive_all()


class _Missions:
    """The missions of one robot: what it drives, sees, and learns."""

    def __init__(self, job: Job, world: World, learner: Any) -> None:
        self.job = job
        self.world = world
        self.learner = learner
        self.pairs, self.noise, self.faults, self.moves = (
            np.random.default_rng([job.seed, number]) for number in range(4)
        )
        self.options: dict[str, float] = {}
        if isinstance(learner, Experience) and job.exploration is not None:
            self.options["exploration"] = job.exploration
        self.shortest: dict[tuple[Cell, Cell], Sequence[Cell]] = {}
        self.is_new = np.ones(world.grid.occupancy.shape, dtype=np.bool_)
        self.forecast: list[list[float]] = []
        self.world_clock = 0.0  # seconds, by which crowds come and go
        self.robot_clock = 0.0  # seconds that the robot has driven
        self.next_fault = FAULT_PERIOD / 2  # seconds of the robot's clock

    def drive_all(self) -> Result:
        """Drive one mission after another."""
        times = []
        for mission in range(self.job.missions):
            if self.job.is_moved and mission == MOVED_AT:
                hidden = self.job.kind.rsplit("-", 1)[1]
                self.world.change(hidden, self.moves)
            times.append(self._drive_one())
        seconds, shortest, best = np.array(times).T
        return Result(self.job, seconds, best, shortest, np.array(self.forecast))

    def _drive_one(self) -> list[float]:
        """Drive a mission between two stations.

        Return the seconds of its route, of the shortest and of the best route.
        """
        world = self.world
        numbers = self.pairs.choice(len(world.stations), 2, replace=False).tolist()
        start, goal = (world.stations[number] for number in numbers)
        if (start, goal) not in self.shortest:
            plan = planner().plan(world.grid, start, goal, RULE)
            self.shortest[start, goal] = plan.cells
        learned_map = self.learner.apply(world.grid, **self.options)
        cells = planner().plan(learned_map, start, goal, RULE).cells
        seconds = path_seconds(cells, world, self.world_clock)
        shortest = path_seconds(self.shortest[start, goal], world, self.world_clock)
        best = world.best_seconds(start, goal, self.world_clock)
        measured = drive(cells, world, self.world_clock, self.noise)
        self._forecast(cells, measured.duration)
        self._learn(measured)
        # Crowds come for all learners at the same mission, however long their drives
        # take.
        self.world_clock += best
        self.robot_clock += measured.duration
        return [seconds, shortest, best]

    def _forecast(self, cells: Sequence[Cell], duration: float) -> None:
        """Note what an experience expected of a route, and mark the route as driven."""
        if not isinstance(self.learner, Experience):
            return
        grid = self.world.grid
        x, y = np.transpose(cells)
        expected = self.learner.expected_time(grid, cells)
        new_share = self.is_new[y, x].mean()
        self.forecast.append([duration, *expected, new_share])
        reach = round(MARKED / grid.resolution)
        for x, y in cells:
            rows = slice(max(y - reach, 0), y + reach + 1)
            columns = slice(max(x - reach, 0), x + reach + 1)
            self.is_new[rows, columns] = False

    def _learn(self, measured: Drive) -> None:
        """Record a drive by the robot's clock, at times with a fault."""
        seconds = measured.seconds + self.robot_clock - self.world_clock
        seen = replace(measured, seconds=seconds)
        if self.job.is_faulty and self.robot_clock >= self.next_fault:
            seen = with_faults(seen, self.faults)
            self.next_fault += FAULT_PERIOD
        self.learner.record(seen.seconds, seen.positions)


def with_faults(measured: Drive, random: Random) -> Drive:
    """Return the drive with a fault.

    The fault is a pause, a teleport, a jump of the clock or a reset of the odometry.
    """
    seconds = measured.seconds.copy()
    positions = measured.positions.copy()
    count = len(seconds)
    row = int(random.integers(count // 4, 3 * count // 4 + 1))  # of the fault
    fault = int(random.integers(4))
    if fault == 0:  # a pause of 10 minutes
        standing = seconds[row] + np.arange(0, 600, 1 / RATE)
        seconds = np.concatenate([seconds[:row], standing, seconds[row:] + 600])
        positions = np.insert(positions, [row] * len(standing), positions[row], axis=0)
    elif fault == 1:  # a teleport for 3 s
        positions[row : row + int(3 * RATE)] += random.uniform(-10, 10, 2)
    elif fault == 2:  # the clock jumps, back or ahead
        seconds[row:] += random.choice([-1, 1]) * random.uniform(5, 3600)
    else:  # odometry begins anew
        positions[row:] -= positions[row]
    return Drive(seconds, positions, measured.duration)
