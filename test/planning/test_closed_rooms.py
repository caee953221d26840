"""Goals inside and outside closed rooms, for bodies with a heading."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from networks import robot_planner

from ddqn_planner import GridMap, Planner
from ddqn_planner.model import RobotNetwork
from ddqn_planner.planning import PlanStatus, pose_field
from ddqn_planner.planning.plan import PosePlan
from ddqn_planner.planning.pose_world import State

CELL = 0.1  # metres
CORNER, SIDE = 40, 26  # of the room, in cells


def hall_with_closed_room() -> GridMap:
    occupancy = np.zeros((110, 110), np.bool_)
    end = CORNER + SIDE
    occupancy[CORNER:end, CORNER:end] = True
    occupancy[CORNER + 1 : end - 1, CORNER + 1 : end - 1] = False
    return GridMap(occupancy, CELL)


HALL = hall_with_closed_room()
# In one corner of the room, in the opposite corner, and in the hall.
START: State = (CORNER + 5, CORNER + 5, 4)
INSIDE: State = (CORNER + SIDE - 6, CORNER + SIDE - 6, 9)
FAR: State = (100, 100, 0)
# Nearer to the start than the goal inside: the search sees these first.
AROUND: list[State] = [
    state
    for place in range(CORNER - 6, CORNER + SIDE, 3)
    for heading in (0, 4, 8, 12)
    for state in ((CORNER - 6, place, heading), (place, CORNER - 6, heading))
]


def plan(planner: Planner, start: State, goals: Sequence[State]) -> PosePlan:
    assert isinstance(planner.network, RobotNetwork)
    angles = planner.network.motions.angles
    start_pose, *goal_poses = [
        (*HALL.cell_to_world((x, y)), float(angles[heading]))
        for x, y, heading in (start, *goals)
    ]
    return planner.plan_poses(HALL, start_pose, goal_poses)


@pytest.mark.parametrize("states_of_small_room", [200, 2**14])
def test_goals_outside_a_closed_room_hide_no_goal_inside(
    monkeypatch: Any, states_of_small_room: int
) -> None:
    monkeypatch.setattr(pose_field, "UNGUIDED", states_of_small_room)
    planner = robot_planner("ackermann", CELL)
    alone = plan(planner, START, [INSIDE])
    for goals in ([INSIDE, *AROUND], [FAR, INSIDE], [*AROUND, INSIDE, FAR]):
        found = plan(planner, START, goals)
        assert found.status is PlanStatus.SUCCEEDED
        assert found.goal == INSIDE[:2]
        # Both costs are proved to lie within their bounds.
        assert alone.cost is not None
        assert found.cost is not None
        assert found.cost <= found.bound * alone.cost * 1.0001
        assert alone.cost <= alone.bound * found.cost * 1.0001
    for goals in (AROUND, [FAR]):
        assert plan(planner, START, goals).status is PlanStatus.NO_PATH
        assert plan(planner, INSIDE, goals).status is PlanStatus.NO_PATH
        # From the hall, the goal inside is the one without a path.
        found = plan(planner, FAR, [INSIDE, *goals])
        assert found.goal in {goal[:2] for goal in goals}
