"""What drives tell of all free places of a map: a Gaussian Markov random field."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place
from ddqn_planner.experience.places import NOISE, Float64, Int64, Places
from ddqn_planner.experience.population import FEW_PLACES, Population
from ddqn_planner.experience.prior import Prior, map_features
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import MAX_SLOWNESS

CORRELATION = 1.0  # metres: how far the slowness of a place tells of that of others
# Slowness is rounded to steps of this share: fields need no repair for less.
STEP = 0.02
STEPS = (1 + STEP) ** np.arange(1 + round(math.log(MAX_SLOWNESS) / math.log(1 + STEP)))
STEPS = np.minimum(STEPS, MAX_SLOWNESS).astype(np.float32)
# Of the log slowness: no place is farther from the solution of its equations.
ACCURACY = 0.01
OVER_RELAXATION = 1.4  # of the solver: neighbours agree sooner
# Around each place, so many places are assumed to be driven without a wait.
WAIT_PLACES = 0.1
# Standard deviations of the log time of a drive: on known places, and what is added on
# places that nobody drove.
DRIVE_NOISE = 0.05
UNKNOWN_NOISE = 0.42


class Painted(NamedTuple):
    """A layer of the map, and the values of the places from which it was made."""

    values: NDArray[Any]  # (P,)
    layer: NDArray[Any]  # (H, W)


class Equations(NamedTuple):
    """The linear equations (diagonal - links) x = right of P places, with L links."""

    begins: NDArray[np.int32]  # (P + 1,): the first link of each place
    neighbours: NDArray[np.int32]  # (L,): the other place of each link
    strengths: Float64  # (L,)
    diagonal: Float64  # (P,)
    tolerance: Float64  # (P,): of the square of a residual


class SumsOnMap(NamedTuple):
    """The sums of `Places`, by the P places of a map: (P,) each."""

    weight: Float64
    sum_of_log: Float64
    passages: Float64
    waited: Float64


class Posterior:
    """The posterior of each place of a map: a connected part of a block of free cells.

    The log slowness of a place is normal around what the map lets expect. Neighbours
    are alike, but not through walls.

    Attributes
    ----------
    known, unknown : (P,) float64
        The share of each place's log slowness that was seen, and the share of its
        standard deviation that remains.
    mean : (P,) float64
        The expected log slowness, without waits.
    slowness : (P,) float64
        The expected seconds over those at nominal speed, with waits.
    """

    def __init__(self, grid: GridMap, side: float, nominal_speed: float) -> None:
        from scipy.ndimage import distance_transform_edt

        self.grid = grid
        self.side = side
        self.nominal_speed = nominal_speed
        self.size = max(1, round(side / grid.resolution))  # cells of a block's side
        self.spacing = self.size * grid.resolution  # metres
        # (H, W), -1 where occupied; and (P, 2).
        self.place, self.middle = _places_of(grid, self.size)
        away, (y, x) = distance_transform_edt(self.place < 0, return_indices=True)
        self.nearest = np.where(away <= 1.5 * self.size, self.place[y, x], -1)
        count = len(self.middle)
        self.links = _links_of(self.place, self.size, count)
        self.linked: Float64 = self.links.sum(axis=1)
        # (P, 2), the solutions of two systems of equations: what was seen beyond what
        # is expected, and the share that is known.
        self.solution = np.zeros((count, 2))
        self.prior: Prior | None = None
        self.predicted = np.zeros(count)  # log slowness, by the prior
        self.painted: dict[str, Painted] = {}

    def time(self, seconds: Float64, places: Int64) -> tuple[float, float]:
        """Return the seconds of a path and the standard deviation of their logarithm.

        Parameters
        ----------
        seconds, places : (N,) float64, (N,) int64
            The expected seconds of each part of the path, and its place.
        """
        total = float(seconds.sum())
        unknown = float(seconds @ self.unknown[places] / total)
        return total, math.hypot(DRIVE_NOISE, UNKNOWN_NOISE * unknown)

    def places_at(self, position: Float64) -> Int64:
        """Return the place of each position (N, 2), the nearest within a place's side.

        It is -1 where no place is so near.
        """
        cells, is_inside = cells_of(position, self.grid)
        x, y = cells.T
        return np.where(is_inside, self.nearest[y, x], -1)

    def update(
        self, places: Places, population: Population, prior: Prior | None
    ) -> None:
        """Solve again with what was seen at places of the world."""
        self._predict(prior)
        self.expected = population.level + population.prior_weight * self.predicted
        sums = self._sums_of(places)
        self._solve(sums, population.variance)
        seen = self.solution[:, 0]
        self.known: Float64 = np.clip(self.solution[:, 1], 0, 1)
        self.unknown = np.sqrt(1 - self.known)
        self.mean = self.expected + seen + population.surplus * (1 - self.known)
        self.slowness = np.exp(self.mean)
        if sums.waited.any():
            waits = self._waits(sums.passages, sums.waited)
            self.slowness += self.nominal_speed * waits

    def _predict(self, prior: Prior | None) -> None:
        """Predict the log slowness of each place, if the prior is another."""
        if prior is self.prior:
            return
        self.prior = prior
        if prior is None:
            self.predicted[:] = 0
        else:
            x, y = self.middle.T
            self.predicted[:] = prior.log_slowness(map_features(self.grid)[y, x])

    def _sums_of(self, places: Places) -> SumsOnMap:
        """Return what was seen at each place of the map."""
        numbers = self.places_at(places.position)
        is_on_map = numbers >= 0
        numbers = numbers[is_on_map]

        def summed(values: Float64) -> Float64:
            sums = np.bincount(numbers, values[is_on_map], len(self.middle))
            return sums.astype(np.float64)

        return SumsOnMap(
            weight=summed(places.weight),
            sum_of_log=summed(places.sum_of_log),
            passages=summed(places.passages),
            waited=summed(places.waited),
        )

    def _solve(self, sums: SumsOnMap, variance: float) -> None:
        """Solve the equations of the field, beginning with the last solution."""
        # A lattice whose links have strength 1 has about the variance ln(32 / kappa) /
        # 4 pi; 1 is added for cells of many metres, where that would be negative.
        kappa = (self.spacing / CORRELATION) ** 2
        scale = variance / (math.log1p(32 / kappa) / (4 * math.pi)) / NOISE
        visits = scale * sums.weight
        # Half of the noise is added, as the mean of its exponential is more than 1.
        seen = scale * (sums.sum_of_log + sums.weight * NOISE / 2)
        right = np.column_stack([seen - visits * self.expected, visits])  # (P, 2)
        # The equations map the same error everywhere to its product with `kappa +
        # visits`, and greater errors to greater residuals: residuals up to that product
        # prove that no error is greater.
        tolerance = (ACCURACY * (kappa + visits)) ** 2
        equations = Equations(
            begins=self.links.indptr,
            neighbours=self.links.indices,
            strengths=self.links.data,
            diagonal=kappa + self.linked + visits,
            tolerance=tolerance,
        )
        _relax(equations, right, self.solution)

    def _waits(self, passages: Float64, waited: Float64) -> Float64:
        """Return the seconds that a robot waits per metre through each place.

        They are the seconds waited around the place, over the metres driven around it.
        So each path through costs what a passage did, also beside the place where
        robots stood.
        """
        reach = round(2 * self.side / self.spacing)
        seconds_around = self._around(waited, reach)
        passages_around = self._around(passages, reach)
        waits = seconds_around / (passages_around + WAIT_PLACES) / self.side
        # Robots wait where nobody drove, too. But one place of waits says nothing of
        # others, so the surroundings of the longest wait do not count.
        longest = np.zeros(len(waits))
        longest[waited.argmax()] = 1
        is_elsewhere = self._around(longest, 2 * reach) == 0
        known_elsewhere = self.known * is_elsewhere
        mean = float(waits @ known_elsewhere) / (FEW_PLACES + float(self.known.sum()))
        waits_in_unknown: Float64 = mean * (1 - self.known)
        return waits + waits_in_unknown

    def _around(self, values: Float64, reach: int) -> Float64:
        """Return a weighted mean over the places around each, none behind a wall."""
        for _ in range(reach):
            neighbours: Float64 = self.links @ values
            mean: Float64 = (values + neighbours) / 5
            values = mean
        return values

    def paint(
        self, name: str, optimism: Float64 | float, fastest: float
    ) -> NDArray[np.float32]:
        """Return (H, W) float32: the slowness over that of the fastest place.

        The array is the same as before while no value changes.

        Parameters
        ----------
        name : str
            Which of the layers.
        optimism : (P,) float64, or float
            The logarithm by which each place is assumed to be faster than expected.
        fastest : float
            The log slowness of the fastest place.
        """
        log = np.log(self.slowness) - optimism - fastest
        steps = np.rint(np.clip(log, 0, math.log(MAX_SLOWNESS)) / math.log(1 + STEP))
        values = STEPS.take(steps.astype(np.int64))
        painted = self.painted.get(name)
        if painted is None or not np.array_equal(values, painted.values):
            painted = Painted(values, self.over(values, 1))
            self.painted[name] = painted
        return painted.layer

    def over(self, values: NDArray[Any], occupied: int) -> NDArray[Any]:
        """Return the value of each cell's place, or that of occupied cells: (H, W)."""
        # The place of an occupied cell is -1: the last value.
        values_with_occupied = np.append(values, values.dtype.type(occupied))
        return values_with_occupied.take(self.place, mode="wrap")


