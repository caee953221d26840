"""Measures plans for robots with a body and a heading: collisions, costs, times and memory.

``--figure collisions`` has each plan checked by an oracle of its own: the body's polygon, every
2 cm and 2 degrees, against each occupied cell (Shapely). ``--maps`` adds ROS maps from a folder.
"""

import argparse
import gc
import math
import os
import time
from collections import defaultdict, deque
from collections.abc import Iterator
from functools import cache
from itertools import pairwise, product
from pathlib import Path
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray
from random_maps import KINDS, generate_map
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from tables import table

from ddqn_planner import GridMap, Planner, load_map
from ddqn_planner.commands.options import file_of
from ddqn_planner.grid import MOVES, Cell, MoveRule
from ddqn_planner.model import ModelMetadata, RobotNetwork, package_version
from ddqn_planner.planning.plan import PosePlan
from ddqn_planner.robot.footprint import read_footprint
from ddqn_planner.robot.motions import HEADINGS, Motion, Motions, make_motions
from ddqn_planner.warm_up import warm_up

CELL: Final = 0.05  # metres
FOOTPRINTS: Final = {
    "rectangle": "[[0.45, 0.3], [-0.45, 0.3], [-0.45, -0.3], [0.45, -0.3]]",
    "car": "[[0.7, 0.3], [-0.2, 0.3], [-0.2, -0.3], [0.7, -0.3]]",
    "disc": "0.25",
    "triangle": "[[0.5, 0.0], [-0.3, 0.35], [-0.3, -0.35]]",
    "corner": "[[0.5, 0.3], [0.1, 0.3], [0.1, 0.1], [-0.3, 0.1], [-0.3, -0.3], [0.5, -0.3]]",
    "long": "[[0.7, 0.2], [-0.5, 0.2], [-0.5, -0.2], [0.7, -0.2]]",
}
RADII: Final = {
    Motion.DIFFERENTIAL: 0.4,
    Motion.ACKERMANN: 0.8,
    Motion.OMNIDIRECTIONAL: 0.4,
}
FAR, AHEAD = (50.0, 60.0), 2.0  # metres of a request, and to the box on its path
METRES, RADIANS = 0.02, math.radians(2)  # between two poses that the oracle looks at
SHRUNK = 1e-6  # metres, so that what only touches does not count

Pose = tuple[float, float, float]


def robot(footprint: str, motion: Motion | str) -> Planner:
    """Return the planner of a body that knows its swept cells exactly, without a training."""
    corners = read_footprint(footprint)
    motions = make_motions(motion, RADII[Motion(motion)], CELL)
    network = RobotNetwork.untrained(corners, motions)
    network.tensors["weight"] = network.swept_by_unit.astype(np.float32)
    network.tensors["threshold"] = np.full(network.sizes["units"], 0.5, np.float32)
    about = (
        "robot",
        network.sizes,
        MoveRule.ROBOT_SAFE,
        1.0,
        "",
        0,
        0,
        package_version(),
    )
    return Planner(network, ModelMetadata(*about))


class Oracle:
    """Counts the occupied cells that a body touches along poses."""

    def __init__(self, grid: GridMap, footprint: str) -> None:
        y, x = np.nonzero(np.pad(grid.occupancy, 1, constant_values=True))
        low = np.column_stack([x - 1.0, y - 1.0]) * grid.resolution + grid.origin[:2]
        high = low + grid.resolution
        self.cells = shapely.STRtree(shapely.box(*low.T, *high.T))
        corners = read_footprint(footprint)
        self.body = shapely.Polygon(corners).buffer(-SHRUNK, join_style="mitre")
        self.corners = np.array(self.body.exterior.coords)

    def collisions(self, poses: NDArray[np.float64]) -> int:
        """Return how many poses touch an occupied cell, of those every 2 cm and 2 degrees."""
        x, y, yaw = np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])]).T
        steps = np.hypot(np.diff(x), np.diff(y)) / METRES
        count = np.ceil(np.maximum(steps, np.abs(np.diff(yaw)) / RADIANS)).astype(int)
        share = [np.linspace(0, 1, n, endpoint=False) for n in np.maximum(count, 1)]
        at = np.concatenate([i + one for i, one in enumerate(share)] + [[len(x) - 1.0]])
        x, y, yaw = (np.interp(at, np.arange(len(x)), axis) for axis in (x, y, yaw))
        cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        u, v = self.corners.T
        outline = np.stack(
            [cos * u - sin * v + x[:, None], sin * u + cos * v + y[:, None]], -1
        )
        touched, _ = self.cells.query(shapely.polygons(outline), predicate="intersects")
        return len(np.unique(touched))


