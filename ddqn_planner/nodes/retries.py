"""Which requests repeat a failed one, for which a newer costmap may have a path."""

import math
import time
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from geometry_msgs.msg import PoseStamped

from ddqn_planner.nodes.outcome import Outcome
from ddqn_planner.planning import PlanStatus

# Statuses that another costmap of the same place may change.
FAILURES = {
    status.name
    for status in (
        PlanStatus.START_OCCUPIED,
        PlanStatus.GOAL_OCCUPIED,
        PlanStatus.NO_PATH,
        PlanStatus.ROLLOUT_TRAPPED,
    )
}
RETRY_WITHIN = 2.0  # seconds after a failure; later if no newer costmap came
MOST_FAILURES = 16


class Failure(NamedTuple):
    """A failed request; a retry may come from another place, or through fewer of its goals."""

    last_goal: PoseStamped  # as the request gave it
    costmap: int  # the number of the one that it failed on
    seconds: float  # by the steady clock


class Retries:
    """The last requests that failed."""

    def __init__(self) -> None:
        self._failures: deque[Failure] = deque(maxlen=MOST_FAILURES)

    def is_retry(
        self, goals: Sequence[PoseStamped], costmap: int, resolution: float
    ) -> bool:
        """Return whether a request for this last goal failed just now, or on this costmap."""
        for failure in self._failures:
            is_recent = time.monotonic() - failure.seconds < RETRY_WITHIN
            may_have_been_cleared = failure.costmap == costmap or is_recent
            is_near = _distance(failure.last_goal, goals[-1]) <= resolution
            if may_have_been_cleared and is_near:
                return True
        return False

    def note(
        self, goals: Sequence[PoseStamped], costmap: int, outcome: Outcome
    ) -> None:
        """Remember a request that failed, or forget its goal if it did not."""
        if outcome.request is None:
            return
        resolution = outcome.request.grid.resolution
        failures = [
            failure
            for failure in self._failures
            if _distance(failure.last_goal, goals[-1]) > resolution
        ]
        self._failures = deque(failures, MOST_FAILURES)
        if outcome.status in FAILURES:
            self._failures.append(Failure(goals[-1], costmap, time.monotonic()))


def _distance(goal: PoseStamped, other: PoseStamped) -> float:
    """Return the metres from one goal to another; infinite in different frames."""
    if goal.header.frame_id != other.header.frame_id:
        return math.inf
    position = goal.pose.position
    other_position = other.pose.position
    return math.hypot(position.x - other_position.x, position.y - other_position.y)
