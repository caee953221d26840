"""Measures how often paths flip on noisy costmaps, and what keeping them costs."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from processes import run_script
from random_maps import Random, generate_map, inflated_costs
from tables import table

from ddqn_planner import GridMap, MoveRule, Planner
from ddqn_planner.grid import Cell, clearance
from ddqn_planner.grid.arguments import Occupancy
from ddqn_planner.grid.moves import cells_along
from ddqn_planner.grid.noise import random_requests
from ddqn_planner.planning import PlanRequest
from ddqn_planner.planning.path_finder import last_step
from ddqn_planner.planning.paths import rest_of_path
from ddqn_planner.planning.segments import cost_along

RULE = MoveRule.ROBOT_SAFE
THRESHOLDS = (0.0, 0.03, 0.05, 0.1)
KINDS = ("two ways", "rooms", "office", "random_10")
SIDE = 160  # cells
RUNS = 16  # of a kind
REPLANS = 100  # of a run, at most
STRIDE = 2  # cells from one replan to the next: at 5 cm, 0.5 m/s and 5 Hz
SIGHT = 80  # cells: farther away than this nothing flickers
# The costmap flickers: these shares of the free cells are seen as obstacles.
SEEN_BESIDE_WALLS = 0.03
SEEN_ELSEWHERE = 0.001
INFLATION = 8.0  # cells around obstacles with costs
AHEAD = 60  # cells of a path that are compared with the last path
APART = 10  # cells between two paths from which on it is a flip


class Driven(NamedTuple):
    """What was counted while a robot drove: replans, flips, and the cost of its way."""

    replans: int
    flips: int
    cost: float


def main(_: Sequence[str]) -> int:
    """Print the flips per 100 replans; cost beside that of the first threshold."""
    rows = []
    planner = Planner.load("any_map")
    planner.fields.max_bytes = 0  # each map comes once
    for kind, path in itertools.product(KINDS, ("cells", "straight")):
        first_cost = None
        for threshold in THRESHOLDS:
            is_straight = path == "straight"
            runs = [
                drive(planner, kind, seed, threshold, is_straight)
                for seed in range(RUNS)
            ]
            replans, flips, cost = np.sum(runs, axis=0)
            if first_cost is None:
                first_cost = cost
            flips_per_100 = f"{100 * flips / replans:.1f}"
            more_cost = f"{cost / first_cost - 1:+.2%}"
            rows.append([kind, path, threshold, int(replans), flips_per_100, more_cost])
    header = "map | path | switch_threshold | replans | flips per 100 | cost driven"
    print(table(header, rows))
    return 0


def drive(
    planner: Planner,
    kind: str,
    seed: int,
    threshold: float,
    is_straight: bool,
    side: int = SIDE,
) -> Driven:
    """Drive from a start to a goal; the seed and the kind fix the map and its noise."""
    random = np.random.default_rng([seed, KINDS.index(kind)])
    occupancy, robot, goal = scenario(kind, side, random)
    driven = [robot]  # cells
    path = np.empty((0, 2), dtype=np.int32)
    replans = 0
    flips = 0
    for number in range(REPLANS):
        # The noise depends on the time, not on what was drawn for another way of the
        # robot.
        noise = np.random.default_rng([seed, number])
        grid = _costmap(occupancy, robot, goal, noise)
        request = PlanRequest(
            grid,
            robot,
            (goal,),
            RULE,
            simplified=is_straight,
            under_way=path,
            switch_threshold=threshold,
        )
        plan = last_step(planner.steps(request))
        if not plan.cells:  # it waits
            continue
        rest_of_last = rest_of_path(path, robot, grid, RULE)
        path = plan.path
        replans += 1
        flips += is_flip(rest_of_last, path)
        cells, _ = cells_along(path)
        driven += [(x, y) for x, y in cells[1 : 1 + STRIDE].tolist()]
        robot = driven[-1]
        if robot == goal:
            break
    true_map = GridMap(occupancy, cost=inflated_costs(occupancy, INFLATION))
    if robot != goal:  # the best path from there, so that all drives end at the goal
        driven += planner.plan(true_map, robot, goal, RULE).cells[1:]
    return Driven(replans, flips, cost_along(driven, true_map, RULE))


def _costmap(occupancy: Occupancy, robot: Cell, goal: Cell, noise: Random) -> GridMap:
    """Return what the robot sees: obstacles that are not there flicker around it."""
    share = np.where(clearance(occupancy) < 2, SEEN_BESIDE_WALLS, SEEN_ELSEWHERE)
    y, x = np.ogrid[: occupancy.shape[0], : occupancy.shape[1]]
    is_in_sight = np.hypot(x - robot[0], y - robot[1]) <= SIGHT
    flickers = noise.random(occupancy.shape) < share
    seen = occupancy | (flickers & is_in_sight)
    for column, row in (robot, goal):
        seen[row, column] = False
    return GridMap(seen, cost=inflated_costs(seen, INFLATION))


def scenario(kind: str, side: int, random: Random) -> tuple[Occupancy, Cell, Cell]:
    """Return a map, a start and a goal at least half a side away."""
    if kind == "two ways":
        occupancy = np.zeros((side // 2, side), dtype=np.bool_)
        margin = side // 8
        occupancy[margin:-margin, side // 3 : -margin] = True
        return occupancy, (2, side // 4), (side - 3, side // 4)
    occupancy = generate_map(kind, (side, side), random)
    while True:
        ((start, goal),) = random_requests(occupancy, RULE, 1, random)
        if np.abs(np.subtract(goal, start)).max() >= side / 2:
            return occupancy, start, goal


def is_flip(last_path: NDArray[np.int32], path: NDArray[np.int32]) -> bool:
    """Return whether a path's next 3 m lead away from what is left of the last one."""
    if not len(last_path):
        return False
    cells, _ = cells_along(path)
    last_cells, _ = cells_along(last_path)
    offsets = cells[:AHEAD, None] - last_cells  # (AHEAD, last cells, 2)
    distances = np.hypot(offsets[..., 0], offsets[..., 1]).min(axis=1)
    return bool((distances > APART).any())


if __name__ == "__main__":
    run_script(main, {})
