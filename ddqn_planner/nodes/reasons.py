"""The reason of an outcome in words: how a path was found, or why there is none."""

import math

import numpy as np
from geometry_msgs.msg import PoseStamped

from ddqn_planner.grid import Cell
from ddqn_planner.nodes.outcome import (
    Request,
)
from ddqn_planner.planning import (
    Plan,
    PlanMethod,
    PlanStatus,
    unknown_space,
)
from ddqn_planner.planning.exact_paths import NO_PATH, ExactPath
from ddqn_planner.planning.plan import PosePlan

TOLERANCE = (
    ", or a greater tolerance"  # does not help with several goals: none of them moves
)


REMEDIES = {
    PlanStatus.START_OUTSIDE_MAP: "set the start on the map",
    PlanStatus.GOAL_OUTSIDE_MAP: "set the goal on the map",
    PlanStatus.START_OCCUPIED: "set the start on a free cell, or a greater start_clearing_radius",
    PlanStatus.GOAL_OCCUPIED: f"set the goal on a free cell{TOLERANCE}",
    PlanStatus.MAP_SIZE_UNSUPPORTED: "set the parameter 'model' to one trained for this size",
    PlanStatus.NO_PATH: f"set the goal where free cells lead to{TOLERANCE}",
    PlanStatus.ROLLOUT_TRAPPED: "train the model longer, or set mode to 'astar_fallback'",
}


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
