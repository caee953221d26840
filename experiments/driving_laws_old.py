"""The laws of former measurements: zones, sills, waits, gradients, noise, crowds."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import scipy.ndimage
from driving_laws import Door, Float64, Law, MakeLaw, Stand, always
from driving_maps import gates
from random_maps import Random

from ddqn_planner.grid import Cell, GridMap

Range = tuple[float, float]
HOUR: Final = 3600.0


def discs(
    grid: GridMap, count: int, radius: Range, factor: Range, random: Random
) -> Float64:
    """Draw discs of some radius (metres) and slowness around free cells: (H, W)."""
    free = np.argwhere(~grid.occupancy)
    y, x = np.ogrid[: grid.height, : grid.width]
    slowness = np.ones(grid.occupancy.shape)
    for _ in range(count):
        centre_y, centre_x = free[random.integers(len(free))]
        metres = np.hypot(y - centre_y, x - centre_x) * grid.resolution
        inside = metres < random.uniform(*radius)
        slowness = np.maximum(slowness, np.where(inside, random.uniform(*factor), 1))
    return slowness


def _zones(grid: GridMap, random: Random) -> Float64:
    """Draw six slow zones, 2 to 5 m wide and 2 to 6 times as slow: (H, W)."""
    return discs(grid, 6, (1, 2.5), (2, 6), random)


def _with_crowds(slowness: Float64, crowds: Sequence[Float64]) -> Law:
    """Return the law of two crowds: one is there in odd hours, the other in even."""
    slowness_by_parity = [
        np.maximum(slowness, crowd)  # of even hours, then of odd hours
        for crowd in reversed(crowds)
    ]
    return Law(lambda clock: slowness_by_parity[int(clock // HOUR) % 2])


def slow_zones(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Let six zones be slow."""
    return always(_zones(grid, random))


def mixture(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Draw slow zones, a slipping carpet, two crowds and a narrow cell.

    The cell lies between two occupied cells, and is 20 times as slow.
    """
    zones = _zones(grid, random)
    carpet = discs(grid, 1, (1.5, 3), (1.4, 1.4), random)
    slowness = np.maximum(zones, carpet)
    crowds = [discs(grid, 1, (1, 2), (2, 2), random) for _ in range(2)]
    occupancy = grid.occupancy
    wall = np.pad(occupancy, 1, constant_values=True)
    is_between_columns = wall[1:-1, :-2] & wall[1:-1, 2:]
    is_between_rows = wall[:-2, 1:-1] & wall[2:, 1:-1]
    narrow = np.argwhere((is_between_columns | is_between_rows) & ~occupancy)
    if len(narrow):
        y, x = narrow[random.integers(len(narrow))]
        slowness[y, x] = 20.0
    return _with_crowds(slowness, crowds)


def crowds(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Draw two crowds of five discs each, of which one is there at a time."""
    both = [discs(grid, 5, (1, 2.5), (2, 5), random) for _ in range(2)]
    return _with_crowds(np.ones(grid.occupancy.shape), both)


def sills(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Let the cells of doors be 5 to 20 times as slow."""
    slowness = np.ones(grid.occupancy.shape)
    for cells in gates(grid, random):
        slowness[cells] = random.uniform(5, 20)
    return always(slowness)


def waits(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Let the robot wait for 5 to 30 s at each passage of some doors."""
    doors = []
    for cells in gates(grid, random):
        is_door = np.zeros(grid.occupancy.shape, dtype=np.bool_)
        is_door[cells] = True
        seconds = random.uniform(5, 30)
        doors.append(Door(is_door, Stand(1, seconds, seconds)))
    level = np.ones(grid.occupancy.shape)
    return Law(lambda clock: level, doors=doors)


def gradient(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Let the map be 1 to 4 times as slow, linearly in a direction."""
    angle = random.uniform(0, 2 * np.pi)
    y, x = np.ogrid[: grid.height, : grid.width]
    distance = np.cos(angle) * x + np.sin(angle) * y
    return always(1 + 3 * (distance - distance.min()) / np.ptp(distance))


def checkerboard(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Let every second square of 1 to 3 m be 2 to 3 times as slow."""
    side = random.uniform(1, 3) / grid.resolution
    y, x = np.indices(grid.occupancy.shape)
    column = (x + random.uniform(0, side)) // side
    row = (y + random.uniform(0, side)) // side
    is_odd = (column + row) % 2 == 1
    return always(np.where(is_odd, random.uniform(2, 3), 1.0))


def noise(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Let the log slowness have the spectrum 1/f, in squares of 25 cm.

    Its standard deviation is 0.65.
    """
    size = grid.resolution
    height, width = grid.occupancy.shape
    rows = ((np.arange(height) + 0.5) * size // 0.25).astype(np.int64)  # of squares
    columns = ((np.arange(width) + 0.5) * size // 0.25).astype(np.int64)
    shape = rows[-1] + 1, columns[-1] + 1
    frequency = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1]))
    frequency[0, 0] = np.inf
    spectrum = np.fft.fft2(random.normal(size=shape)) / frequency
    log = np.fft.ifft2(spectrum).real
    slowness = np.exp(np.maximum(0.4 + 0.65 * log / log.std(), 0))
    return always(slowness[np.ix_(rows, columns)])


def ramps(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Let five rectangles of 3 to 6 m be slow upward, but not downward.

    Upward they are 2.5 to 5 times as slow.
    """
    free = np.argwhere(~grid.occupancy)
    uphill = np.zeros((*grid.occupancy.shape, 2))
    for _ in range(5):
        y, x = free[random.integers(len(free))]
        half_sides = np.rint(random.uniform(1.5, 3, 2) / grid.resolution)
        rows, columns = half_sides.astype(np.int64)
        angle = random.uniform(0, 2 * np.pi)
        climb = random.uniform(1.5, 4)  # the slowness upward, less 1 of level ground
        box = slice(max(y - rows, 0), y + rows), slice(max(x - columns, 0), x + columns)
        uphill[box] = climb * np.cos(angle), climb * np.sin(angle)
    level = np.ones(grid.occupancy.shape)
    return Law(lambda clock: level, uphill)


def clearance(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Let the robot be slow near walls: 2.5 to 4.5 times beside them.

    The factor falls with the distance.
    """
    padded = np.pad(grid.occupancy, 1, constant_values=True)
    cells = scipy.ndimage.distance_transform_edt(~padded)[1:-1, 1:-1] - 0.5
    metres = cells * grid.resolution
    factor = random.uniform(1.5, 3.5)
    return always(1 + factor * np.exp(-metres / random.uniform(0.3, 0.6)))


LAWS: Final[dict[str, MakeLaw]] = {
    "mixture": mixture,
    "discs": slow_zones,
    "sills": sills,
    "waits": waits,
    "gradient": gradient,
    "checkerboard": checkerboard,
    "noise": noise,
    "ramps": ramps,
    "crowds": crowds,
    "clearance": clearance,
}
