"""What a planner is asked, and what it answers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import Cell, GridMap, MoveRule, path_length
from ddqn_planner.grid.arguments import Choice, numbers
from ddqn_planner.planning.segments import SAME_COST
from ddqn_planner.robot.motions import turn_between

SAME_POSE = 1e-6  # metres and radians
ROUNDING = 1 + 1e-6  # so that 0.15 m in cells of 0.05 m reach 3 cells, not 2.9999999


class PlanStatus(Choice):
    """The outcome of a request, each with the sentence that a user reads."""

    SUCCEEDED = "succeeded"
    START_OUTSIDE_MAP = "the start lies outside the map"
    GOAL_OUTSIDE_MAP = "the goal lies outside the map"
    START_OCCUPIED = "the start is occupied"
    GOAL_OCCUPIED = "the goal is occupied"
    MAP_SIZE_UNSUPPORTED = "the model was not trained for maps of this size"
    NO_PATH = "no path leads from the start to the goal"
    ROLLOUT_TRAPPED = "a path exists, but the model's greedy steps do not find it"


class PlanMethod(Choice):
    """How a path is to be found, or was found."""

    GREEDY = "greedy"
    """By greedy steps in the Q field alone."""
    ASTAR_FALLBACK = "astar_fallback"
    """By greedy steps; where these are trapped, by a search in the Q field's order."""


# Fields of a `Plan`, and the type of each.
CHOICES: tuple[tuple[str, type[Choice]], ...] = (
    ("status", PlanStatus),
    ("method", PlanMethod),
    ("move_rule", MoveRule),
)
Pose: TypeAlias = tuple[float, float, float]  # metres, metres, radians; map frame
Place = TypeVar("Place", Cell, Pose)
Number = TypeVar("Number", bound=np.generic)
AnyPlan = TypeVar("AnyPlan", bound="Plan")


@dataclass(frozen=True)
class PathRequest(Generic[Place]):
    """The request for a path of cells or of poses, so that it may wait.

    Parameters
    ----------
    grid : GridMap
    start : cell or pose
    goals : tuple of cells or poses
        Of several goals, the path leads to the one that the cheapest path reaches.
    under_way : (N, 2) cells or (N, 3) poses
        The path that the robot follows; empty for none.
    switch_threshold : float
        The share by which the rest of that path may cost more than a new path.
    """

    grid: GridMap
    start: Place
    goals: tuple[Place, ...]
    under_way: Any = field(default=(), compare=False, kw_only=True)
    switch_threshold: float = field(default=0.0, kw_only=True)

    def keeps(self, cost: float, new_cost: float) -> bool:
        """Return whether the rest of a path under way is kept, not the new path.

        `cost` is that of the rest, and `new_cost` that of the new path.
        """
        return cost <= (1 + self.switch_threshold) * new_cost * SAME_COST


@dataclass(frozen=True)
class PlanRequest(PathRequest[Cell]):
    """The request for a path of cells, see `Planner.plan`."""

    move_rule: MoveRule
    method: PlanMethod = PlanMethod.GREEDY
    tolerance: float = 0.0  # cells; with a tolerance there is one goal
    simplified: bool = False
    start_clearing_radius: float = 0.0  # cells

    @property
    def reach(self) -> float:
        """How far the goal may move, in cells."""
        return self.tolerance * ROUNDING

    @property
    def cells(self) -> tuple[Cell, ...]:
        """The cells of the start and of the goals."""
        return self.start, *self.goals

    def after(self, leg: Plan, goal: Cell) -> PlanRequest:
        """Return the request for the next leg: from the end of a leg to a goal."""
        return replace(self, start=leg.cells[-1], goals=(goal,))


@dataclass(frozen=True)
class PoseRequest(PathRequest[Pose]):
    """The request for a path of poses, see `Planner.plan_poses`."""

    tolerance: tuple[float, float] = (0.0, 0.0)  # metres, radians; for one goal
    bound: float = 1.2
    is_bound_proved: bool = True  # or the first path is enough
    start_clearing_radius: float = 0.0  # metres
    either_direction: bool = False  # a goal may be reached forwards or backwards
    finished: bool = True  # with exact ends, see `pose_finish`

    @property
    def has_any_heading(self) -> bool:
        """Whether a path may end at its goal in any heading."""
        _, radians = self.tolerance
        return radians * ROUNDING >= math.pi

    @property
    def may_goal_move(self) -> bool:
        """Whether a goal without room may move or turn to another state."""
        metres, radians = self.tolerance
        return metres > 0 or (radians > 0 and not self.has_any_heading)

    @property
    def reach(self) -> tuple[tuple[float, float], bool]:
        """Where a path may end besides the goals themselves."""
        return self.tolerance, self.either_direction

    @property
    def cells(self) -> tuple[Cell, ...]:
        """The cells of the start and of the goals."""
        poses = self.start, *self.goals
        return tuple(self.grid.world_to_cell(x, y) for x, y, _ in poses)

    def after(self, leg: PosePlan, goal: Pose) -> PoseRequest:
        """Return the request for the next leg: from the end of a leg to a goal."""
        x, y, yaw = leg.poses[-1].tolist()
        return replace(self, start=(x, y, yaw), goals=(goal,))


