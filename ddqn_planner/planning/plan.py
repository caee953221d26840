"""What a planner answers."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from ddqn_planner.grid import Cell, path_length


class PlanStatus(str, Enum):
    """The outcome of a request, each with the sentence that a user reads."""

    SUCCEEDED = "succeeded"
    START_OUTSIDE_MAP = "the start lies outside the map"
    GOAL_OUTSIDE_MAP = "the goal lies outside the map"
    START_OCCUPIED = "the start is occupied"
    GOAL_OCCUPIED = "the goal is occupied"
    MAP_SIZE_UNSUPPORTED = "the model was not trained for maps of this size"
    NO_PATH = "no path leads from the start to the goal"
    WALK_TRAPPED = "a path exists, but the model's greedy steps do not find it"


@dataclass(frozen=True)
class Plan:
    """A path, or the reason why there is none.

    Parameters
    ----------
    status : PlanStatus
    cells : tuple of (x, y)
        From start to goal, every move legal; empty unless the status is SUCCEEDED.
    """

    status: PlanStatus
    cells: tuple[Cell, ...] = ()

    @property
    def length(self) -> float:
        """Length in cells: 1 for a straight move, sqrt(2) for a diagonal one."""
        return path_length(self.cells)
