"""Measures planning and training beside their peers, in CPU time (`make bench`).

All run on one thread.
"""

import gc
import math
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import dijkstra3d
import gymnasium
import nano_astar
import numpy as np
import pyastar2d
import tcod.path
import torch
from numpy.typing import NDArray
from processes import run_script
from random_maps import KINDS, Random, generate_map
from stable_baselines3 import DQN
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from straight_paths import measure_straight_paths
from tables import report
from torch import nn
from torch_learner import TorchLearner

from ddqn_planner import GridMap, MoveRule, Plan, Planner, QField
from ddqn_planner.grid import Cell, inflate, shortest_distances
from ddqn_planner.grid.arguments import Occupancy
from ddqn_planner.grid.noise import random_costs, random_requests
from ddqn_planner.training.environment import paper_scenario
from ddqn_planner.training.gymnasium_environments import GridEnvironment
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import Trainer

RULE = MoveRule.ROBOT_SAFE
MAP_KINDS = ("random_20", "rooms", "office", "maze")
REQUESTS, ROUNDS, FIELDS, CHANGES = 15, 3, 100, 100
STEPS, TRAINING_ROUNDS = 3_000, 5
FLIPPED = 10  # cells that a change near a place flips, of the 25 around it
WALL = 41  # cells of a wall that opens or closes
SHORTEST = 40
"""Moves of the shortest path for replans: robot and goal are far from each other."""

# The kinds of changes, and where on the path: a number of moves from its ends, or 0 for
# its middle.
CHANGE_KINDS = {
    "cells near the robot": 10,
    "cells near the goal": -11,
    "cells anywhere": 0,
    "a wall opens": 0,
    "a wall closes": 0,
    "a wall beside the goal": -3,
}
# They cut corners, and cost what the entered cell costs; a diagonal as much as a
# straight move, or with tcod 1.4 times as much. pyastar2d is not among them: where
# cells cost differently, it may read memory that it never set.
PEERS = "tcod", "dijkstra3d A*", "dijkstra3d from both ends"
LOADED = Planner.load("any_map")


def new_planner() -> Planner:
    """Return a planner that knows no map yet; the tables of its network are made."""
    return Planner(LOADED.network, LOADED.metadata)


def timed(
    function: Callable[..., Any], *arguments: Any, **options: Any
) -> tuple[float, Any]:
    """Call a function; return how long it computed, milliseconds, and its answer."""
    began = time.process_time()
    answer = function(*arguments, **options)
    return 1e3 * (time.process_time() - began), answer


def medians(times: Sequence[Sequence[float]]) -> list[float]:
    """Return the median of each column."""
    return [statistics.median(column) for column in zip(*times, strict=True)]


def measure_paper_map() -> Iterator[bool]:
    """Time the Q field of the paper's map, computed anew each time."""
    planner, scenario = Planner.load("dilemma"), paper_scenario()
    of_map = scenario.grid, scenario.goal, planner.metadata.move_rule
    times = [timed(planner.network.q_values, *of_map)[0] for _ in range(FIELDS)]
    yield report("Q field of the 20x20 map", statistics.median(times), "ms", 20)


