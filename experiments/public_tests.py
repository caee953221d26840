"""Public tests of path planners, entered: MPD, tiled MPD, GPPC's dynamic track, BARN.

python experiments/public_tests.py mpd FOLDER     # data/mpd of planning-datasets
python experiments/public_tests.py tiled FOLDER   # the same folder: 2 x 2 and 4 x 4
python experiments/public_tests.py gppc FOLDER    # data of GPPC's startkit-dynamic
python experiments/public_tests.py barn FOLDER    # world_0.world to world_299.world

Without --model, the cells that the Jackal's body sweeps are computed, not learned: the
same cells as those of a model that `ddqn-planner train-robot` has proved. Times are
CPU time.
"""

import argparse
import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import shapely
from bodies import Oracle, robot
from generalisation import OPTIMAL, illegal_moves
from numpy.typing import NDArray
from public_data import (
    BARN_RADIUS,
    MPD_SUFFIX,
    MpdMap,
    Patch,
    Query,
    barn_map,
    read_barn,
    read_gppc,
    read_mpd,
)
from tables import table

from ddqn_planner import GridMap, MoveRule, Plan, Planner
from ddqn_planner.grid import MOVES, Cell, shortest_distances
from ddqn_planner.robot.motions import Motion
from ddqn_planner.warm_up import warm_up

JACKAL: Final = "[[0.254, 0.215], [-0.254, 0.215], [-0.254, -0.215], [0.254, -0.215]]"
BARN_START: Final = (-2.25, 3.0, math.pi / 2)
BARN_GOAL: Final = (-2.25, 13.0, math.pi / 2)
MPD_COLUMNS: Final = (
    "kind | maps | starts | solved | optimal | worst ratio | fewest moves | moves ratio"
)
TILED_COLUMNS: Final = "cells | maps | starts | solved | optimal | worst ratio"
TILED_MAPS: Final = 20  # of each size
GPPC_COLUMNS: Final = (
    "scenario | cells | changes | queries | right | ms a query: median | mean "
    "| ms a change: mean"
)
BARN_COLUMNS: Final = "worlds | solved | colliding | mean ms | median | max"


class Rollouts(NamedTuple):
    """The paths from N starts to one goal."""

    ratio: NDArray[
        np.float64
    ]  # (N,): length over the optimum; inf without a legal path
    moves: NDArray[np.float64]  # (N,): number of moves; inf likewise
    starts: NDArray[np.int64]  # (N, 2): x and y


def rollouts_from_all_starts(
    planner: Planner, occupancy: NDArray[np.bool_], goal: Cell
) -> Rollouts:
    """Plan from every cell that a path leads from, and measure by scipy's Dijkstra."""
    rule = MoveRule.CORNER_CUTTING
    grid = GridMap(occupancy)
    distances = shortest_distances(grid, goal, rule)
    y, x = np.nonzero(np.isfinite(distances) & (distances > 0))
    starts = np.column_stack([x, y])
    plans = planner.q_field(grid, goal, rule).rollouts(starts)
    optimum = distances[y, x]
    return Rollouts(*_measured(plans, starts, goal, grid, optimum), starts)


