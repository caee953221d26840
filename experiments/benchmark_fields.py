"""Measures requests, replans and whole fields of the model for any map, beside their peers.

Part of `make bench`. Compared calls take turns in one run, and ratios are of their medians. Times
are CPU times of this process, which vary less on a loaded machine; each call uses one thread. It
plans on generated maps, each call with a `GridMap` of its own that was made before the clock began.
"""

from __future__ import annotations

import gc
import math
import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import nano_astar
import numpy as np
import pyastar2d
from benchmark import report
from processes import run_script
from random_maps import KINDS, generate_map

from ddqn_planner import GridMap, MoveRule, Plan, Planner, QField
from ddqn_planner.grid import Cell, shortest_distances
from ddqn_planner.grid.arguments import Occupancy
from ddqn_planner.grid.noise import random_costs, random_requests
from ddqn_planner.planning.field import network_field

RULE = MoveRule.ROBOT_SAFE
REQUEST_KINDS = ("random_20", "rooms", "office", "maze")
REQUESTS = 15
ROUNDS = 3
FLIPPED = 10
"""Cells that a change near a place flips, of the 25 around it."""
CHANGES = 100
WALL = 41
"""Cells of a wall that opens or closes."""
SHORTEST = 40
"""Moves of the shortest path for replans: robot and goal are far from each other."""

Prepared = Callable[[], Callable[[], Any]]
"""Makes all that a call needs, and returns the call, which is timed."""

LOADED = Planner.load("any_map")


def main(_: Sequence[str]) -> int:
    """Print each figure beside its bound; return 1 if one is missed."""
    gc.freeze()  # else this process pauses to look for garbage among what it has imported
    missed = []
    for side in (256, 1024):
        missed += measure_requests(side)
        missed += measure_known_goals(side)
    for side in (1024, 2000):
        missed += measure_replans(side)
    missed += measure_worst_replans(1024)
    missed.append(measure_whole_fields(32, False, 50))
    for side in (256, 1024, 2000):
        missed.append(measure_whole_fields(side, False, 20))
        missed.append(measure_whole_fields(side, True, 25))
    return int(any(missed))


def new_planner() -> Planner:
    """Return a planner that knows no map yet; the tables of its network are made."""
    return Planner(LOADED.network, LOADED.metadata)


def take_turns(*prepared: Prepared, rounds: int = ROUNDS) -> tuple[list[float], list[Any]]:
    """Return the median milliseconds of each call, and the last answer of each."""
    times: list[list[float]] = [[] for _ in prepared]
    answers: list[Any] = [None for _ in prepared]
    for _ in range(rounds):
        for number, prepare in enumerate(prepared):
            call = prepare()
            began = time.process_time()
            answers[number] = call()
            times[number].append(1e3 * (time.process_time() - began))
    return [statistics.median(of_call) for of_call in times], answers


def ready(call: Callable[[], Any]) -> Prepared:
    """Return the preparation of a call that needs none."""
    return lambda: call


def medians(times: Sequence[Sequence[float]]) -> list[float]:
    """Return the median of each column."""
    return [statistics.median(column) for column in zip(*times, strict=True)]


def measure_requests(side: int) -> list[bool]:
    """Compare one request on a new map with A* in C++."""
    missed = []
    for kind in REQUEST_KINDS:
        random, times = np.random.default_rng(0), []
        occupancy = generate_map(kind, (side, side), random)
        of_nano = occupancy.astype(np.uint8)
        weights = np.where(occupancy, np.inf, 1).astype(np.float32)

        def ours(start: Cell, goal: Cell, occupancy: Occupancy = occupancy) -> Callable[[], Plan]:
            return partial(new_planner().plan, GridMap(occupancy), start, goal, RULE)

        for start, goal in random_requests(occupancy, RULE, REQUESTS, random):
            ends = start[::-1], goal[::-1]
            nano = partial(nano_astar.astar, of_nano, *ends)
            pyastar = partial(pyastar2d.astar_path, weights, *ends, allow_diagonal=True)
            took, (plan, (_, length), _) = take_turns(
                partial(ours, start, goal), ready(nano), ready(pyastar)
            )
            assert math.isclose(plan.length, length, rel_tol=1e-6), (plan.length, length)
            times.append(took)
        our_ms, nano_ms, pyastar_ms = medians(times)
        name = f"{side}x{side} {kind}: request {our_ms:.2f} ms"
        for peer, peer_ms, bound in (
            (f"nano-astar {nano_ms:.2f}", nano_ms, 1.0),
            (f"pyastar2d* {pyastar_ms:.2f}", pyastar_ms, 1.3),
        ):
            missed.append(report(f"{name}, {peer}; ratio", our_ms / peer_ms, "x", bound))
    print("* cuts corners, and a diagonal counts 1: its paths are no paths under our rule")
    return missed


