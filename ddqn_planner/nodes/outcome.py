"""A query for a path, and its outcome: a plan, or a status with reason and remedy."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from geometry_msgs.msg import PoseStamped
from std_msgs.msg import Header

from ddqn_planner.planning import Plan, Planner, PlanRequest, PlanStatus
from ddqn_planner.planning.exact_paths import NO_PATH, ExactPath
from ddqn_planner.planning.plan import PosePlan
from ddqn_planner.planning.pose_planner import PoseRequest

Request = PlanRequest | PoseRequest

# Seconds in which a new listener hears a first map, odometry or TF, at a load of 20.
PATIENCE = 5.0
ALL_GOALS = -1  # instead of an index, as in ComputePathThroughPoses

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


class PathQuery(NamedTuple):
    """A query for a path, as a service or an action received it."""

    start: PoseStamped | None  # None: the robot's pose
    goals: Sequence[PoseStamped]  # the path leads through all goals, in this order
    planner_id: str = ""
    has_via_points: bool = False  # all goals but the last are via-points
    tolerance: float | None = None  # metres; None: the parameter's


class RequestError(ValueError):
    """A request cannot be handed to the planner.

    Parameters
    ----------
    status : str
        For `Outcome.status`.
    reason : str
        What is wrong, and what to do.
    listening_since : float
        When the node began to listen to a message that is missing, in seconds of the
        steady clock. A request waits for the message while it `may_come`: for
        `PATIENCE` from then on. By default it does not wait.
    """

    def __init__(
        self, status: str, reason: str, listening_since: float = -math.inf
    ) -> None:
        super().__init__(reason)
        self.status = status
        self.may_come = time.monotonic() - listening_since < PATIENCE


@dataclass(frozen=True)
class Outcome:
    """The answer to a request; without planner and request if it is not well-formed."""

    status: str  # the name of a `PlanStatus`, or that of a `RequestError`
    reason: str
    planner: Planner | None = None
    request: Request | None = None
    plan: Plan = field(default_factory=lambda: Plan(PlanStatus.NO_PATH))
    goal: PoseStamped | None = None  # in the map's frame
    map_header: Header | None = None  # of the map that it was planned on
    # The plan's path between exact poses, for a disc; empty for a robot with a body.
    path: ExactPath = field(default=NO_PATH, compare=False)
    is_dense: bool = False  # whether the message has a pose at least every cell
    header: Header = field(default_factory=Header)  # of the message with the path
    # The index of the goal where a partial path ends.
    last_reached: int = ALL_GOALS

    @property
    def has_failed(self) -> bool:
        """Whether the request may succeed on another costmap of the same place."""
        return self.request is not None and self.status in FAILURES

    @property
    def length(self) -> float:
        """Length of its path in cells."""
        return self.plan.length if isinstance(self.plan, PosePlan) else self.path.length


# Returns the outcome of a request that is given up now, else None.
GivenUp = Callable[[], Outcome | None]

NO_REQUEST = Outcome("NO_REQUEST", "no plan was asked for yet")
STOPPING = Outcome(
    "NOT_ACTIVE", "the node is being stopped; start it again, and ask again"
)
NOT_ACTIVE = Outcome(
    "NOT_ACTIVE",
    "the node is not active; configure and activate it, "
    "with a lifecycle manager or `ros2 lifecycle set`",
)
