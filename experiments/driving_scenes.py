"""Small worlds that each ask one question of `Experience`."""

import itertools
from argparse import Namespace
from typing import Final

import numpy as np
from driving_halls import SQUARES
from driving_halls import hall as hall_with
from driving_laws import Door, Float64, Law, Stand, always
from driving_missions import Job, Result, planner, run_in
from driving_worlds import RULE, SPEED, World, drive
from numpy.typing import NDArray
from tables import table

from ddqn_planner import Experience, GridMap

Sections = dict[str, str]

RESOLUTION: Final = 0.25  # metres
DOOR_WAITS: Final = (10, 30, 60)  # seconds
DOOR_DRIVES: Final = 40
ALIKE: Final = 2.5  # seconds by which ways through one door differ, at most
HALL_MISSIONS: Final = 60
PASSAGES: Final = 100  # of a door, before and after the one wait there
ONE_WAIT: Final = 70  # seconds
TWO_SPEEDS: Final = (4.0, 1.0)  # slowness
TWO_SPEEDS_DRIVES: Final = 40
ZONE_NOISES: Final = (0.02, 0.035, 0.05)  # metres
ZONE_RATES: Final = (10, 50)  # poses per second
ZONE_WIDTHS: Final = (0.2, 0.35, 0.5)  # metres, of the robot
ZONE_DRIVES: Final = 10


def doors(options: Namespace) -> Sections:
    """Count the drives through a door where the robot waits at each passage.

    Another door is 6 s farther.
    """
    rows = []
    for seconds in DOOR_WAITS:
        passages = []  # of each seed
        for seed in range(options.seeds):
            world = _two_rooms(40, 8, Stand(1, seconds, seconds))
            result = _result(world, seed, DOOR_DRIVES, options)
            passages.append(np.count_nonzero(_is_through_first_door(result)))
        rows.append([f"{seconds} s", f"{np.mean(passages):.1f}", max(passages)])
    return {"Doors": table(f"wait | drives through it, of {DOOR_DRIVES} | most", rows)}


def one_wait(options: Namespace) -> Sections:
    """Count the drives through a door after the robot waited there once.

    It has passed the door many times without a wait. Another door is 6 s farther.
    """
    open_doors = _two_rooms(52, 5, None)
    closed_once = _two_rooms(52, 5, Stand(1, ONE_WAIT, ONE_WAIT))
    start, goal = open_doors.stations
    way = planner().plan(open_doors.grid, start, goal, RULE).cells
    rows = []
    for seed in range(options.seeds):
        experience = Experience(SPEED)
        random = np.random.default_rng(seed)
        for number in range(PASSAGES + 1):
            world = closed_once if number == PASSAGES else open_doors
            cells = way if number % 2 == 0 else way[::-1]
            measured = drive(cells, world, 0.0, random)
            experience.record(measured.seconds, measured.positions)
        expected = experience.expected_time(open_doors.grid, way).seconds
        result = _result(open_doors, seed, PASSAGES, options, experience)
        passages = np.count_nonzero(_is_through_first_door(result))
        rows.append([seed, f"{expected:.1f} s", passages])
    header = f"seed | expected time of the way | drives through it, of {PASSAGES}"
    return {"One wait": table(header, rows)}


def hall(options: Namespace) -> Sections:
    """Measure missions from one end of a hall to the other, past a slow square."""
    rows = []
    for square in SQUARES:
        world = hall_with(square)
        ratios = []  # of each seed and mission
        for seed in range(options.seeds):
            result = _result(world, seed, HALL_MISSIONS, options)
            ratios.append(result.seconds / result.best)
        mean = np.mean(ratios, axis=0)
        last = f"{mean[-1]:.2f} ({np.max(ratios, axis=0)[-1]:.2f})"
        middle = f"{square.x:g} m, {square.y:g} m"
        size = f"{square.side:g} m"
        shown = [f"{mean[mission - 1]:.2f}" for mission in (2, 20)]
        rows.append([middle, size, square.slowness, *shown, last])
    header = "middle | side | slowness | mission 2 | mission 20 | mission 60 (worst)"
    return {"The hall": table(header, rows)}


