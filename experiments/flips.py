"""Measures how often paths flip on noisy costmaps, and what keeping them costs."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
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
SIDE, RUNS, REPLANS = (
    160,
    16,
    100,
)  # cells of a side; runs of a kind; replans of a run at most
STRIDE = 2  # cells from one replan to the next: at 5 cm, 0.5 m/s and 5 Hz
SIGHT = 80  # cells: farther away than this nothing flickers
# The costmap flickers: such shares of the free cells are seen as obstacles, with costs
# around.
SEEN_BESIDE_WALLS, SEEN_ELSEWHERE, INFLATION = 0.03, 0.001, 8.0
AHEAD, APART = (
    60,
    10,
)  # cells: how far ahead a path counts, and how far apart it has flipped


class Driven(NamedTuple):
    """What was counted while a robot drove: replans, flips, and the cost of its way."""

    replans: int
    flips: int
    cost: float


def main(_: Sequence[str]) -> int:
    """Print the flips per 100 replans; cost beside that of the first threshold."""
    rows, planner = [], Planner.load("any_map")
    planner.fields.nbytes = 0  # each map comes once
    for kind, path in itertools.product(KINDS, ("cells", "straight")):
        first = None
        for threshold in THRESHOLDS:
            how = threshold, path == "straight"
            runs = [drive(planner, kind, seed, *how) for seed in range(RUNS)]
            replans, flips, cost = np.sum(runs, axis=0)
            first = first or cost
            more = f"{cost / first - 1:+.2%}"
            rows.append(
                [
                    kind,
                    path,
                    threshold,
                    int(replans),
                    f"{100 * flips / replans:.1f}",
                    more,
                ]
            )
    print(
        table(
            "map | path | switch_threshold | replans | flips per 100 | cost driven",
            rows,
        )
    )
    return 0


def drive(
    planner: Planner,
    kind: str,
    seed: int,
    threshold: float,
    straight: bool,
    side: int = SIDE,
) -> Driven:
    """Drive from a start to a goal; the seed and the kind fix the map and its noise."""
    random = np.random.default_rng([seed, KINDS.index(kind)])
    occupancy, robot, goal = scenario(kind, side, random)
    share = np.where(clearance(occupancy) < 2, SEEN_BESIDE_WALLS, SEEN_ELSEWHERE)
    y, x = np.ogrid[: occupancy.shape[0], : occupancy.shape[1]]
    way, path, replans, flips = [robot], np.empty((0, 2), dtype=np.int32), 0, 0
    for number in range(REPLANS):
        # The noise depends on the time, not on what was drawn for another way of the
        # robot.
        noise = np.random.default_rng([seed, number]).random(occupancy.shape) < share
        seen = occupancy | (noise & (np.hypot(x - robot[0], y - robot[1]) <= SIGHT))
        seen[robot[::-1]] = seen[goal[::-1]] = False
        grid = GridMap(seen, cost=inflated_costs(seen, INFLATION))
        request = PlanRequest(
            grid, robot, (goal,), RULE, simplified=straight, under_way=path
        )
        plan = last_step(planner.steps(replace(request, switch_threshold=threshold)))
        if not plan.cells:  # it waits
            continue
        rest, path = rest_of_path(path, robot, grid, RULE), plan.path
        replans += 1
        flips += is_flip(rest, path)
        way += [(x, y) for x, y in cells_along(path)[0][1 : 1 + STRIDE].tolist()]
        robot = way[-1]
        if robot == goal:
            break
    true_map = GridMap(occupancy, cost=inflated_costs(occupancy, INFLATION))
    if robot != goal:  # the best path from there, so that all drives end at the goal
        way += planner.plan(true_map, robot, goal, RULE).cells[1:]
    return Driven(replans, flips, cost_along(way, true_map, RULE))


def scenario(kind: str, side: int, random: Random) -> tuple[Occupancy, Cell, Cell]:
    """Return a map, a start and a goal at least half a side away."""
    if kind == "two ways":
        occupancy = np.zeros((side // 2, side), dtype=np.bool_)
        occupancy[side // 8 : -side // 8, side // 3 : -side // 8] = True
        return occupancy, (2, side // 4), (side - 3, side // 4)
    occupancy = generate_map(kind, (side, side), random)
    while True:
        ((start, goal),) = random_requests(occupancy, RULE, 1, random)
        if max(abs(goal[0] - start[0]), abs(goal[1] - start[1])) >= side / 2:
            return occupancy, start, goal


def is_flip(rest: NDArray[np.int32], path: NDArray[np.int32]) -> bool:
    """Return whether a path's next 3 m lead away from the last path's rest."""
    if not len(rest):
        return False
    ahead, _ = cells_along(path)
    apart = np.hypot(
        *(ahead[:AHEAD, None] - cells_along(rest)[0]).transpose(2, 0, 1)
    ).min(axis=1)
    return bool((apart > APART).any())


if __name__ == "__main__":
    run_script(main)