def measure_requests(side: int) -> Iterator[bool]:
    """Compare a request on a new map with A* in C++.

    A request to a known goal is timed, too.
    """
    for kind in MAP_KINDS:
        random = np.random.default_rng(0)
        occupancy = generate_map(kind, (side, side), random)
        nano_map = occupancy.astype(np.uint8)
        weights = np.where(occupancy, np.inf, 1).astype(np.float32)
        requests = []  # of each the medians of its times, and the length of its path
        for start, goal in random_requests(occupancy, RULE, REQUESTS, random):
            ends = start[::-1], goal[::-1]
            times = []
            for _ in range(ROUNDS):
                planner = new_planner()
                grid = GridMap(occupancy)
                ms, plan = timed(planner.plan, grid, start, goal, RULE)
                known_ms, _ = timed(planner.plan, grid, plan.cells[1], goal, RULE)
                nano_ms, (_, length) = timed(nano_astar.astar, nano_map, *ends)
                pyastar_ms, _ = timed(
                    pyastar2d.astar_path, weights, *ends, allow_diagonal=True
                )
                times.append((ms, nano_ms, pyastar_ms, known_ms))
            lengths = plan.length, length
            assert math.isclose(*lengths, rel_tol=1e-6), lengths
            requests.append((*medians(times), len(plan.cells)))
        ms, nano_ms, pyastar_ms, known_ms, moves = medians(requests)
        place = f"{side}x{side} {kind}"
        name = f"{place}: request {ms:.2f} ms"
        yield report(f"{name}, nano-astar {nano_ms:.2f}; ratio", ms / nano_ms, "x", 1.0)
        ratio = ms / pyastar_ms
        yield report(f"{name}, pyastar2d* {pyastar_ms:.2f}; ratio", ratio, "x", 1.3)
        yield report(f"{place}: known goal, {moves:.0f} cells", known_ms, "ms", 0.1)
    print(
        "* cuts corners, and a diagonal counts 1: its paths are no paths under our rule"
    )


def search_with_tcod(cost: NDArray[np.int32], start: Cell, goal: Cell) -> Any:
    """Return the path of libtcod's A*, given whole costs, 0 where occupied."""
    graph = tcod.path.SimpleGraph(
        cost=cost, cardinal=5, diagonal=7, greed=int(cost[cost > 0].min())
    )
    search = tcod.path.Pathfinder(graph)
    search.add_root(start[::-1])
    return search.path_to(goal[::-1])


def farthest_cells(occupancy: Occupancy) -> tuple[Cell, Cell]:
    """Return two cells near opposite corners, of the most connected ones."""
    labels = GridMap(occupancy).labels(RULE)
    cells = np.argwhere(labels == np.bincount(labels[~occupancy]).argmax())[:, ::-1]
    first, last = cells.sum(axis=1).argmin(), cells.sum(axis=1).argmax()
    return tuple(cells[first].tolist()), tuple(cells[last].tolist())