def _measured(
    plans: Sequence[Plan],
    starts: NDArray[np.int64],
    goal: Cell,
    grid: GridMap,
    optimum: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the ratios and the numbers of moves (N,), see `Rollouts`."""
    paths = [plan.path for plan in plans]
    path = np.concatenate(paths)  # all cells, of one path after another
    number = np.repeat(np.arange(len(paths)), [len(cells) for cells in paths])
    is_step = number[1:] == number[:-1]  # else from one path to the next
    number_of_step = number[1:][is_step]
    step = np.diff(path, axis=0)[is_step]
    x, y = path[:-1][is_step].T
    is_move = (step[:, None] == MOVES).all(axis=2)  # (steps, A): which move it is
    legal = grid.legal_moves(MoveRule.CORNER_CUTTING)
    is_legal = (is_move & legal[:, y, x].T).any(axis=1)

    def sum_of_path(of_steps: NDArray[Any]) -> NDArray[np.float64]:
        return np.bincount(number_of_step, of_steps, len(paths)).astype(np.float64)

    ends = [(*cells[0], *cells[-1]) if len(cells) else (-1,) * 4 for cells in paths]
    expected = np.column_stack([starts, np.tile(goal, (len(paths), 1))])
    is_solved = (np.array(ends) == expected).all(axis=1)
    is_solved &= sum_of_path(~is_legal) == 0
    length = sum_of_path(np.hypot(*step.T))
    moves = sum_of_path(np.ones(len(step)))
    ratio = np.where(is_solved, length / optimum, np.inf)
    return ratio, np.where(is_solved, moves, np.inf)


def mpd(options: argparse.Namespace) -> str:
    """Return the table of MPD's kinds: all starts of all test maps."""
    planner = Planner.load(options.model or "any_map")
    rows = []
    for kind, maps in mpd_kinds(options.folder):
        results = []
        least_moves = []
        for test in maps[: options.maps]:
            rollouts = rollouts_from_all_starts(planner, test.occupancy, test.goal)
            x, y = rollouts.starts.T
            results.append(rollouts)
            least_moves.append(test.moves[y, x])
        moves = np.concatenate([rollouts.moves for rollouts in results])
        moves_ratio = moves / np.concatenate(least_moves)
        rows.append(
            [
                kind,
                len(results),
                *_ratios(results),
                f"{np.mean(moves_ratio <= OPTIMAL):.1%}",
                f"{moves_ratio.mean():.4f}",
            ]
        )
    return table(MPD_COLUMNS, rows)


def mpd_kinds(folder: Path) -> Iterator[tuple[str, list[MpdMap]]]:
    """Yield the name and the test maps of each kind in a folder."""
    paths = sorted(folder.glob(f"*{MPD_SUFFIX}"))
    if not paths:
        raise SystemExit(f"{folder}: has no *{MPD_SUFFIX}; give data/mpd")
    for path in paths:
        yield path.name.removesuffix(MPD_SUFFIX), read_mpd(path)


def tiled(options: argparse.Namespace) -> str:
    """Return the table of maps made of 2 x 2 and 4 x 4 test maps of any kinds."""
    planner = Planner.load(options.model or "any_map")
    tiles = [test.occupancy for _, maps in mpd_kinds(options.folder) for test in maps]
    random = np.random.default_rng(0)
    rows = []
    for side in (2, 4):
        results: list[Rollouts] = []
        while len(results) < (options.maps or TILED_MAPS):
            drawn = random.choice(len(tiles), (side, side))
            occupancy = np.block([[tiles[tile] for tile in row] for row in drawn])
            y, x = random.choice(np.argwhere(~occupancy)).tolist()
            results.append(rollouts_from_all_starts(planner, occupancy, (x, y)))
        height, width = occupancy.shape
        rows.append([f"{width} x {height}", len(results), *_ratios(results)])
    return table(TILED_COLUMNS, rows)


def _ratios(results: Sequence[Rollouts]) -> list[str]:
    """Return the numbers of starts, solved and optimal ones, and the worst ratio."""
    ratio = np.concatenate([rollouts.ratio for rollouts in results])
    solved = np.isfinite(ratio)
    return [
        f"{len(ratio):,}",
        f"{np.count_nonzero(solved):,}",
        f"{np.count_nonzero(ratio <= OPTIMAL):,}",
        f"{ratio[solved].max():.4f}",
    ]


def gppc(options: argparse.Namespace) -> str:
    """Return the table of GPPC's dynamic track: all queries, on the changed maps."""
    paths = sorted(options.folder.glob("*.scen"))
    if not paths:
        raise SystemExit(f"{options.folder}: has no *.scen; give the startkit's data")
    planner = Planner.load(options.model or "any_map")
    for _ in warm_up(planner):
        pass
    return table(GPPC_COLUMNS, [_gppc_row(planner, path) for path in paths])


def _gppc_row(planner: Planner, path: Path) -> list[object]:
    """Run a scenario from its first to its last command."""
    scenario = read_gppc(path)
    grid = GridMap(np.zeros(scenario.shape, np.bool_))
    change_ms, query_ms = [], []
    right = 0
    for command in scenario.commands:
        began = time.process_time()
        if isinstance(command, Patch):
            grid = grid.with_patch(command.occupancy, command.x, command.y)
            change_ms.append(1e3 * (time.process_time() - began))
            continue
        plan = planner.plan(grid, command.start, command.goal, MoveRule.ROBOT_SAFE)
        query_ms.append(1e3 * (time.process_time() - began))
        right += is_right(command, plan.cells, plan.length, grid)
    height, width = scenario.shape
    return [
        path.stem,
        f"{width} x {height}",
        f"{len(change_ms):,}",
        f"{len(query_ms):,}",
        f"{right:,}",
        f"{np.median(query_ms):.2f}",
        f"{np.mean(query_ms):.2f}",
        f"{np.mean(change_ms):.2f}",
    ]


def is_right(query: Query, cells: Sequence[Cell], length: float, grid: GridMap) -> bool:
    """Return whether a path is legal and as short as the file says.

    Without a path in the file there must be none.
    """
    if math.isinf(query.length):
        return not cells
    if not cells or (cells[0], cells[-1]) != (query.start, query.goal):
        return False
    legal = grid.legal_moves(MoveRule.ROBOT_SAFE)
    is_legal = illegal_moves(cells, legal) == 0
    return is_legal and math.isclose(length, query.length, rel_tol=1e-6, abs_tol=1e-6)


def barn(options: argparse.Namespace) -> str:
    """Return the table of BARN's worlds, planned for the Jackal's exact body."""
    if options.model is None:
        planner = robot(JACKAL, Motion.DIFFERENTIAL)
    else:
        planner = Planner.load(options.model)
    for _ in warm_up(planner):
        pass
    paths = [options.folder / f"world_{number}.world" for number in range(300)]
    solved = colliding = 0
    query_ms = []
    for path in paths[: options.maps]:
        centres = read_barn(path)
        grid = barn_map(centres)
        began = time.process_time()
        plan = planner.plan_poses(grid, BARN_START, BARN_GOAL)
        query_ms.append(1e3 * (time.process_time() - began))
        solved += bool(plan.poses.size)
        discs = shapely.buffer(shapely.points(centres), BARN_RADIUS, quad_segs=64)
        if plan.poses.size:
            colliding += Oracle(discs, JACKAL).collisions(plan.poses) > 0
    times = np.mean(query_ms), np.median(query_ms), np.max(query_ms)
    row = [len(query_ms), solved, colliding, *(f"{value:.2f}" for value in times)]
    return table(BARN_COLUMNS, [row])


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table of one test."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    tests = {"mpd": mpd, "tiled": tiled, "gppc": gppc, "barn": barn}
    parser.add_argument("test", choices=tests)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--model", help="by default any_map; for barn, see above")
    parser.add_argument("--maps", type=int, help="at most so many, of each kind")
    options = parser.parse_args(arguments)
    print(tests[options.test](options))


if __name__ == "__main__":
    main()