def inner_radius(corners: NDArray[np.float64]) -> float:
    """Return the radius of the circle around the origin that fits into a polygon, metres."""
    sides = np.roll(corners, -1, axis=0) - corners
    share = np.clip(-(corners * sides).sum(axis=1) / (sides**2).sum(axis=1), 0, 1)
    return float(np.hypot(*(corners + share[:, None] * sides).T).min())


def requests(
    grid: GridMap, radius: float, random: np.random.Generator
) -> Iterator[tuple[Pose, Pose]]:
    """Yield starts and goals whose surroundings are free within a radius, in metres."""
    from scipy.ndimage import distance_transform_edt

    free = (
        distance_transform_edt(np.pad(~grid.occupancy, 1))[1:-1, 1:-1] * grid.resolution
    )
    rows, columns = np.nonzero(free > radius)
    while len(rows):
        poses = []
        for place in random.integers(len(rows), size=2):
            x, y = grid.cell_to_world((int(columns[place]), int(rows[place])))
            over, up, turn = random.uniform(-0.5, 0.5, 3)
            poses.append((x + over * CELL, y + up * CELL, turn * 2 * math.pi))
        yield poses[0], poses[1]


def worlds(maps: Path | None, random: np.random.Generator) -> dict[str, GridMap]:
    """Return maps whose halls and doors are wide enough for a robot: generated, and from ROS."""
    found = {}
    for kind in KINDS:
        cells = generate_map(kind, (14, 14), random)
        found[kind] = GridMap(np.kron(cells, np.ones((20, 20), np.bool_)), CELL)
    for path in sorted(maps.glob("*.yaml")) if maps else ():
        found[path.stem] = load_map(path)
    return found


@cache
def ways(motions: Motions) -> list[dict[Cell, float]]:
    """Return the cells that the origin passes on each primitive, and their shares of its length."""
    found = []
    for poses in motions.poses:
        at = np.linspace(0, len(poses) - 1, 1001)
        way = np.column_stack(
            [np.interp(at, range(len(poses)), poses[:, i]) for i in (0, 1)]
        )
        length = np.hypot(*np.diff(way, axis=0).T) + 1e-12
        cells = np.floor((way[1:] + way[:-1]) / 2 + 0.5).astype(np.int64)
        shares: dict[Cell, float] = defaultdict(float)
        for (x, y), share in zip(
            cells.tolist(), (length / length.sum()).tolist(), strict=True
        ):
            shares[x, y] += share
        found.append(shares)
    return found


def least_costs(
    grid: GridMap,
    motions: Motions,
    swept: NDArray[np.bool_],
    *goals: tuple[int, int, int],
) -> NDArray[np.float64]:
    """Return (H, W, 16): the least cost from every pose to a goal, in cells, by Dijkstra."""
    height, width = grid.occupancy.shape
    reach, multiplier = swept.shape[-1] // 2, grid.cost_multiplier
    occupied = np.pad(grid.occupancy, reach, constant_values=True)
    edges = []
    for number, way in enumerate(ways(motions)):
        hit = np.zeros((height, width), np.bool_)
        for y, x in np.argwhere(swept[number]):
            hit |= occupied[y : y + height, x : x + width]
        for over, up in way:  # an origin outside of the body may leave the map
            hit[max(height - up, 0) :] = hit[:, max(width - over, 0) :] = True
            hit[: max(-up, 0)] = hit[:, : max(-over, 0)] = True
        y, x = np.nonzero(~hit)
        factor = np.zeros(len(x))
        for (over, up), share in way.items():
            factor += share * multiplier[y + up, x + over]
        allowed = np.ones(len(x), np.bool_)
        for here, after in pairwise(way):
            if grid.forbidden is not None:
                action = MOVES.tolist().index([after[0] - here[0], after[1] - here[1]])
                allowed &= (grid.forbidden[y + here[1], x + here[0]] >> action & 1) == 0
        over, up = motions.offset[number]
        before = (y * width + x) * 16 + motions.start[number]
        after = ((y + up) * width + x + over) * 16 + motions.end[number]
        edges.append(
            np.column_stack([before, after, motions.cost[number] * factor])[allowed]
        )
    before, after, cost = np.concatenate(edges).T
    size = grid.occupancy.size * 16
    graph = coo_matrix(
        (cost, (after.astype(int), before.astype(int))), (size, size)
    ).tocsr()
    numbers = [(y * width + x) * 16 + heading for x, y, heading in goals]
    costs: NDArray[np.float64] = dijkstra(graph, indices=numbers, min_only=True)
    return costs.reshape(height, width, 16)


