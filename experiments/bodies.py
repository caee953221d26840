"""Measures plans for bodies with a heading: collisions, costs, times, memory.

``--figure collisions`` has each plan checked by an oracle of its own: the body's
polygon, every 2 cm and 2 degrees, against each occupied cell (Shapely). ``--maps`` adds
ROS maps from a folder.
"""

import argparse
import gc
import math
import os
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import islice, pairwise, product
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from processes import memory
from random_maps import KINDS, generate_map
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from slow_places import times
from tables import table

from ddqn_planner import GridMap, Planner, load_map
from ddqn_planner.commands.options import file_of
from ddqn_planner.grid import MOVES, Cell, MoveRule
from ddqn_planner.model import ModelMetadata, RobotNetwork
from ddqn_planner.planning.path_finder import last_step
from ddqn_planner.planning.plan import PosePlan, PoseRequest
from ddqn_planner.robot.driving_costs import DrivingCosts
from ddqn_planner.robot.footprint import read_footprint
from ddqn_planner.robot.motions import HEADINGS as DEFAULT_HEADINGS
from ddqn_planner.robot.motions import Motion, Motions
from ddqn_planner.training.robot import MotionOptions, read_motions
from ddqn_planner.version import __version__
from ddqn_planner.warm_up import warm_up

CELL: Final = 0.05  # metres
FOOTPRINTS: Final = {
    "rectangle": "[[0.45, 0.3], [-0.45, 0.3], [-0.45, -0.3], [0.45, -0.3]]",
    "car": "[[0.7, 0.3], [-0.2, 0.3], [-0.2, -0.3], [0.7, -0.3]]",
    "disc": "0.25",
    "triangle": "[[0.5, 0.0], [-0.3, 0.35], [-0.3, -0.35]]",
    "corner": "[[0.5, 0.3], [0.1, 0.3], [0.1, 0.1], [-0.3, 0.1], [-0.3, -0.3], "
    "[0.5, -0.3]]",
    "long": "[[0.7, 0.2], [-0.5, 0.2], [-0.5, -0.2], [0.7, -0.2]]",
}
RADII: Final = {
    Motion.DIFFERENTIAL: 0.4,
    Motion.ACKERMANN: 0.8,
    Motion.OMNIDIRECTIONAL: 0.4,
}
SHORTEST_REQUEST: Final = 50.0  # metres from start to goal
LONGEST_REQUEST: Final = 60.0
BOX_AHEAD: Final = 2.0  # metres on the path to the box that is put on it
ORACLE_METRES: Final = 0.02  # between two poses that the oracle tries
ORACLE_RADIANS: Final = math.radians(2)
BEND_METRES: Final = 0.25  # on which a curvature is measured
STRAIGHT: Final = 0.05  # per metre: a smaller curvature is none
SHRUNK: Final = 1e-6  # metres, so that a body that only touches does not collide

Pose = tuple[float, float, float]


def robot(
    footprint: str,
    motion: Motion | str,
    headings: int = DEFAULT_HEADINGS,
    costs: DrivingCosts = DrivingCosts(),  # noqa: B008 - it never changes
) -> Planner:
    """Return the planner of a body that knows its swept cells exactly.

    It needs no training.
    """
    corners = read_footprint(footprint)
    motion = Motion(motion)
    options = MotionOptions(motion, RADII[motion], CELL, headings, costs=costs)
    motions = read_motions(options)
    network = RobotNetwork.untrained(corners, motions)
    network.tensors["weight"] = network.swept_by_unit.astype(np.float32)
    network.tensors["threshold"] = np.full(network.sizes["units"], 0.5, np.float32)
    metadata = ModelMetadata(
        network="robot",
        sizes=network.sizes,
        move_rule=MoveRule.ROBOT_SAFE,
        gamma=1.0,
        map_fingerprint="",
        steps=0,
        seed=0,
        package_version=__version__,
    )
    return Planner(network, metadata)


