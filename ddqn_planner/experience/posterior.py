"""What drives tell of all free places of a map: a Gaussian Markov random field."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place
from ddqn_planner.experience.places import (
    NOISE,
    OPEN_QUANTILE,
    SURE_PLACES,
    Float32,
    Float64,
    Int64,
    Places,
    Sums,
)
from ddqn_planner.experience.prior import FEATURES, map_features, regression
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import MAX_SLOWNESS

CORRELATION = 1.0  # metres: how far the slowness of a place tells of that of others
# Slowness is rounded to steps of this share: fields need no repair for less.
STEP = 0.02
STEPS = (1 + STEP) ** np.arange(1 + round(math.log(MAX_SLOWNESS) / math.log(1 + STEP)))
STEPS = np.minimum(STEPS, MAX_SLOWNESS).astype(np.float32)
# Of the log slowness: no place is farther from the solution of the equations.
ACCURACY = 0.01
OVER_RELAXATION = 1.4  # of the solver: neighbours agree sooner
# The variance of the log slowness of places, assumed from so many places before the
# first drive, and its limits.
VARIANCE = 1.0
ASSUMED_PLACES = 4.0
LEAST_VARIANCE = 0.02
MOST_VARIANCE = 2.0
SMALLEST_WEIGHT = 0.2  # of a place's visits, from which the place counts for it
# Neighbours are alike: so many places of a path tell as much of other places as one
# place alone.
ALIKE_PLACES = 8.0
ASSUMED_PASSAGES = 4.0  # of each place, without a wait
# A straight path through a place leads to so many ends of ways of two links or less.
WAYS_AROUND = 11.0
# Standard deviations of the log time of a drive: on known places, and what is added on
# places that nobody drove.
DRIVE_NOISE = 0.05
UNKNOWN_NOISE = 0.42
NO_PLACE = (
    -1
)  # in arrays of places' numbers: an occupied cell, or a position off the map


class Painted(NamedTuple):
    """A layer of the map, and the values of the P places from which it was made."""

    values: Float32  # (P,)
    layer: Float32  # (H, W)


class Links(Protocol):
    """A sparse (P, P) array of scipy: the strengths of L links between P places."""

    indptr: NDArray[np.int32]  # (P + 1,)
    indices: NDArray[np.int32]  # (L,)
    data: Float64  # (L,)

    def sum(self, *, axis: int) -> Float64:
        """Return the sum of each row or column: (P,)."""

    def __matmul__(self, values: Float64) -> Float64:
        """Return the products with the columns of an array."""


class Equations(NamedTuple):
    """The linear equations (diagonal - links) x = right of P places, with L links."""

    first_link: NDArray[np.int32]  # (P + 1,): of each place; at last L
    neighbour: NDArray[np.int32]  # (L,): the place to which each link leads
    strength: Float64  # (L,)
    diagonal: Float64  # (P,)
    tolerance: Float64  # (P,): up to which the square of a residual counts as 0


class Posterior:
    """The posterior of each place of a map: a connected part of a block of free cells.

    The log slowness of a place is normal around what the map lets expect. Neighbours
    are alike, but not through walls.

    Parameters
    ----------
    grid : GridMap
        The map, of H x W cells.
    side : float
        Of a place, which is a square; metres.
    nominal_speed : float
        Metres per second.

    Attributes
    ----------
    place : (H, W) int64
        The number of each cell's place; NO_PLACE where the cell is occupied.
    known, unknown : (P,) float64
        The share of each place's log slowness that was seen, and the share of its
        standard deviation that remains.
    expected, mean : (P,) float64
        The log slowness, without waits, that is expected before the first visit of a
        place and of those near it, and after the visits.
    excess : (P,) float64
        The standard deviation of one visit's log slowness beyond the usual one.
    slowness : (P,) float64
        The expected seconds over those at nominal speed, with waits.
    variance : float
        Of the log slowness of places around the expected one.
    coefficients : (FEATURES,) float64
        By how much each feature of the map raises the log slowness.
    """

    def __init__(self, grid: GridMap, side: float, nominal_speed: float) -> None:
        """Divide a map into places and link neighbours; `update` solves the field.

        `grid` is the map of H x W cells, `side` the side of a place in metres, and
        `nominal_speed` is in metres per second.
        """
        from scipy.ndimage import distance_transform_edt

        self.grid = grid
        self.side = side
        self.nominal_speed = nominal_speed
        block = max(1, round(side / grid.resolution))  # cells of a block's side
        self._spacing = block * grid.resolution  # metres from a place to the next
        self.place = _places_of(grid, block)
        self._middle_cells = _middle_cells_of(self.place, block)
        # Each cell's place, and that of the nearest free cell for an occupied one.
        cells_away: Float64
        x: Int64
        y: Int64
        cells_away, (y, x) = distance_transform_edt(  # (H, W) each
            self.place == NO_PLACE, return_indices=True
        )
        is_near = cells_away <= 1.5 * block
        self._nearest_place = np.where(is_near, self.place[y, x], NO_PLACE)  # (H, W)
        count = len(self._middle_cells)  # P
        self._links = _links_of(self.place, block, count)
        # (P,): the sum over the links of each place.
        self._strength_of_links = self._links.sum(axis=1)
        # (P, 2), the solutions of two systems of equations: the log slowness that was
        # seen beyond the expected one, and the share that is known.
        self._solution = np.zeros((count, 2))
        x, y = self._middle_cells.T
        self._features = map_features(grid)[y, x].astype(np.float64)  # (P, FEATURES)
        self.coefficients = np.zeros(FEATURES)
        self.variance = VARIANCE
        self._painted: Painted | None = None  # by the last call of `paint`

    def deviation_of(self, seconds: Float64, places: Int64) -> float:
        """Return the standard deviation of the logarithm of a path's time.

        Parameters
        ----------
        seconds, places : (N,) float64, (N,) int64
            The expected seconds of each part of the path, and the number of its place.
        """
        # The mean over the time of the path: 0 if all is known, 1 if nothing.
        share = seconds / seconds.sum()
        unknown = float(share @ self.unknown[places])
        excess = float(share @ self.excess[places])
        return math.hypot(DRIVE_NOISE, UNKNOWN_NOISE * unknown, excess)

    def places_at(self, position: Float64) -> Int64:
        """Return the number of the nearest place to each position: (N,).

        `position` is (N, 2), x and y in metres in the frame of the map. The number is
        NO_PLACE off the map, and where no place is within 1.5 sides of a place.
        """
        cells, is_inside = cells_of(position, self.grid)
        x = cells[:, 0]
        y = cells[:, 1]
        return np.where(is_inside, self._nearest_place[y, x], NO_PLACE)

    def update(self, places: Places, open_log: float, prior: Float64) -> None:
        """Compute `known`, `unknown`, `mean` and `slowness` of each of P places.

        Parameters
        ----------
        places : Places
            What was seen at places of the world.
        open_log : float
            The log slowness in the open, where few places of this map are known.
        prior : (FEATURES,) float64
            By how much features of other maps raised the log slowness.
        """
        sums = self._sums_of(places)
        log = sums.log_of_mean()  # (P,)
        noise = sums.noise()  # (P,)
        self.coefficients = self._regression(sums, log, noise, prior)
        self.expected = self._features @ self.coefficients
        known_beyond = (log - self.expected)[sums.is_known()]
        if len(known_beyond) >= SURE_PLACES:
            self.expected += np.quantile(known_beyond, OPEN_QUANTILE)
        else:
            self.expected += open_log
        # Nobody drives faster than on the open floor: features that no driven place had
        # would predict any speed.
        self.expected = np.maximum(self.expected, min(open_log, 0.0))
        self.variance = self._variance(sums, log - self.expected, noise)
        self._solve(sums.weight / noise, log - self.expected)
        self.known: Float64 = np.clip(self._solution[:, 1], 0, 1)
        self.unknown = np.sqrt(1 - self.known)
        self.mean = self.expected + self._solution[:, 0]
        self.excess = np.sqrt(np.maximum(noise - NOISE, 0))
        self.slowness = np.exp(self.mean)
        if sums.waited.any():
            self.slowness += self.nominal_speed * self._waits(sums)

    def _variance(self, sums: Sums, beyond: Float64, noise: Float64) -> float:
        """Return the variance of the log slowness of places, as driven places show it.

        `sums` are of the map's P places, `beyond` (P,) is their log slowness less the
        expected one, and `noise` (P,) the variance of one visit.
        """
        driven = sums.weight >= SMALLEST_WEIGHT
        # The part of each square that is not noise.
        squares = beyond[driven] ** 2 - noise[driven] / sums.weight[driven]
        total = ASSUMED_PLACES * VARIANCE + squares.sum() / ALIKE_PLACES
        mean_square = total / (ASSUMED_PLACES + len(squares) / ALIKE_PLACES)
        return float(np.clip(mean_square, LEAST_VARIANCE, MOST_VARIANCE))

    def _regression(
        self, sums: Sums, log: Float64, noise: Float64, prior: Float64
    ) -> Float64:
        """Return by how much features of this map raise the log slowness: (FEATURES,).

        `sums` are of the map's P places; `log` and `noise` (P,) are their log slowness
        and the variance of one visit. `prior` (FEATURES,) is from other maps.
        """
        driven = sums.weight > 0
        visits = sums.weight[driven] / noise[driven]  # the inverse variance of the mean
        weight = 1 / (1 / VARIANCE + 1 / visits) / ALIKE_PLACES
        return regression(self._features[driven], log[driven], weight, prior)

    def _sums_of(self, places: Places) -> Sums:
        """Return what was seen at each of the map's P places.

        `places` are N squares of the world, aligned with the axes of its frame. The
        map's places are blocks of cells of the same size, from the map's corner on. A
        square's sums count for the place of the map that is nearest to the square's
        first visit; those of squares off the map are left out.
        """
        nearest_place = self.places_at(places.position)  # (N,)
        is_on_map = nearest_place != NO_PLACE
        place_of_square = nearest_place[is_on_map]  # (M,)
        count = len(self._middle_cells)  # P
        # Without any square on the map, `bincount` returns integers.
        columns = {
            name: np.bincount(place_of_square, values[is_on_map], count).astype(float)
            for name, values in places.sums().items()
        }
        return Sums(**columns)

    def _solve(self, visits: Float64, log: Float64) -> None:
        """Solve the equations of the Gaussian Markov random field over the P places.

        Changes `_solution` (P, 2) from the last solution to the new one. Its first
        column is the log slowness that was seen beyond the expected one, and its second
        column the share that is known: 0 far from visits, near 1 after many.

        Parameters
        ----------
        visits : (P,) float64
            The inverse variance of the log slowness that was seen at each place.
        log : (P,) float64
            That log slowness, less the expected one.
        """
        # Neighbours are linked with the strength 1, and each place is drawn to 0 with
        # the strength kappa. On such a lattice the values have about the variance
        # ln(32 / kappa) / 4 pi; for large kappa, where that would be negative, 1 is
        # added to the argument.
        kappa = (self._spacing / CORRELATION) ** 2
        variance_of_lattice = math.log1p(32 / kappa) / (4 * math.pi)
        # All is scaled so that the field has the given variance.
        strength = self.variance / variance_of_lattice * visits  # (P,)
        right = np.column_stack([strength * log, strength])  # (P, 2)
        # If the solution is off by the same error everywhere, the residuals are that
        # error times `kappa + strength`, and they are larger for larger errors. So
        # residuals up to this product prove that no place is off by more than ACCURACY.
        largest_residual = ACCURACY * (kappa + strength)  # (P,)
        equations = Equations(
            first_link=self._links.indptr,
            neighbour=self._links.indices,
            strength=self._links.data,
            diagonal=kappa + self._strength_of_links + strength,
            tolerance=largest_residual**2,
        )
        _relax(equations, right, self._solution)

    def _waits(self, sums: Sums) -> Float64:
        """Return the seconds that a robot waits per metre through each place: (P,).

        They are the mean seconds of a passage, with some passages without a wait
        assumed. A path that passes beside the place where robots stood has the same
        wait: the sums are those around a place.
        """
        seconds = self._sum_around(sums.waited)
        passages = self._sum_around(sums.passages) + WAYS_AROUND * ASSUMED_PASSAGES
        return seconds / passages / self.side

    def _sum_around(self, values: Float64) -> Float64:
        """Return for each place a weighted sum of the values around it: (P,).

        `values` (P,) are those of places. The sum is over all ways of two links or less
        from the place, of which none leads through a wall.
        """
        for _ in range(2):
            values = values + self._links @ values
        return values

    def paint(self, open_log: float) -> Float32:
        """Return the slowness of each cell over that of the open floor.

        (H, W) float32: 1 to MAX_SLOWNESS, in steps of 2 %, and 1 in occupied cells. No
        place counts as faster than the open floor, whose log slowness is `open_log`.
        While no value changes, the array is the very object of the last call, so that
        fields need no repair.
        """
        log = np.log(self.slowness) - open_log  # (P,)
        possible_log = np.clip(log, 0, math.log(MAX_SLOWNESS))
        steps = np.rint(possible_log / math.log(1 + STEP)).astype(np.int64)
        values = STEPS[steps]  # (P,)
        painted = self._painted
        if painted is None or not np.array_equal(values, painted.values):
            painted = Painted(values, self.to_cells(values, occupied=1))
            self._painted = painted
        return painted.layer

    def to_cells(self, values: Float32, occupied: float) -> Float32:
        """Return the value of each cell: (H, W) float32.

        A free cell has that of its place, from the `values` (P,), and an occupied cell
        the value `occupied`.
        """
        # NO_PLACE is the index of the last value.
        values_with_occupied = np.append(values, np.float32(occupied))
        return values_with_occupied[self.place]


def _places_of(grid: GridMap, block: int) -> Int64:
    """Return the number of each cell's place: (H, W); NO_PLACE for occupied cells.

    The map `grid` is divided into blocks of `block` x `block` cells, and a place is a
    connected part of the free cells of a block.
    """
    from scipy.ndimage import label

    # In a copy of the map, an occupied row and column follow each block, so that no
    # connected part has cells of two blocks.
    height, width = grid.occupancy.shape
    row = np.arange(height)
    column = np.arange(width)
    row_in_copy = row + row // block
    column_in_copy = column + column // block
    cells_in_copy = np.ix_(row_in_copy, column_in_copy)
    shape_of_copy = row_in_copy[-1] + 1, column_in_copy[-1] + 1
    is_free = np.zeros(shape_of_copy, dtype=np.bool_)
    is_free[cells_in_copy] = ~grid.occupancy
    # Free parts have labels from 1 on, and occupied cells 0.
    labels: Int64 = label(is_free, output=np.int64)[0]
    place: Int64 = labels[cells_in_copy] - 1
    return place


def _middle_cells_of(place: Int64, block: int) -> Int64:
    """Return for each place its cell that is nearest to the middle of its block.

    Parameters
    ----------
    place : (H, W) int64
        The number of each cell's place, or NO_PLACE.
    block : int
        The cells of a block's side.

    Returns
    -------
    (P, 2) int64
        The x and y of a cell for each place.
    """
    y, x = np.nonzero(place != NO_PLACE)  # (N,) each, for N free cells
    middle = (block - 1) / 2
    distance_to_middle = np.hypot(x % block - middle, y % block - middle)
    nearest_first = np.argsort(distance_to_middle, kind="stable")
    x = x[nearest_first]
    y = y[nearest_first]
    # `unique` returns the first index of each place, in the order of their numbers.
    _, first = np.unique(place[y, x], return_index=True)
    return np.column_stack([x[first], y[first]])


def _links_of(place: Int64, block: int, count: int) -> Links:
    """Return the links between neighbour places, a sparse (P, P) array of strengths.

    A link's strength is the share of a block's side along which two places touch.

    Parameters
    ----------
    place : (H, W) int64
        The number of each cell's place, or NO_PLACE.
    block, count : int
        The cells of a block's side, and the number P of places.
    """
    from scipy.sparse import csr_array

    # The places of all pairs of cells that lie side by side, or one above the other.
    first = np.concatenate([place[:, :-1].ravel(), place[:-1].ravel()])
    second = np.concatenate([place[:, 1:].ravel(), place[1:].ravel()])
    are_free = (first != NO_PLACE) & (second != NO_PLACE)
    is_link = are_free & (first != second)
    strength = np.full(np.count_nonzero(is_link), 1 / block)
    # `csr_array` adds up the strengths of the same pair of places.
    links = csr_array(
        (strength, (first[is_link], second[is_link])), shape=(count, count)
    )
    both_ways: Links = (links + links.T).tocsr()
    return both_ways


@in_place
def _relax(equations: Equations, residual: Float64, solution: Float64) -> None:
    """Solve two systems of equations by relaxation: one place after another.

    The function ends when no place has residuals above its tolerance.

    Parameters
    ----------
    equations : Equations
        The equations (diagonal - links) x = right of P places. Both systems have these
        left sides, with different right sides.
    residual : (P, 2) float64
        The right side of each system. It is changed to the residuals, which are the
        right sides less the left sides.
    solution : (P, 2) float64
        An estimate of x for each system. It is changed to the solutions.
    """
    first_link = equations.first_link
    neighbours = equations.neighbour
    strengths = equations.strength
    diagonal = equations.diagonal
    count = diagonal.size
    # Subtract the left sides.
    for place in range(count):
        for system in range(2):
            residual[place, system] -= diagonal[place] * solution[place, system]
            for link in range(first_link[place], first_link[place + 1]):
                neighbour = neighbours[link]
                residual[place, system] += strengths[link] * solution[neighbour, system]
    is_solved = False
    while not is_solved:
        is_solved = True
        for place in range(count):
            # Of the residuals of both systems.
            square = residual[place, 0] ** 2 + residual[place, 1] ** 2
            is_off = square > equations.tolerance[place]
            if not is_off:
                continue
            is_solved = False
            for system in range(2):
                # The change of the solution that makes this residual 0, and a little
                # more, with which fewer rounds are needed.
                change = OVER_RELAXATION * residual[place, system] / diagonal[place]
                solution[place, system] += change
                residual[place, system] -= change * diagonal[place]
                for link in range(first_link[place], first_link[place + 1]):
                    neighbour = neighbours[link]
                    residual[neighbour, system] += strengths[link] * change


def cells_of(position: Float64, grid: GridMap) -> tuple[Int64, NDArray[np.bool_]]:
    """Return the cell of each position, and whether the position is on the map.

    Parameters
    ----------
    position : (N, 2) float64
        The x and y of each position, metres in the frame of the map.
    grid : GridMap
        The map.

    Returns
    -------
    cells : (N, 2) int64
        The column and row of each cell; off the map, those of the nearest cell.
    is_inside : (N,) bool
        Whether the position is on the map.
    """
    origin_x, origin_y, yaw = grid.origin
    cos = math.cos(yaw)
    sin = math.sin(yaw)
    # From the axes of the frame to those of the map, still in metres.
    rotation = [[cos, -sin], [sin, cos]]
    on_axes_of_map = (position - (origin_x, origin_y)) @ rotation
    cells = np.floor(on_axes_of_map / grid.resolution).astype(np.int64)
    nearest = np.clip(cells, 0, [grid.width - 1, grid.height - 1])
    is_inside = (cells == nearest).all(axis=1)
    return nearest, is_inside
