"""The active goal: when to plan to it again, and which part of its path to keep."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import PoseStamped
from std_msgs.msg import Header

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.grid.map_changes import shift_between
from ddqn_planner.nodes.outcome import Outcome, Request
from ddqn_planner.planning import Planner, PlanRequest, PlanStatus
from ddqn_planner.planning.plan import PosePlan
from ddqn_planner.planning.pose_planner import PoseRequest
from ddqn_planner.robot.motions import HEADINGS

# Radians by which a body turns until that is a reason to plan.
TURN_TO_PLAN = 2 * math.pi / HEADINGS
UNCHANGED = Outcome("UNCHANGED", "the active goal needs no new plan")


class Situation(NamedTuple):
    """The map and the place of the robot, on which a plan to the active goal depends."""

    grid: GridMap
    map_header: Header | None
    start: Cell
    turns: int | None  # the body's yaw in units of TURN_TO_PLAN; None without a body


@dataclass
class ActiveGoal:
    """Decides when to plan again, and what to publish, as docs/nodes.md says."""

    # The last ``goal_pose``, or ``goal_poses``, of which the nearest counts; none at first.
    poses: Sequence[PoseStamped]
    period: float  # seconds between looks for a change
    # The last outcome whose path was published for this goal.
    followed: Outcome | None = None
    last: Outcome = UNCHANGED
    next_look: float = 0.0  # by the steady clock, in seconds

    @property
    def lacks_pose(self) -> bool:
        """Whether the goal waits for TF or odometry."""
        return bool(self.poses) and self.last.status in ("NO_START", "TF_ERROR")

    def is_look_due(self, lacks_map: bool) -> bool:
        """Return whether to look for a change, after which the goal may be planned for.

        Where a costmap stopped after a plan, its path has to be taken back at once.
        """
        costmap_stopped = lacks_map and self.last.request is not None
        is_period_over = time.monotonic() >= self.next_look
        return bool(self.poses) and (costmap_stopped or is_period_over)

    def schedule_look(self) -> bool:
        """Return whether a look is due by the period; if so, the next period begins."""
        now = time.monotonic()
        if self.period > 0 and now < self.next_look:
            return False
        self.next_look = now + self.period
        return True

    def is_due(
        self, planner: Planner, request: Request, header: Header, is_period_over: bool
    ) -> bool:
        """Return whether to plan: the map or the robot's place changed, and it matters.

        Parameters
        ----------
        planner : Planner
        request : Request
            For a path to this goal.
        header : Header
            Of the request's map. A map that came again unchanged is planned on, so that
            the diagnostics name the last map.
        is_period_over : bool
            Whether any change matters, or only one that leaves the robot without a path.
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
        return len(planner.rest_of_path(request)) == 0

    def note(self, outcome: Outcome) -> bool:
        """Keep an outcome; return whether to publish its path, which may be empty."""
        last = self.last
        self.last = outcome
        self.next_look = time.monotonic() + self.period
        is_same_kind = outcome.status == last.status
        is_same_frame = outcome.header.frame_id == last.header.frame_id
        has_path = len(outcome.plan.path) > 0
        is_new_path = has_path and outcome.plan.extra_cost is None
        is_news = is_new_path or not (is_same_kind and is_same_frame)
        if is_news and has_path:
            self.followed = outcome
        return is_news


def situation_of(request: Request, header: Header | None) -> Situation:
    """Return the situation in which a request is planned for."""
    turns = None
    if isinstance(request, PoseRequest):
        turns = round(request.start[2] / TURN_TO_PLAN)
    return Situation(request.grid, header, request.cells[0], turns)


def with_current_path(request: Request, last: Outcome, frame: str) -> Request:
    """Return a request that may keep the rest of the path that the robot follows.

    Parameters
    ----------
    request : Request
    last : Outcome
        Of the path; its model may have been another one.
    frame : str
        The frame of the request's map.

    Returns
    -------
    Request
        The same request if the path was in another frame or of another kind, or ended
        outside the request's map.
    """
    if frame != last.header.frame_id:
        return request
    if isinstance(request, PoseRequest):
        if not isinstance(last.plan, PosePlan):
            return request
        return replace(request, under_way=last.plan.poses)
    last_request = last.request
    if not isinstance(last_request, PlanRequest):
        return request
    if last_request.simplified != request.simplified:
        return request
    shift = shift_between(last_request.grid, request.grid)
    if shift is None:
        return request
    cells = last.plan.path + np.array(shift, np.int32)
    x, y = cells[-1].tolist()
    if not request.grid.contains((x, y)):
        return request
    return replace(request, under_way=cells)
