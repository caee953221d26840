"""What learns from driving: `Experience`, and simpler ways to compare it with."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import numpy as np
import scipy.linalg
from driving_worlds import SPEED, Float64
from scipy.optimize import minimize
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import cg

from ddqn_planner import Experience, GridMap
from ddqn_planner.experience import Learned
from ddqn_planner.grid.arguments import MAX_SLOWNESS
from ddqn_planner.training.prior_training import prior_of

WINDOW: Final = 0.5  # seconds over which poses are averaged
MORE_PLACES: Final = 1.1  # times as many as the last time teach the prior anew
CELL, SQUARE = 0.25, 1.0  # metres: the sides of places
VISIT_NOISE: Final = 0.1  # variance of the log slowness of a visit
# Of the parameters of a Gaussian process: the length, and the deviations of signal and
# noise.
LIMITS: Final = np.log([0.5, 0.05, 0.05]), np.log([10, 2, 2])


class Learner:
    """Learns nothing of the squares of a map. Others learn their slowness."""

    def __init__(self, grid: GridMap, side: float = CELL) -> None:
        self.side, self.origin = side, np.array(grid.origin[:2])
        rows, columns = (
            ((np.arange(cells) + 0.5) * grid.resolution // side).astype(np.int64)
            for cells in grid.occupancy.shape
        )
        self.shape = int(rows[-1]) + 1, int(columns[-1]) + 1
        self.of_cells, self.count = (
            rows[:, None] * self.shape[1] + columns,
            np.prod(self.shape),
        )
        self.slowness: Float64 | None = None

    def apply(self, grid: GridMap) -> GridMap:
        """Return the map with the slowness of each square."""
        if self.slowness is None:
            return grid
        of_squares = np.clip(self.slowness, 1, MAX_SLOWNESS).astype(np.float32)
        times = {
            "slowness": of_squares[self.of_cells],
            "seconds_per_cell": grid.resolution / SPEED,
        }
        return replace(grid, **times)

    def record(self, seconds: Float64, positions: Float64) -> None:
        """Learn from the poses of a drive."""
        window = ((seconds - seconds[0]) // WINDOW).astype(np.int64)
        number = np.bincount(window)
        x, y, t = (np.bincount(window, of) / number for of in (*positions.T, seconds))
        middle = np.stack([x[1:] + x[:-1], y[1:] + y[:-1]]) / 2 - self.origin[:, None]
        last = np.array([[self.shape[1] - 1], [self.shape[0] - 1]])
        column, row = (middle // self.side).astype(np.int64).clip(0, last)
        steps = row * self.shape[1] + column
        metres, took = (
            np.bincount(steps, np.hypot(np.diff(x), np.diff(y))),
            np.bincount(steps, np.diff(t)),
        )
        squares = np.unique(steps)
        driven = np.maximum(metres[squares], self.side / 4)
        self.learn(
            squares,
            driven,
            np.clip(took[squares] * SPEED / driven, 1 / 3, MAX_SLOWNESS),
        )

    def learn(self, squares: Any, metres: Float64, slowness: Float64) -> None:
        """Learn from a drive: the metres in each square, and the square's slowness."""


class LastTime(Learner):
    """Remembers the last time of each cell."""

    def learn(self, squares: Any, metres: Float64, slowness: Float64) -> None:
        """Learn from the squares of a drive."""
        self.slowness = np.ones(self.count) if self.slowness is None else self.slowness
        self.slowness[squares] = slowness


class MeanTime(Learner):
    """Remembers the mean time for a metre in each square."""

    def __init__(self, grid: GridMap) -> None:
        super().__init__(grid, SQUARE)
        self.metres, self.took = np.zeros((2, self.count))

    def learn(self, squares: Any, metres: Float64, slowness: Float64) -> None:
        """Learn from the squares of a drive."""
        self.metres[squares] += metres
        self.took[squares] += metres * slowness
        self.slowness = np.where(
            self.metres, self.took / np.maximum(self.metres, 1e-9), 1
        )


