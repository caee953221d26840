"""Compares paths of robots with a body with other planners' paths, request by request.

``requests`` writes maps and requests into a folder, and ``plan`` writes the paths of
this planner to a CSV file there. ``compare`` prints a table of such files. A planner's
file has a line for each pose: map, request, milliseconds, x, y, yaw. The maps hold
obstacles alone; add costs around them as `inflated_as_nav2` does.
"""

import argparse
import csv
import math
import time
from collections import Counter
from collections.abc import Iterator
from itertools import chain, groupby, islice
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from bodies import (
    CELL,
    Oracle,
    Pose,
    Shape,
    inner_radius,
    map_files,
    occupied_cells,
    requests,
    shape_of,
)
from map_files import save_map
from numpy.typing import NDArray
from random_maps import generate_map
from tables import table

from ddqn_planner import GridMap, Planner, load_map
from ddqn_planner.commands.options import file_of
from ddqn_planner.grid.inflation import clearance, grid_from_costmap
from ddqn_planner.model import RobotNetwork
from ddqn_planner.warm_up import warm_up

SHAPES: Final = ("random_10", "rooms", "corridors", "office", "maze")
MAPS_OF_KIND: Final = 3
CELLS_OF_MAP: Final = (12, 12)
CELL_OF_MAP: Final = 30  # cells of 0.05 m: the width of a corridor
HALL: Final = 400  # cells of the side of the empty map
ROS_MAPS: Final = "ROS maps"
SHORTEST: Final = 4.0  # metres from start to goal
ROOM: Final = 0.05  # metres between a body that starts or arrives, and an obstacle
INFLATION_RADIUS: Final = 1.0  # metres, as for Nav2's inflation layer
COST_SCALING_FACTOR: Final = 3.0
REQUEST_FIELDS: Final = (
    "map",
    "request",
    *("start_x", "start_y", "start_yaw"),
    *("goal_x", "goal_y", "goal_yaw"),
)
POSE_FIELDS: Final = ("map", "request", "ms", "x", "y", "yaw")

Key = tuple[str, str]  # the name of a map and the number of a request


class Request(NamedTuple):
    """What is planned: a path on a map."""

    map_name: str
    number: str
    start: Pose
    goal: Pose

    @property
    def key(self) -> Key:
        """The map's name and the number."""
        return self.map_name, self.number

    @property
    def kind(self) -> str:
        """The kind of the map."""
        return kind_of(self.map_name)


class PlannedPath(NamedTuple):
    """A path (N, 3) of poses, and the CPU time until it was there."""

    ms: float
    poses: NDArray[np.float64]


class Measured(NamedTuple):
    """What is measured of a path."""

    shape: Shape
    length: float  # metres
    clearance: float  # centimetres between the body and the nearest obstacle
    ms: float


Paths = dict[Key, PlannedPath]
Measurements = dict[Key, Measured]


def kind_of(map_name: str) -> str:
    """Return the kind of a map: its name without a number."""
    return map_name.partition("-")[0]