def two_speeds(options: Namespace) -> Sections:
    """Measure what is expected where half of all drives are four times as slow."""
    shape = (20, 80)
    grid = GridMap(np.zeros(shape, dtype=np.bool_), RESOLUTION)
    path = [(x, 10) for x in range(2, 78)]
    worlds = [
        World(grid, always(np.full(shape, slowness)), [path[0], path[-1]])
        for slowness in TWO_SPEEDS
    ]
    rows = []
    for seed in range(options.seeds):
        random = np.random.default_rng(seed)
        experience = Experience(SPEED)
        durations = []
        for number in random.permutation(TWO_SPEEDS_DRIVES):
            measured = drive(path, worlds[number % 2], 0.0, random)
            durations.append(measured.duration)
            experience.record(measured.seconds, measured.positions)
        seconds, low, high = experience.expected_time(grid, path)
        true = f"{np.min(durations):.0f} to {np.max(durations):.0f} s"
        mean = f"{np.mean(durations):.0f} s"
        rows.append([seed, true, mean, f"{seconds:.0f} s [{low:.0f}, {high:.0f}]"])
    header = "seed | drives take | mean | expected time [interval of 90 %]"
    return {"Two speeds": table(header, rows)}


def zones(_: Namespace) -> Sections:
    """Measure the learned slowness of a zone whose slowness is 4.0.

    The poses are of several kinds.
    """
    grid = GridMap(np.zeros((20, 80), dtype=np.bool_), RESOLUTION)
    slowness = np.ones((20, 80))
    slowness[:, 32:48] = 4
    path = [(x, 10) for x in range(2, 78)]
    world = World(grid, always(slowness), [path[0], path[-1]])
    rows = []
    for noise, rate in itertools.product(ZONE_NOISES, ZONE_RATES):
        learned = []
        for width in ZONE_WIDTHS:
            experience = Experience(SPEED, width)
            random = np.random.default_rng(0)
            clock = 0.0
            for number in range(ZONE_DRIVES):
                route = path if number % 2 == 0 else path[::-1]
                measured = drive(route, world, clock, random, noise, rate)
                experience.record(measured.seconds, measured.positions)
                clock += measured.duration
            in_zone = experience.slowness(grid)[10, 36:44].mean()
            learned.append(f"{in_zone:.2f}")
        rows.append([f"{100 * noise:g} cm", f"{rate} Hz", *learned])
    widths = " | ".join(f"robot_width {width}" for width in ZONE_WIDTHS)
    return {"A zone of slowness 4.0": table(f"noise of poses | rate | {widths}", rows)}


def _two_rooms(height: int, margin: int, stand: Stand | None) -> World:
    """Make a world of two rooms with two doors, and a stand in the nearer one.

    The map has so many rows, and the two stations are so many from its borders. The
    way through the other door takes 5 to 7 s longer.
    """
    occupancy = np.zeros((height, 40), dtype=np.bool_)
    wall = height // 2
    occupancy[wall] = True
    occupancy[wall, 10:13] = False
    occupancy[wall, 24:27] = False
    stations = [(11, margin), (11, height - margin)]
    level: Float64 = np.ones(occupancy.shape)
    doors = []
    if stand is not None:
        cells = np.zeros(occupancy.shape, dtype=np.bool_)
        cells[wall, 10:13] = True
        doors.append(Door(cells, stand))
    law = Law(lambda clock: level, doors=doors)
    return World(GridMap(occupancy, RESOLUTION), law, stations)


def _result(
    world: World,
    seed: int,
    missions: int,
    options: Namespace,
    experience: Experience | None = None,
) -> Result:
    """Drive missions in a world, with experience or from the beginning."""
    job = Job("scene", seed, (), missions, options.exploration)
    learner = Experience(SPEED) if experience is None else experience
    return run_in(job, world, "experience", learner)


def _is_through_first_door(result: Result) -> NDArray[np.bool_]:
    """Return which missions led through the nearer of two doors: (M,)."""
    # The shortest path leads through it, and the detour takes another time.
    return np.abs(result.seconds - result.shortest) < ALIKE
