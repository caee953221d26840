"""Measures how the paths of bodies bend: turning, flips of curvature, cusps, reverse.

``python path_shapes.py car OLD_CAR --side 20`` compares models on the same requests;
the lengths are those of each path divided by that of the first model's path of
primitives. An oracle checks each pose for collisions, see `bodies.Oracle`.
"""

import argparse
import math
import time
from collections import defaultdict
from collections.abc import Iterator
from itertools import islice, product
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from bodies import (
    CELL,
    Oracle,
    Pose,
    Shape,
    map_files,
    occupied_cells,
    requests,
    shape_of,
)
from numpy.typing import NDArray
from random_maps import KINDS, generate_map
from tables import table

from ddqn_planner import GridMap, Planner, load_map
from ddqn_planner.commands.options import file_of
from ddqn_planner.grid.inflation import inflate
from ddqn_planner.model import RobotNetwork
from ddqn_planner.planning.path_finder import last_step
from ddqn_planner.planning.plan import PosePlan, PoseRequest
from ddqn_planner.robot.directions import directions_of_travel

SHAPE_RADIUS: Final = 0.75  # metres of free space around starts and goals
LEAST_DISTANCE: Final = 4.0  # metres from a start to its goal
EXACT: Final = 1e-6  # centimetres and degrees
CELLS_OF_BLOCK: Final = 20  # along a side of a block of a generated map
FIGURES: Final = 2  # digits
HEADER: Final = (
    "map | model | paths | requests | degrees per 10 m | flips | cusps | in reverse, % "
    "| length | ends off, cm | degrees | exact | ms | with a collision"
)


class Variant(NamedTuple):
    """How a path is planned."""

    model: str
    is_finished: bool


class Result(NamedTuple):
    """One path."""

    shape: Shape
    reverse: float  # per cent of the length
    length: float  # divided by that of the first variant
    milliseconds: float
    collides: bool


def reverse_of(poses: NDArray[np.float64]) -> float:
    """Return the share of a path (N, 3) that is driven in reverse, per cent."""
    lengths = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    in_cells = poses / (CELL, CELL, 1)
    is_reverse = directions_of_travel(in_cells) < 0
    return 100 * float(lengths[is_reverse].sum() / lengths.sum())


def length_of(poses: NDArray[np.float64]) -> float:
    """Return the length of a path (N, 3) in metres."""
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())


def maps_of(options: argparse.Namespace) -> Iterator[tuple[str, GridMap]]:
    """Yield maps with their names: a hall, generated maps, ROS maps, all with costs."""
    random = np.random.default_rng(options.seed)
    cells = round(options.side / CELL)
    blocks = (cells // CELLS_OF_BLOCK, cells // CELLS_OF_BLOCK)
    maps = {"empty": GridMap(np.zeros((cells, cells), np.bool_), CELL)}
    for kind in KINDS:
        occupancy = generate_map(kind, blocks, random)
        block = np.ones((CELLS_OF_BLOCK, CELLS_OF_BLOCK), np.bool_)
        maps[kind] = GridMap(np.kron(occupancy, block), CELL)
    for path in map_files(options.maps):
        maps[path.stem] = load_map(path)
    for name, grid in maps.items():
        yield name, grid
        yield f"{name}, costs", inflate(grid, 0.0, 1.0)


def plan_of(
    planner: Planner, grid: GridMap, start: Pose, goal: Pose, is_finished: bool
) -> tuple[PosePlan, float]:
    """Return a plan, and the milliseconds of CPU time that it took."""
    assert planner.pose_planner is not None
    request = PoseRequest(grid, start, (goal,), finished=is_finished)
    began = time.process_time()
    plan = last_step(planner.pose_planner.steps(request))
    return plan, 1e3 * (time.process_time() - began)


def results_of_request(
    planners: dict[Variant, Planner], grid: GridMap, ends: tuple[Pose, Pose]
) -> dict[Variant, Result]:
    """Return the path of each variant; none if a variant has no path."""
    start, goal = ends
    obstacles = occupied_cells(GridMap(grid.uninflated, CELL))
    results: dict[Variant, Result] = {}
    first_length = 0.0
    for variant, planner in planners.items():
        assert isinstance(planner.network, RobotNetwork)
        plan, ms = plan_of(planner, grid, start, goal, variant.is_finished)
        if not plan.poses.size:
            return {}
        length = length_of(plan.poses)
        first_length = first_length or length
        oracle = Oracle(obstacles, str(planner.network.footprint.tolist()))
        collides = oracle.collisions(plan.poses) > 0
        results[variant] = Result(
            shape_of(plan.poses, start, goal),
            reverse_of(plan.poses),
            length / first_length,
            ms,
            collides,
        )
    return results


def row_of(name: str, variant: Variant, results: list[Result]) -> list[object]:
    """Return the row of a map and a variant: means, but the median of the time."""
    shapes = np.array([result.shape for result in results])  # (N, 5)
    mean = Shape(*shapes.mean(axis=0).tolist())
    ends = shapes[:, Shape._fields.index("off") :]  # (N, 2)
    reverse = float(np.mean([result.reverse for result in results]))
    length = float(np.mean([result.length for result in results]))
    exact = float((ends < EXACT).all(axis=1).mean())
    ms = float(np.median([result.milliseconds for result in results]))
    figures = [mean.turning, mean.flips, mean.cusps, reverse, length]
    figures += [mean.off, mean.turned, exact, ms]
    return [
        name,
        Path(variant.model).stem,
        "finished" if variant.is_finished else "of primitives",
        len(results),
        *(f"{figure:.{FIGURES}f}" for figure in figures),
        sum(result.collides for result in results),
    ]


def shapes(options: argparse.Namespace) -> Iterator[list[object]]:
    """Yield the rows of each map, and of all maps together."""
    planners = {
        Variant(model, is_finished): Planner.load(model)
        for model, is_finished in product(options.models, (False, True))
    }
    random = np.random.default_rng(options.seed)
    of_all: dict[Variant, list[Result]] = defaultdict(list)
    for name, grid in maps_of(options):
        drawn = requests(GridMap(grid.uninflated, CELL), SHAPE_RADIUS, random)
        far = (
            ends
            for ends in drawn
            if math.dist(ends[0][:2], ends[1][:2]) > LEAST_DISTANCE
        )
        of_map: dict[Variant, list[Result]] = defaultdict(list)
        for ends in islice(far, options.requests):
            results = results_of_request(planners, grid, ends)
            for variant, result in results.items():
                of_map[variant].append(result)
                of_all[variant].append(result)
        for variant, of_variant in of_map.items():
            yield row_of(name, variant, of_variant)
    for variant, of_variant in of_all.items():
        yield row_of("all", variant, of_variant)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("models", nargs="+", help="names or files of robots' models")
    parser.add_argument(
        "--maps", type=file_of, metavar="FOLDER", help="ROS maps of 0.05 m"
    )
    parser.add_argument(
        "--requests", type=int, default=12, metavar="N", help="of each map"
    )
    parser.add_argument(
        "--side", type=float, default=14.0, metavar="M", help="of generated maps"
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print(table(HEADER, list(shapes(options))))


if __name__ == "__main__":
    main()
