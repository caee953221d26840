"""Missions of a robot in a world of `driving_worlds`, and what they took."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Final

import driving_worlds as worlds
import numpy as np
from driving_learners import LEARNERS
from driving_maps import Bool
from driving_worlds import RATE, RULE, Drive, Float64, World, drive, path_seconds
from random_maps import Random

from ddqn_planner import Experience, Planner, inflate, load_map
from ddqn_planner.grid import Cell
from ddqn_planner.training.prior_training import prior_of

MOVED_AT: Final = 100  # the mission before which all that is slow moves, where it does
FAULT_EVERY: Final = (
    900.0  # seconds of driving: four faults per hour, one of each kind on average
)
TEACHING: Final = 50  # missions on one map, before the robot comes to another
ROBOT_RADIUS: Final = 0.2  # metres, on maps from files


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
    prior_from: str | None = (
        None  # the kind that another world teaches; "" for an untaught robot
    )


@dataclass(frozen=True)
class Result:
    """The seconds of a job's routes, and of the best and the shortest routes."""

    job: Job
    seconds: Float64
    best: Float64
    shortest: Float64
    forecast: (
        Float64  # (M, 5): measured, the expected time, its bounds, and the new share
    )

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
        source, teacher = (
            replace(job, kind=job.prior_from, prior_from=""),
            Experience(worlds.SPEED),
        )
        taught = world_of(source)
        run_in(replace(source, missions=TEACHING), taught, teacher)
        learner.prior = prior_of(taught.grid, teacher.evidence.places, teacher.prior)
    return run_in(job, world, learner)


def run_in(job: Job, world: World, learner: Any) -> Result:
    """Drive a job's missions in its world, with a learner."""
    grid = world.grid
    missions, noise, faults, moved = (
        np.random.default_rng([job.seed, n]) for n in range(4)
    )
    is_exploring = isinstance(learner, Experience) and job.exploration is not None
    given = {"exploration": job.exploration} if is_exploring else {}
    shortest: dict[tuple[int, int], Sequence[Cell]] = {}
    new = np.ones(grid.occupancy.shape, dtype=np.bool_)
    times, forecast = [], []
    clock, own, next_fault = 0.0, 0.0, FAULT_EVERY / 2
    for mission in range(job.missions):
        if job.is_moved and mission == MOVED_AT:
            world.change(job.kind.rsplit("-", 1)[1], moved)
        pair = tuple(missions.choice(len(world.stations), 2, replace=False).tolist())
        start, goal = (world.stations[number] for number in pair)
        if pair not in shortest:
            shortest[pair] = planner().plan(grid, start, goal, RULE).cells
        cells = planner().plan(learner.apply(grid, **given), start, goal, RULE).cells
        of_routes = [
            path_seconds(route, world, clock) for route in (cells, shortest[pair])
        ]
        best = world.best_seconds(start, goal, clock)
        times.append([*of_routes, best])
        measured = drive(cells, world, clock, noise)
        if isinstance(learner, Experience):
            x, y = np.transpose(cells)
            expected = learner.expected_time(grid, cells)
            forecast.append([measured.duration, *expected, new[y, x].mean()])
            _mark(new, cells, round(0.25 / grid.resolution))
        seen = replace(measured, seconds=measured.seconds + own - clock)
        if job.is_faulty and own >= next_fault:
            seen, next_fault = with_faults(seen, faults), next_fault + FAULT_EVERY
        learner.record(seen.seconds, seen.positions)
        # Crowds come for all learners at the same mission, however long their drives
        # take.
        clock, own = clock + best, own + measured.duration
    seconds, of_shortest, of_best = np.array(times).T
    return Result(job, seconds, of_best, of_shortest, np.array(forecast))


def _mark(new: Bool, cells: Sequence[Cell], reach: int) -> None:
    """Mark what is near a path as driven."""
    for x, y in cells:
        new[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1] = (
            False
        )


def with_faults(measured: Drive, random: Random) -> Drive:
    """Return the drive with a fault.

    The fault is a pause, a teleport, a jump of the clock or a reset of the odometry.
    """
    seconds, positions = measured.seconds.copy(), measured.positions.copy()
    at = int(random.integers(len(seconds) // 4, 3 * len(seconds) // 4 + 1))
    fault = int(random.integers(4))
    if fault == 0:  # a pause of 10 minutes
        standing = seconds[at] + np.arange(0, 600, 1 / RATE)
        seconds = np.concatenate([seconds[:at], standing, seconds[at:] + 600])
        positions = np.insert(positions, [at] * len(standing), positions[at], axis=0)
    elif fault == 1:  # a teleport for 3 s
        positions[at : at + int(3 * RATE)] += random.uniform(-10, 10, 2)
    elif fault == 2:  # the clock jumps, back or ahead
        seconds[at:] += random.choice([-1, 1]) * random.uniform(5, 3600)
    else:  # odometry begins anew
        positions[at:] -= positions[at]
    return Drive(seconds, positions, measured.duration)
