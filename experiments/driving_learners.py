"""What learns from driving: `Experience`, and simpler ways to compare it with."""

from collections.abc import Callable
from typing import Any, Final, Protocol

import numpy as np
import scipy.linalg
from driving_worlds import SPEED, Float64
from scipy.optimize import minimize
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import cg

from ddqn_planner import Experience, GridMap
from ddqn_planner.grid.arguments import MAX_SLOWNESS

WINDOW: Final = 0.5  # seconds over which poses are averaged
CELL, SQUARE = 0.25, 1.0  # metres: the sides of places
VISIT_NOISE: Final = 0.1  # variance of the log slowness of a visit
LIMITS: Final = np.log([0.5, 0.05, 0.05]), np.log([10, 2, 2])  # of a Gaussian process


class Learner(Protocol):
    """What gets the poses of its drives, and gives a map to plan on."""

    def apply(self, grid: GridMap) -> GridMap:
        """Return the map with what was learned."""

    def record(self, seconds: Float64, positions: Float64) -> None:
        """Learn from a drive."""


class Nothing:
    """Learns nothing, and plans the shortest path."""

    def __init__(self, grid: GridMap) -> None:
        self.grid = grid

    def apply(self, grid: GridMap) -> GridMap:
        """Return the map."""
        return grid

    def record(self, seconds: Float64, positions: Float64) -> None:
        """Ignore a drive."""