class Explanation(NamedTuple):
    """The clauses of which a plan's reason is made."""

    cause: str  # the words of the status, or more exactly why there is no path
    remarks: tuple[str, ...] = ()  # in what a path differs from its request
    remedy: str = ""  # what to do if unknown space is why there is no path

    def __str__(self) -> str:
        clauses = [self.cause, *self.remarks]
        if self.remedy:
            clauses.append(self.remedy)
        return "; ".join(clauses)


UNEXPLAINED = Explanation(cause="")  # until the plan's status is its cause


@dataclass(frozen=True, eq=False)
class Plan:
    """A path, or the reason why there is none.

    Equal plans may have taken different times.

    Parameters
    ----------
    status : PlanStatus
    path : (N, 2) int32
        The cells from start to goal, every move or simplified segment legal; empty
        unless the status is SUCCEEDED. It cannot be written to.
    method : PlanMethod
        ASTAR_FALLBACK if it was searched for because the greedy steps were trapped.
    move_rule : MoveRule
        The rule under which the moves are legal.
    cost : float, optional
        The cost of the path: the sum over cells of the length in each cell times its
        `GridMap.cost_multiplier`. Only a planner's plan on a map with costs has it. On
        a map of expected times it is in seconds.
    goal : (x, y), optional
        Where the path ends, or would end: the goal of the request, the nearest of
        several goals, or the cell to which the goal moved. None for a rollout, or if no
        Q field was needed.
    extra_cost : float, optional
        If the path under way is kept: the share by which its rest costs more than a new
        path.
    reason : str
        The status in words. If unknown space is the reason why there is no path, it
        says so, and what to do.
    field_ms, rollout_ms : float
        How long a planner took for the Q field, and for the path from it, in
        milliseconds.
    explanation : Explanation
        The clauses of the reason. By default its cause is the status in words.
    """

    status: PlanStatus
    path: NDArray[np.int32] = field(default_factory=lambda: np.empty((0, 2), np.int32))
    method: PlanMethod = PlanMethod.GREEDY
    move_rule: MoveRule = MoveRule.ROBOT_SAFE
    cost: float | None = None
    goal: Cell | None = None
    extra_cost: float | None = None
    field_ms: float = 0.0
    rollout_ms: float = 0.0
    reason: str = ""
    explanation: Explanation = field(default=UNEXPLAINED, kw_only=True)

    def __post_init__(self) -> None:
        """Turn the fields into their types: a sequence of cells is a path, too.

        The plan is frozen, so its fields are set by `object.__setattr__`.
        """
        path = self.path
        if not isinstance(path, np.ndarray) or path.dtype != np.int32:
            limits = (-(2**31), 2**31 - 1)
            path = numbers("the path", path, between=limits).astype(np.int32)
        if path.size and path.shape[1:] != (2,):
            raise ValueError(f"the path has shape {path.shape}; give (N, 2)")
        path = path.reshape(-1, 2)
        path.flags.writeable = False
        object.__setattr__(self, "path", path)
        # A name stands for the member of a `Choice`: "greedy" for PlanMethod.GREEDY.
        for name, choice in CHOICES:
            value = getattr(self, name)
            if type(value) is not choice:
                object.__setattr__(self, name, choice(value))
        if not self.reason:
            object.__setattr__(self, "reason", self.status.value)
        if not self.explanation.cause:
            by_status = self.explanation._replace(cause=self.status.value)
            object.__setattr__(self, "explanation", by_status)

    def __setstate__(self, state: dict[str, object]) -> None:
        """Take what was pickled or copied: NumPy forgets that arrays are read-only."""
        vars(self).update(state)
        for value in state.values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False

    def __repr__(self) -> str:
        """Return the path's ends and length, or why there is none, in one line."""
        if self.status is not PlanStatus.SUCCEEDED:
            return f"{type(self).__name__}({self.status.name}: {self.reason})"
        parts = [self._path_in_words(), f"length {self.length:.2f}"]
        if self.cost is not None:
            parts.append(f"cost {self.cost:.2f}")
        if self.method is not PlanMethod.GREEDY:
            parts.append(self.method.value)
        return f"{type(self).__name__}({', '.join(parts)})"

    def _path_in_words(self) -> str:
        """Return how many cells the path has, and its ends."""
        if not len(self.path):
            return "0 cells"
        start = tuple(self.path[0].tolist())
        goal = tuple(self.path[-1].tolist())
        return f"{len(self.path)} cells from {start} to {goal}"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Plan) and self._identity() == other._identity()

    def __hash__(self) -> int:
        return hash(self._identity())

    def _identity(self) -> tuple[object, ...]:
        """Return all that equal plans have in common: not the times, not the reason."""
        return (
            self.status,
            self.path.tobytes(),
            self.method,
            self.move_rule,
            self.cost,
            self.extra_cost,
            self.goal,
        )

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """The path as pairs of Python ints, made at the first use."""
        return tuple(zip(*self.path.T.tolist(), strict=True))

    @property
    def length(self) -> float:
        """Length in cells under the plan's rule, see `path_length`."""
        return path_length(self.path)