class Oracle:
    """Counts the poses of a path where a body touches an obstacle.

    Parameters
    ----------
    obstacles : (N,) array of Shapely's polygons
        In metres.
    footprint : str
        The body's.
    """

    def __init__(self, obstacles: NDArray[np.object_], footprint: str) -> None:
        self.obstacles = shapely.STRtree(obstacles)
        corners = read_footprint(footprint)
        self.body = shapely.Polygon(corners).buffer(-SHRUNK, join_style="mitre")
        self.corners = np.array(self.body.exterior.coords)

    def collisions(self, poses: NDArray[np.float64]) -> int:
        """Return at how many poses of a path the body touches an obstacle.

        Poses are tried every 2 cm and every 2 degrees between those of `poses` (N, 3):
        x, y in metres and the yaw in radians.
        """
        outlines = self._outlines(poses)
        touching, _ = self.obstacles.query(outlines, predicate="intersects")
        return len(np.unique(touching))

    def clearance(self, poses: NDArray[np.float64]) -> float:
        """Return the least distance between the body and an obstacle, in metres.

        Poses are tried as in `collisions`.
        """
        _, distances = self.obstacles.query_nearest(
            self._outlines(poses), return_distance=True, all_matches=False
        )
        return float(distances.min())

    def _outlines(self, poses: NDArray[np.float64]) -> NDArray[np.object_]:
        """Return the body's polygons (M,) at the poses of a path and between them."""
        x, y, _ = poses.T
        yaw = np.unwrap(poses[:, 2])
        metres = np.hypot(np.diff(x), np.diff(y))
        radians = np.abs(np.diff(yaw))
        steps = np.maximum(metres / ORACLE_METRES, radians / ORACLE_RADIANS)
        steps_between = np.maximum(np.ceil(steps), 1).astype(int)  # (N - 1,)

        # (M,): the index in `poses` of each tried pose, with its share of the way on.
        pieces = [
            index + np.linspace(0, 1, count, endpoint=False)
            for index, count in enumerate(steps_between)
        ]
        tried = np.concatenate([*pieces, [len(x) - 1.0]])
        index = np.arange(len(x))
        x, y, yaw = (np.interp(tried, index, column) for column in (x, y, yaw))

        cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        ahead, left = self.corners.T  # metres from the origin of the body
        outline_x = cos * ahead - sin * left + x[:, None]  # (M, corners)
        outline_y = sin * ahead + cos * left + y[:, None]
        outlines: NDArray[np.object_] = shapely.polygons(
            np.stack([outline_x, outline_y], axis=-1)
        )
        return outlines


def occupied_cells(grid: GridMap) -> NDArray[np.object_]:
    """Return the squares (N,) of a map's occupied cells, and of those around it."""
    y, x = np.nonzero(np.pad(grid.occupancy, 1, constant_values=True))
    low = np.column_stack([x - 1.0, y - 1.0]) * grid.resolution + grid.origin[:2]
    high = low + grid.resolution
    squares: NDArray[np.object_] = shapely.box(*low.T, *high.T)
    return squares


def inner_radius(corners: NDArray[np.float64]) -> float:
    """Return the radius of the largest circle around the origin in a polygon, m.

    `corners` (N, 2) are the polygon's, in metres.
    """
    sides = np.roll(corners, -1, axis=0) - corners
    # The point of each side that is nearest to the origin, as a share of the side.
    share = -(corners * sides).sum(axis=1) / (sides**2).sum(axis=1)
    points = corners + np.clip(share, 0, 1)[:, None] * sides
    return float(np.hypot(*points.T).min())


def requests(
    grid: GridMap, radius: float, random: np.random.Generator
) -> Iterator[tuple[Pose, Pose]]:
    """Yield starts and goals whose surroundings are free within a radius, in metres."""
    from scipy.ndimage import distance_transform_edt

    distance = distance_transform_edt(np.pad(~grid.occupancy, 1))[1:-1, 1:-1]
    rows, columns = np.nonzero(distance * grid.resolution > radius)
    while len(rows):
        poses = []
        for number in random.integers(len(rows), size=2):
            x, y = grid.cell_to_world((int(columns[number]), int(rows[number])))
            offset_x, offset_y, turns = random.uniform(-0.5, 0.5, 3)
            yaw = turns * 2 * math.pi
            poses.append((x + offset_x * CELL, y + offset_y * CELL, yaw))
        yield poses[0], poses[1]


def map_files(folder: Path | None) -> list[Path]:
    """Return the ROS maps of a folder, sorted; none without a folder."""
    if folder is None:
        return []
    return sorted(folder.glob("*.yaml"))


def worlds(folder: Path | None, random: np.random.Generator) -> dict[str, GridMap]:
    """Return maps whose halls and doors are wide enough for a robot, by their names.

    Some maps are generated, the others are the ROS maps of the folder.
    """
    maps = {}
    for kind in KINDS:
        cells = generate_map(kind, (14, 14), random)
        maps[kind] = GridMap(np.kron(cells, np.ones((20, 20), np.bool_)), CELL)
    for path in map_files(folder):
        maps[path.stem] = load_map(path)
    return maps