def measure_requests_with_costs(side: int) -> Iterator[bool]:
    """Compare requests across new maps with costs with searches in C and C++."""
    ratios = []
    for kind in MAP_KINDS:
        random = np.random.default_rng(0)
        occupancy = generate_map(kind, (side, side), random)
        start, goal = farthest_cells(occupancy)
        inflated = inflate(GridMap(occupancy, 0.05), 0, 1).cost
        for name, cost in (
            ("inflated", inflated),
            ("random", random_costs(occupancy, random)),
        ):
            multiplier, times = GridMap(occupancy, cost=cost).cost_multiplier, []
            weights = np.where(occupancy, np.inf, multiplier).astype(np.float32)
            whole = np.where(occupancy, 0, np.rint(25 * multiplier)).astype(np.int32)
            ends = weights, start[::-1], goal[::-1]
            for _ in range(2 + ROUNDS * 1024 // side):
                ms, _ = timed(
                    new_planner().plan, GridMap(occupancy, cost=cost), start, goal, RULE
                )
                tcod_ms, _ = timed(search_with_tcod, whole, start, goal)
                astar_ms, _ = timed(
                    dijkstra3d.dijkstra, *ends, connectivity=8, compass=True
                )
                both_ms, _ = timed(
                    dijkstra3d.dijkstra, *ends, connectivity=8, bidirectional=True
                )
                times.append((ms, tcod_ms, astar_ms, both_ms))
            ms, *peers = medians(times[2:])  # the first rounds of all load their code
            ratios.append([ms / peer for peer in peers])
            beside = ", ".join(f"{peer:.1f}" for peer in peers)
            print(
                f"{side}x{side} {kind}, {name} costs: {ms:.1f} ms; peers {beside}",
                flush=True,
            )
    for peer, of_peer in zip(PEERS, zip(*ratios, strict=True), strict=True):
        typical = statistics.median(of_peer)
        request = f"{side}x{side}: long request with costs"
        figure = f"{request} / {peer}, median {typical:.2f}; worst"
        yield report(figure, max(of_peer), "x", 1.0)


class Change(NamedTuple):
    """A map, and another patch of it from the cell (x, y) on."""

    occupancy: Occupancy
    patch: Occupancy
    x: int
    y: int

    def maps(self) -> tuple[GridMap, GridMap]:
        """Return the map before and after the change."""
        grid = GridMap(self.occupancy)
        return grid, grid.with_patch(self.patch, self.x, self.y)


def draw_change(
    kind: str, occupancy: Occupancy, path: Sequence[Cell], random: Random
) -> Change:
    """Draw a change of cells around a place or anywhere, or a wall across a path."""
    side = len(occupancy)
    index = CHANGE_KINDS[kind] or len(path) // 2
    x, y = path[index]
    width = height = side if kind == "cells anywhere" else 5
    if "wall" in kind:
        way_x, way_y = np.abs(np.subtract(path[index + 2], path[index - 2]))
        width, height = (WALL, 1) if way_y > way_x else (1, WALL)
    x = int(np.clip(x - width // 2, 0, side - width))
    y = int(np.clip(y - height // 2, 0, side - height))
    box = occupancy[y : y + height, x : x + width]
    if "wall" not in kind:
        flipped = box.copy()
        flipped.flat[random.choice(box.size, FLIPPED, replace=False)] ^= True
        return Change(occupancy, flipped, x, y)
    opens = kind == "a wall opens"
    if "beside" in kind:
        opens = random.random() < 0.5
    if not opens:
        return Change(occupancy, np.ones_like(box), x, y)
    walled = occupancy.copy()
    walled[y : y + height, x : x + width] = True
    return Change(walled, box, x, y)


def draw_changes(
    map_kind: str, side: int, kind: str
) -> Iterator[tuple[Change, Cell, Cell]]:
    """Draw changes that leave start and goal free, each with its start and goal."""
    random = np.random.default_rng(0)
    drawn = 0
    occupancy = generate_map(map_kind, (side, side), random)
    while drawn < CHANGES // len(MAP_KINDS):
        ((start, goal),) = random_requests(occupancy, RULE, 1, random)
        path = new_planner().plan(GridMap(occupancy), start, goal, RULE).cells
        if len(path) <= SHORTEST:
            continue
        change = draw_change(kind, occupancy, path, random)
        _, changed_map = change.maps()
        if changed_map.is_free(start) and changed_map.is_free(goal):
            drawn += 1
            yield change, start, goal


def replan(
    change: Change, start: Cell, goal: Cell, knows_former: bool
) -> tuple[float, Plan]:
    """Time a plan on a changed map, by a planner that may know the former map."""
    planner = new_planner()
    former_map, changed_map = change.maps()
    if knows_former:
        planner.plan(former_map, start, goal, RULE)
    return timed(planner.plan, changed_map, start, goal, RULE)


def measure_replans(side: int) -> Iterator[bool]:
    """Compare replans with new fields, which must give the same path."""
    for kind in CHANGE_KINDS:
        ratios = []
        for map_kind in MAP_KINDS:
            for change, start, goal in draw_changes(map_kind, side, kind):
                times = []
                for _ in range(ROUNDS):
                    ms, plan = replan(change, start, goal, knows_former=True)
                    new_ms, new_plan = replan(change, start, goal, knows_former=False)
                    assert plan.cells == new_plan.cells, (start, goal)
                    times.append((ms, new_ms))
                ms, new_ms = medians(times)
                ratios.append(ms / new_ms)
        typical = statistics.median(ratios)
        figure = f"{side}x{side}, {kind}: replan / new, median {typical:.3f}; worst"
        yield report(figure, max(ratios), "x", 2.0)


def measure_short_requests(side: int) -> Iterator[bool]:
    """Compare a request of 15 cells on a map of random costs with one without."""
    random = np.random.default_rng(0)
    occupancy = random.random((side, side)) < 0.2
    occupancy[3:30, 3:30] = False
    costs = random_costs(occupancy, random)
    times = []
    for _ in range(CHANGES):
        maps = GridMap(occupancy), GridMap(occupancy, cost=costs)
        times.append(
            [timed(new_planner().plan, m, (5, 5), (20, 20), RULE)[0] for m in maps]
        )
    ms, ms_with_costs = medians(times)
    name = f"{side}x{side}, 15 cells: {ms:.2f} ms; with costs {ms_with_costs:.2f}"
    yield report(f"{name}; ratio", ms_with_costs / ms, "x", 2.0)


def measure_first_request(side: int) -> Iterator[bool]:
    """Time first requests on a huge map, to a near goal."""
    random = np.random.default_rng(0)
    occupancy = random.random((side, side)) < 0.1
    middle = side // 2
    start, goal = (middle, middle), (middle + 60, middle)
    occupancy[start[::-1]] = occupancy[goal[::-1]] = False
    for name, cost in (("", None), (", random costs", random_costs(occupancy, random))):
        grid, times = GridMap(occupancy, cost=cost), []
        for _ in range(ROUNDS):
            ms, plan = timed(new_planner().plan, grid, start, goal, RULE)
            assert plan.cells
            times.append(ms)
        figure = f"{side}x{side}{name}, 60 cells: request"
        yield report(figure, statistics.median(times), "ms", 600)


def measure_repairs(sides: tuple[int, int], with_costs: bool) -> Iterator[bool]:
    """Compare replans near the robot on a large map and on a small one.

    Their times include the patches.
    """
    known: list[list[Any]] = []
    for side in sides:
        random = np.random.default_rng(0)
        occupancy = random.random((side, side)) < 0.2
        occupancy[100:140, 100:140] = occupancy[500:503, 500:503] = False
        grid = GridMap(
            occupancy, cost=random_costs(occupancy, random) if with_costs else None
        )
        known.append([random, new_planner(), grid])
        known[-1][1].plan(grid, (110, 110), (501, 501), RULE)

    def repair(of_side: list[Any]) -> None:
        random, planner, grid = of_side
        (x, y), flipped = (
            random.integers(112, 130, 2),
            random.choice(25, FLIPPED, replace=False),
        )
        patch = grid.occupancy[y : y + 5, x : x + 5].copy()
        patch.flat[flipped] ^= True
        of_side[2] = grid.with_patch(patch, x, y)
        assert planner.plan(of_side[2], (110, 110), (501, 501), RULE).cells

    small, large = medians(
        [[timed(repair, it)[0] for it in known] for _ in range(CHANGES)]
    )
    costs = ", costs" if with_costs else ""
    times = f"{small:.2f} ms at {sides[0]}, {large:.2f} at {sides[1]}"
    yield report(
        f"{FLIPPED} cells near the robot{costs}: {times}; ratio",
        large / small,
        "x",
        3,
    )


def all_values(grid: GridMap, goal: Cell) -> QField:
    """Return a field whose value was asked for in every cell."""
    field = new_planner().q_field(grid, goal, RULE)
    _ = field.value
    return field


def measure_whole_fields(side: int, costs: bool, bound: float) -> Iterator[bool]:
    """Compare the value of every cell with scipy's Dijkstra, on each kind.

    The time of scipy's includes the graph.
    """
    name = f"{side}x{side}, random costs" if costs else f"{side}x{side}"
    rounds = 20 if side < 1000 else 1
    ratios = []
    nbytes = 0
    for kind in KINDS:
        random = np.random.default_rng(0)
        occupancy = generate_map(kind, (side, side), random)
        cost = random_costs(occupancy, random) if costs else None
        times = []
        for _, goal in random_requests(occupancy, RULE, ROUNDS, random):
            for _ in range(rounds):
                ms, field = timed(all_values, GridMap(occupancy, cost=cost), goal)
                new_map = GridMap(occupancy, cost=cost)
                scipy_ms, _ = timed(shortest_distances, new_map, goal, RULE)
                times.append((ms, scipy_ms))
            nbytes = max(nbytes, field.nbytes - field.value.nbytes)
        # Python makes code faster that ran often.
        ms, scipy_ms = medians(times[rounds // 2 :])
        ratios.append((ms / scipy_ms, kind))
        print(f"{name}, {kind}: field {ms:.1f} ms, Dijkstra {scipy_ms:.1f} ms")
        sys.stdout.flush()
    worst, kind = max(ratios)
    figure = f"{name}: field / Dijkstra, worst kind ({kind})"
    yield report(figure, 100 * worst, "%", bound)
    yield report(f"{name}: bytes per cell of a field", nbytes / side**2, "B", 10)


class PaperFeatures(BaseFeaturesExtractor):
    """The paper's convolution, for Stable-Baselines3.

    The Q head of Stable-Baselines3 is the fully connected layer.
    """

    def __init__(self, observation_space: gymnasium.spaces.Box, filters: int) -> None:
        height, width = observation_space.shape
        super().__init__(
            observation_space, filters * ((height + 1) // 2) * ((width + 1) // 2)
        )
        self.convolution = nn.Conv2d(1, filters, kernel_size=3, stride=2, padding=1)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return (B, features)."""
        return torch.relu(self.convolution(observations.unsqueeze(1))).flatten(1)


def measure_training() -> Iterator[bool]:
    """Compare training with torch and with Stable-Baselines3.

    The network is the same, with an update for each step.
    """
    # ε is at its last value from the start: a random action costs no forward pass.
    p = HyperParameters(epsilon_start=HyperParameters().epsilon_end)
    scenario = paper_scenario()
    ours, in_torch = (Trainer([scenario], p, seed=0) for _ in range(2))
    TorchLearner(in_torch)
    theirs = DQN(
        "MlpPolicy",
        GridEnvironment(scenario, p),
        learning_rate=p.learning_rate,
        buffer_size=p.replay_capacity,
        learning_starts=p.learning_starts,
        batch_size=p.batch_size,
        gamma=p.gamma,
        train_freq=p.update_interval,
        target_update_interval=p.target_interval,
        exploration_initial_eps=p.epsilon_start,
        exploration_final_eps=p.epsilon_end,
        policy_kwargs={
            "features_extractor_class": PaperFeatures,
            "features_extractor_kwargs": {"filters": p.filters},
            "net_arch": [],
        },
        seed=0,
        device="cpu",
    )
    weights = sum(tensor.size for tensor in ours.network.tensors.values())
    assert weights == sum(weight.numel() for weight in theirs.q_net.parameters())
    times = []
    for _ in range(1 + TRAINING_ROUNDS):
        until = ours.steps + STEPS
        in_rounds = [timed(list, trainer.run(until))[0] for trainer in (ours, in_torch)]
        in_rounds.append(timed(theirs.learn, STEPS, reset_num_timesteps=False)[0])
        times.append(in_rounds)
    del times[0]  # all past `learning_starts`, and warm
    rates = [1e3 * STEPS / ms for ms in medians(times)]
    for name, place, bound in (("torch", 1, 20), ("Stable-Baselines3", 2, 30)):
        ratio = statistics.median(round[place] / round[0] for round in times)
        figure = f"training: {rates[0]:.0f} steps/s; {name} {rates[place]:.0f}; ratio"
        yield report(figure, ratio, "x", bound, at_most=False)


def main(_: Sequence[str]) -> int:
    """Print each figure beside its bound; return 1 if one is missed."""
    torch.set_num_threads(1)
    # Else this process pauses to look for garbage among what it has imported.
    gc.freeze()
    missed = [*measure_paper_map(), *measure_training()]
    for side in (256, 1024):
        missed += [*measure_requests(side), *measure_requests_with_costs(side)]
    missed += [*measure_short_requests(1024), *measure_replans(1024)]
    missed += measure_first_request(8192)
    for with_costs in (False, True):
        missed += measure_repairs((1024, 2048), with_costs)
    missed += measure_whole_fields(64, True, 30)
    for side in (256, 1024, 2048):
        missed += measure_straight_paths(side, MAP_KINDS)
    for side in (256, 1024, 2000):
        missed += [
            *measure_whole_fields(side, False, 20),
            *measure_whole_fields(side, True, 25),
        ]
    return int(any(missed))


if __name__ == "__main__":
    run_script(main, {})
