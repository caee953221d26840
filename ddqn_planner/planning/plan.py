"""What a planner answers."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from ddqn_planner.grid import Cell, MoveRule, path_length
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
    """How a path is found, or was."""

    GREEDY = "greedy"
    """By greedy steps in the Q field alone."""
    ASTAR_FALLBACK = "astar_fallback"
    """By greedy steps, or where they are trapped by a search in the order of the Q field."""


@dataclass(frozen=True)
class Plan:
    """A path, or the reason why there is none.

    Parameters
    ----------
    status : PlanStatus
    cells : tuple of (x, y)
        From start to goal, every move legal; empty unless the status is SUCCEEDED. The goal is
        another than the one asked for where that is occupied or cut off and a tolerance was given.
    method : PlanMethod
        GUIDED if it was searched for because the greedy steps were trapped.
    move_rule : MoveRule
        The rule under which the moves are legal.
    cost : float, optional
        What the path costs, see `path_cost`: on a map with costs, if a planner made the plan.
    """

    status: PlanStatus
    cells: tuple[Cell, ...] = ()
    method: PlanMethod = PlanMethod.GREEDY
    move_rule: MoveRule = MoveRule.ROBOT_SAFE
    cost: float | None = None

    @property
    def length(self) -> float:
        """Length in cells under the plan's rule, see `path_length`."""
        return path_length(self.cells, self.move_rule)