class GaussianProcess(Learner):
    """The log slowness of squares: squared exponential, with all parameters fitted."""

    def __init__(self, grid: GridMap) -> None:
        super().__init__(grid, SQUARE)
        self.number, self.sum, self.drives = (
            np.zeros(self.count),
            np.zeros(self.count),
            0,
        )
        self.parameters = np.log([2.0, 0.5, 0.3])
        at = np.indices(self.shape).reshape(2, -1).T * SQUARE
        self.squared = ((at[:, None] - at) ** 2).sum(axis=2)

    def learn(self, squares: Any, metres: Float64, slowness: Float64) -> None:
        """Learn from a drive; after 1, 2, 4, 8, ... drives, fit the parameters."""
        self.number[squares] += 1
        self.sum[squares] += np.log(slowness)
        self.drives += 1
        if self.drives & (self.drives - 1) == 0:
            how = {"method": "Nelder-Mead", "options": {"maxfev": 80}}
            fit = minimize(lambda tried: self._solve(tried)[0], self.parameters, **how)
            self.parameters = np.clip(fit.x, *LIMITS)
        self.slowness = np.exp(self._solve(self.parameters)[1])

    def _solve(self, parameters: Float64) -> tuple[float, Float64]:
        """Return the negative log likelihood, and each square's mean log slowness."""
        length, signal, noise = np.exp(np.clip(parameters, *LIMITS))
        known = np.flatnonzero(self.number)
        number = self.number[known]
        seen = self.sum[known] / number
        kernel = signal**2 * np.exp(-self.squared[known] / (2 * length**2))
        among = kernel[:, known] + np.diag(noise**2 / number + 1e-6)
        factor = scipy.linalg.cho_factor(among, lower=True, check_finite=False)
        both = scipy.linalg.cho_solve(
            factor, np.stack([seen, np.ones(len(known))], axis=1)
        )
        mean = float(both[:, 0].sum() / both[:, 1].sum())
        weights = both[:, 0] - mean * both[:, 1]
        misfit = float((seen - mean) @ weights) / 2 + float(
            np.log(np.diag(factor[0])).sum()
        )
        return misfit, mean + weights @ kernel


class MarkovField(Learner):
    """The log slowness of free cells: a Gaussian Markov random field, not tuned."""

    def __init__(self, grid: GridMap, tau: float = 0.4, kappa: float = CELL**2) -> None:
        super().__init__(grid)
        free = np.bincount(self.of_cells.ravel(), ~grid.occupancy.ravel()) > 0
        number = np.arange(self.count).reshape(self.shape)
        pairs = (number[:, 1:], number[:, :-1]), (number[1:], number[:-1])
        ends = np.concatenate(
            [np.stack([of.ravel() for of in pair]) for pair in pairs], axis=1
        )
        first, last = ends[:, free[ends].all(axis=0)]
        links = coo_array(
            (np.ones(len(first)), (first, last)), (self.count, self.count)
        ).tocsr()
        links += links.T
        self.prior = tau * (diags_array(links.sum(axis=1) + kappa) - links)
        self.weight, self.sum, self.mean = np.zeros((3, self.count))

    def learn(self, squares: Any, metres: Float64, slowness: Float64) -> None:
        """Learn from the squares of a drive."""
        weight = np.minimum(metres / self.side, 1) / VISIT_NOISE
        self.weight[squares] += weight
        self.sum[squares] += weight * np.log(slowness)
        precision = (self.prior + diags_array(self.weight)).tocsr()
        inverse = diags_array(1 / precision.diagonal())
        self.mean = cg(precision, self.sum, self.mean, rtol=1e-4, M=inverse)[0]
        self.slowness = np.exp(self.mean)


class TaughtExperience(Experience):
    """A learner that trains its prior as often as `trainer_node` does."""

    def __init__(self, grid: GridMap) -> None:
        super().__init__(SPEED)
        self.grid, self.places = grid, 0

    def record(self, seconds: Any, positions: Any) -> Learned:
        """Learn from a drive."""
        learned = super().record(seconds, positions)
        places = len(self.evidence.places)
        if places > self.places and places >= MORE_PLACES * self.places:
            self.places = places
            self.prior = prior_of(self.grid, self.evidence.places, self.prior)
        return learned


LEARNERS: Final[dict[str, Callable[[GridMap], Any]]] = {
    "experience": TaughtExperience,
    "shortest path": Learner,
    "last time per cell": LastTime,
    "mean per square": MeanTime,
    "Gaussian process": GaussianProcess,
    "Markov field": MarkovField,
}