def inflated_as_nav2(grid: GridMap, inscribed_radius: float) -> GridMap:
    """Return a map with the costs of Nav2's inflation layer, as Nav2 publishes them.

    `inscribed_radius` is that of the body, in metres.
    """
    metres = clearance(grid.occupancy) * grid.resolution
    falling = np.exp(-COST_SCALING_FACTOR * np.maximum(metres - inscribed_radius, 0))
    cost = np.floor(252 * falling)
    values = np.where(cost >= 1, 1 + 97 * (cost - 1) // 251, 0)
    values[metres > INFLATION_RADIUS] = 0
    values[metres <= inscribed_radius] = 99
    values[grid.occupancy] = 100
    return grid_from_costmap(values.astype(np.int8), grid.resolution, grid.origin)


def generated_maps(random: np.random.Generator) -> Iterator[tuple[str, GridMap]]:
    """Yield an empty hall and maps of each shape, with their names."""
    yield "hall", GridMap(np.zeros((HALL, HALL), np.bool_), CELL)
    for shape in SHAPES:
        for number in range(MAPS_OF_KIND):
            cells = generate_map(shape, CELLS_OF_MAP, random)
            occupancy = np.kron(cells, np.ones((CELL_OF_MAP, CELL_OF_MAP), np.bool_))
            yield f"{shape}-{number}", GridMap(occupancy, CELL)


def free_requests(
    grid: GridMap, footprint: NDArray[np.float64], random: np.random.Generator
) -> Iterator[tuple[Pose, Pose]]:
    """Yield starts and goals at which the body has room."""
    oracle = Oracle(occupied_cells(grid), str(footprint.tolist()))
    drawn = chain.from_iterable(requests(grid, inner_radius(footprint), random))
    free = (pose for pose in drawn if oracle.clearance(np.array([pose])) > ROOM)
    # Each pose is in one pair alone: `zip` takes the poses of one generator in turn.
    for start, goal in zip(free, free, strict=False):
        if math.dist(start[:2], goal[:2]) > SHORTEST:
            yield start, goal


def write_requests(options: argparse.Namespace) -> None:
    """Write maps and requests into the folder."""
    random = np.random.default_rng(options.seed)
    footprint = robot_of(Planner.load(options.model)).footprint
    maps = dict(generated_maps(random))
    for path in map_files(options.maps):
        grid = load_map(path)
        obstacles = GridMap(grid.uninflated, grid.resolution, grid.origin)
        maps[f"{ROS_MAPS}-{path.stem}"] = obstacles
    maps_of_kind = Counter(kind_of(name) for name in maps)
    options.folder.mkdir(parents=True, exist_ok=True)
    with (options.folder / "requests.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(REQUEST_FIELDS)
        for name, grid in maps.items():
            save_map(grid, options.folder / f"{name}.yaml")
            count = options.requests // maps_of_kind[kind_of(name)]
            drawn = free_requests(grid, footprint, random)
            for number, (start, goal) in enumerate(islice(drawn, count)):
                writer.writerow([name, number, *start, *goal])


def read_map(folder: Path, name: str) -> GridMap:
    """Read a map of a folder, by its name."""
    return load_map(folder / f"{name}.yaml")


def read_requests(folder: Path) -> list[Request]:
    """Read the requests of a folder."""
    requests_ = []
    with (folder / "requests.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            name, number, *numbers = (row[field] for field in REQUEST_FIELDS)
            x, y, yaw, goal_x, goal_y, goal_yaw = map(float, numbers)
            goal = (goal_x, goal_y, goal_yaw)
            requests_.append(Request(name, number, (x, y, yaw), goal))
    return requests_


def robot_of(planner: Planner) -> RobotNetwork:
    """Return the network of a planner for a robot with a body."""
    assert isinstance(planner.network, RobotNetwork)
    return planner.network


def write_paths(options: argparse.Namespace) -> None:
    """Plan all requests of a folder, and write the paths."""
    planner = Planner.load(options.model)
    assert planner.pose_planner is not None
    radius = inner_radius(robot_of(planner).footprint)
    for _ in warm_up(planner):
        pass
    with (options.folder / options.csv).open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(POSE_FIELDS)
        by_map = groupby(read_requests(options.folder), lambda each: each.map_name)
        for name, requests_of_map in by_map:
            grid = read_map(options.folder, name)
            if not options.without_costs:
                grid = inflated_as_nav2(grid, radius)
            for request in requests_of_map:
                ends = request.start, request.goal
                began = time.process_time()
                plan = planner.plan_poses(grid, *ends, prove=options.prove)
                ms = 1e3 * (time.process_time() - began)
                for pose in plan.poses.tolist():
                    writer.writerow([*request.key, f"{ms:.3f}", *pose])


def read_paths(path: Path) -> Paths:
    """Read a planner's paths."""
    with path.open(newline="") as file:
        lines = [[row[field] for field in POSE_FIELDS] for row in csv.DictReader(file)]
    paths: Paths = {}
    for key, lines_of_path in groupby(lines, lambda line: (line[0], line[1])):
        numbers = np.array([line[2:] for line in lines_of_path], np.float64)
        paths[key] = PlannedPath(float(numbers[0, 0]), numbers[:, 1:])
    return paths


def measured(
    paths: Paths, requests_: list[Request], oracles: dict[str, Oracle]
) -> Measurements:
    """Measure the paths of one planner."""
    measurements: Measurements = {}
    for request in requests_:
        if request.key not in paths:
            continue
        ms, poses = paths[request.key]
        measurements[request.key] = Measured(
            shape_of(poses, request.start, request.goal),
            float(np.hypot(*np.diff(poses[:, :2].T)).sum()),
            100 * oracles[request.map_name].clearance(poses),
            ms,
        )
    return measurements


def compare(options: argparse.Namespace) -> None:
    """Print a table of the paths in CSV files: a row for each kind of map and file.

    Lengths are those over the paths of the first file. All figures but the numbers of
    solved requests are of those requests alone that all of the files solve.
    """
    footprint = str(robot_of(Planner.load(options.model)).footprint.tolist())
    requests_ = read_requests(options.folder)
    oracles = {
        name: Oracle(occupied_cells(read_map(options.folder, name)), footprint)
        for name in {request.map_name for request in requests_}
    }
    names = [Path(name).stem for name in options.csv]
    planners = [
        measured(read_paths(options.folder / name), requests_, oracles)
        for name in options.csv
    ]
    kinds = list(dict.fromkeys(request.kind for request in requests_))
    rows = []
    for kind in (*kinds, "all"):
        keys = [each.key for each in requests_ if kind in (each.kind, "all")]
        common = [key for key in keys if all(key in planner for planner in planners)]
        for name, planner in zip(names, planners, strict=True):
            solved = sum(key in planner for key in keys)
            first_lengths = [planners[0][key].length for key in common]
            figures = figures_of([planner[key] for key in common], first_lengths)
            rows.append([kind, name, f"{solved} of {len(keys)}", *figures])
    print(table(COLUMNS, rows))


COLUMNS: Final = (
    "map | paths of | solved | degrees per 10 m | flips | cusps | length "
    "| least clearance, cm: median | worst | with a collision "
    "| ends off, cm | degrees | ms: median | 95 % | worst"
)


def figures_of(measurements: list[Measured], first_lengths: list[float]) -> list[str]:
    """Return the figures of a row."""
    if not measurements:
        return []
    shapes, lengths, clearances, times = zip(*measurements, strict=True)
    turning, flips, cusps, off, turned = np.mean(shapes, axis=0)
    return [
        f"{turning:.0f}",
        f"{flips:.2f}",
        f"{cusps:.2f}",
        f"{np.mean(np.divide(lengths, first_lengths)):.3f}",
        f"{np.median(clearances):.1f}",
        f"{min(clearances):.1f}",
        f"{clearances.count(0)}",
        f"{off:.2f}",
        f"{turned:.2f}",
        f"{np.median(times):.1f}",
        f"{np.percentile(times, 95):.0f}",
        f"{max(times):.0f}",
    ]


def main() -> None:
    """Write requests or paths, or compare paths."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--model", default="car", help="whose body is the robot's")
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("requests", help="write maps and requests")
    command.set_defaults(run=write_requests)
    command.add_argument(
        "--maps", type=file_of, metavar="FOLDER", help="ROS maps of 0.05 m"
    )
    command.add_argument(
        "--requests", type=int, default=33, metavar="N", help="of each kind of map"
    )
    command.add_argument("--seed", type=int, default=0)
    command = commands.add_parser("plan", help="write the paths of this planner")
    command.set_defaults(run=write_paths)
    command.add_argument("csv", help="name of the file of paths")
    command.add_argument("--without-costs", action="store_true")
    command.add_argument("--prove", action="store_true", help="not the first paths")
    command = commands.add_parser("compare", help="print a table of files of paths")
    command.set_defaults(run=compare)
    command.add_argument("csv", nargs="+", help="names of files of paths")
    options = parser.parse_args()
    options.run(options)


if __name__ == "__main__":
    main()
