"""The active goal: when to plan for it again, and which of its plans to publish."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from geometry_msgs.msg import PoseStamped

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.grid.arguments import Cells
from ddqn_planner.nodes.report import Outcome
from ddqn_planner.planning import PlanRequest, PlanStatus
from ddqn_planner.planning.paths import rest_of_path
from ddqn_planner.planning.repair import shift_between

SUCCEEDED = PlanStatus.SUCCEEDED.name

UNCHANGED = Outcome("UNCHANGED", "the active goal needs no new plan")


class PathUnderWay:
    """The last path to a goal, in cells of the map that it was planned on."""

    def __init__(self) -> None:
        self._path: Cells = ()
        self._grid: GridMap | None = None
        self._frame = ""

    def keep(self, path: Cells, grid: GridMap, frame: str) -> None:
        """Take the place of the path before."""
        self._path, self._grid, self._frame = path, grid, frame

    def on(self, grid: GridMap, frame: str) -> Cells:
        """Return it in cells of a map; empty if it has no such cells."""
        if not len(self._path) or self._grid is None or frame != self._frame:
            return ()
        shift, (x, y) = shift_between(self._grid, grid), self._path[-1]
        if shift is None or not grid.contains((int(x) + shift[0], int(y) + shift[1])):
            return ()
        return np.asarray(self._path, dtype=np.int32) + np.array(shift, dtype=np.int32)


class ActiveGoal:
    """Decides when to plan again, and what to publish; the table in docs/nodes.md has the rules.

    Attributes
    ----------
    poses : list of PoseStamped
        The last ``goal_pose``, or the last ``goal_poses``, of which the nearest one counts.
    """

    def __init__(self) -> None:
        self.poses: list[PoseStamped] = []
        # Of the paths that were published for this goal, the last one.
        self._path = PathUnderWay()
        # What was planned last; None to plan whatever is asked.
        self._planned: tuple[GridMap, Cell] | None = None
        # The frame and the status of what was published last; None to publish whatever comes.
        self._shown: tuple[str, str] | None = None
        self._is_new = self._is_due = self._looks = False
        self._period = self._next_look = 0.0

    def set(self, poses: list[PoseStamped]) -> None:
        """Take a new goal."""
        self.poses = poses
        self.restart()

    def restart(self) -> None:
        """Plan without the path under way, at once: the goal, the model or a parameter changed."""
        self._is_new = True

    def plan_at_once(self) -> None:
        """Plan at once: somebody has set where the robot is."""
        self._is_due = True

    def is_look_due(self) -> bool:
        """Return whether it is time to look if something changed."""
        return bool(self.poses) and time.monotonic() >= self._next_look

    def begin(self, replan_period: float) -> None:
        """Begin to look whether to plan; `next_request` follows, and `is_news` after a plan."""
        self._looks, self._period = self.is_look_due(), replan_period
        if self._looks:
            self._wait_for_next_look()
        if self._is_new:
            self._path = PathUnderWay()
        if self._is_new or self._is_due:
            self._planned = self._shown = None
        self._is_new = self._is_due = False

    def next_request(
        self, request: PlanRequest, frame: str, switch_threshold: float
    ) -> PlanRequest | None:
        """Return the request for the next plan; None while there is no reason to plan."""
        grid, start = request.grid, request.start
        if self._planned is not None and self._planned[0] is grid and self._planned[1] == start:
            return None
        path = self._path.on(grid, frame)
        is_followed = self._shown == (frame, SUCCEEDED) and not self._looks
        if is_followed and len(rest_of_path(path, start, grid, request.move_rule)):
            return None
        self._path.keep(path, grid, frame)
        self._planned = grid, start
        self._wait_for_next_look()
        return replace(request, under_way=path, switch_threshold=switch_threshold)

    def is_news(self, outcome: Outcome, frame: str) -> bool:
        """Return whether to publish the path of an outcome, which may be empty."""
        if outcome.request is None:
            self._planned = None
        path = outcome.plan.every_cell
        shown, self._shown = self._shown, (frame, outcome.status)
        if shown == self._shown and (not len(path) or outcome.plan.extra_cost is not None):
            return False
        if len(path) and outcome.request is not None:
            self._path.keep(path, outcome.request.grid, frame)
        return True

    def _wait_for_next_look(self) -> None:
        self._next_look = time.monotonic() + self._period