def _places_of(grid: GridMap, size: int) -> tuple[Int64, Int64]:
    """Return each cell's place, (H, W), and a cell (x, y) near each place's middle.

    A place is a connected part of a block of `size` x `size` cells.
    """
    from scipy.ndimage import label

    # Between the blocks are rows and columns that connect nothing.
    height, width = grid.occupancy.shape
    rows = np.arange(height) + np.arange(height) // size
    columns = np.arange(width) + np.arange(width) // size
    is_free = np.zeros((rows[-1] + 1, columns[-1] + 1), dtype=np.bool_)
    is_free[np.ix_(rows, columns)] = ~grid.occupancy
    labels: Int64 = label(is_free, output=np.int64)[0]
    place = labels[np.ix_(rows, columns)] - 1
    y, x = np.nonzero(place >= 0)
    middle = (size - 1) / 2
    distance_to_middle = np.hypot(x % size - middle, y % size - middle)
    order = np.argsort(distance_to_middle, kind="stable")
    cells = np.column_stack([x, y])[order]
    # Of each place the first cell in this order.
    _, first = np.unique(place[y, x][order], return_index=True)
    return place, cells[first]


def _links_of(place: Int64, size: int, count: int) -> Any:
    """Return the links of places, a sparse (P, P) array.

    A link's strength is the share of a block's side along which two places touch.
    """
    from scipy.sparse import csr_array

    left_of = place[:, :-1].ravel()
    right_of = place[:, 1:].ravel()
    below = place[:-1].ravel()
    above = place[1:].ravel()
    first = np.concatenate([left_of, below])
    second = np.concatenate([right_of, above])
    is_linked = (first != second) & (first >= 0) & (second >= 0)
    ends = first[is_linked], second[is_linked]
    strength = np.full(np.count_nonzero(is_linked), 1 / size)
    links = csr_array((strength, ends), shape=(count, count))
    return (links + links.T).tocsr()