def measure_known_goals(side: int) -> list[bool]:
    """Time a start to which a field has grown: the robot has made one move."""
    missed = []
    for kind in REQUEST_KINDS:
        random, times = np.random.default_rng(0), []
        occupancy = generate_map(kind, (side, side), random)
        for start, goal in random_requests(occupancy, RULE, REQUESTS, random):
            planner, grid = new_planner(), GridMap(occupancy)
            after_a_move = planner.plan(grid, start, goal, RULE).cells[1]
            call = partial(planner.plan, grid, after_a_move, goal, RULE)
            (took,), (plan,) = take_turns(ready(call))
            times.append((took, len(plan.cells)))
        took, cells = medians(times)
        figure = f"{side}x{side} {kind}: known goal, path of {cells:.0f} cells"
        missed.append(report(figure, took, "ms", 0.1))
    return missed


class Change(NamedTuple):
    """A map, and a patch of it that replaces some of its cells."""

    occupancy: Occupancy
    patch: Occupancy
    x: int
    y: int


def flipped(occupancy: Occupancy, place: Cell, random: np.random.Generator) -> Change:
    """Return a change of some cells around a place."""
    x, y = (int(np.clip(number - 2, 0, len(occupancy) - 5)) for number in place)
    patch = occupancy[y : y + 5, x : x + 5].copy()
    patch.flat[random.choice(patch.size, FLIPPED, replace=False)] ^= True
    return Change(occupancy, patch, x, y)


def flipped_anywhere(occupancy: Occupancy, random: np.random.Generator) -> Change:
    """Return a change of as many cells all over the map."""
    patch = occupancy.copy()
    patch.flat[random.choice(patch.size, FLIPPED, replace=False)] ^= True
    return Change(occupancy, patch, 0, 0)


