"""What the planner node says: what became of a request, its log, and `/diagnostics`."""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from std_msgs.msg import Header

from ddqn_planner.grid import Cell
from ddqn_planner.nodes.runtime import BaseNode
from ddqn_planner.planning import (
    Plan,
    PlanMethod,
    Planner,
    PlanRequest,
    PlanStatus,
    unknown_space,
)
from ddqn_planner.planning.exact_paths import NO_PATH, ExactPath
from ddqn_planner.planning.plan import PosePlan
from ddqn_planner.planning.pose_planner import PoseRequest

Request = PlanRequest | PoseRequest

PATIENCE = 5.0  # seconds in which a new listener hears a first map, odometry or TF, at a load of 20
PERIOD = 0.9  # seconds until diagnostics are due when nothing changes: at the next look

TOLERANCE = (
    ", or a greater tolerance"  # does not help with several goals: none of them moves
)
ALL_GOALS = -1  # as in ComputePathThroughPoses
REMEDIES = {
    PlanStatus.START_OUTSIDE_MAP: "set the start on the map",
    PlanStatus.GOAL_OUTSIDE_MAP: "set the goal on the map",
    PlanStatus.START_OCCUPIED: "set the start on a free cell, or a greater start_clearing_radius",
    PlanStatus.GOAL_OCCUPIED: f"set the goal on a free cell{TOLERANCE}",
    PlanStatus.MAP_SIZE_UNSUPPORTED: "set the parameter 'model' to one trained for this size",
    PlanStatus.NO_PATH: f"set the goal where free cells lead to{TOLERANCE}",
    PlanStatus.ROLLOUT_TRAPPED: "train the model longer, or set mode to 'astar_fallback'",
}


class RequestError(ValueError):
    """There is no request for the planner; what the node listens to since just now `may_come`."""

    def __init__(self, status: str, reason: str, since: float = -math.inf) -> None:
        super().__init__(reason)
        self.status, self.may_come = status, time.monotonic() - since < PATIENCE


@dataclass(frozen=True)
class Outcome:
    """What became of a request; without a planner and a `PlanRequest` if it is not well-formed."""

    status: str  # the name of a `PlanStatus`, or that of a `RequestError`
    reason: str
    planner: Planner | None = None
    request: Request | None = None
    plan: Plan = field(default_factory=lambda: Plan(PlanStatus.NO_PATH))
    goal: PoseStamped | None = None  # in the map's frame
    map_header: Header | None = None  # of the map that it was planned on
    path: ExactPath = field(
        default=NO_PATH, compare=False
    )  # of a disc, between exact poses
    is_dense: bool = False  # whether its path has a pose at least every cell
    header: Header = field(default_factory=Header)  # of its path
    last_reached: int = (
        ALL_GOALS  # of several goals, the index of the one where the path ends
    )

    @property
    def length(self) -> float:
        """Length of its path in cells."""
        return self.plan.length if isinstance(self.plan, PosePlan) else self.path.length


NO_REQUEST = Outcome("NO_REQUEST", "no plan was asked for yet")
WAYS = "with a lifecycle manager or `ros2 lifecycle set`"
STOPPING = Outcome(
    "NOT_ACTIVE", "the node is being stopped; start it again, and ask again"
)
NOT_ACTIVE = Outcome(
    "NOT_ACTIVE", f"the node is not active; configure and activate it, {WAYS}"
)


def reason_of(
    request: Request,
    plan: Plan,
    start: PoseStamped,
    goal: PoseStamped,
    robot_radius: float,
    path: ExactPath = NO_PATH,
) -> str:
    """Say how a path between two poses was found, or why there is none and what to do."""
    grid, has_body = request.grid, isinstance(plan, PosePlan)
    begin, goals = request.cells[0], request.cells[1:]
    clearing: float = getattr(request, "start_clearing_radius", 0.0)
    cleared = f"{clearing * grid.resolution:.3g} m"
    if plan.status is not PlanStatus.SUCCEEDED:
        status, remedy = plan.status.value, REMEDIES[plan.status]
        is_unknown = plan.reason.endswith(unknown_space.REMEDY)
        if is_unknown:
            status, _, remedy = plan.reason.partition("; ")
        elif has_body:
            remedy = remedy.removesuffix(", or a greater start_clearing_radius")
            remedy = remedy.replace("on a free cell", "where the robot's body has room")
        to = f"goal: {_place(goal, goals[0])}"
        if len(goals) > 1:
            why_not = status if is_unknown else plan.reason
            status = f"no path to any of {len(goals)} goals: {why_not}"
            remedy = remedy.removesuffix(TOLERANCE)
            to = f"goals: cells {', '.join(map(str, goals[:5]))}{', ...' * (len(goals) > 5)}"
        of_map = f"map: {grid.width} x {grid.height} cells"
        reason = f"{status} (start: {_place(start, begin)}; {to}; {of_map})"
        on_map = filter(grid.contains, goals)
        is_goal = plan.status is PlanStatus.GOAL_OCCUPIED and not is_unknown
        if is_goal and not all(map(grid.is_obstacle, on_map)):
            near = (
                f"robot_radius, {robot_radius:g} m"
                if robot_radius
                else "the costmap allows"
            )
            near = "the robot's body allows" if has_body else near
            reason += f", nearer to an obstacle than {near}"
        if plan.status is PlanStatus.START_OCCUPIED and clearing:
            reason += f", deeper than the start_clearing_radius, {cleared}"
        return f"{reason}; {remedy}"
    several = len(goals) > 1
    number = f" to goal {reached(request, plan) + 1} of {len(goals)}" if several else ""
    how, length = "by greedy steps", path.length
    if isinstance(plan, PosePlan):
        length = plan.length
        how = f"by greedy steps, of at most {plan.bound:.3g} times the least cost"
        if math.isinf(plan.bound):
            how = (
                "kept, as there is none from the cell and heading nearest to the start"
            )
    elif plan.method is not PlanMethod.GREEDY:
        how = "searched for in the order of the Q field: the greedy steps were trapped"
    reason = f"a path of {length:.2f} cells{number}, {how}"
    if plan.extra_cost:
        reason += f", kept: its cost is {plan.extra_cost:+.1%} beside that of a new one"
    if plan.goal is not None and plan.goal not in goals and not several:
        metres = (
            math.dist(plan.goal, goals[0]) * grid.resolution
        )  # as the tolerance counts
        why = unknown_space.goal_in_words(grid, goals[0]) or "is cut off"
        reason += f"; the goal {why} and moved {metres:.3g} m"
    if grid.is_obstacle(plan.path[0]):
        reason += (
            f"; the start is occupied: obstacles within {cleared} of it were ignored"
        )
    return reason


