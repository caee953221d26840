"""Expected times of the map's places, from what the trainer has learned of the robot's drives."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from rclpy.task import Future

from ddqn_planner.experience import ExpectedTime, Experience
from ddqn_planner.experience.take_over import take_over
from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.report import Outcome
from ddqn_planner.nodes.runtime import Worker
from ddqn_planner.planning import Plan

CHANGED_SHARE = 0.02
"""Share of cells that may change before experience is spread anew over the map, which takes long.
What a robot sees on its way, as a person who stands there, changes little of what it learned."""


class ExpectedTimes:
    """Puts expected times on maps. One worker thread uses it."""

    def __init__(self) -> None:
        self._experience: Experience | None = None
        self._spread_on: GridMap | None = None

    def load(self, path: str) -> None:
        """Use what the trainer saved from now on.

        Raises
        ------
        ExperienceFileError
            If the file cannot be used; what was used before stays.
        """
        newer = Experience.load(path)
        if self._experience is not None:
            take_over(newer, self._experience)
        self._experience = newer

    def apply(self, grid: GridMap) -> GridMap:
        """Return a map whose moves cost expected time, or the same map before a drive."""
        if self._experience is None or self._experience.evidence.places == 0:
            return grid
        if self._spread_on is None or not _is_like(grid, self._spread_on):
            self._spread_on = grid
        timed = self._experience.apply(self._spread_on)
        return grid.with_layers(slowness=timed.slowness, seconds_per_cell=timed.seconds_per_cell)

    def expected_time(self, grid: GridMap, plan: Plan) -> ExpectedTime | None:
        """Return how long a plan takes; None if its map has no expected times, or is an old one."""
        map_of_now = self._spread_on
        if self._experience is None or map_of_now is None or grid.slowness is None:
            return None
        if not _is_like(grid, map_of_now):
            return None
        return self._experience.expected_time(map_of_now, plan.every_cell)


def _is_like(grid: GridMap, other: GridMap) -> bool:
    return (
        grid.occupancy.shape == other.occupancy.shape
        and grid.resolution == other.resolution
        and grid.origin == other.origin
        and np.mean(grid.occupancy != other.occupancy) <= CHANGED_SHARE
    )


class Forecast:
    """How long the last plan takes, for the diagnostics: the worker computes it."""

    def __init__(self, times: ExpectedTimes, worker: Worker) -> None:
        self._times, self._worker = times, worker
        self._outcome: Outcome | None = None
        self._computing: Future | None = None
        self._time: ExpectedTime | None = None

    def look(self, outcome: Outcome) -> bool:
        """Return whether there is news; begin to compute what is not known of a new outcome."""
        if outcome is not self._outcome:
            self._outcome, self._time, self._computing = outcome, None, None
            request, plan = outcome.request, outcome.plan
            if request is not None and len(plan.path) and request.grid.slowness is not None:
                self._computing = self._worker.call(self._times.expected_time, request.grid, plan)
        if self._computing is None or not self._computing.done():
            return False
        with suppress(MemoryError):
            self._time = self._computing.result()
        self._computing = None
        return self._time is not None

    def describe(self) -> dict[str, str]:
        """Return what the diagnostics say."""
        if self._time is None:
            return {}
        seconds, low, high = self._time
        return {
            "expected time (s)": f"{seconds:.1f}",
            "expected time, 90 % interval (s)": f"{low:.1f} to {high:.1f}",
        }