@in_place
def _relax(equations: Equations, residual: Float64, solution: Float64) -> None:
    """Solve two systems of equations by residuals, until none is above its tolerance.

    Parameters
    ----------
    equations : Equations
        The equations of both systems.
    residual : (P, 2) float64
        The right sides of the systems; it becomes their residuals.
    solution : (P, 2) float64
        An estimate; it becomes the solution.
    """
    begins = equations.begins
    neighbours = equations.neighbours
    strengths = equations.strengths
    diagonal = equations.diagonal
    count = diagonal.size
    for place in range(count):
        residual[place, 0] -= diagonal[place] * solution[place, 0]
        residual[place, 1] -= diagonal[place] * solution[place, 1]
        for link in range(begins[place], begins[place + 1]):
            neighbour = neighbours[link]
            residual[place, 0] += strengths[link] * solution[neighbour, 0]
            residual[place, 1] += strengths[link] * solution[neighbour, 1]
    is_solved = False
    while not is_solved:
        is_solved = True
        for place in range(count):
            excess = residual[place, 0]
            excess_known = residual[place, 1]
            square = excess * excess + excess_known * excess_known
            is_off = square > equations.tolerance[place]
            if not is_off:
                continue
            is_solved = False
            # The change that makes this place's residual 0, and a little more.
            change = OVER_RELAXATION * excess / diagonal[place]
            change_known = OVER_RELAXATION * excess_known / diagonal[place]
            solution[place, 0] += change
            solution[place, 1] += change_known
            residual[place, 0] -= change * diagonal[place]
            residual[place, 1] -= change_known * diagonal[place]
            for link in range(begins[place], begins[place + 1]):
                neighbour = neighbours[link]
                residual[neighbour, 0] += strengths[link] * change
                residual[neighbour, 1] += strengths[link] * change_known


def cells_of(position: Float64, grid: GridMap) -> tuple[Int64, NDArray[np.bool_]]:
    """Return the nearest cells of positions, (N, 2), and which lie on the map."""
    *corner, yaw = grid.origin
    cos = math.cos(yaw)
    sin = math.sin(yaw)
    along = (position - corner) @ [[cos, -sin], [sin, cos]]
    cells = np.floor(along / grid.resolution).astype(np.int64)
    nearest = np.clip(cells, 0, [grid.width - 1, grid.height - 1])
    return nearest, (cells == nearest).all(axis=1)