@cache
def ways(motions: Motions) -> list[dict[Cell, float]]:
    """Return the cells that the origin passes on each primitive.

    With each cell, an offset from the first one, comes its share of the primitive's
    length. The cells are in the order of the way.
    """
    cells_of_primitives = []
    for poses in motions.poses:
        index = np.linspace(0, len(poses) - 1, 1001)
        x = np.interp(index, range(len(poses)), poses[:, 0])
        y = np.interp(index, range(len(poses)), poses[:, 1])
        points = np.column_stack([x, y])
        lengths = np.hypot(*np.diff(points, axis=0).T) + 1e-12
        middles = (points[1:] + points[:-1]) / 2
        cells = np.floor(middles + 0.5).astype(np.int64)
        length_shares = (lengths / lengths.sum()).tolist()
        share_of_cell: dict[Cell, float] = defaultdict(float)
        for (x, y), share in zip(cells.tolist(), length_shares, strict=True):
            share_of_cell[x, y] += share
        cells_of_primitives.append(share_of_cell)
    return cells_of_primitives


def least_costs(
    grid: GridMap,
    motions: Motions,
    swept: NDArray[np.bool_],
    *goals: tuple[int, int, int],
) -> NDArray[np.float64]:
    """Return the least cost from every pose to a goal, by Dijkstra.

    `swept` (primitives, side, side) has the cells that the body sweeps on each
    primitive; its middle is the cell of the origin. A goal is (x, y, heading). The
    costs are in cells: (H, W, headings), infinite without a path.
    """
    layers = 2 if motions.cusp else 1  # driven ahead, and in reverse
    edges = [
        in_layer(edges_of_primitive(grid, motions, swept, primitive), layer, layers)
        for primitive in range(len(motions.poses))
        for layer in layers_of(motions.poses[primitive], layers)
    ]
    if motions.cusp:
        state = np.arange(grid.occupancy.size * motions.headings * layers)
        cost = np.full(len(state), motions.cusp)
        edges.append(np.column_stack([state, state ^ 1, cost]))
    state, next_state, cost = np.concatenate(edges).T
    size = grid.occupancy.size * motions.headings * layers
    # Against the drive, as the search begins at the goals.
    ends = next_state.astype(int), state.astype(int)
    graph = coo_matrix((cost, ends), (size, size)).tocsr()
    numbers = [
        ((y * grid.width + x) * motions.headings + heading) * layers + layer
        for x, y, heading in goals
        for layer in range(layers)
    ]
    costs: NDArray[np.float64] = dijkstra(graph, indices=numbers, min_only=True)
    shape = grid.height, grid.width, motions.headings, layers
    least: NDArray[np.float64] = costs.reshape(shape).min(axis=-1)
    return least


def layers_of(poses: NDArray[np.float64], layers: int) -> range:
    """Return in which layers a primitive is driven: ahead 0, in reverse 1, or both.

    Without cusps there is one layer.
    """
    dx, dy, turn = np.diff(poses, axis=0).T
    yaw = poses[:-1, 2] + turn / 2
    ahead = (dx * np.cos(yaw) + dy * np.sin(yaw)).sum()
    is_neither = abs(ahead) <= 0.9 * np.hypot(dx, dy).sum()
    if layers == 1 or is_neither:
        return range(layers)
    return range(1) if ahead > 0 else range(1, 2)


def in_layer(
    edges: NDArray[np.float64], layer: int, layers: int
) -> NDArray[np.float64]:
    """Return edges (N, 3) between poses as edges between the states of a layer."""
    pose, next_pose, cost = edges.T
    return np.column_stack([pose * layers + layer, next_pose * layers + layer, cost])


def edges_of_primitive(
    grid: GridMap, motions: Motions, swept: NDArray[np.bool_], primitive: int
) -> NDArray[np.float64]:
    """Return the drives of one primitive on the map, (N, 3).

    The columns are the number of the pose, of the next pose, and the cost in cells.
    """
    way = ways(motions)[primitive]
    y, x = np.nonzero(~is_blocked(grid, swept[primitive], way))
    factor = np.zeros(len(x))
    for (dx, dy), share in way.items():
        factor += share * grid.cost_multiplier[y + dy, x + dx]
    is_allowed = np.ones(len(x), np.bool_)
    if grid.forbidden is not None:
        for (dx, dy), (next_dx, next_dy) in pairwise(way):
            action = MOVES.tolist().index([next_dx - dx, next_dy - dy])
            actions = grid.forbidden[y + dy, x + dx]  # a bit for each forbidden one
            is_allowed &= (actions >> action & 1) == 0
    dx, dy = motions.offset[primitive]
    pose = (y * grid.width + x) * motions.headings + motions.start[primitive]
    next_cell = (y + dy) * grid.width + x + dx
    next_pose = next_cell * motions.headings + motions.end[primitive]
    cost = motions.cost[primitive] * factor
    return np.column_stack([pose, next_pose, cost])[is_allowed]


