"""Maps that no model was trained on, with planning requests; here generated ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from random_maps import generate_map, gradient_costs, inflated_costs

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.grid.arguments import Occupancy
from ddqn_planner.grid.noise import random_costs, random_requests, unknown_costs

INFLATION_RADIUS = 5.0
"""How far the cost of an obstacle reaches, cells."""

UNKNOWN_SHARE = 0.2
"""Share of the free cells that ``unknown`` makes unknown."""

COSTS: Final[dict[str, Callable[[Occupancy, np.random.Generator], NDArray[np.int8] | None]]] = {
    "none": lambda occupancy, random: None,
    "random": random_costs,
    "gradient": gradient_costs,
    "inflated": lambda occupancy, random: inflated_costs(occupancy, INFLATION_RADIUS),
    "unknown": lambda occupancy, random: unknown_costs(occupancy, UNKNOWN_SHARE, random),
}
"""The costs that free cells can get."""

GOALS = 10
"""Different goals per generated map: each needs a Q field and exact distances."""


@dataclass(frozen=True)
class RequestSettings:
    """How requests are drawn: so many per map, each with a path under the move rule.

    The costs are a key of `COSTS`. A value out of its range raises a ValueError.
    """

    move_rule: MoveRule
    requests: int = 200
    costs: str = "none"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.requests < 1:
            raise ValueError(f"requests is {self.requests}; give at least 1")
        if self.costs not in COSTS:
            raise ValueError(f"costs is {self.costs!r}; give one of {', '.join(COSTS)}")
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; give at least 0")

    def random(self, name: str) -> np.random.Generator:
        """Return a map's random generator, which does not depend on the other maps."""
        return np.random.default_rng([self.seed, *name.encode()])

    def grid(self, occupancy: Occupancy, random: np.random.Generator) -> GridMap:
        """Return the grid map with its costs."""
        return GridMap(occupancy, cost=COSTS[self.costs](occupancy, random))


@dataclass(frozen=True, eq=False)
class BenchmarkMap:
    """A map with requests."""

    set_name: str
    """Kind of a generated map, or set of a benchmark."""
    name: str
    """Name of the map within its set."""
    grid: GridMap
    requests: list[tuple[Cell, Cell]]
    """Start and goal of each request; a path joins them."""
    optima: NDArray[np.float64] | None = None
    """(N,): the shortest path's length of each request, if a file gives it under this move rule."""
    precision: float = 0.0
    """Greatest rounding error of `optima`, cells."""

    @property
    def size(self) -> str:
        """Width x height."""
        return f"{self.grid.width}x{self.grid.height}"


def generated_maps(
    kinds: Sequence[str], sizes: Sequence[int], maps: int, settings: RequestSettings
) -> Iterator[BenchmarkMap]:
    """Generate a number of square maps per kind and side (cells), and draw requests on each."""
    for kind in kinds:
        for size in sizes:
            for number in range(maps):
                name = f"{kind}-{size}-{number}"
                random = settings.random(name)
                occupancy = generate_map(kind, (size, size), random)
                yield with_random_requests(kind, name, occupancy, GOALS, settings, random)


def with_random_requests(
    set_name: str,
    name: str,
    occupancy: Occupancy,
    goals: int,
    settings: RequestSettings,
    random: np.random.Generator,
) -> BenchmarkMap:
    """Draw costs and requests for a map; the requests share a number of goals evenly."""
    grid, rule = settings.grid(occupancy, random), settings.move_rule
    requests: list[tuple[Cell, Cell]] = []
    parts = np.array_split(range(settings.requests), goals)
    drawn = random_requests(occupancy, rule, goals, random)
    for part, (start, goal) in zip(parts, drawn, strict=True):
        more = random_starts(occupancy, goal, rule, max(len(part) - 1, 0), random)
        requests += [(cell, goal) for cell in [start, *more][: len(part)]]
    return BenchmarkMap(set_name, name, grid, requests)


def random_starts(
    occupancy: Occupancy, goal: Cell, move_rule: MoveRule, count: int, random: np.random.Generator
) -> list[Cell]:
    """Draw cells, except the goal, from which a path leads to the goal; they may repeat."""
    connected = GridMap(occupancy).reachable([goal], move_rule)
    connected[goal[1], goal[0]] = False
    cells = np.argwhere(connected)
    if not len(cells):
        return []
    return [(x, y) for y, x in random.choice(cells, count).tolist()]
