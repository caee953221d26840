"""Drives along straight lines in a hall."""

from __future__ import annotations

import math

import numpy as np

from ddqn_planner import Experience, GridMap

SPEED = 0.5
HALL = GridMap(np.zeros((40, 60), dtype=bool), 0.25)
"""15 m by 10 m."""

Point = tuple[float, float]
Poses = tuple[np.ndarray, np.ndarray]
"""Seconds (N,) and positions (N, 2)."""


def straight(
    start: Point,
    end: Point,
    slowness: float = 1.0,
    rate: float = 10.0,
    began: float = 0.0,
) -> Poses:
    """A drive at constant speed."""
    duration = math.dist(start, end) / SPEED * slowness
    seconds = np.arange(0, duration + 0.5 / rate, 1 / rate)
    share = (seconds / duration)[:, None]
    return began + seconds, np.array(start) * (1 - share) + np.array(end) * share


def uneven(x: np.ndarray, slowness: np.ndarray, rate: float = 10.0) -> Poses:
    """A drive along y = 5.1, of some slowness from each x (N,) to the next."""
    at_x = np.append(0, np.cumsum(np.diff(x) / SPEED * slowness[:-1]))
    seconds = np.arange(0, at_x[-1], 1 / rate)
    return seconds, np.column_stack(
        [np.interp(seconds, at_x, x), np.full(len(seconds), 5.1)]
    )


def driven(*drives: Poses, **options: float) -> Experience:
    """What drives teach."""
    experience = Experience(SPEED, **options)
    for drive in drives:
        experience.record(*drive)
    return experience


def at(grid: GridMap, values: np.ndarray, x: float, y: float) -> float:
    """The value of the cell at a place."""
    column, row = grid.world_to_cell(x, y)
    return float(values[row, column])
