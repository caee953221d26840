"""Open halls with a slow square, round which a robot has to learn to drive."""

from typing import Final, NamedTuple

import numpy as np
from driving_laws import always
from driving_worlds import World

from ddqn_planner.grid import GridMap

LENGTH: Final = 20.0  # metres, of a hall
WIDTH: Final = 10.0  # metres
RESOLUTION: Final = 0.25  # metres
STATIONS: Final = ((2.0, 5.0), (18.0, 5.0))  # metres: missions lead to and fro


class Square(NamedTuple):
    """A square in which a robot is slow."""

    x: float  # metres, of its middle
    y: float  # metres, of its middle
    side: float  # metres
    slowness: float = 6.0


SQUARES: Final = (
    Square(10, 5, 4),
    Square(10, 5, 6),  # 2 m remain at each side
    Square(10, 5, 2),
    Square(6, 4, 4),  # the straight way passes near its edge
    Square(14, 6, 3),
    Square(9, 5, 4, slowness=3),
)


def hall(square: Square) -> World:
    """Return an open hall with a slow square, and a station at each of its ends."""
    shape = round(WIDTH / RESOLUTION), round(LENGTH / RESOLUTION)
    grid = GridMap(np.zeros(shape, dtype=np.bool_), RESOLUTION)
    y, x = (np.indices(shape) + 0.5) * RESOLUTION  # of the middles of the cells
    distance = np.maximum(np.abs(x - square.x), np.abs(y - square.y))
    slowness = np.where(distance < square.side / 2, square.slowness, 1.0)
    stations = [grid.world_to_cell(*station) for station in STATIONS]
    return World(grid, always(slowness), stations)