def is_blocked(
    grid: GridMap, swept: NDArray[np.bool_], way: dict[Cell, float]
) -> NDArray[np.bool_]:
    """Return where a primitive cannot begin: (H, W).

    The body would touch an occupied cell of the map or its border.
    """
    height, width = grid.occupancy.shape
    reach = swept.shape[-1] // 2
    occupied = np.pad(grid.occupancy, reach, constant_values=True)
    blocked = np.zeros((height, width), np.bool_)
    for y, x in np.argwhere(swept):
        blocked |= occupied[y : y + height, x : x + width]
    for dx, dy in way:  # an origin outside of the body may leave the map
        blocked[max(height - dy, 0) :] = True
        blocked[: max(-dy, 0)] = True
        blocked[:, max(width - dx, 0) :] = True
        blocked[:, : max(-dx, 0)] = True
    return blocked


def narrow(random: np.random.Generator) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield doors 10 cm wider than a body of 0.6 m, corridors and mazes."""
    for _ in range(3):
        occupancy = np.zeros((100, 110), np.bool_)
        wall = random.integers(35, 75)
        door = random.integers(5, 81)
        occupancy[:, wall : wall + random.integers(1, 9)] = True
        occupancy[door : door + 14] = False
        yield "door", occupancy
        occupancy = np.ones((100, 110), np.bool_)
        width = random.integers(14, 24)
        corner = random.integers(45, 80)
        occupancy[5 : 5 + width, 5:corner] = False
        occupancy[5:95, corner - width : corner] = False
        yield "corridor with a turn", occupancy
        maze = generate_map("maze", (5, 5), random)
        yield "maze", np.kron(maze, np.ones((24, 24), np.bool_))


@dataclass
class Optimality:
    """What plans in one kind of narrow place cost; the ratios are the greatest."""

    requests: int = 0
    solved: int = 0
    above_bound: int = 0
    first_ratio: float = 1.0  # of the cost of the first plan to the least one
    last_ratio: float = 1.0  # of the plan whose bound is 1
    bound: float = 1.0  # that was proved of the first plan


def optimality(options: argparse.Namespace) -> Iterator[list[Any]]:
    """Yield a row for each kind of narrow place.

    A row has the number of solved requests, and their costs over the least ones.
    """
    random = np.random.default_rng(options.seed)
    planner = Planner.load(options.model)
    assert isinstance(planner.network, RobotNetwork)
    motions = planner.network.motions
    results: dict[str, Optimality] = {}
    for name, occupancy in narrow(random):
        grid = GridMap(occupancy, CELL)
        result = results.setdefault(name, Optimality())
        least = np.full(1, np.inf)
        while np.isfinite(least).sum() < 1000:
            y, x = random.choice(np.argwhere(~occupancy)).tolist()
            heading = int(random.integers(motions.headings))
            goal = (x, y, heading)
            least = least_costs(grid, motions, planner.network.swept(), goal)
        end = pose_at(grid, motions, *goal)
        starts = np.argwhere(np.isfinite(least) & (least > 0))
        for y, x, heading in random.choice(starts, options.requests).tolist():
            start = pose_at(grid, motions, x, y, heading)
            _compare(planner, grid, start, end, least[y, x, heading], result)
    for name, result in results.items():
        ratios = result.first_ratio, result.last_ratio, result.bound
        counts = result.requests, result.solved, result.above_bound
        yield [name, *counts, *(f"{ratio:.4f}" for ratio in ratios)]


def pose_at(grid: GridMap, motions: Motions, x: int, y: int, heading: int) -> Pose:
    """Return the pose of a cell's centre with a numbered heading."""
    return (*grid.cell_to_world((x, y)), float(motions.angles[heading]))


