"""Waiting for a newer costmap: for requests that repeat a failed one."""

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import PoseStamped

from ddqn_planner.nodes.outcome import Outcome

RETRY_WITHIN = 2.0  # seconds after a failure; later if no newer costmap came
MOST_FAILURES = 16
INTERVALS = 8  # between the last messages, whose median is the period


class Arrivals:
    """Counts maps and their updates, and measures the time from one to the next."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.number = 0
        """How many maps and updates came: also the number of the last one."""
        self.number_at_vain_wait = -1
        """What `number` was when a request last waited, and nothing came."""
        self.times: deque[float] = deque(maxlen=INTERVALS + 1)
        """When the last maps and updates came, in seconds by the clock."""

    def note(self) -> float:
        """Count a map or an update that comes now; return the time in seconds."""
        now = self._clock()
        self.number += 1
        self.times.append(now)
        return now

    @property
    def period(self) -> float:
        """Seconds between messages, the median; infinite before the second message."""
        intervals = np.diff(self.times)
        if len(intervals) == 0:
            return math.inf
        if len(intervals) <= 2:
            # Two messages may come together, as a costmap and its first update.
            return float(intervals.max())
        return float(np.median(intervals))


class Failure(NamedTuple):
    """A failed request; a retry may start elsewhere, or have fewer goals before."""

    last_goal: PoseStamped  # in the frame of the request
    costmap: int  # the number, in `Arrivals`, of the costmap that had no path
    seconds: float  # when it failed, by the steady clock


class Retries:
    """The last requests that failed."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._failures: deque[Failure] = deque(maxlen=MOST_FAILURES)

    def is_retry(
        self, goals: Sequence[PoseStamped], costmap: int, resolution: float
    ) -> bool:
        """Return whether a request with the same last goal failed before.

        Parameters
        ----------
        goals : sequence of PoseStamped
            Of the request that may be a retry.
        costmap : int
            The number, in `Arrivals`, of the costmap now. A failure counts if this
            costmap had no path, or if the failure is less than `RETRY_WITHIN` ago.
        resolution : float
            Metres: two goals that are no farther from each other are the same.
        """
        for failure in self._failures:
            is_recent = self._clock() - failure.seconds < RETRY_WITHIN
            may_have_been_cleared = failure.costmap == costmap or is_recent
            is_near = _distance(failure.last_goal, goals[-1]) <= resolution
            if may_have_been_cleared and is_near:
                return True
        return False

    def note(
        self, goals: Sequence[PoseStamped], costmap: int, outcome: Outcome
    ) -> None:
        """Forget older failures to a request's last goal; remember one if it failed.

        Parameters
        ----------
        goals : sequence of PoseStamped
            Of the request.
        costmap : int
            The number, in `Arrivals`, of the costmap that was planned on.
        outcome : Outcome
            Of the request.
        """
        if outcome.request is None:
            return
        last_goal = goals[-1]
        resolution = outcome.request.grid.resolution
        failures = [
            failure
            for failure in self._failures
            if _distance(failure.last_goal, last_goal) > resolution
        ]
        self._failures = deque(failures, MOST_FAILURES)
        if outcome.has_failed:
            self._failures.append(Failure(last_goal, costmap, self._clock()))


def _distance(goal: PoseStamped, other: PoseStamped) -> float:
    """Return the metres from one goal to another; infinite in different frames."""
    if goal.header.frame_id != other.header.frame_id:
        return math.inf
    position = goal.pose.position
    other_position = other.pose.position
    return math.hypot(position.x - other_position.x, position.y - other_position.y)
