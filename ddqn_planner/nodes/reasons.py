"""An outcome in words: how a path was found, or why there is none; names of goals."""

import math
from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import PoseStamped

from ddqn_planner.grid import Cell
from ddqn_planner.nodes.outcome import PathQuery, Request
from ddqn_planner.planning import Plan, PlanMethod, PlanStatus, unknown_space
from ddqn_planner.planning.exact_paths import NO_PATH, ExactPath
from ddqn_planner.planning.plan import PosePlan, PoseRequest

THE_START = "the start"  # in errors
THE_GOAL = "the goal"  # in errors, where there is one goal
MOST_CELLS = 5  # of goals that a reason lists
# Another remedy, but not for several goals: none of them moves.
TOLERANCE = ", or a greater tolerance"
# Another remedy, unless all cells under the body are ignored.
CLEARING_RADIUS = ", or a greater start_clearing_radius"
REMEDIES = {
    PlanStatus.START_OUTSIDE_MAP: "set the start on the map",
    PlanStatus.GOAL_OUTSIDE_MAP: "set the goal on the map",
    PlanStatus.START_OCCUPIED: "set the start on a free cell",
    PlanStatus.GOAL_OCCUPIED: "set the goal on a free cell",
    PlanStatus.MAP_SIZE_UNSUPPORTED: (
        "set the parameter 'model' to one trained for this size"
    ),
    PlanStatus.NO_PATH: "set the goal where free cells lead to",
    PlanStatus.ROLLOUT_TRAPPED: (
        "train the model longer, or set mode to 'astar_fallback'"
    ),
}
REMEDIES_OF_BODY = {
    **REMEDIES,
    PlanStatus.START_OCCUPIED: "set the start where the robot's body has room",
    PlanStatus.GOAL_OCCUPIED: "set the goal where the robot's body has room",
}


def goal_names(count: int, has_via_points: bool = False) -> list[str]:
    """Return what errors call the goals of a query, from the first to the last.

    With via-points, all goals but the last are via-points.
    """
    if has_via_points:
        return [*(f"via-point {number}" for number in range(1, count)), THE_GOAL]
    if count == 1:
        return [THE_GOAL]
    return [f"goal {number}" for number in range(1, count + 1)]


def missed_goal_in_words(
    query: PathQuery, names: Sequence[str], number_of_legs: int
) -> str:
    """Return in words the goal to which the last of the planned legs has no path.

    `names` are those of the query's goals, and `number_of_legs` counts planned legs.
    """
    name = names[number_of_legs - 1]
    if name == THE_GOAL:
        return name
    number_of_via_points = len(names) - 1
    count = number_of_via_points if query.has_via_points else len(names)
    return f"{name} of {count}"


def reason_of(
    request: Request,
    plan: Plan,
    start: PoseStamped,
    goal: PoseStamped,
    robot_radius: float,
    path: ExactPath = NO_PATH,
) -> str:
    """Return in words how a path was found, or why there is none and what to do.

    Parameters
    ----------
    request : Request
    plan : Plan
        The plan for the request, with or without a path.
    start, goal : PoseStamped
        Start and goal of the plan, in the map's frame.
    robot_radius : float
        The parameter ``robot_radius``, in metres.
    path : ExactPath
        For a disc, the plan's path between the exact poses; a body has none.
    """
    if plan.status is PlanStatus.SUCCEEDED:
        return reason_of_path(request, plan, path)
    return reason_of_failure(request, plan, start, goal, robot_radius)


def reason_of_failure(
    request: Request,
    plan: Plan,
    start: PoseStamped,
    goal: PoseStamped,
    robot_radius: float,
) -> str:
    """Return in words why there is no path, between which places, and what to do.

    Parameters
    ----------
    request : Request
    plan : Plan
        The plan for the request, without a path.
    start, goal : PoseStamped
        Start and goal of the plan, in the map's frame.
    robot_radius : float
        The parameter ``robot_radius``, in metres.
    """
    problem = plan.explanation.cause
    number_of_goals = len(request.goals)
    if number_of_goals > 1:
        problem = f"no path to any of {number_of_goals} goals: {problem}"
    places = _places_in_words(request, start, goal)
    lack_of_room = _lack_of_room_in_words(request, plan, robot_radius)
    # Against unknown space, a plan has a remedy of its own.
    remedy = plan.explanation.remedy or _remedy_of(plan, request)
    return f"{problem} ({places}){lack_of_room}; {remedy}"


def _places_in_words(request: Request, start: PoseStamped, goal: PoseStamped) -> str:
    """Return where start and goals of a request lie, and how large its map is.

    `start` and `goal` are those of the plan, in the map's frame.
    """
    grid = request.grid
    start_cell, *goal_cells = request.cells
    goals = f"goal: {_place(goal, goal_cells[0])}"
    if len(goal_cells) > 1:
        goals = _cells_in_words(goal_cells)
    size = f"map: {grid.width} x {grid.height} cells"
    return f"start: {_place(start, start_cell)}; {goals}; {size}"


def _lack_of_room_in_words(request: Request, plan: Plan, robot_radius: float) -> str:
    """Return how much room an occupied start or goal lacks, as the end of a sentence.

    It is empty for another status, for goals on obstacles, and for a start on which no
    obstacle is ignored. `robot_radius` is in metres.
    """
    if plan.status is PlanStatus.START_OCCUPIED and _clearing_radius(request):
        return _depth_in_words(_clearing_radius(request))
    is_unknown = bool(plan.explanation.remedy)
    if plan.status is not PlanStatus.GOAL_OCCUPIED or is_unknown:
        return ""
    grid = request.grid
    _, *goal_cells = request.cells
    goals_on_map = filter(grid.contains, goal_cells)
    if all(map(grid.is_obstacle, goals_on_map)):
        return ""
    # A goal is occupied, and is no obstacle: it lies in the inflated cells around one.
    return f", nearer to an obstacle than {_clearance_in_words(plan, robot_radius)}"