def _compare(
    planner: Planner,
    grid: GridMap,
    start: Pose,
    goal: Pose,
    least_cost: float,
    result: Optimality,
) -> None:
    """Plan with the bounds 1.2 and 1, and add the plans to the result."""
    first = plan_of_primitives(planner, grid, start, goal, bound=1.2)
    last = plan_of_primitives(planner, grid, start, goal, bound=1.0)
    first_ratio = (first.cost or np.nan) / least_cost
    last_ratio = (last.cost or np.nan) / least_cost
    result.requests += 1
    result.solved += bool(first.poses.size and last.poses.size)
    result.above_bound += bool(first_ratio > first.bound * 1.0001)
    # NaN, of a request without a plan, stays.
    result.first_ratio = float(np.maximum(result.first_ratio, first_ratio))
    result.last_ratio = float(np.maximum(result.last_ratio, last_ratio))
    result.bound = max(result.bound, first.bound)


def plan_of_primitives(
    planner: Planner, grid: GridMap, start: Pose, goal: Pose, bound: float
) -> PosePlan:
    """Return a path that is not finished: Dijkstra's costs are those of primitives."""
    assert planner.pose_planner is not None
    request = PoseRequest(grid, start, (goal,), bound=bound, finished=False)
    return last_step(planner.pose_planner.steps(request))


def collisions(options: argparse.Namespace) -> Iterator[list[Any]]:
    """Yield a row of the table of collisions for each body and motion.

    A row has the numbers of requests, plans, colliding plans and poses.
    """
    random = np.random.default_rng(options.seed)
    maps = worlds(options.maps, random)
    for (name, footprint), motion in product(FOOTPRINTS.items(), Motion):
        planner = robot(footprint, motion)
        radius = inner_radius(read_footprint(footprint))
        plans = []
        colliding = 0
        for grid in maps.values():
            oracle = Oracle(occupied_cells(grid), footprint)
            drawn = requests(grid, radius + CELL, random)
            for start, goal in islice(drawn, options.requests):
                plan = planner.plan_poses(grid, start, goal)
                plans.append(len(plan.poses))
                if plan.poses.size:
                    colliding += oracle.collisions(plan.poses) > 0
        solved = sum(poses > 0 for poses in plans)
        yield [name, motion.value, len(plans), solved, colliding, sum(plans)]


class Shape(NamedTuple):
    """How a path bends, per 10 m except for the ends."""

    turning: float  # degrees
    flips: float  # changes between bends to the left and to the right
    cusps: float  # changes between ahead and reverse
    off: float  # centimetres from the start or the goal: the greater of both
    turned: float  # degrees, likewise


def shape_of(poses: NDArray[np.float64], start: Pose, goal: Pose) -> Shape:
    """Return how a path (N, 3) from a start to a goal bends; all in metres."""
    dx, dy = np.diff(poses[:, :2], axis=0).T
    lengths = np.hypot(dx, dy)
    yaw = np.unwrap(poses[:, 2])
    mean_yaw = (yaw[1:] + yaw[:-1]) / 2
    is_moving = lengths > 1e-4
    is_ahead = (dx * np.cos(mean_yaw) + dy * np.sin(mean_yaw) > 0)[is_moving]
    # The curvature on each quarter of a metre.
    way = np.append(0, np.cumsum(lengths))
    marks = np.arange(0, way[-1], BEND_METRES)
    curvature = np.diff(np.interp(marks, way, yaw)) / BEND_METRES
    sides = np.sign(curvature[np.abs(curvature) >= STRAIGHT])
    off = np.abs(poses[[0, -1]] - [start, goal])  # (2, 3)
    turned = np.abs((off[:, 2] + math.pi) % (2 * math.pi) - math.pi)
    per_10_m = 10 / way[-1]
    return Shape(
        turning=per_10_m * float(np.degrees(np.abs(np.diff(yaw)).sum())),
        flips=per_10_m * float((np.diff(sides) != 0).sum()),
        cusps=per_10_m * float((np.diff(is_ahead.astype(int)) != 0).sum()),
        off=100 * float(np.hypot(off[:, 0], off[:, 1]).max()),
        turned=float(np.degrees(turned.max())),
    )


class Speed(NamedTuple):
    """What one request took: milliseconds of CPU time, if no unit is named."""

    first: float
    next: float  # from the next poses of the first plan
    repair: float  # after a change of the map
    new: float  # with a new field on the changed map
    bound: float  # that was proved of the first plan
    megabytes: float