@dataclass(frozen=True, eq=False, repr=False)
class PosePlan(Plan):
    """A path for a robot with a body and a heading.

    Its `path` has the cells of the origin.

    Parameters
    ----------
    poses : (N, 3) float64
        x, y in metres and yaw in radians, -pi to pi, in the map frame, from start to
        goal, at most half a cell apart; empty unless the status is SUCCEEDED.
    driven : float
        The length of the origin's way in cells, whatever the direction.
    bound : float
        The proved ratio of the cost to the least cost: 1.0 if the cost is the least.
    escape : int
        How many poses lead out of the obstacles on which the robot starts, see
        `Planner.plan_poses`: from pose number `escape` on, the body touches none. 0 for
        a start with room for the body.
    """

    poses: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    driven: float = 0.0
    bound: float = 1.0
    escape: int = 0

    @property
    def length(self) -> float:
        """Length of the origin's way in cells."""
        return self.driven

    def _path_in_words(self) -> str:
        """Return how many poses the path has, and what is proved of its cost."""
        return f"{len(self.poses)} poses, bound {self.bound:.3g}"

    def _identity(self) -> tuple[object, ...]:
        return *super()._identity(), self.poses.tobytes(), self.bound


def explained(plan: AnyPlan, explanation: Explanation) -> AnyPlan:
    """Return a plan with an explanation, and the reason that says it."""
    return replace(plan, reason=str(explanation), explanation=explanation)


def with_remark(plan: AnyPlan, remark: str) -> AnyPlan:
    """Return a plan with one more remark on its path."""
    explanation = plan.explanation
    remarks = (*explanation.remarks, remark)
    return explained(plan, explanation._replace(remarks=remarks))


def joined(plans: Sequence[Plan]) -> Plan:
    """Return the plan through several goals, made of the plans of its legs.

    Each leg except the last succeeded, and ends where the next leg begins. If the last
    leg has no path, its plan is returned as it is: the legs before it do not count.
    """
    last = plans[-1]
    if not last.path.size:
        return last
    # All legs are on one map: all of them have a cost, or none.
    costs = [plan.cost for plan in plans if plan.cost is not None]
    was_searched = PlanMethod.ASTAR_FALLBACK in {plan.method for plan in plans}
    # The last leg's plan, to which the other legs are added.
    base = _with_poses_of(plans) if isinstance(last, PosePlan) else last
    return replace(
        base,
        path=_end_to_end([plan.path for plan in plans]),
        method=PlanMethod.ASTAR_FALLBACK if was_searched else PlanMethod.GREEDY,
        cost=sum(costs) if costs else None,
        field_ms=sum(plan.field_ms for plan in plans),
        rollout_ms=sum(plan.rollout_ms for plan in plans),
    )


def are_joined(plans: Sequence[Plan]) -> bool:
    """Return whether each leg with poses begins where the leg before it ends."""
    legs = [plan.poses for plan in plans if isinstance(plan, PosePlan)]
    for leg, next_leg in pairwise(legs):
        if not len(next_leg):  # the last leg has no path
            return True
        dx, dy, _ = next_leg[0] - leg[-1]
        turn = float(turn_between(leg[-1, 2], next_leg[0, 2]))
        if max(abs(dx), abs(dy), abs(turn)) > SAME_POSE:
            return False
    return True


def _with_poses_of(plans: Sequence[Plan]) -> PosePlan:
    """Return the plan of the last leg with the poses and the remarks of all legs."""
    legs = [plan for plan in plans if isinstance(plan, PosePlan)]
    last = legs[-1]
    all_remarks = [remark for leg in legs for remark in leg.explanation.remarks]
    each_once = tuple(dict.fromkeys(all_remarks))
    return replace(
        explained(last, last.explanation._replace(remarks=each_once)),
        poses=_end_to_end([leg.poses for leg in legs]),
        driven=sum(leg.driven for leg in legs),
        bound=max(leg.bound for leg in legs),
        escape=legs[0].escape,
    )


def _end_to_end(legs: Sequence[NDArray[Number]]) -> NDArray[Number]:
    """Return the rows of all legs, (N, 2) or (N, 3); each row is there once.

    Each leg begins with the last row of the leg before it.
    """
    return np.concatenate([legs[0][:1], *(leg[1:] for leg in legs)])
