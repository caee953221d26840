"""How good the greedy walk of a model is on maps that it never saw: ``ddqn-planner evaluate``."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import astuple, dataclass, fields
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.experiments.benchmark_maps import BenchmarkMap
from ddqn_planner.experiments.tables import table
from ddqn_planner.files import write_atomically, write_csv
from ddqn_planner.grid import MOVES, Cell, GridMap, MoveRule, legal_moves, path_cost
from ddqn_planner.planning import Planner, QField, shortest_distances

OPTIMAL = 1 + 1e-6
"""A walk of at most this ratio to the optimum counts as optimal."""

AGREES = 1e-4
"""Relative; beside it an optimum may be off by what its file rounds."""

COLUMNS = (
    "maps",
    "requests",
    "success",
    "any move",
    "optimal",
    "mean",
    "worst",
    "illegal",
    "field ms",
    "Dijkstra ms",
    "field/Dijkstra",
    "path ms",
)

FIRST_GROUP_END = 16
"""Upper end of the first group of optima; each one after it reaches twice as far."""


@dataclass(frozen=True)
class Walk:
    """The greedy walk of one request, checked against the map and the exact optimum.

    Parameters
    ----------
    set_name, map_name, size : str
        See `BenchmarkMap`.
    optimum : float
        Exact cost of the best path; without costs its length in cells.
    agrees : bool, optional
        Whether the benchmark's file gives the same; None where it says nothing.
    ratio : float
        Cost of the walk over the optimum; infinite where it does not reach the goal.
    any_move : bool
        Whether the walk reaches the goal too if the network may choose illegal moves, which end
        it.
    illegal : int
        Illegal moves in the walk.
    field_ms, dijkstra_ms : float
        Time of the field of the goal and of the exact distances to it, see
        `compare_with_dijkstra`; requests to the same goal share them.
    path_ms : float
        Time of the walk in the field.
    """

    set_name: str
    map_name: str
    size: str
    optimum: float
    agrees: bool | None
    ratio: float
    any_move: bool
    illegal: int
    field_ms: float
    dijkstra_ms: float
    path_ms: float

    @property
    def length_group(self) -> str:
        """The group of the optimum: 0-16, 16-32, 32-64 and so on, the upper end excluded."""
        doublings = max(0, math.frexp(self.optimum / FIRST_GROUP_END)[1])
        upper = FIRST_GROUP_END * 2**doublings
        return f"{upper // 2 if doublings else 0}-{upper}"


@dataclass(frozen=True)
class Summary:
    """What a group of walks comes to; "all" where a group is not set apart.

    Parameters
    ----------
    set_name, size, optimum : str
        The group.
    maps, requests : int
    success, any_move, optimal : int
        How many of the requests the walk solves, solves without knowing which moves are legal,
        and solves at the least cost.
    mean, worst : float
        Cost over the optimum of those that are solved; NaN if none is.
    illegal : int
        Illegal moves in all walks.
    field_ms, dijkstra_ms, path_ms : float
        Medians.
    """

    set_name: str
    size: str
    optimum: str
    maps: int
    requests: int
    success: int
    any_move: int
    optimal: int
    mean: float
    worst: float
    illegal: int
    field_ms: float
    dijkstra_ms: float
    path_ms: float


def measure(planner: Planner, maps: Iterable[BenchmarkMap], move_rule: MoveRule) -> Iterator[Walk]:
    """Walk every request of every map.

    Raises
    ------
    ValueError
        If the model cannot plan on a map of such a size.
    """
    warm = False
    for benchmark_map in maps:
        grid = benchmark_map.grid
        legal = legal_moves(grid.occupancy, move_rule)
        given = benchmark_map.optima
        if given is None:
            given = np.full(len(benchmark_map.requests), np.nan)
        cases = sorted(
            zip(benchmark_map.requests, given.tolist(), strict=True), key=lambda case: case[0][1]
        )
        for goal, some in groupby(cases, key=lambda case: case[0][1]):
            if not warm:  # the first field of a process also loads compiled code
                compare_with_dijkstra(planner, grid, goal, move_rule)
                warm = True
            field, field_ms, optima, dijkstra_ms = compare_with_dijkstra(
                planner, grid, goal, move_rule
            )
            unmasked = field.unmasked()
            for (start, _), given_optimum in some:
                began = time.perf_counter()
                cells = field.rollout(start).cells
                path_ms = 1e3 * (time.perf_counter() - began)
                arrived = cells[:1] == (start,) and cells[-1:] == (goal,)
                cost = path_cost(cells, grid.cost_multiplier, move_rule) if arrived else math.inf
                optimum = float(optima[start[1], start[0]])
                agrees = math.isclose(
                    given_optimum, optimum, rel_tol=AGREES, abs_tol=benchmark_map.precision
                )
                yield Walk(
                    set_name=benchmark_map.set_name,
                    map_name=benchmark_map.name,
                    size=benchmark_map.size,
                    optimum=optimum,
                    agrees=None if math.isnan(given_optimum) else agrees,
                    ratio=cost / optimum if start != goal else 1.0,
                    any_move=bool(unmasked.rollout(start).cells),
                    illegal=illegal_moves(cells, legal),
                    field_ms=field_ms,
                    dijkstra_ms=dijkstra_ms,
                    path_ms=path_ms,
                )


def compare_with_dijkstra(
    planner: Planner, grid: GridMap, goal: Cell, move_rule: MoveRule
) -> tuple[QField, float, NDArray[np.float64], float]:
    """Compute the Q field and the exact distances to a goal, and time both, one after the other.

    The field is timed with its policy, the distances with the graph that scipy's Dijkstra needs:
    from either of them the path of any start can be read.

    Returns
    -------
    QField
    float
        Its time, ms.
    (H, W) float64
        See `shortest_distances`.
    float
        Their time, ms.
    """
    began = time.perf_counter()
    # A planner of its own: one that has seen the goal would look the field up.
    field = Planner(planner.network, planner.metadata).q_field(grid, goal, move_rule)
    field.policy  # noqa: B018
    middle = time.perf_counter()
    distances = shortest_distances(grid, goal, move_rule)
    ended = time.perf_counter()
    return field, 1e3 * (middle - began), distances, 1e3 * (ended - middle)


def illegal_moves(cells: Sequence[Cell], legal: NDArray[np.bool_]) -> int:
    """Count the steps of a path that are no legal moves.

    Parameters
    ----------
    cells : sequence of (x, y)
    legal : (8, H, W) bool
        See `legal_moves`.
    """
    array = np.array(cells, dtype=np.int64).reshape(-1, 2)
    x, y = array[:-1].T
    is_action = (np.diff(array, axis=0)[:, None] == MOVES).all(axis=2)
    return int(np.count_nonzero(~(is_action & legal[:, y, x].T).any(axis=1)))


def summarise(walks: Sequence[Walk]) -> list[Summary]:
    """Sum the walks up: by set and size, by optimum, and all of them."""
    by_optimum = sorted(walks, key=lambda walk: walk.optimum)
    return [
        *_groups(walks, lambda walk: (walk.set_name, walk.size, "all")),
        *_groups(by_optimum, lambda walk: ("all", "all", walk.length_group)),
        *_groups(walks, lambda walk: ("all", "all", "all")),
    ]


def _groups(
    walks: Sequence[Walk], group_of: Callable[[Walk], tuple[str, str, str]]
) -> list[Summary]:
    groups: dict[tuple[str, str, str], list[Walk]] = {}
    for walk in walks:
        groups.setdefault(group_of(walk), []).append(walk)
    return [_summary(*group, some) for group, some in groups.items()]


def _summary(set_name: str, size: str, optimum: str, walks: Sequence[Walk]) -> Summary:
    ratios = np.array([walk.ratio for walk in walks])
    solved = ratios[np.isfinite(ratios)]
    return Summary(
        set_name,
        size,
        optimum,
        maps=len({(walk.set_name, walk.size, walk.map_name) for walk in walks}),
        requests=len(walks),
        success=len(solved),
        any_move=sum(walk.any_move for walk in walks),
        optimal=int(np.count_nonzero(ratios <= OPTIMAL)),
        mean=float(solved.mean()) if len(solved) else math.nan,
        worst=float(solved.max()) if len(solved) else math.nan,
        illegal=sum(walk.illegal for walk in walks),
        field_ms=float(np.median([walk.field_ms for walk in walks])),
        dijkstra_ms=float(np.median([walk.dijkstra_ms for walk in walks])),
        path_ms=float(np.median([walk.path_ms for walk in walks])),
    )


def markdown(summaries: Sequence[Summary], walks: Sequence[Walk], description: str) -> str:
    """Return the report: what was measured, a table by set and size, and one by optimum."""
    *groups, total = summaries
    sets = [[group.set_name, group.size, *_cells(group)] for group in groups if group.size != "all"]
    lengths = [[group.optimum, *_cells(group)] for group in groups if group.size == "all"]
    given = [walk.agrees for walk in walks if walk.agrees is not None]
    lines = [
        description,
        "",
        "Only requests that a path solves are drawn. Any move: solved too by a walk that may choose"
        " illegal moves, which end it. Optimal, mean, worst: cost of the walk over that of the best"
        " path. Times: medians; Dijkstra's with its graph.",
        *(
            [f"Optima given by files: the oracle agrees with {sum(given)}/{len(given)}."]
            if given
            else []
        ),
        "",
        table(["set", "size", *COLUMNS], [*sets, ["all", "all", *_cells(total)]]),
        "",
        table(["optimum", *COLUMNS], lengths),
    ]
    return "\n".join(lines) + "\n"


def write_report(path: Path, summaries: Sequence[Summary], text: str) -> None:
    """Write the report as Markdown, or its summaries as CSV, as the ending of the path says."""
    if path.suffix.lower() == ".csv":
        columns = [field.name for field in fields(Summary)]
        write_csv(path, columns, [astuple(summary) for summary in summaries])
    else:
        write_atomically(path, text.encode())


def _cells(summary: Summary) -> list[str]:
    counts = summary.success, summary.any_move, summary.optimal
    return [
        str(summary.maps),
        str(summary.requests),
        *(f"{count}/{summary.requests}" for count in counts),
        f"{summary.mean:.4f}",
        f"{summary.worst:.4f}",
        str(summary.illegal),
        f"{summary.field_ms:.2f}",
        f"{summary.dijkstra_ms:.2f}",
        f"{summary.field_ms / summary.dijkstra_ms:.2f}",
        f"{summary.path_ms:.3f}",
    ]