def narrow(random: np.random.Generator) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield doors 10 cm wider than a body of 0.6 m, corridors with a turn, and mazes."""
    for _ in range(3):
        occupancy = np.zeros((100, 110), np.bool_)
        wall, door = random.integers(35, 75), random.integers(5, 81)
        occupancy[:, wall : wall + random.integers(1, 9)] = True
        occupancy[door : door + 14] = False
        yield "door", occupancy
        occupancy = np.ones((100, 110), np.bool_)
        wide, corner = random.integers(14, 24), random.integers(45, 80)
        occupancy[5 : 5 + wide, 5:corner] = occupancy[5:95, corner - wide : corner] = (
            False
        )
        yield "corridor with a turn", occupancy
        maze = generate_map("maze", (5, 5), random)
        yield "maze", np.kron(maze, np.ones((24, 24), np.bool_))


def optimality(options: argparse.Namespace) -> Iterator[list[Any]]:
    """Yield a row for each kind of narrow place: what is solved, and costs over the least."""
    random, planner = np.random.default_rng(options.seed), Planner.load(options.model)
    assert isinstance(planner.network, RobotNetwork)
    motions, swept = planner.network.motions, planner.network.swept()
    rows: dict[str, list[Any]] = {}
    for name, occupancy in narrow(random):
        grid, row = (
            GridMap(occupancy, CELL),
            rows.setdefault(name, [0, 0, 0, 1.0, 1.0, 1.0]),
        )
        best = np.full(1, np.inf)
        while np.isfinite(best).sum() < 1000:
            y, x = random.choice(np.argwhere(~occupancy)).tolist()
            heading = int(random.integers(HEADINGS))
            best = least_costs(grid, motions, swept, (x, y, heading))
        end = *grid.cell_to_world((x, y)), float(motions.angles[heading])
        reached = np.argwhere(np.isfinite(best) & (best > 0))
        for y, x, heading in random.choice(reached, options.requests).tolist():
            start = *grid.cell_to_world((x, y)), float(motions.angles[heading])
            first, last = (
                planner.plan_poses(grid, start, end, bound=b) for b in (1.2, 1.0)
            )
            ratios = [
                (plan.cost or np.nan) / best[y, x, heading] for plan in (first, last)
            ]
            row[:2] = row[0] + 1, row[1] + bool(first.poses.size and last.poses.size)
            row[2] += ratios[0] > first.bound * 1.0001
            row[3:] = np.maximum(row[3:], [*ratios, first.bound]).tolist()
    for name, row in rows.items():
        yield [name, *row[:3], *(f"{ratio:.4f}" for ratio in row[3:])]


def collisions(options: argparse.Namespace) -> Iterator[list[Any]]:
    """Yield a row for each body and motion: requests, plans, how many of them collide, poses."""
    random = np.random.default_rng(options.seed)
    maps = worlds(options.maps, random)
    for (name, footprint), motion in product(FOOTPRINTS.items(), Motion):
        planner, counts = robot(footprint, motion), np.zeros(4, np.int64)
        radius = inner_radius(read_footprint(footprint))
        for grid in maps.values():
            oracle, asked = (
                Oracle(grid, footprint),
                requests(grid, radius + CELL, random),
            )
            for _, (start, goal) in zip(range(options.requests), asked, strict=False):
                plan = planner.plan_poses(grid, start, goal)
                collides = bool(plan.poses.size and oracle.collisions(plan.poses))
                counts += 1, bool(plan.poses.size), collides, len(plan.poses)
        yield [name, motion.value, *counts.tolist()]


def speed(options: argparse.Namespace) -> Iterator[list[Any]]:
    """Yield a row for each map: what a request of 50 to 60 m costs, in CPU time."""
    maps = {f"blocks, {share:.0%}": blocks(share, options.seed) for share in (0.1, 0.2)}
    for path in sorted(options.maps.glob("*.yaml")) if options.maps else ():
        if min((grid := load_map(path)).occupancy.shape) * grid.resolution > FAR[1]:
            maps[path.stem] = grid
    for name, grid in maps.items():
        random = np.random.default_rng(options.seed)
        figures: list[list[float]] = []
        asked = requests(grid, 0.55, random)
        planner = Planner.load(options.model)
        deque(warm_up(planner), maxlen=0)  # what is compiled first takes long
        while len(figures) < options.requests:
            start, goal = next(asked)
            if FAR[0] < math.dist(start[:2], goal[:2]) < FAR[1]:
                figures.append(drive(planner, grid, start, goal, options.bound))
        found = np.array(figures)
        middle, worst, ratio = (
            np.median(found, axis=0),
            found.max(axis=0),
            found[:, 2] / found[:, 3],
        )
        row = [
            found[:, 0].mean(),
            worst[0],
            *middle[1:4],
            np.median(ratio),
            ratio.max(),
        ]
        yield [name, *(f"{x:.2f}" for x in (*row, found[:, 4].mean(), worst[5]))]


def drive(
    planner: Planner, grid: GridMap, start: Pose, goal: Pose, bound: float
) -> list[float]:
    """Return milliseconds: first plan, next, repair, new; then the bound, and the memory in MB."""
    other = Planner(planner.network, planner.metadata)
    for one in (planner, other):  # what holds for the map
        one.plan_poses(grid, start, start)
    gc.collect()
    before = resident()
    first, plan = timed(planner, grid, start, goal, bound)
    memory = resident() - before
    if not plan.poses.size:
        return [first, 0, 1, 1, 1, memory]
    following = [
        timed(planner, grid, tuple(pose), goal, bound) for pose in plan.poses[1:12]
    ]
    after = float(np.median([milliseconds for milliseconds, _ in following]))
    way = np.append(0, np.cumsum(np.hypot(*np.diff(plan.poses[:, :2].T))))
    x, y = grid.world_to_cell(*plan.poses[np.searchsorted(way, AHEAD), :2])
    changed = grid.with_patch(np.ones((8, 8), np.bool_), x - 4, y - 4)
    repair, _ = timed(planner, changed, start, goal, bound)
    new, _ = timed(other, changed, start, goal, bound)
    return [first, after, repair, new, plan.bound, memory]


def timed(
    planner: Planner, grid: GridMap, start: Pose, goal: Pose, bound: float
) -> tuple[float, PosePlan]:
    """Return the milliseconds of CPU time of a plan, and the plan."""
    began = time.process_time()
    plan = planner.plan_poses(grid, start, goal, bound=bound)
    return 1e3 * (time.process_time() - began), plan


def resident() -> float:
    """Return the memory of this process in MB."""
    return (
        int(Path("/proc/self/statm").read_text().split()[1])
        * os.sysconf("SC_PAGESIZE")
        / 1e6
    )


def blocks(share: float, seed: int) -> GridMap:
    """Return 2000 x 2000 cells, of which rectangles and discs of 2 to 5 m cover a share."""
    random, occupancy = np.random.default_rng(seed), np.zeros((2000, 2000), np.bool_)
    rows, columns = np.ogrid[:2000, :2000]
    while occupancy.mean() < share:
        (x, y), (wide, high) = (
            random.integers(2000, size=2),
            random.integers(20, 50, size=2),
        )
        box = abs(columns - x) < wide, abs(rows - y) < high
        disc = (columns - x) ** 2 + (rows - y) ** 2 < wide**2
        occupancy |= box[0] & box[1] if random.random() < 0.5 else disc
    return GridMap(occupancy, CELL)


FIGURES: Final = {
    "collisions": (
        "body | motion | requests | plans | with a collision | poses",
        collisions,
    ),
    "optimality": (
        "place | requests with a way | solved | above the bound | worst cost | at last | bound",
        optimality,
    ),
    "speed": (
        "map | first, mean ms | worst | next | repair | new | ratio | worst | bound | MB",
        speed,
    ),
}


def main() -> None:
    """Print the figure that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--figure", choices=FIGURES, required=True)
    parser.add_argument(
        "--maps", type=file_of, metavar="FOLDER", help="ROS maps of 0.05 m"
    )
    parser.add_argument(
        "--requests", type=int, default=30, metavar="N", help="of each map"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--model", default="differential_robot", help="whose times count"
    )
    parser.add_argument(
        "--bound", type=float, default=1.2, help="of the paths whose times count"
    )
    options = parser.parse_args()
    header, rows = FIGURES[options.figure]
    print(table(header, list(rows(options))))


if __name__ == "__main__":
    main()
