"""What a departure costs at least, beside exact costs."""

import numpy as np
import pytest
from bodies import least_costs

from ddqn_planner import GridMap, Planner
from ddqn_planner.model import RobotNetwork
from ddqn_planner.planning import departure
from ddqn_planner.planning.departure import (
    NO_TURN,
    PER_CELL,
    REACH,
    Departure,
    departure_cost,
)


@pytest.mark.parametrize("model", ["car", "differential_robot"])
def test_no_path_costs_less_than_its_departure(model: str) -> None:
    planner = Planner.load(model)
    network = planner.network
    assert isinstance(network, RobotNetwork)
    assert planner.pose_planner is not None
    random = np.random.default_rng(0)
    occupancy = random.random((36, 110)) < 0.001
    grid = GridMap(occupancy, network.motions.resolution)
    body = planner.pose_planner.body
    departure.write_ahead(body)
    goal_x, goal_y, goal_heading = 60, 18, 3
    occupancy[goal_y - 16 : goal_y + 17, goal_x - 20 : goal_x + 21] = False
    least = least_costs(
        grid, network.motions, network.swept(), (goal_x, goal_y, goal_heading)
    )
    has_path = np.isfinite(least)
    assert has_path.sum() > 1000
    tight = 0
    known = 0
    near = 0
    for y, x, heading in np.argwhere(has_path).tolist():
        tables = body.departures.cost[heading], body.departures.excess[heading]
        bound = departure_cost(goal_x, goal_y, Departure(x, y, *tables, NO_TURN))
        cost = least[y, x, heading]
        assert bound <= cost
        # Near the start, a table also knows the heading at the goal.
        if max(abs(goal_x - x), abs(goal_y - y)) <= REACH // 2:
            turn = body.departures.turn[heading, goal_y - y + REACH, goal_x - x + REACH]
            directed = body.directions * goal_heading
            bound_of_turn = turn[directed : directed + body.directions].min() / PER_CELL
            assert bound + bound_of_turn <= cost
            known += bound + bound_of_turn > 0.95 * cost
            near += 1
        straight = np.hypot(goal_x - x, goal_y - y)
        # It knows much of what a robot pays that faces away from its goal.
        tight += cost > straight + 10 and bound > straight + 0.5 * (cost - straight)
    assert tight > 100
    assert known > 0.1 * near
