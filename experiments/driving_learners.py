"""What learns from driving: `Experience`, and a plain field to compare it with."""

from collections.abc import Callable
from dataclasses import replace
from typing import Final, Protocol

import numpy as np
from driving_laws import Float64
from driving_worlds import SPEED
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import cg

from ddqn_planner import Experience, GridMap
from ddqn_planner.grid.arguments import MAX_SLOWNESS

WINDOW: Final = 0.5  # seconds over which poses are averaged
SIDE: Final = 0.25  # metres: the side of a place, as of `Experience`
VISIT_NOISE: Final = 0.1  # variance of the log slowness of a visit
# Of the field: its precision between neighbours, and toward 0.
TAU: Final = 0.4
KAPPA: Final = 0.0625


class Learner(Protocol):
    """Learns from drives, and makes maps of expected times."""

    def record(self, seconds: Float64, positions: Float64) -> object:
        """Learn from the poses of a drive: (N,) seconds, and (N, 2) metres."""

    def apply(self, grid: GridMap) -> GridMap:
        """Return the map with expected times."""


class MarkovField:
    """The log slowness of free places: a Gaussian Markov random field, not tuned."""

    def __init__(self, grid: GridMap) -> None:
        self.origin = np.array(grid.origin[:2])
        height, width = grid.occupancy.shape
        rows = ((np.arange(height) + 0.5) * grid.resolution // SIDE).astype(np.int64)
        columns = ((np.arange(width) + 0.5) * grid.resolution // SIDE).astype(np.int64)
        self.shape = int(rows[-1]) + 1, int(columns[-1]) + 1  # in places
        # (H, W): the number of the place of each cell
        self.of_cells = rows[:, None] * self.shape[1] + columns

        count = self.shape[0] * self.shape[1]
        free_cells = np.bincount(self.of_cells.ravel(), ~grid.occupancy.ravel())
        is_free = free_cells > 0
        number = np.arange(count).reshape(self.shape)
        side_by_side = np.stack([number[:, 1:].ravel(), number[:, :-1].ravel()])
        one_above_the_next = np.stack([number[1:].ravel(), number[:-1].ravel()])
        pairs = np.concatenate([side_by_side, one_above_the_next], axis=1)
        first, second = pairs[:, is_free[pairs].all(axis=0)]
        links = coo_array((np.ones(len(first)), (first, second)), (count, count))
        links = links.tocsr() + links.tocsr().T
        self.prior = TAU * (diags_array(links.sum(axis=1) + KAPPA) - links)
        self.weight = np.zeros(count)
        self.weighted_log = np.zeros(count)
        self.mean_log = np.zeros(count)

    def apply(self, grid: GridMap) -> GridMap:
        """Return the map with the slowness of each place."""
        slowness = np.clip(np.exp(self.mean_log), 1, MAX_SLOWNESS).astype(np.float32)
        return replace(
            grid,
            slowness=slowness[self.of_cells],
            seconds_per_cell=grid.resolution / SPEED,
        )

    def record(self, seconds: Float64, positions: Float64) -> None:
        """Learn from the poses of a drive: (N,) seconds, and (N, 2) metres."""
        # The mean pose of each window of time.
        window = ((seconds - seconds[0]) // WINDOW).astype(np.int64)
        count = np.bincount(window)
        x = np.bincount(window, positions[:, 0]) / count
        y = np.bincount(window, positions[:, 1]) / count
        time = np.bincount(window, seconds) / count

        # A step from one mean pose to the next belongs to the place of its middle.
        middle = np.stack([x[1:] + x[:-1], y[1:] + y[:-1]]) / 2 - self.origin[:, None]
        last = np.array([[self.shape[1] - 1], [self.shape[0] - 1]])
        column, row = (middle // SIDE).astype(np.int64).clip(0, last)
        place = row * self.shape[1] + column  # of each step
        places = np.unique(place)
        metres = np.bincount(place, np.hypot(np.diff(x), np.diff(y)))[places]
        duration = np.bincount(place, np.diff(time))[places]
        metres = np.maximum(metres, SIDE / 4)
        slowness = np.clip(duration * SPEED / metres, 1 / 3, MAX_SLOWNESS)

        weight = np.minimum(metres / SIDE, 1) / VISIT_NOISE
        self.weight[places] += weight
        self.weighted_log[places] += weight * np.log(slowness)
        precision = (self.prior + diags_array(self.weight)).tocsr()
        inverse = diags_array(1 / precision.diagonal())
        self.mean_log, _ = cg(
            precision, self.weighted_log, self.mean_log, rtol=1e-4, M=inverse
        )


LEARNERS: Final[dict[str, Callable[[GridMap], Learner]]] = {
    "experience": lambda _: Experience(SPEED),
    "Markov field": MarkovField,
}