def speed(options: argparse.Namespace) -> Iterator[list[Any]]:
    """Yield a row for each map: what a request of 50 to 60 m costs, in CPU time."""
    maps = {f"blocks, {share:.0%}": blocks(share, options.seed) for share in (0.1, 0.2)}
    for path in map_files(options.maps):
        grid = load_map(path)
        if min(grid.occupancy.shape) * grid.resolution > LONGEST_REQUEST:
            maps[path.stem] = grid
    for name, grid in maps.items():
        random = np.random.default_rng(options.seed)
        drawn = requests(grid, 0.55, random)
        planner = Planner.load(options.model)
        for _ in warm_up(planner):  # what is compiled first takes long
            pass
        speeds: list[Speed] = []
        while len(speeds) < options.requests:
            start, goal = next(drawn)
            distance = math.dist(start[:2], goal[:2])
            if SHORTEST_REQUEST < distance < LONGEST_REQUEST:
                speeds.append(drive(planner, grid, start, goal, options.bound))
        yield [name, *(f"{figure:.2f}" for figure in figures_of(speeds))]


def figures_of(speeds: list[Speed]) -> list[float]:
    """Return the figures of a row of the table of speed."""
    first, following, repair, new, bound, megabytes = np.array(speeds).T
    ratio = repair / new
    return [
        first.mean(),
        first.max(),
        float(np.median(following)),
        float(np.median(repair)),
        float(np.median(new)),
        float(np.median(ratio)),
        ratio.max(),
        bound.mean(),
        megabytes.max(),
    ]


def drive(
    planner: Planner, grid: GridMap, start: Pose, goal: Pose, bound: float
) -> Speed:
    """Measure one request; the robot drives some poses, and the map changes."""
    other_planner = Planner(planner.network, planner.metadata)
    # What holds for the map is made before.
    planner.plan_poses(grid, start, start)
    other_planner.plan_poses(grid, start, start)
    gc.collect()
    former_memory = memory(os.getpid())
    first, plan = timed(planner, grid, start, goal, bound)
    megabytes = memory(os.getpid()) - former_memory
    if not plan.poses.size:
        return Speed(first, 0, 1, 1, 1, megabytes)
    times = [
        timed(planner, grid, tuple(pose), goal, bound)[0] for pose in plan.poses[1:12]
    ]
    # A box of 40 cm on the path.
    steps = np.hypot(*np.diff(plan.poses[:, :2].T))
    metres = np.append(0, np.cumsum(steps))
    box_pose = plan.poses[np.searchsorted(metres, BOX_AHEAD)]
    x, y = grid.world_to_cell(*box_pose[:2])
    changed = grid.with_patch(np.ones((8, 8), np.bool_), x - 4, y - 4)
    repair, _ = timed(planner, changed, start, goal, bound)
    new, _ = timed(other_planner, changed, start, goal, bound)
    return Speed(first, float(np.median(times)), repair, new, plan.bound, megabytes)


def timed(
    planner: Planner, grid: GridMap, start: Pose, goal: Pose, bound: float
) -> tuple[float, PosePlan]:
    """Return the milliseconds of CPU time of a plan, and the plan."""
    began = time.process_time()
    plan = planner.plan_poses(grid, start, goal, bound=bound)
    return 1e3 * (time.process_time() - began), plan


def blocks(share: float, seed: int) -> GridMap:
    """Return a map of rectangles and discs of 2 to 5 m.

    The map has 2000 x 2000 cells; the obstacles cover a share of them.
    """
    random = np.random.default_rng(seed)
    occupancy = np.zeros((2000, 2000), np.bool_)
    rows, columns = np.ogrid[:2000, :2000]
    while occupancy.mean() < share:
        x, y = random.integers(2000, size=2)
        half_width, half_height = random.integers(20, 50, size=2)
        if random.random() < 0.5:
            is_in_columns = abs(columns - x) < half_width
            occupancy |= is_in_columns & (abs(rows - y) < half_height)
        else:
            occupancy |= (columns - x) ** 2 + (rows - y) ** 2 < half_width**2
    return GridMap(occupancy, CELL)


FIGURES: Final = {
    "collisions": (
        "body | motion | requests | plans | with a collision | poses",
        collisions,
    ),
    "optimality": (
        "place | requests with a way | solved | above the bound | worst cost "
        "| at last | bound",
        optimality,
    ),
    "speed": (
        "map | first, mean ms | worst | next | repair | new | ratio | worst "
        "| bound | MB",
        speed,
    ),
    "times": (
        "model | expected times | requests | without: median ms | mean | 95 % "
        "| with: median | mean | 95 % | ratio: median | mean | 95 % "
        "| first paths, mean",
        times,
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
