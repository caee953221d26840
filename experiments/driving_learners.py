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
CELL: Final = 0.25  # metres: the side of a place, as of `Experience`
SQUARE: Final = 1.0  # metres: the side of a place of the simple learners
VISIT_NOISE: Final = 0.1  # variance of the log slowness of a visit
# The parameters of a Gaussian process are logarithms: of the length in metres, and of
# the standard deviations of signal and noise.
FIRST_PARAMETERS: Final = np.log([2.0, 0.5, 0.3])
LIMITS: Final = np.log([0.5, 0.05, 0.05]), np.log([10, 2, 2])
MAX_FITS: Final = 80  # likelihoods of a fit of the parameters


class Learner:
    """Learns nothing of the squares of a map. Others learn their slowness."""

    def __init__(self, grid: GridMap, side: float = CELL) -> None:
        self.side = side  # metres, of a square
        self.origin = np.array(grid.origin[:2])
        height, width = grid.occupancy.shape
        rows = ((np.arange(height) + 0.5) * grid.resolution // side).astype(np.int64)
        columns = ((np.arange(width) + 0.5) * grid.resolution // side).astype(np.int64)
        self.shape = int(rows[-1]) + 1, int(columns[-1]) + 1  # in squares
        self.count = np.prod(self.shape)
        # (H, W): the number of the square of each cell
        self.of_cells = rows[:, None] * self.shape[1] + columns
        self.slowness: Float64 | None = None  # of each square; None before a drive

    def apply(self, grid: GridMap) -> GridMap:
        """Return the map with the slowness of each square."""
        if self.slowness is None:
            return grid
        slowness = np.clip(self.slowness, 1, MAX_SLOWNESS).astype(np.float32)
        return replace(
            grid,
            slowness=slowness[self.of_cells],
            seconds_per_cell=grid.resolution / SPEED,
        )

    def record(self, seconds: Float64, positions: Float64) -> None:
        """Learn from the poses of a drive.

        `positions` (N, 2) are in metres.
        """
        # The mean pose of each window of time.
        window = ((seconds - seconds[0]) // WINDOW).astype(np.int64)
        count = np.bincount(window)
        x = np.bincount(window, positions[:, 0]) / count
        y = np.bincount(window, positions[:, 1]) / count
        time = np.bincount(window, seconds) / count

        # A step from one mean pose to the next belongs to the square of its middle.
        middle = np.stack([x[1:] + x[:-1], y[1:] + y[:-1]]) / 2 - self.origin[:, None]
        last = np.array([[self.shape[1] - 1], [self.shape[0] - 1]])
        column, row = (middle // self.side).astype(np.int64).clip(0, last)
        square = row * self.shape[1] + column  # of each step
        squares = np.unique(square)
        metres = np.bincount(square, np.hypot(np.diff(x), np.diff(y)))[squares]
        duration = np.bincount(square, np.diff(time))[squares]
        metres = np.maximum(metres, self.side / 4)
        slowness = np.clip(duration * SPEED / metres, 1 / 3, MAX_SLOWNESS)
        self.learn(squares, metres, slowness)

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
        self.metres = np.zeros(self.count)
        self.slow_metres = np.zeros(self.count)  # metres times slowness

    def learn(self, squares: Any, metres: Float64, slowness: Float64) -> None:
        """Learn from the squares of a drive."""
        self.metres[squares] += metres
        self.slow_metres[squares] += metres * slowness
        mean = self.slow_metres / np.maximum(self.metres, 1e-9)
        self.slowness = np.where(self.metres, mean, 1)


class GaussianProcess(Learner):
    """The log slowness of squares: squared exponential, with all parameters fitted."""

    def __init__(self, grid: GridMap) -> None:
        super().__init__(grid, SQUARE)
        self.visits = np.zeros(self.count)
        self.sum_of_log = np.zeros(self.count)  # of the slowness of the visits
        self.drives = 0
        self.parameters = FIRST_PARAMETERS
        position = np.indices(self.shape).reshape(2, -1).T * SQUARE
        difference = position[:, None] - position
        self.squared_distance = (difference**2).sum(axis=2)  # (count, count) m²

    def learn(self, squares: Any, metres: Float64, slowness: Float64) -> None:
        """Learn from a drive; after 1, 2, 4, 8, ... drives, fit the parameters."""
        self.visits[squares] += 1
        self.sum_of_log[squares] += np.log(slowness)
        self.drives += 1
        if self.drives & (self.drives - 1) == 0:  # a power of two
            fit = minimize(
                lambda parameters: self._solve(parameters)[0],
                self.parameters,
                method="Nelder-Mead",
                options={"maxfev": MAX_FITS},
            )
            self.parameters = np.clip(fit.x, *LIMITS)
        self.slowness = np.exp(self._solve(self.parameters)[1])

    def _solve(self, parameters: Float64) -> tuple[float, Float64]:
        """Return the negative log likelihood, and each square's mean log slowness."""
        length, signal, noise = np.exp(np.clip(parameters, *LIMITS))
        visited = np.flatnonzero(self.visits)
        visits = self.visits[visited]
        mean_log = self.sum_of_log[visited] / visits
        correlation = np.exp(-self.squared_distance[visited] / (2 * length**2))
        kernel = signal**2 * correlation  # of visited squares and all squares
        covariance = kernel[:, visited] + np.diag(noise**2 / visits + 1e-6)
        factor = scipy.linalg.cho_factor(covariance, lower=True, check_finite=False)
        sides = np.stack([mean_log, np.ones(len(visited))], axis=1)
        solved = scipy.linalg.cho_solve(factor, sides)
        # The mean of the process is the one that is most likely.
        mean = float(solved[:, 0].sum() / solved[:, 1].sum())
        weights = solved[:, 0] - mean * solved[:, 1]
        half_log_determinant = float(np.log(np.diag(factor[0])).sum())
        misfit = float((mean_log - mean) @ weights) / 2 + half_log_determinant
        return misfit, mean + weights @ kernel


class MarkovField(Learner):
    """The log slowness of free cells: a Gaussian Markov random field, not tuned."""

    def __init__(self, grid: GridMap, tau: float = 0.4, kappa: float = CELL**2) -> None:
        super().__init__(grid)
        free_cells = np.bincount(self.of_cells.ravel(), ~grid.occupancy.ravel())
        is_free = free_cells > 0
        number = np.arange(self.count).reshape(self.shape)
        side_by_side = np.stack([number[:, 1:].ravel(), number[:, :-1].ravel()])
        one_above_the_next = np.stack([number[1:].ravel(), number[:-1].ravel()])
        pairs = np.concatenate([side_by_side, one_above_the_next], axis=1)
        first, second = pairs[:, is_free[pairs].all(axis=0)]
        shape = self.count, self.count
        links = coo_array((np.ones(len(first)), (first, second)), shape).tocsr()
        links += links.T
        self.prior = tau * (diags_array(links.sum(axis=1) + kappa) - links)
        self.weight = np.zeros(self.count)
        self.weighted_log = np.zeros(self.count)
        self.mean_log = np.zeros(self.count)

    def learn(self, squares: Any, metres: Float64, slowness: Float64) -> None:
        """Learn from the squares of a drive."""
        weight = np.minimum(metres / self.side, 1) / VISIT_NOISE
        self.weight[squares] += weight
        self.weighted_log[squares] += weight * np.log(slowness)
        precision = (self.prior + diags_array(self.weight)).tocsr()
        inverse = diags_array(1 / precision.diagonal())
        self.mean_log, _ = cg(
            precision, self.weighted_log, self.mean_log, rtol=1e-4, M=inverse
        )
        self.slowness = np.exp(self.mean_log)


class TaughtExperience(Experience):
    """A learner that trains its prior as often as `trainer_node` does."""

    def __init__(self, grid: GridMap) -> None:
        super().__init__(SPEED)
        self.grid = grid
        self.taught_places = 0  # places when the prior was trained last

    def record(self, seconds: Any, positions: Any) -> Learned:
        """Learn from a drive."""
        learned = super().record(seconds, positions)
        places = len(self.evidence.places)
        if places > self.taught_places and places >= MORE_PLACES * self.taught_places:
            self.taught_places = places
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
