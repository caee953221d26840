"""What became of a request, in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from geometry_msgs.msg import PoseStamped

from ddqn_planner.grid import Cell, path_length
from ddqn_planner.planning import Plan, PlanMethod, PlanStatus
from ddqn_planner.planning.problem import Problem, Solution

NO_REQUEST, NO_MAP, NO_START, NO_MODEL = "NO_REQUEST", "NO_MAP", "NO_START", "NO_MODEL"
INVALID_START, INVALID_GOAL = "INVALID_START", "INVALID_GOAL"
INVALID_TOLERANCE, FAILED = "INVALID_TOLERANCE", "FAILED"

REMEDIES = {
    PlanStatus.START_OUTSIDE_MAP: "set the start on the map",
    PlanStatus.GOAL_OUTSIDE_MAP: "set the goal on the map",
    PlanStatus.START_OCCUPIED: "set the start on a free cell",
    PlanStatus.GOAL_OCCUPIED: "set the goal on a free cell, or a greater tolerance",
    PlanStatus.MAP_SIZE_UNSUPPORTED: "set the parameter 'model' to one trained for this size",
    PlanStatus.NO_PATH: "set the goal where free cells lead to, or a greater tolerance",
    PlanStatus.ROLLOUT_TRAPPED: "train the model longer, or set mode to 'astar_fallback'",
}

NO_SOLUTION = Solution(Plan(PlanStatus.NO_PATH))


class RequestError(ValueError):
    """The planner cannot be asked; the message says why and what to do."""

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(reason)
        self.status = status


@dataclass(frozen=True)
class Outcome:
    """What became of a request.

    Parameters
    ----------
    status : str
        The name of a `PlanStatus`, or of one of the constants above: then there was no plan.
    sentence : str
        What a user reads: how there is a path, or why there is none and what to do.
    problem : Problem, optional
    solution : Solution, optional
        Both, unless there was no plan.
    map_stamp : str
        The stamp of the map that it was planned on, seconds; empty without a map.
    """

    status: str
    sentence: str
    problem: Problem | None = None
    solution: Solution = NO_SOLUTION
    map_stamp: str = ""

    @property
    def succeeded(self) -> bool:
        """Whether there is a path."""
        return self.status == PlanStatus.SUCCEEDED.name

    @property
    def kind(self) -> tuple[str, PlanMethod]:
        """What tells it from another outcome, whatever places and lengths its sentence names."""
        return self.status, self.solution.plan.method


def outcome_of(
    problem: Problem,
    solution: Solution,
    start: PoseStamped,
    goal: PoseStamped,
    robot_radius: float,
    map_stamp: str,
) -> Outcome:
    """Say what became of a problem whose start and goal were these poses.

    Parameters
    ----------
    problem : Problem
    solution : Solution
    start, goal : geometry_msgs/PoseStamped
    robot_radius : float
        By which the problem's map was inflated, metres.
    map_stamp : str
        See `Outcome`.
    """
    status, grid = solution.plan.status, problem.grid
    if status is PlanStatus.SUCCEEDED:
        return Outcome(status.name, _how(problem, solution), problem, solution, map_stamp)
    reason = (
        f"{status.value} (start: {_place(start, problem.start)}; "
        f"goal: {_place(goal, problem.goal)}; map: {grid.width} x {grid.height} cells)"
    )
    if status is PlanStatus.GOAL_OCCUPIED and not grid.is_obstacle(problem.goal):
        reason += f", nearer to an obstacle than robot_radius, {robot_radius:g} m"
    sentence = f"{reason}; {REMEDIES[status]}"
    return Outcome(status.name, sentence, problem, solution, map_stamp)


def _how(problem: Problem, solution: Solution) -> str:
    """Return how there is a path."""
    sentence = f"a path of {path_length(solution.cells, problem.move_rule):.2f} cells"
    if solution.plan.method is PlanMethod.GREEDY:
        sentence += ", by greedy steps"
    else:
        sentence += ", searched for in the order of the Q field: the greedy steps were trapped"
    if solution.goal is not None and solution.goal != problem.goal:
        moved = float(np.hypot(*np.subtract(solution.goal, problem.goal)))
        why = "is cut off" if problem.grid.is_free(problem.goal) else "is occupied"
        sentence += f"; the goal {why} and moved {moved * problem.grid.resolution:.3g} m"
    return sentence


def _place(stamped: PoseStamped, cell: Cell) -> str:
    position = stamped.pose.position
    return f"({position.x:.6g}, {position.y:.6g}) m in cell ({cell[0]:.6g}, {cell[1]:.6g})"
