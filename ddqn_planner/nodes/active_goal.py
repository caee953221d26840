"""The active goal: when to plan to it again, and what of the last path to keep."""

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from std_msgs.msg import Header

from ddqn_planner.grid.map_changes import shift_between
from ddqn_planner.nodes.outcome import (
    Outcome,
    Request,
)
from ddqn_planner.planning import Planner, PlanRequest, PlanStatus
from ddqn_planner.planning.paths import rest_of_path
from ddqn_planner.planning.plan import PosePlan
from ddqn_planner.planning.pose_planner import PoseRequest
from ddqn_planner.robot.motions import HEADINGS

HEADING = (
    2 * math.pi / HEADINGS
)  # radians that a robot turns until that is a reason to plan


UNCHANGED = Outcome("UNCHANGED", "the active goal needs no new plan")


@dataclass
class ActiveGoal:
    """Decides when to plan again, and what to publish; the table in docs/nodes.md has the rules."""

    poses: list[
        PoseStamped
    ]  # the last ``goal_pose``, or ``goal_poses``: the nearest one counts
    period: float  # seconds between looks if something changed
    followed: Outcome | None = (
        None  # the last one whose path was published for this goal
    )
    last: Outcome = UNCHANGED
    next_look: float = 0.0

    @property
    def lacks_pose(self) -> bool:
        """Whether it waits for TF or odometry."""
        return bool(self.poses) and self.last.status in ("NO_START", "TF_ERROR")

    def is_look_due(self, lacks_map: bool) -> bool:
        """Return whether it is time to look if something changed; the next plan does then."""
        stopped = (
            lacks_map and self.last.request is not None
        )  # a costmap: its path is taken back
        return bool(self.poses) and (stopped or time.monotonic() >= self.next_look)

    def is_due(self, planner: Planner, request: Request, header: Header) -> bool:
        """Return whether there is a reason to plan."""
        last, now = self.last, time.monotonic()
        if looks := self.period == 0 or now >= self.next_look:
            self.next_look = now + self.period
        # A map that came again as it was is planned on, so that the diagnostics name the last one.
        known = last.request and _inputs_of(last.request, last.map_header)
        if known == _inputs_of(request, header):
            return False
        shown = last.status, last.header.frame_id
        is_followed = shown == (PlanStatus.SUCCEEDED.name, header.frame_id)
        return looks or not is_followed or not len(_rest(planner, request))

    def is_news(self, outcome: Outcome) -> bool:
        """Return whether to publish the path of an outcome, which may be empty."""
        shown, new = ((it.status, it.header.frame_id) for it in (self.last, outcome))
        self.last, self.next_look = outcome, time.monotonic() + self.period
        has_path = len(outcome.plan.path) > 0
        is_news = shown != new or (has_path and outcome.plan.extra_cost is None)
        if is_news and has_path:
            self.followed = outcome
        return is_news


def _inputs_of(request: Request, header: Header | None) -> tuple[Any, ...]:
    """Return what a plan for the active goal depends on: map, place, and heading of the robot."""
    yaws = request.start[2:]  # of a body
    return (
        request.grid,
        header,
        request.cells[0],
        *(round(yaw / HEADING) for yaw in yaws),
    )


def path_under_way(last: Outcome, request: Request, frame: str) -> Any:
    """Return the last path in cells of a request's map; none if it has another place or form."""
    if frame != last.header.frame_id:
        return ()
    plan, before = last.plan, last.request  # with another model perhaps
    if isinstance(request, PoseRequest):
        return plan.poses if isinstance(plan, PosePlan) else ()
    if not isinstance(before, PlanRequest) or before.simplified != request.simplified:
        return ()
    if (shift := shift_between(before.grid, request.grid)) is None:
        return ()
    cells = plan.path + np.array(shift, np.int32)
    return cells if request.grid.contains((*cells[-1].tolist(),)) else ()


def _rest(planner: Planner, request: Request) -> Any:
    """Return what is left of the path under way, if it is free and the robot near it."""
    way, grid = request.under_way, request.grid
    if isinstance(request, PlanRequest):
        return rest_of_path(way, request.start, grid, request.move_rule)
    assert planner.pose_planner is not None
    return planner.pose_planner.rest_of(way, request.start, grid)
