"""Draws two pictures of docs/benchmarks.md: the cells that a request visits, and its time."""

from __future__ import annotations

import math
import statistics
import time
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import nano_astar
import numpy as np
from numpy.typing import NDArray
from random_maps import generate_map

from ddqn_planner import GridMap, MoveRule, Planner
from ddqn_planner.grid import shortest_distances
from ddqn_planner.grid.noise import random_requests
from ddqn_planner.planning.field import DistanceField
from ddqn_planner.planning.kernels import CLOSED

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "images"
RULE = MoveRule.ROBOT_SAFE
SIDES = (256, 512, 1024, 2000)
COLOURS = {"random_20": "#0072B2", "rooms": "#D55E00", "office": "#009E73", "maze": "#CC79A7"}
"""Of each kind of map, from Okabe and Ito's palette, which colour-blind readers can tell apart."""
REQUESTS = 30

LOADED = Planner.load("any_map")


def new_planner() -> Planner:
    """Return a planner that knows no map yet."""
    return Planner(LOADED.network, LOADED.metadata)


def draw_visited_cells() -> None:
    """Draw what one request visits, beside A* and Dijkstra's algorithm."""
    random = np.random.default_rng(1)
    occupancy = generate_map("office", (160, 160), random)
    requests = random_requests(occupancy, RULE, REQUESTS, random)
    start, goal = max(requests, key=lambda ends: math.dist(*ends))
    grid = GridMap(occupancy)
    planner = new_planner()
    plan = planner.plan(grid, start, goal, RULE)
    field = planner.q_field(grid, goal, RULE)
    assert isinstance(field, DistanceField)
    closed = field.known.state.reshape(grid.height + 2, -1)[1:-1, 1:-1] == CLOSED
    ends = start[::-1], goal[::-1]
    _, _, history = nano_astar.astar(occupancy.astype(np.uint8), *ends, return_history=True)
    by_a_star = np.zeros_like(closed)
    by_a_star[tuple(history.T)] = True
    distances = shortest_distances(grid, goal, RULE)
    by_dijkstra = distances <= distances[start[1], start[0]]

    figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.9), layout="constrained")
    panels = {"this planner": closed, "A* (nano-astar)": by_a_star, "Dijkstra": by_dijkstra}
    for axis, (name, visited) in zip(axes, panels.items(), strict=True):
        draw_panel(axis, grid, visited)
        x, y = np.array(plan.cells).T
        axis.plot(x, y, color="#D55E00", linewidth=1.5)
        axis.plot(*start, "o", *goal, "*", color="black", markersize=7)
        axis.set_title(f"{name}: {np.count_nonzero(visited):,} cells")
    figure.savefig(FOLDER / "visited_cells.png", dpi=120)


def draw_panel(axis: Any, grid: GridMap, visited: NDArray[np.bool_]) -> None:
    """Draw the map with the cells that were visited."""
    colours = np.full((*visited.shape, 3), 1.0)
    colours[visited] = (0.68, 0.83, 0.93)
    colours[grid.occupancy] = (0.35, 0.35, 0.35)
    axis.imshow(colours, origin="lower", interpolation="nearest")
    axis.set_xticks([])
    axis.set_yticks([])


def draw_times() -> None:
    """Draw the time of a request on a new map against the length of its path."""
    figure, axes = plt.subplots(1, len(SIDES), figsize=(10.5, 3.2), sharey=True, sharex=True,
                                layout="constrained")  # fmt: skip
    for axis, side in zip(axes, SIDES, strict=True):
        for kind, colour in COLOURS.items():
            random = np.random.default_rng(0)
            occupancy = generate_map(kind, (side, side), random)
            lengths, times = [], []
            for start, goal in random_requests(occupancy, RULE, REQUESTS, random):
                of_request = []
                for _ in range(3):
                    planner, grid = new_planner(), GridMap(occupancy)
                    began = time.process_time()
                    plan = planner.plan(grid, start, goal, RULE)
                    of_request.append(1e3 * (time.process_time() - began))
                lengths.append(plan.length)
                times.append(statistics.median(of_request))
            axis.loglog(lengths, times, ".", color=colour, label=kind)
            print(f"{side}x{side} {kind}: median {statistics.median(times):.2f} ms", flush=True)
        axis.set_title(f"{side} x {side}")
        axis.set_xlabel("length of the path, cells")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("CPU time, ms")
    axes[0].legend(fontsize=8)
    figure.savefig(FOLDER / "request_times.png", dpi=120)


if __name__ == "__main__":
    draw_visited_cells()
    draw_times()