class Places:
    """Squares of the map, and what the visits of a drive say of each."""

    def __init__(self, grid: GridMap, side: float) -> None:
        self.side, self.origin = side, np.array(grid.origin[:2])
        rows, columns = (
            ((np.arange(cells) + 0.5) * grid.resolution // side).astype(np.int64)
            for cells in grid.occupancy.shape
        )
        self.shape = int(rows[-1]) + 1, int(columns[-1]) + 1
        self.of_cells = rows[:, None] * self.shape[1] + columns
        self.count = self.shape[0] * self.shape[1]

    def visits(self, seconds: Float64, positions: Float64) -> tuple[Any, Float64, Float64]:
        """Return the places of a drive, and the metres and the slowness of each."""
        window = ((seconds - seconds[0]) // WINDOW).astype(np.int64)
        number = np.bincount(window)
        x, y, t = (np.bincount(window, of) / number for of in (*positions.T, seconds))
        middle = np.stack([x[1:] + x[:-1], y[1:] + y[:-1]]).T / 2 - self.origin
        column, row = (middle // self.side).astype(np.int64).T
        inside = row.clip(0, self.shape[0] - 1) * self.shape[1] + column.clip(0, self.shape[1] - 1)
        metres = np.bincount(inside, np.hypot(np.diff(x), np.diff(y)), self.count)
        took = np.bincount(inside, np.diff(t), self.count)
        places = np.unique(inside)
        metres = np.maximum(metres[places], self.side / 4)
        return places, metres, np.clip(took[places] * SPEED / metres, 1 / 3, MAX_SLOWNESS)

    def on_map(self, grid: GridMap, slowness: Float64) -> GridMap:
        """Return a map with the slowness of each place."""
        of_cells = np.clip(slowness, 1, MAX_SLOWNESS).astype(np.float32)[self.of_cells]
        return grid.with_slowness(of_cells, grid.resolution / SPEED)


class LastTime:
    """Remembers the last time of each cell."""

    def __init__(self, grid: GridMap) -> None:
        self.places = Places(grid, CELL)
        self.slowness = np.ones(self.places.count)

    def apply(self, grid: GridMap) -> GridMap:
        """Return the map with what was learned."""
        return self.places.on_map(grid, self.slowness)

    def record(self, seconds: Float64, positions: Float64) -> None:
        """Learn from a drive."""
        places, _, slowness = self.places.visits(seconds, positions)
        self.slowness[places] = slowness


class MeanTime:
    """Remembers the mean time for a metre in each square."""

    def __init__(self, grid: GridMap) -> None:
        self.places = Places(grid, SQUARE)
        self.metres, self.took = np.zeros((2, self.places.count))

    def apply(self, grid: GridMap) -> GridMap:
        """Return the map with what was learned."""
        known = np.divide(self.took, self.metres, np.ones_like(self.took), where=self.metres > 0)
        return self.places.on_map(grid, known)

    def record(self, seconds: Float64, positions: Float64) -> None:
        """Learn from a drive."""
        places, metres, slowness = self.places.visits(seconds, positions)
        self.metres[places] += metres
        self.took[places] += metres * slowness


class GaussianProcess:
    """The log slowness of squares: squared exponential, with all parameters fitted."""

    def __init__(self, grid: GridMap) -> None:
        self.places, self.drives = Places(grid, SQUARE), 0
        self.number, self.sum = np.zeros((2, self.places.count))
        self.parameters = np.log([2.0, 0.5, 0.3])  # length, and deviations of signal and noise
        at = np.indices(self.places.shape).reshape(2, -1).T * SQUARE
        self.squared = ((at[:, None] - at) ** 2).sum(axis=2)
        self.slowness = np.ones(self.places.count)

    def apply(self, grid: GridMap) -> GridMap:
        """Return the map with what was learned."""
        return self.places.on_map(grid, self.slowness)

    def record(self, seconds: Float64, positions: Float64) -> None:
        """Learn from a drive."""
        places, _, slowness = self.places.visits(seconds, positions)
        self.number[places] += 1
        self.sum[places] += np.log(slowness)
        self.drives += 1
        if self.drives & (self.drives - 1) == 0:  # after 1, 2, 4, 8, ... drives
            some = {"maxfev": 80}
            fit = minimize(
                lambda p: self._solve(p)[0], self.parameters, method="Nelder-Mead", options=some
            )
            self.parameters = np.clip(fit.x, np.log([0.5, 0.05, 0.05]), np.log([10, 2, 2]))
        _, mean, weights, known = self._solve(self.parameters)
        length, signal, _ = np.exp(self.parameters)
        kernel = signal**2 * np.exp(-self.squared[:, known] / (2 * length**2))
        self.slowness = np.exp(mean + kernel @ weights)

    def _solve(self, parameters: Float64) -> tuple[float, float, Float64, Any]:
        """Return the negative log likelihood, the mean, the weights, and the squares visited."""
        length, signal, noise = np.exp(np.clip(parameters, *LIMITS))
        known = np.flatnonzero(self.number)
        number = self.number[known]
        seen = self.sum[known] / number
        kernel = signal**2 * np.exp(-self.squared[np.ix_(known, known)] / (2 * length**2))
        kernel[np.diag_indices(len(known))] += noise**2 / number + 1e-6
        factor = scipy.linalg.cho_factor(kernel, lower=True, check_finite=False)
        both = scipy.linalg.cho_solve(factor, np.stack([seen, np.ones(len(known))], axis=1))
        mean = float(both[:, 0].sum() / both[:, 1].sum())
        weights = both[:, 0] - mean * both[:, 1]
        misfit = float((seen - mean) @ weights) / 2 + float(np.log(np.diag(factor[0])).sum())
        return misfit, mean, weights, known


class MarkovField:
    """The log slowness of free cells: a Gaussian Markov random field, not tuned."""

    def __init__(self, grid: GridMap, tau: float = 0.4, kappa: float = CELL**2) -> None:
        self.places = Places(grid, CELL)
        free = np.bincount(self.places.of_cells.ravel(), ~grid.occupancy.ravel()) > 0
        number = np.arange(self.places.count).reshape(self.places.shape)
        ends = np.concatenate(
            [
                np.stack([number[:, 1:].ravel(), number[:, :-1].ravel()], axis=1),
                np.stack([number[1:].ravel(), number[:-1].ravel()], axis=1),
            ]
        )
        first, last = ends[free[ends].all(axis=1)].T
        size = (self.places.count,) * 2
        links = coo_array((np.ones(len(first)), (first, last)), size).tocsr()
        links = links + links.T
        degree = np.asarray(links.sum(axis=1))
        self.prior = tau * (diags_array(degree + kappa) - links)
        self.weight, self.sum, self.mean = np.zeros((3, self.places.count))

    def apply(self, grid: GridMap) -> GridMap:
        """Return the map with what was learned."""
        return self.places.on_map(grid, np.exp(self.mean))

    def record(self, seconds: Float64, positions: Float64) -> None:
        """Learn from a drive."""
        places, metres, slowness = self.places.visits(seconds, positions)
        weight = np.minimum(metres / CELL, 1) / VISIT_NOISE
        self.weight[places] += weight
        self.sum[places] += weight * np.log(slowness)
        precision = (self.prior + diags_array(self.weight)).tocsr()
        inverse = diags_array(1 / precision.diagonal())
        self.mean = cg(precision, self.sum, self.mean, rtol=1e-4, M=inverse)[0]


LEARNERS: Final[dict[str, Callable[[GridMap], Learner]]] = {
    "experience": lambda grid: Experience(SPEED),
    "shortest path": Nothing,
    "last time per cell": LastTime,
    "mean per square": MeanTime,
    "Gaussian process": GaussianProcess,
    "Markov field": MarkovField,
}