def wall(occupancy: Occupancy, path: Sequence[Cell], at: int, opens: bool) -> Change:
    """Return the change that a wall across a path opens or closes."""
    (x0, y0), (x, y), (x1, y1) = path[at - 2], path[at], path[at + 2]
    along_x = abs(y1 - y0) > abs(x1 - x0)
    x, y = (max(x - WALL // 2, 0), y) if along_x else (x, max(y - WALL // 2, 0))
    height, width = (1, WALL) if along_x else (WALL, 1)
    box = slice(y, y + height), slice(x, x + width)
    if not opens:
        return Change(occupancy, np.ones_like(occupancy[box]), x, y)
    closed = occupancy.copy()
    closed[box] = True
    return Change(closed, occupancy[box], x, y)


CHANGE_KINDS: dict[str, Callable[[Occupancy, Sequence[Cell], np.random.Generator], Change]] = {
    "cells near the robot": lambda map_, path, random: flipped(map_, path[10], random),
    "cells near the goal": lambda map_, path, random: flipped(map_, path[-11], random),
    "cells anywhere": lambda map_, path, random: flipped_anywhere(map_, random),
    "a wall opens": lambda map_, path, random: wall(map_, path, len(path) // 2, True),
    "a wall closes": lambda map_, path, random: wall(map_, path, len(path) // 2, False),
    "a wall beside the goal": lambda map_, path, random: wall(
        map_, path, len(path) - 3, random.random() < 0.5
    ),
}


def replan(change: Change, start: Cell, goal: Cell) -> Callable[[], Plan]:
    """Plan on the map before a change; return the call that plans after it."""
    planner, grid = new_planner(), GridMap(change.occupancy)
    planner.plan(grid, start, goal, RULE)
    return partial(planner.plan, grid.with_patch(*change[1:]), start, goal, RULE)


def new_plan(change: Change, start: Cell, goal: Cell) -> Callable[[], Plan]:
    """Return the call that plans after a change without the plan before it."""
    grid = GridMap(change.occupancy).with_patch(*change[1:])
    return partial(new_planner().plan, grid, start, goal, RULE)


def plan_by_q_values(change: Change, start: Cell, goal: Cell) -> Callable[[], Plan]:
    """Return the call that plans after a change as version 0.2.0 did: with Q of every cell."""
    grid = GridMap(change.occupancy).with_patch(*change[1:])

    def plan() -> Plan:
        return network_field(LOADED.network, grid, goal, RULE).rollout(start)

    return plan


def draw_changes(
    map_kind: str, side: int, change_kind: str, count: int
) -> list[tuple[Change, Cell, Cell]]:
    """Draw changes that leave start and goal free, each with its start and goal."""
    drawn: list[tuple[Change, Cell, Cell]] = []
    random = np.random.default_rng(0)
    occupancy = generate_map(map_kind, (side, side), random)
    while len(drawn) < count:
        ((start, goal),) = random_requests(occupancy, RULE, 1, random)
        path = new_planner().plan(GridMap(occupancy), start, goal, RULE).cells
        if len(path) <= SHORTEST:
            continue
        change = CHANGE_KINDS[change_kind](occupancy, path, random)
        after = GridMap(change.occupancy).with_patch(*change[1:])
        if after.is_free(start) and after.is_free(goal):
            drawn.append((change, start, goal))
    return drawn


def measure_replans(side: int) -> list[bool]:
    """Compare a replan after a change near the robot with a new plan by Q of every cell."""
    missed = []
    for kind in REQUEST_KINDS:
        times = []
        for drawn in draw_changes(kind, side, "cells near the robot", 5):
            took, (ours, theirs) = take_turns(
                partial(replan, *drawn), partial(plan_by_q_values, *drawn)
            )
            assert math.isclose(ours.length, theirs.length, rel_tol=1e-6), drawn[1:]
            times.append(took)
        our_ms, q_ms = medians(times)
        figure = f"{side}x{side} {kind}: replan {our_ms:.2f} ms, all Q {q_ms:.0f}; ratio"
        missed.append(report(figure, 100 * our_ms / q_ms, "%", 1))
    print("All Q in version 0.2.0: 113 to 158 ms at 1024x1024, 976 to 1,179 at 2000x2000")
    return missed


def measure_worst_replans(side: int) -> list[bool]:
    """Compare replans with a new field on the changed map, which must give the same path."""
    missed = []
    for change_kind in CHANGE_KINDS:
        ratios: list[tuple[float, str, float, float]] = []
        for map_kind in REQUEST_KINDS:
            count = CHANGES // len(REQUEST_KINDS)
            for drawn in draw_changes(map_kind, side, change_kind, count):
                took, (ours, fresh) = take_turns(partial(replan, *drawn), partial(new_plan, *drawn))
                assert ours.cells == fresh.cells, drawn[1:]
                ratios.append((took[0] / took[1], map_kind, took[0], took[1]))
        typical, (worst, kind, ms, fresh_ms) = statistics.median(r[0] for r in ratios), max(ratios)
        print(f"worst: {kind}, {ms:.1f} ms; new field {fresh_ms:.1f} ms")
        figure = f"{side}x{side}, {change_kind}: replan / new, median {typical:.3f}; worst"
        missed.append(report(figure, worst, "x", 2.0))
    return missed


def whole_field(grid: GridMap, goal: Cell) -> QField:
    """Return a field whose value was asked for in every cell."""
    field = new_planner().q_field(grid, goal, RULE)
    _ = field.value
    return field


def measure_whole_fields(side: int, costs: bool, bound: float) -> bool:
    """Compare the value of every cell with scipy's Dijkstra, graph included, on each kind."""
    ratios, nbytes = {}, 0
    for kind in KINDS:
        random, times = np.random.default_rng(0), []
        occupancy = generate_map(kind, (side, side), random)
        cost = random_costs(occupancy, random) if costs else None

        def value(goal: Cell, occupancy: Occupancy, cost: Any) -> Callable[[], QField]:
            return partial(whole_field, GridMap(occupancy, cost=cost), goal)

        def distances(goal: Cell, occupancy: Occupancy, cost: Any) -> Callable[[], Any]:
            return partial(shortest_distances, GridMap(occupancy, cost=cost), goal, RULE)

        for _, goal in random_requests(occupancy, RULE, ROUNDS, random):
            took, (field, _) = take_turns(
                partial(value, goal, occupancy, cost),
                partial(distances, goal, occupancy, cost),
                rounds=ROUNDS if side < 1000 else 1,
            )
            times.append(took)
            nbytes = max(nbytes, field.nbytes - field.value.nbytes)
        ours, dijkstra = medians(times)
        ratios[kind] = ours / dijkstra
        name = f"{side}x{side}{', random costs' if costs else ''}"
        print(f"{name}, {kind}: field {ours:.1f} ms, Dijkstra {dijkstra:.1f} ms", flush=True)
    per_cell = nbytes / side**2
    worst = max(ratios, key=lambda kind: ratios[kind])
    missed = side > 32 and report(f"{name}: bytes per cell of a field", per_cell, "B", 10)
    figure = f"{name}: field / Dijkstra, worst kind ({worst})"
    return report(figure, 100 * ratios[worst], "%", bound) or missed


if __name__ == "__main__":
    run_script(main)
