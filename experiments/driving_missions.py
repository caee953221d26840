"""Missions of a robot in a world of `driving_worlds`, and what they took."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import driving_worlds as worlds
import numpy as np
from driving_kinds import law_of
from driving_laws import Float64
from driving_learners import LEARNERS, Learner
from driving_worlds import RATE, RULE, Drive, World, drive, path_seconds
from random_maps import Random

from ddqn_planner import Experience, Planner, inflate, load_map
from ddqn_planner.grid import Cell, GridMap

MOVED_AT: Final = 100
"""The mission before which all that is slow moves, in jobs where it moves."""
FAULT_PERIOD: Final = 900.0
"""Seconds of driving from one fault to the next; the four kinds are equally likely."""
TEACHING: Final = 50  # missions on one map, before the robot comes to another
ROBOT_RADIUS: Final = 0.2  # metres, on maps from files
MARKED: Final = 0.25  # metres from a path within which cells count as driven


# Who knows the mean time of each place, and whether that of turns, too.
KNOWN: Final = {"places known": False, "places and turns known": True}


class KnownTimes:
    """One who knows the mean times of a world, which a learner can at best learn."""

    def __init__(self, world: World, has_turns: bool) -> None:
        self.world = world
        self.has_turns = has_turns
        self.clock = 0.0  # seconds of the world's clock

    def apply(self, _: GridMap) -> GridMap:
        """Return the map with the mean times at the time of the clock."""
        return self.world.mean_times(self.clock, self.has_turns)

    def record(self, seconds: Float64, positions: Float64) -> None:
        """Learn nothing."""


@dataclass(frozen=True)
class Job:
    """A world, who drives in it one after another, and how.

    The world is of a kind, or a map file with a law.
    """

    kind: str
    seed: int
    learners: Sequence[str]
    missions: int
    exploration: float | None = None  # None for the default of `Experience.apply`
    is_faulty: bool = False
    is_moved: bool = False
    prior_from: str | None = None
    """The kind of world that teaches a prior; "" if it is driven without one."""


@dataclass(frozen=True)
class Result:
    """The seconds of a learner's routes, and of the best and the shortest routes."""

    kind: str
    learner: str
    seconds: Float64
    best: Float64
    shortest: Float64
    forecast: Float64
    """(M, 5) seconds: measured, expected, least and greatest expected; new share."""

    def above(self, first: int, end: int) -> float:
        """Return the percentage above the best possible time, over some missions."""
        ratio = self.seconds[first:end].sum() / self.best[first:end].sum()
        return 100 * float(ratio - 1)

    def over_shortest(self, first: int, end: int) -> float:
        """Return the percentage points that it is above the shortest paths."""
        difference = (self.seconds - self.shortest)[first:end].sum()
        return 100 * float(difference / self.best[first:end].sum())

    def of_shortest_path(self) -> "Result":
        """Return the result of one who drives the shortest paths of these missions."""
        return replace(
            self, learner="shortest path", seconds=self.shortest, forecast=np.empty(0)
        )


@cache
def planner() -> Planner:
    """Load the planner, once in a process."""
    return Planner.load("any_map")


def world_of(job: Job) -> World:
    """Make the world of a job."""
    name, law = job.kind.rsplit("-", 1)
    if name.endswith(".yaml"):
        random = np.random.default_rng([job.seed, 1])
        world = worlds.make_world(inflate(load_map(name), ROBOT_RADIUS), law, random)
    else:
        world = worlds.generated_world(job.kind, job.seed)
    if job.prior_from is not None:  # the same law holds on both maps
        world = worlds.moved(world, law, np.random.default_rng(job.seed))
    return world


def run(job: Job) -> list[Result]:
    """Drive the missions of a job with each of its learners."""
    world = world_of(job)
    results = []
    for name in job.learners:
        learner = (
            KnownTimes(world, KNOWN[name])
            if name in KNOWN
            else LEARNERS[name](world.grid)
        )
        if job.prior_from and isinstance(learner, Experience):
            learner.prior = _taught_prior(job, job.prior_from)
        results.append(run_in(job, world, name, learner))
    return results


def _taught_prior(job: Job, kind: str) -> Float64:
    """Return the prior that a robot learns in a world of another kind."""
    lesson = replace(job, kind=kind, prior_from="", missions=TEACHING)
    teacher = Experience(worlds.SPEED)
    world = world_of(lesson)
    run_in(lesson, world, "teacher", teacher)
    return teacher.prior_of(world.grid)


def run_in(job: Job, world: World, name: str, learner: Learner) -> Result:
    """Drive a job's missions in its world, with a learner."""
    return _Missions(job, world, name, learner).drive_all()


class _Missions:
    """The missions of one robot: what it drives, sees, and learns."""

    def __init__(self, job: Job, world: World, name: str, learner: Learner) -> None:
        self.job = job
        self.world = world
        self.name = name
        self.learner = learner
        self.pairs, self.noise, self.faults, self.moves = (
            np.random.default_rng([job.seed, number]) for number in range(4)
        )
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
                law = law_of(self.job.kind)
                self.world = worlds.moved(self.world, law, self.moves)
            times.append(self._drive_one())
        seconds, shortest, best = np.array(times).T
        forecast = np.array(self.forecast)
        return Result(self.job.kind, self.name, seconds, best, shortest, forecast)

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
        cells = planner().plan(self._learned_map(), start, goal, RULE).cells
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

    def _learned_map(self) -> GridMap:
        """Return the map with what the learner expects."""
        exploration = self.job.exploration
        if isinstance(self.learner, Experience) and exploration is not None:
            return self.learner.apply(self.world.grid, exploration)
        if isinstance(self.learner, KnownTimes):
            self.learner.clock = self.world_clock
        return self.learner.apply(self.world.grid)

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
