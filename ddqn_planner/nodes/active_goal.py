"""The active goal: when to plan to it again, and when its path is news."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from geometry_msgs.msg import PoseStamped
from std_msgs.msg import Header

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.nodes.outcome import Outcome, Request
from ddqn_planner.planning import Planner, PlanStatus
from ddqn_planner.planning.pose_planner import PoseRequest

# Radians by which a body turns until that is a reason to plan.
TURN_TO_PLAN = math.pi / 8
UNCHANGED = Outcome("UNCHANGED", "the active goal needs no new plan")


class Situation(NamedTuple):
    """The map and the robot's place, on which a plan to the active goal depends."""

    grid: GridMap
    map_header: Header | None
    start: Cell
    # The yaw of a robot with a body, in units of TURN_TO_PLAN; None without a body.
    turns: int | None


@dataclass
class ActiveGoal:
    """Decides when to plan again, and what to publish, as docs/nodes.md says."""

    # The last ``goal_pose``, or ``goal_poses``: the planner leads to the nearest one.
    # Empty before the first message.
    poses: Sequence[PoseStamped]
    period: float  # seconds, the parameter ``replan_period``
    # The last outcome whose path was published for this goal.
    followed: Outcome | None = None
    last: Outcome = UNCHANGED  # UNCHANGED until there is one
    period_ends: float = 0.0  # in seconds of the steady clock

    @property
    def lacks_pose(self) -> bool:
        """Whether the goal waits for TF or odometry."""
        return bool(self.poses) and self.last.status in ("NO_START", "TF_ERROR")

    def is_check_due(self, lacks_map: bool) -> bool:
        """Return whether to check now, by `is_due`, if the goal needs a new plan.

        ``lacks_map`` says that there is no map to plan on. If there was one for the
        last plan, the costmap has stopped, and the path has to be withdrawn at once.
        """
        costmap_stopped = lacks_map and self.last.request is not None
        is_period_over = time.monotonic() >= self.period_ends
        return bool(self.poses) and (costmap_stopped or is_period_over)

    def begin_period_if_due(self) -> bool:
        """Begin the next period if the last one is over; return whether it was."""
        now = time.monotonic()
        if self.period > 0 and now < self.period_ends:
            return False
        self.period_ends = now + self.period
        return True

    def is_due(
        self, planner: Planner, request: Request, header: Header, is_period_over: bool
    ) -> bool:
        """Return whether the map or the robot's place changed in a way that matters.

        Parameters
        ----------
        planner : Planner
        request : Request
            For a path to this goal.
        header : Header
            Of the request's map. A map that came again unchanged is planned on, so that
            the diagnostics name the last map.
        is_period_over : bool
            If so, any change matters; else only a change that leaves the robot without
            a path.
        """
        last = self.last
        if last.request is not None:
            last_situation = situation_of(last.request, last.map_header)
            if last_situation == situation_of(request, header):
                return False
        if is_period_over:
            return True
        has_path = last.status == PlanStatus.SUCCEEDED.name
        if not has_path or last.header.frame_id != header.frame_id:
            return True
        can_follow_path = len(planner.rest_of_path(request)) > 0
        return not can_follow_path

    def note(self, outcome: Outcome) -> bool:
        """Keep an outcome as the last one, and begin the next period.

        Returns
        -------
        bool
            Whether to publish the outcome's path, which may be empty: whether it is new
            to those who have the last one.
        """
        last = self.last
        self.last = outcome
        self.period_ends = time.monotonic() + self.period
        has_same_status = outcome.status == last.status
        has_same_frame = outcome.header.frame_id == last.header.frame_id
        has_path = len(outcome.plan.path) > 0
        was_kept = outcome.plan.extra_cost is not None  # the rest of the last path
        is_new_path = has_path and not was_kept
        is_news = is_new_path or not has_same_status or not has_same_frame
        if is_news and has_path:
            self.followed = outcome
        return is_news


def situation_of(request: Request, header: Header | None) -> Situation:
    """Return the situation for which a request asks, on the map with a header."""
    turns = None
    if isinstance(request, PoseRequest):
        _, _, yaw = request.start
        turns = round(yaw / TURN_TO_PLAN)
    start_cell = request.cells[0]
    return Situation(request.grid, header, start_cell, turns)