def reached(request: Request, plan: Plan) -> int:
    """Return which of several goals a plan leads to, from 0: a path that is kept ends beside it."""
    if plan.goal is None:
        return 0
    return int(np.argmin([math.dist(cell, plan.goal) for cell in request.cells[1:]]))


def _place(stamped: PoseStamped, cell: Cell) -> str:
    position = stamped.pose.position
    return (
        f"({position.x:.6g}, {position.y:.6g}) m in cell ({cell[0]:.6g}, {cell[1]:.6g})"
    )


class Refusals:
    """What a node refused and has not accepted since, and why; it is logged when that changes."""

    def __init__(
        self, node: BaseNode, on_change: Callable[[], None] = lambda: None
    ) -> None:
        self.node, self._on_change, self._due = node, on_change, 0.0
        self.refused: dict[str, str] = {}
        self.publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)

    @contextmanager
    def taking(self, what: str, often: bool = False) -> Iterator[None]:
        """Accept something, or refuse it by its error; of what comes often, log the first."""
        try:
            yield
        except (ValueError, MemoryError) as error:
            is_logged = not often or what not in self.refused
            self.refuse(what, str(error) or repr(error), is_logged)
        else:
            self.accept(what)

    def refuse(self, what: str, reason: str, log: bool = True) -> None:
        """Refuse something, and perhaps log it, unless the last reason was the same."""
        if log and self.refused.get(what) != reason:
            self.node.get_logger().error(f"{what} refused: {reason}")
        self.refused[what] = reason
        self.change()

    def accept(self, what: str) -> None:
        """Forget that something was refused."""
        if self.refused.pop(what, None):
            self.change()

    def change(self) -> None:
        """Publish soon: something about the node changed."""
        self._due = 0.0
        self._on_change()

    def problems(self) -> list[str]:
        """Return what a user reads of all that is refused."""
        return [f"{what} refused: {reason}" for what, reason in self.refused.items()]

    def tell(
        self, what: str, level: bytes, message: str, values: Mapping[str, str]
    ) -> None:
        """Publish diagnostics; topics' problems are in them, and logged once."""
        if problems := self.node.topic_problems():
            level, message = (
                max(level, DiagnosticStatus.WARN),
                "; ".join([message, *problems]),
            )
        status = DiagnosticStatus(
            name=f"{self.node.get_fully_qualified_name()}: {what}"
        )
        status.level, status.message = level, message
        status.values = [
            KeyValue(key=key, value=value) for key, value in values.items()
        ]
        self.publisher.publish(
            DiagnosticArray(header=self.node.header(), status=[status])
        )


class Report(Refusals):
    """Logs what the planner node does, and publishes the last outcome with what was refused."""

    outcome = NO_REQUEST

    def is_due(self) -> bool:
        """Return whether somebody listens, and something changed or `PERIOD` has passed."""
        if is_due := time.monotonic() >= self._due:
            self._due = time.monotonic() + PERIOD
            self.node.topic_problems()  # which are logged, whoever listens
        return is_due and self.publisher.get_subscription_count() > 0

    def note(self, outcome: Outcome) -> None:
        """Keep the last outcome for the diagnostics."""
        self.outcome = outcome
        self.change()

    def log(self, outcome: Outcome, paths: bool = False) -> None:
        """Log why there is no path, or how it was found: that takes a sixth of a request."""
        if not outcome.plan.path.size:
            self.node.get_logger().warning(f"no plan: {outcome.reason}")
        elif paths:
            self.node.get_logger().info(outcome.reason)

    def publish(self, fatal: bool, missing: str, more: Mapping[str, str]) -> None:
        """Publish the diagnostics; `fatal` if the node cannot plan until its user helps."""
        outcome, plan, problems = self.outcome, self.outcome.plan, self.problems()
        of_map = outcome.map_header
        if missing and missing != outcome.reason:
            problems.append(missing)
        good = not problems and (plan.path.size or outcome.status == "NO_REQUEST")
        level = DiagnosticStatus.OK if good else DiagnosticStatus.WARN
        level = DiagnosticStatus.ERROR if fatal else level
        values = {
            "status": outcome.status,
            "reason": outcome.reason,
            "method": plan.method.value,
            "path length (cells)": f"{outcome.length:.3f}",
            "field time (ms)": f"{plan.field_ms:.3f}",
            "rollout time (ms)": f"{plan.rollout_ms:.3f}",
            "planned on the map of (s)": seconds(of_map.stamp) if of_map else "",
            **more,
        }
        self.tell("plan", level, "; ".join([outcome.reason, *problems]), values)


def seconds(stamp: Time) -> str:
    """Return a stamp as seconds with nine decimals."""
    return f"{stamp.sec}.{stamp.nanosec:09d}"
