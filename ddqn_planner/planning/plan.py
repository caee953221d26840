"""What a planner is asked, and what it answers."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from ddqn_planner.grid import Cell, GridMap, MoveRule, path_length
from ddqn_planner.grid.arguments import Choice


class PlanStatus(str, Enum):
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
    """By greedy steps, or where they are trapped by a search in the order of the Q field."""


@dataclass(frozen=True)
class PlanRequest:
    """All that a path is planned with, so that a request may wait while other things change.

    Parameters
    ----------
    grid : GridMap
    start, goal : (x, y)
    move_rule : MoveRule
    method : PlanMethod
        Whether to search where the greedy steps are trapped.
    tolerance : float
        How far a goal that is occupied or cut off may move, in cells: to the nearest free cell
        that a path reaches.
    simplified : bool
        Whether to leave out cells, see `simplify`.
    """

    grid: GridMap
    start: Cell
    goal: Cell
    move_rule: MoveRule
    method: PlanMethod = PlanMethod.GREEDY
    tolerance: float = 0.0
    simplified: bool = False


@dataclass(frozen=True)
class Plan:
    """A path, or the reason why there is none.

    Parameters
    ----------
    status : PlanStatus
    cells : tuple of (x, y)
        From start to goal, every move legal, or every segment if the path was simplified; empty
        unless the status is SUCCEEDED.
    method : PlanMethod
        ASTAR_FALLBACK if it was searched for because the greedy steps were trapped.
    move_rule : MoveRule
        The rule under which the moves are legal.
    cost : float, optional
        What the path costs before it is simplified, see `path_cost`: on a map with costs, if a
        planner made the plan. On a map of expected times it is in seconds.
    goal : (x, y), optional
        Where the path ends, or would end: the goal asked for, or the cell to which it moved. None
        if no Q field is needed to say that there is no path, or for a rollout.
    field_ms, rollout_ms : float
        How long it took to get the Q field, and the path from it, in milliseconds. Where the field
        had to grow for the start, its time includes the path.
    """

    status: PlanStatus
    cells: tuple[Cell, ...] = ()
    method: PlanMethod = PlanMethod.GREEDY
    move_rule: MoveRule = MoveRule.ROBOT_SAFE
    cost: float | None = None
    goal: Cell | None = None
    field_ms: float = field(default=0.0, compare=False)
    rollout_ms: float = field(default=0.0, compare=False)

    @property
    def length(self) -> float:
        """Length in cells under the plan's rule, see `path_length`."""
        return path_length(self.cells, self.move_rule)