def _remedy_of(plan: Plan, request: Request) -> str:
    """Return in words what to do about a status that ended a request without a path."""
    remedies = REMEDIES_OF_BODY if isinstance(plan, PosePlan) else REMEDIES
    remedy = remedies[plan.status]
    _, *goal_cells = request.cells
    has_one_goal = len(goal_cells) == 1
    if plan.status is PlanStatus.START_OCCUPIED:
        if not math.isinf(_clearing_radius(request)):
            remedy += CLEARING_RADIUS
    elif plan.status in (PlanStatus.GOAL_OCCUPIED, PlanStatus.NO_PATH) and has_one_goal:
        remedy += TOLERANCE
    return remedy


def reason_of_path(request: Request, plan: Plan, path: ExactPath = NO_PATH) -> str:
    """Return in words how long a path is, how it was found, and what was changed.

    The goal may have moved, or obstacles at the start may have been ignored. `plan` is
    the plan for `request`, with a path; `path` is this path between the exact poses for
    a disc, and empty for a body.
    """
    clauses = [_path_in_words(request, plan, path)]
    moved_goal = _moved_goal_in_words(request, plan)
    if moved_goal:
        clauses.append(moved_goal)
    clauses += plan.explanation.remarks
    is_disc = not isinstance(plan, PosePlan)
    if is_disc and request.grid.is_obstacle(plan.path[0]):
        radius = f"{_clearing_radius(request):.3g} m"
        ignored = f"obstacles within {radius} of it were ignored"
        clauses.append(f"the start is occupied: {ignored}")
    return "; ".join(clauses)


def _path_in_words(request: Request, plan: Plan, path: ExactPath) -> str:
    """Return how long a path is, to which of several goals, and how it was found.

    The arguments are those of `reason_of_path`.
    """
    length = plan.length if isinstance(plan, PosePlan) else path.length
    words = f"a path of {length:.2f} cells"
    number_of_goals = len(request.goals)
    if number_of_goals > 1:
        words += f" to goal {nearest_goal(request, plan) + 1} of {number_of_goals}"
    words += f", {_method_in_words(plan)}"
    if plan.extra_cost:
        words += f", kept: its cost is {plan.extra_cost:+.1%} beside that of a new one"
    return words


def _moved_goal_in_words(request: Request, plan: Plan) -> str:
    """Return how far a single goal has moved, and why; empty if it has not."""
    _, *goal_cells = request.cells
    goal = goal_cells[0]
    if len(goal_cells) > 1 or plan.goal is None or plan.goal == goal:
        return ""
    grid = request.grid
    problem = unknown_space.goal_in_words(grid, goal) or "is cut off"
    # In metres between centres of cells, as the tolerance counts.
    metres = math.dist(plan.goal, goal) * grid.resolution
    return f"the goal {problem} and moved {metres:.3g} m"


def _method_in_words(plan: Plan) -> str:
    """Return in words by which method the path of a plan was found."""
    if isinstance(plan, PosePlan):
        if not math.isinf(plan.bound):
            return f"by greedy steps, of at most {plan.bound:.3g} times the least cost"
        if plan.extra_cost is None:
            return "of which nothing is proved"
        # No field leads from the start.
        return "kept, as there is none from the cell and heading nearest to the start"
    if plan.method is PlanMethod.GREEDY:
        return "by greedy steps"
    return "searched for in the order of the Q field: the greedy steps were trapped"


def _clearing_radius(request: Request) -> float:
    """Return the start_clearing_radius of a request in metres, perhaps infinite."""
    if isinstance(request, PoseRequest):
        return request.start_clearing_radius
    return request.start_clearing_radius * request.grid.resolution


def _depth_in_words(clearing_radius: float) -> str:
    """Return how deep a start lies in obstacles; the radius is in metres."""
    if math.isinf(clearing_radius):
        return ", and no motion leads out of the obstacles under the body"
    return f", deeper than the start_clearing_radius, {clearing_radius:.3g} m"


def _clearance_in_words(plan: Plan, robot_radius: float) -> str:
    """Return how near to an obstacle a robot may be, and by which of its settings."""
    if isinstance(plan, PosePlan):
        return "the robot's body allows"
    if robot_radius:
        return f"robot_radius, {robot_radius:g} m"
    return "the costmap allows"


def _cells_in_words(goal_cells: Sequence[Cell]) -> str:
    """Return a list of at most MOST_CELLS goals in words."""
    cells = ", ".join(map(str, goal_cells[:MOST_CELLS]))
    if len(goal_cells) > MOST_CELLS:
        cells += ", ..."
    return f"goals: cells {cells}"


def nearest_goal(request: Request, plan: Plan) -> int:
    """Return the index of the goal to which a plan leads; 0 without a path.

    A kept path may end some cells from the goal.
    """
    if plan.goal is None:
        return 0
    _, *goal_cells = request.cells
    return int(np.argmin([math.dist(cell, plan.goal) for cell in goal_cells]))


def _place(stamped: PoseStamped, cell: Cell) -> str:
    """Return a position and its cell in words."""
    position = stamped.pose.position
    return (
        f"({position.x:.6g}, {position.y:.6g}) m in cell ({cell[0]:.6g}, {cell[1]:.6g})"
    )
