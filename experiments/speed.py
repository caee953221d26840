"""Measures planning and training beside their peers (`make bench`), in CPU time on one thread."""

import gc
import math
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import gymnasium
import nano_astar
import numpy as np
import pyastar2d
import torch
from random_maps import KINDS, Random, generate_map
from stable_baselines3 import DQN
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from tables import report
from torch import nn

from ddqn_planner import GridMap, MoveRule, Planner, QField
from ddqn_planner.grid import Cell, shortest_distances
from ddqn_planner.grid.arguments import Occupancy
from ddqn_planner.grid.noise import random_costs, random_requests
from ddqn_planner.training.environment import GridEnvironment, paper_scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import Trainer

RULE = MoveRule.ROBOT_SAFE
MAP_KINDS = ("random_20", "rooms", "office", "maze")
REQUESTS, ROUNDS, FIELDS, CHANGES = 15, 3, 100, 100
STEPS, TRAINING_ROUNDS = 3_000, 5
FLIPPED = 10  # cells that a change near a place flips, of the 25 around it
WALL = 41  # cells of a wall that opens or closes
SHORTEST = 40  # moves of the shortest path for replans: robot and goal are far from each other

Call = Callable[[], Any]  # what is timed; a `Callable[[], Call]` makes all that it needs
LOADED = Planner.load("any_map")


def new_planner() -> Planner:
    """Return a planner that knows no map yet; the tables of its network are made."""
    return Planner(LOADED.network, LOADED.metadata)


def new_request(occupancy: Occupancy, start: Cell, goal: Cell) -> Call:
    """Return the call that plans on a new map."""
    return partial(new_planner().plan, GridMap(occupancy), start, goal, RULE)


def on_new_map(function: Callable[..., Any], occupancy: Occupancy, cost: Any, goal: Cell) -> Call:
    """Return the call of a function of a map that it does not know."""
    return partial(function, GridMap(occupancy, cost=cost), goal, RULE)


def ready(function: Callable[..., Any], *arguments: Any, **options: Any) -> Callable[[], Call]:
    """Return the preparation of a call that needs none."""
    return lambda: partial(function, *arguments, **options)


def take_turns(*prepare: Callable[[], Call], rounds: int = ROUNDS) -> tuple[list[float], list[Any]]:
    """Prepare and time each call in turn; return their median milliseconds and last answers."""
    times: list[list[float]] = [[] for _ in prepare]
    answers: list[Any] = [None for _ in prepare]
    for _ in range(rounds):
        for number, make in enumerate(prepare):
            call = make()
            began = time.process_time()
            answers[number] = call()
            times[number].append(1e3 * (time.process_time() - began))
    return [statistics.median(of_call) for of_call in times], answers


def medians(times: Sequence[Sequence[float]]) -> list[float]:
    """Return the median of each column."""
    return [statistics.median(column) for column in zip(*times, strict=True)]


def measure_paper_map() -> Iterator[bool]:
    """Time the Q field of the paper's map, computed anew each time."""
    planner, scenario = Planner.load("dilemma"), paper_scenario()
    rule = planner.metadata.move_rule
    field = ready(planner.network.q_values, scenario.grid, scenario.goal, rule)
    ((took,), _) = take_turns(field, rounds=FIELDS)
    yield report("Q field of the 20x20 map", took, "ms", 20)


def measure_requests(side: int) -> Iterator[bool]:
    """Compare a request on a new map with A* in C++, and time one to a goal that is known."""
    for kind in MAP_KINDS:
        random, times = np.random.default_rng(0), []
        occupancy = generate_map(kind, (side, side), random)
        of_nano = occupancy.astype(np.uint8)
        weights = np.where(occupancy, np.inf, 1).astype(np.float32)
        for start, goal in random_requests(occupancy, RULE, REQUESTS, random):
            cells = start[::-1], goal[::-1]
            took, (plan, (_, length), _) = take_turns(
                partial(new_request, occupancy, start, goal),
                ready(nano_astar.astar, of_nano, *cells),
                ready(pyastar2d.astar_path, weights, *cells, allow_diagonal=True),
            )
            assert math.isclose(plan.length, length, rel_tol=1e-6), (plan.length, length)
            planner, grid = new_planner(), GridMap(occupancy)
            moved = planner.plan(grid, start, goal, RULE).cells[1]
            ((known,), _) = take_turns(ready(planner.plan, grid, moved, goal, RULE), rounds=1)
            times.append((*took, known, len(plan.cells)))
        our_ms, nano_ms, pyastar_ms, known_ms, moves = medians(times)
        name = f"{side}x{side} {kind}: request {our_ms:.2f} ms"
        yield report(f"{name}, nano-astar {nano_ms:.2f}; ratio", our_ms / nano_ms, "x", 1.0)
        yield report(f"{name}, pyastar2d* {pyastar_ms:.2f}; ratio", our_ms / pyastar_ms, "x", 1.3)
        yield report(f"{side}x{side} {kind}: known goal, {moves:.0f} cells", known_ms, "ms", 0.1)
    print("* cuts corners, and a diagonal counts 1: its paths are no paths under our rule")


