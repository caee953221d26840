"""What drives tell of all free places of a map: a Gaussian Markov random field."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.experience.places import (
    KNOWN_WEIGHT,
    LEAST_WEIGHT,
    NOISE,
    Float32,
    Float64,
    Int64,
    Places,
    open_level,
)
from ddqn_planner.experience.prior import map_features, regression
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import MAX_SLOWNESS, Occupancy

if TYPE_CHECKING:
    from scipy.sparse import csr_array

CORRELATION = 1.0  # metres: how far the slowness of a place tells of that of others
# Slowness is rounded to steps of this share: fields need no repair for less.
STEP = 0.02
OPEN_STEP = 0.1  # of the log slowness of the fastest moves
# The error of the log slowness up to which the equations count as solved: the root mean
# square over all places, if the error is the same everywhere.
ACCURACY = 0.01
VARIANCE = 1.0  # of the log slowness of places around the expected one
# Neighbours are alike: so many places of a path tell as much of the map's features as
# one place alone.
ALIKE_PLACES = 8.0
# What was seen tells of places up to so many links away, less over each link. Along a
# straight path, the sum over a place and those around it is SUM_AROUND times its value.
LINKS_AROUND = 2
TIE = 0.5
SUM_AROUND = 4.5
ASSUMED_PASSAGES = 4.0  # of each place, without a wait
# Standard deviations of the log time of a drive: on known places, and what is added on
# places that nobody drove.
DRIVE_NOISE = 0.05
UNKNOWN_NOISE = 0.42
# In arrays of places' numbers: an occupied cell, or a position off the map.
NO_PLACE = -1


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
    unknown : (P,) float64
        The standard deviation of each place's log slowness: 1 where nothing is known.
    expected, mean : (P,) float64
        The log slowness, without waits, that is expected before the first visit of a
        place and of those near it, and after the visits.
    excess : (P,) float64
        The standard deviation of one visit's log slowness beyond the usual one.
    slowness : (P,) float64
        The expected seconds over those at nominal speed, with waits.
    coefficients : (FEATURES,) float64
        By how much each feature of the map raises the log slowness.
    fastest_log : float
        The log slowness of the open floor, of the nominal speed at most: no move is
        expected to be faster.
    painted, uncertainty : (H, W) float32
        The slowness of each cell over that of the fastest moves, in steps of 2 %, and
        the standard deviation of its logarithm; both are 1 in occupied cells.
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
        self.place = _places_of(grid.occupancy, block)
        self._count = 1 + int(self.place.max())  # P
        # Each cell's place, and that of the nearest free cell for an occupied one.
        cells_away, (y, x) = distance_transform_edt(  # (H, W) each
            self.place == NO_PLACE, return_indices=True
        )
        is_near = cells_away <= 1.5 * block
        self._nearest_place = np.where(is_near, self.place[y, x], NO_PLACE)  # (H, W)
        self._links = _links_of(self.place, block, self._count)
        # Neighbours are linked with the strength 1, and each place is drawn to its
        # expected value with the strength kappa. On such a lattice the values have
        # about the variance ln(32 / kappa) / 4 pi; for large kappa, where that would be
        # negative, 1 is added to the argument.
        spacing = block * grid.resolution  # metres from a place to the next
        kappa = (spacing / CORRELATION) ** 2
        self._tie = TIE / (1 + kappa)
        self._variance_of_lattice = math.log1p(32 / kappa) / (4 * math.pi)
        self._largest_residual = ACCURACY * kappa * math.sqrt(self._count)
        # (P,): of the precision of the field; it grows with the visits.
        self._diagonal = kappa + self._links.sum(axis=1)
        self._beyond = np.zeros(self._count)  # of the log slowness, see `_solve`
        # (P, FEATURES): the means over the cells of each place.
        cells = self._sums(self.place, np.ones(self.place.shape))
        features = np.moveaxis(map_features(grid), -1, 0)  # (FEATURES, H, W)
        sums = [self._sums(self.place, feature) for feature in features]
        self._features = (np.array(sums) / cells).T

    def _sums(self, place: Int64, values: Float64 | Float32) -> Float64:
        """Return the sum over each of the map's places: (P,).

        `values` are at the places whose numbers are `place`, an array of the same
        shape. Values at NO_PLACE are left out.
        """
        sums = np.bincount(place.ravel() + 1, values.ravel(), self._count + 1)
        return sums[1:].astype(np.float64)

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
        """Compute all attributes that follow from what was seen.

        What was seen at a square of the world counts for the place of the map that is
        nearest to the middle of the square.

        Parameters
        ----------
        places : Places
            What was seen at places of the world.
        open_log : float
            The log slowness in the open, where few places of this map are known.
        prior : (FEATURES,) float64
            By how much features of other maps raised the log slowness.
        """
        place = self.places_at(places.position)
        inverse_noise = places.weight / places.noise()
        # The inverse variance of the log slowness that was seen at each place: (P,).
        visits = self._sums(place, inverse_noise)
        sum_of_log = self._sums(place, inverse_noise * places.log_of_mean())
        log = sum_of_log / np.maximum(visits, LEAST_WEIGHT)
        self.coefficients = self._regression(visits, log, prior)
        expected = self._features @ self.coefficients
        is_known = visits >= KNOWN_WEIGHT / NOISE
        expected += open_level((log - expected)[is_known], open_log)
        # Nobody drives faster than on the open floor: features that no driven place had
        # would predict any speed.
        self.expected = np.maximum(expected, min(open_log, 0.0))
        self._solve(visits, log - self.expected)
        self.mean = self.expected + self._beyond

        noise = self._sums(place, places.weight) / np.maximum(visits, LEAST_WEIGHT)
        self.excess = np.sqrt(np.maximum(noise - NOISE, 0))
        wait = self._update_surroundings(place, places, visits)
        self.slowness = np.exp(self.mean) + self.nominal_speed / self.side * wait

        # A change of the fastest moves makes all fields anew.
        self.fastest_log = OPEN_STEP * min(0, round(open_log / OPEN_STEP))
        self.painted = self._paint(np.log(self.slowness) - self.fastest_log)
        self.uncertainty = self.to_cells(self.unknown, occupied=1)

    def _update_surroundings(
        self, place: Int64, places: Places, visits: Float64
    ) -> Float64:
        """Compute how unknown each place is; return the mean seconds of a wait: (P,).

        What was seen at a place tells of those around it, too: a path that passes
        beside the place where robots stood has the same wait. For the parameters see
        `update`; `place` is the number of each of `places` on this map, and `visits`
        (P,) the inverse variance of what was seen.
        """
        passages = self._sums(place, places.passages)
        seconds_waited = self._sums(place, places.waited)
        share_seen = visits / (1 / VARIANCE + visits)
        surroundings = np.column_stack([share_seen, passages, seconds_waited])
        for _ in range(LINKS_AROUND):
            surroundings = surroundings + self._tie * (self._links @ surroundings)
        share_nearby, passages_nearby, seconds_nearby = surroundings.T / SUM_AROUND
        self.unknown = np.sqrt(1 - np.clip(share_nearby, share_seen, 1))
        mean_wait: Float64 = seconds_nearby / (passages_nearby + ASSUMED_PASSAGES)
        return mean_wait

    def _regression(self, visits: Float64, log: Float64, prior: Float64) -> Float64:
        """Return by how much features of this map raise the log slowness: (FEATURES,).

        `log` (P,) is the log slowness that was seen at each place, and `visits` (P,)
        its inverse variance. `prior` (FEATURES,) is from other maps.
        """
        driven = visits > 0
        weight = 1 / (1 / VARIANCE + 1 / visits[driven]) / ALIKE_PLACES
        return regression(self._features[driven], log[driven], weight, prior)

    def _solve(self, visits: Float64, log: Float64) -> None:
        """Solve the equations of the Gaussian Markov random field over the P places.

        Changes `_beyond` (P,), the log slowness beyond the expected one, from the last
        solution to the new one.

        Parameters
        ----------
        visits : (P,) float64
            The inverse variance of the log slowness that was seen at each place.
        log : (P,) float64
            That log slowness, less the expected one.
        """
        # All is scaled so that the field has the given variance.
        strength = VARIANCE / self._variance_of_lattice * visits  # (P,)
        diagonal = self._diagonal + strength
        # By conjugate gradients from the last solution, so that places far from all
        # changes stay as they are. The equations' left sides are the product of x with
        # `diagonal`, less its product with the links.
        solution = self._beyond
        residual = strength * log - (diagonal * solution - self._links @ solution)
        direction = np.zeros(self._count)
        last_product = 1.0
        while math.sqrt(residual @ residual) > self._largest_residual:
            scaled = residual / diagonal
            product = residual @ scaled
            direction = scaled + product / last_product * direction
            image = diagonal * direction - self._links @ direction
            length = product / (direction @ image)
            solution = solution + length * direction
            residual = residual - length * image
            last_product = product
        self._beyond = solution

    def _paint(self, log: Float64) -> Float32:
        """Return the slowness of cells: (H, W), of which the log is `log` (P,).

        It is 1 to MAX_SLOWNESS, in steps of 2 %, and 1 in occupied cells.
        """
        step = math.log(1 + STEP)
        possible_log = np.clip(log, 0, math.log(MAX_SLOWNESS))
        values = np.exp(step * np.rint(possible_log / step))  # (P,)
        return self.to_cells(np.minimum(values, MAX_SLOWNESS), occupied=1)

    def to_cells(self, values: Float64, occupied: float) -> Float32:
        """Return the value of each cell: (H, W) float32.

        A free cell has that of its place, from the `values` (P,), and an occupied cell
        the value `occupied`.
        """
        # NO_PLACE is the index of the last value.
        values_with_occupied = np.append(values, occupied).astype(np.float32)
        return values_with_occupied[self.place]


def _places_of(occupancy: Occupancy, block: int) -> Int64:
    """Return the number of each cell's place: (H, W); NO_PLACE for occupied cells.

    The map is divided into blocks of `block` x `block` cells, and a place is a
    connected part of the free cells of a block.
    """
    from scipy.ndimage import label

    # Blocks are black and white as those of a chess board. Blocks of one colour touch
    # at their corners alone, so no connected part has cells of two blocks.
    row, column = np.ogrid[: occupancy.shape[0], : occupancy.shape[1]]
    is_white = (row // block + column // block) % 2 == 0  # (H, W)
    place = np.full(occupancy.shape, NO_PLACE, dtype=np.int64)
    count = 0
    for is_of_colour in (is_white, ~is_white):
        is_free = is_of_colour & ~occupancy
        labels, part_count = label(is_free, output=np.int64)  # from 1 on
        place[is_free] = labels[is_free] - 1 + count
        count += part_count
    return place


def _links_of(place: Int64, block: int, count: int) -> csr_array:
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
    return links + links.T


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
    cells = np.floor(grid.in_cells(position)).astype(np.int64)
    nearest = np.clip(cells, 0, [grid.width - 1, grid.height - 1])
    is_inside = (cells == nearest).all(axis=1)
    return nearest, is_inside