CHANGE_KINDS = (
    "cells near the robot",
    "cells near the goal",
    "cells anywhere",
    "a wall opens",
    "a wall closes",
    "a wall beside the goal",
)
Change = tuple[Occupancy, Occupancy, int, int]  # a map, and a patch of it with its x and y


def draw_change(kind: str, occupancy: Occupancy, path: Sequence[Cell], random: Random) -> Change:
    """Draw a change of some cells around a place or anywhere, or of a wall across a path."""
    if "wall" not in kind:
        side, x, y = len(occupancy), 0, 0
        if kind != "cells anywhere":
            place = path[10 if "robot" in kind else -11]
            x, y = (int(np.clip(c - 2, 0, side - 5)) for c in place)
            side = 5
        patch = occupancy[y : y + side, x : x + side].copy()
        patch.flat[random.choice(patch.size, FLIPPED, replace=False)] ^= True
        return occupancy, patch, x, y
    at, opens = len(path) // 2, kind == "a wall opens"
    if kind == "a wall beside the goal":
        at, opens = len(path) - 3, random.random() < 0.5
    (x0, y0), (x, y), (x1, y1) = path[at - 2], path[at], path[at + 2]
    along_x = abs(y1 - y0) > abs(x1 - x0)
    x, y = (max(x - WALL // 2, 0), y) if along_x else (x, max(y - WALL // 2, 0))
    height, width = (1, WALL) if along_x else (WALL, 1)
    closed = occupancy.copy()
    closed[y : y + height, x : x + width] = True
    before, after = (closed, occupancy) if opens else (occupancy, closed)
    return before, after[y : y + height, x : x + width], x, y


def plan_after(change: Change, start: Cell, goal: Cell, knows_before: bool) -> Call:
    """Return the call that plans after a change, with the plan before it or without."""
    planner, grid = new_planner(), GridMap(change[0])
    if knows_before:
        planner.plan(grid, start, goal, RULE)
    return partial(planner.plan, grid.with_patch(*change[1:]), start, goal, RULE)


def draw_changes(map_kind: str, side: int, kind: str) -> Iterator[tuple[Change, Cell, Cell]]:
    """Draw changes that leave start and goal free, each with its start and goal."""
    random, drawn = np.random.default_rng(0), 0
    occupancy = generate_map(map_kind, (side, side), random)
    while drawn < CHANGES // len(MAP_KINDS):
        ((start, goal),) = random_requests(occupancy, RULE, 1, random)
        path = new_planner().plan(GridMap(occupancy), start, goal, RULE).cells
        if len(path) > SHORTEST:
            change = draw_change(kind, occupancy, path, random)
            after = GridMap(change[0]).with_patch(*change[1:])
            if after.is_free(start) and after.is_free(goal):
                drawn += 1
                yield change, start, goal


def measure_replans(side: int) -> Iterator[bool]:
    """Compare replans with a new field on the changed map, which must give the same path."""
    for kind in CHANGE_KINDS:
        ratios: list[tuple[float, str, float, float]] = []
        for map_kind in MAP_KINDS:
            for drawn in draw_changes(map_kind, side, kind):
                (ms, fresh_ms), (ours, fresh) = take_turns(
                    partial(plan_after, *drawn, True), partial(plan_after, *drawn, False)
                )
                assert ours.cells == fresh.cells, drawn[1:]
                ratios.append((ms / fresh_ms, map_kind, ms, fresh_ms))
        typical, (worst, on, ms, fresh_ms) = statistics.median(r[0] for r in ratios), max(ratios)
        print(f"worst: {on}, {ms:.1f} ms; new field {fresh_ms:.1f} ms")
        figure = f"{side}x{side}, {kind}: replan / new, median {typical:.3f}; worst"
        yield report(figure, worst, "x", 2.0)


def all_values(grid: GridMap, goal: Cell, rule: MoveRule) -> QField:
    """Return a field whose value was asked for in every cell."""
    field = new_planner().q_field(grid, goal, rule)
    _ = field.value
    return field


def measure_whole_fields(side: int, costs: bool, bound: float) -> Iterator[bool]:
    """Compare the value of every cell with scipy's Dijkstra, graph included, on each kind."""
    ratios, nbytes, name = {}, 0, f"{side}x{side}{', random costs' if costs else ''}"
    for kind in KINDS:
        random, times = np.random.default_rng(0), []
        occupancy = generate_map(kind, (side, side), random)
        cost = random_costs(occupancy, random) if costs else None
        for _, goal in random_requests(occupancy, RULE, ROUNDS, random):
            took, (field, _) = take_turns(
                partial(on_new_map, all_values, occupancy, cost, goal),
                partial(on_new_map, shortest_distances, occupancy, cost, goal),
                rounds=ROUNDS if side < 1000 else 1,
            )
            times.append(took)
            nbytes = max(nbytes, field.nbytes - field.value.nbytes)
        ours, dijkstra = medians(times)
        ratios[kind] = ours / dijkstra
        print(f"{name}, {kind}: field {ours:.1f} ms, Dijkstra {dijkstra:.1f} ms", flush=True)
    worst = max(ratios, key=lambda kind: ratios[kind])
    figure = f"{name}: field / Dijkstra, worst kind ({worst})"
    yield report(figure, 100 * ratios[worst], "%", bound)
    yield report(f"{name}: bytes per cell of a field", nbytes / side**2, "B", 10)


class PaperFeatures(BaseFeaturesExtractor):
    """The paper's convolution, for Stable-Baselines3; its Q head is the fully connected layer."""

    def __init__(self, observation_space: gymnasium.spaces.Box, filters: int) -> None:
        height, width = observation_space.shape
        super().__init__(observation_space, filters * ((height + 1) // 2) * ((width + 1) // 2))
        self.convolution = nn.Conv2d(1, filters, kernel_size=3, stride=2, padding=1)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return (B, features)."""
        return torch.relu(self.convolution(observations.unsqueeze(1))).flatten(1)


def measure_training() -> Iterator[bool]:
    """Compare our steps per second with Stable-Baselines3's DQN: same network, an update a step."""
    # ε is at its last value from the start: a random action costs no forward pass.
    p = HyperParameters(epsilon_start=HyperParameters().epsilon_end)
    scenario, rule = paper_scenario(), MoveRule.CORNER_CUTTING
    ours = Trainer([scenario], rule, p, seed=0)
    features = {
        "features_extractor_class": PaperFeatures,
        "features_extractor_kwargs": {"filters": p.filters},
        "net_arch": [],
    }
    theirs = DQN(
        "MlpPolicy",
        GridEnvironment(scenario, rule, p),
        learning_rate=p.learning_rate,
        buffer_size=p.replay_capacity,
        learning_starts=p.learning_starts,
        batch_size=p.batch_size,
        gamma=p.gamma,
        train_freq=p.update_interval,
        gradient_steps=1,
        target_update_interval=p.target_interval,
        exploration_initial_eps=p.epsilon_start,
        exploration_final_eps=p.epsilon_end,
        policy_kwargs=features,
        seed=0,
        device="cpu",
    )
    weights = [sum(w.numel() for w in net.parameters()) for net in (ours.network, theirs.q_net)]
    assert weights[0] == weights[1]
    times: list[tuple[float, float]] = []
    for _ in range(1 + TRAINING_ROUNDS):
        began = time.perf_counter()
        for _ in ours.run(ours.steps + STEPS):
            pass
        middle = time.perf_counter()
        theirs.learn(STEPS, reset_num_timesteps=False)
        times.append((middle - began, time.perf_counter() - middle))
    del times[0]  # both past `learning_starts`, and warm
    our_rate, their_rate = (STEPS / seconds for seconds in medians(times))
    ratio = statistics.median(theirs / ours for ours, theirs in times)
    figure = f"training: {our_rate:.0f} steps/s; Stable-Baselines3 {their_rate:.0f}; ratio"
    yield report(figure, ratio, "x", 1.5, at_most=False)


def main() -> int:
    """Print each figure beside its bound; return 1 if one is missed."""
    torch.set_num_threads(1)
    gc.freeze()  # else this process pauses to look for garbage among what it has imported
    missed = [*measure_paper_map(), *measure_training()]
    for side in (256, 1024):
        missed += measure_requests(side)
    missed += measure_replans(1024)
    for side in (256, 1024, 2000):
        missed += [*measure_whole_fields(side, False, 20), *measure_whole_fields(side, True, 25)]
    return int(any(missed))


if __name__ == "__main__":
    sys.exit(main())
