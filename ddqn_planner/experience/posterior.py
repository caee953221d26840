"""What drives tell of all free places of a map: a Gaussian Markov random field."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place
from ddqn_planner.experience.places import NOISE, Float32, Float64, Int64, Places
from ddqn_planner.experience.population import FEW_PLACES, Population
from ddqn_planner.experience.prior import Prior, map_features
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
# Around each place, so many passages without a wait are assumed.
WAIT_PLACES = 0.1
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
    mean : (P,) float64
        The expected log slowness, without waits.
    slowness : (P,) float64
        The expected seconds over those at nominal speed, with waits.
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
        self._prior: Prior | None = None
        self._predicted = np.zeros(count)  # log slowness, by the prior
        self._painted: dict[str, Painted] = {}

    def deviation_of(self, seconds: Float64, places: Int64) -> float:
        """Return the standard deviation of the logarithm of a path's time.

        Parameters
        ----------
        seconds, places : (N,) float64, (N,) int64
            The expected seconds of each part of the path, and the number of its place.
        """
        # The mean over the time of the path: 0 if all is known, 1 if nothing.
        unknown = float(seconds @ self.unknown[places] / seconds.sum())
        return math.hypot(DRIVE_NOISE, UNKNOWN_NOISE * unknown)

    def places_at(self, position: Float64) -> Int64:
        """Return the number of the nearest place to each position: (N,).

        `position` is (N, 2), x and y in metres in the frame of the map. The number is
        NO_PLACE off the map, and where no place is within 1.5 sides of a place.
        """
        cells, is_inside = cells_of(position, self.grid)
        x = cells[:, 0]
        y = cells[:, 1]
        return np.where(is_inside, self._nearest_place[y, x], NO_PLACE)

    def predicted_at(self, position: Float64) -> Float64:
        """Return the log slowness that the prior predicts at each position: (N,).

        `position` is (N, 2), x and y in metres. Without a prior, and off the map, the
        prediction is 0.
        """
        # NO_PLACE is the index of the last value.
        predicted = np.append(self._predicted, 0.0)
        return predicted[self.places_at(position)]

    def update(
        self, places: Places, population: Population, prior: Prior | None
    ) -> None:
        """Compute `known`, `unknown`, `mean` and `slowness` of each of P places.

        `mean` is the expected log slowness, the logarithm of the time in a place over
        that at nominal speed; `slowness` is that ratio, with waits. `known` is the
        share of the log slowness that was seen, and `unknown` the share of its standard
        deviation that remains.

        Parameters
        ----------
        places : Places
            What was seen at places of the world.
        population : Population
            The distribution of the log slowness of places.
        prior : Prior or None
            Predicts the log slowness of places from the map.
        """
        self._predict(prior)
        expected = population.level + population.prior_weight * self._predicted  # (P,)
        sums = self._sums_of(places)
        self._solve(sums, expected, population.variance)
        seen_beyond_expected = self._solution[:, 0]
        self.known: Float64 = np.clip(self._solution[:, 1], 0, 1)
        self.unknown = np.sqrt(1 - self.known)
        surplus = population.surplus * (1 - self.known)
        self.mean = expected + seen_beyond_expected + surplus
        self.slowness = np.exp(self.mean)
        if sums.waited.any():
            waits = self._waits(sums.passages, sums.waited)
            self.slowness += self.nominal_speed * waits

    def _predict(self, prior: Prior | None) -> None:
        """Set the log slowness that a prior predicts, unless it is the last prior."""
        if prior is self._prior:
            return
        self._prior = prior
        if prior is None:
            self._predicted[:] = 0
        else:
            x = self._middle_cells[:, 0]
            y = self._middle_cells[:, 1]
            self._predicted[:] = prior.log_slowness(map_features(self.grid)[y, x])

    def _sums_of(self, places: Places) -> SumsOnMap:
        """Return, for each of the map's P places, the sums of what was seen there.

        `places` are N squares of the world, aligned with the axes of its frame. The
        map's places are blocks of cells of the same size, from the map's corner on. A
        square's sums count for the place of the map that is nearest to the square's
        first visit; those of squares off the map are left out.
        """
        nearest_place = self.places_at(places.position)  # (N,)
        is_on_map = nearest_place != NO_PLACE
        place_of_square = nearest_place[is_on_map]  # (M,)
        count = len(self._middle_cells)  # P

        def summed(values: Float64) -> Float64:
            """Return the sums (P,) of the values (N,) of squares."""
            sums = np.bincount(place_of_square, values[is_on_map], count)
            # Without any square on the map, the sums are integers.
            return sums.astype(np.float64)

        return SumsOnMap(
            weight=summed(places.weight),
            sum_of_log=summed(places.sum_of_log),
            passages=summed(places.passages),
            waited=summed(places.waited),
        )

    def _solve(self, sums: SumsOnMap, expected: Float64, variance: float) -> None:
        """Solve the equations of the Gaussian Markov random field over the P places.

        Changes `_solution` (P, 2) from the last solution to the new one. Its first
        column is the log slowness that was seen beyond the expected one, and its second
        column the share that is known: 0 far from visits, near 1 after many.

        Parameters
        ----------
        sums : SumsOnMap
            What was seen at each place of the map.
        expected : (P,) float64
            The log slowness of each place that is expected without any visit.
        variance : float
            The variance of the log slowness of places.
        """
        # Neighbours are linked with the strength 1, and each place is drawn to 0 with
        # the strength kappa. On such a lattice the values have about the variance
        # ln(32 / kappa) / 4 pi; for large kappa, where that would be negative, 1 is
        # added to the argument.
        kappa = (self._spacing / CORRELATION) ** 2
        variance_of_lattice = math.log1p(32 / kappa) / (4 * math.pi)
        # Each visit draws its place to the log slowness that was seen, with the
        # strength `scale`: so the field has the given variance, and a visit has NOISE.
        scale = variance / variance_of_lattice / NOISE
        visits = scale * sums.weight  # (P,): the strength of all visits of each place
        # Half of the noise is added, as the mean of its exponential is more than 1.
        seen = scale * (sums.sum_of_log + sums.weight * NOISE / 2)  # (P,)
        right = np.column_stack([seen - visits * expected, visits])  # (P, 2)
        # If the solution is off by the same error everywhere, the residuals are that
        # error times `kappa + visits`, and they are larger for larger errors. So
        # residuals up to this product prove that no place is off by more than ACCURACY.
        largest_residual = ACCURACY * (kappa + visits)  # (P,)
        equations = Equations(
            first_link=self._links.indptr,
            neighbour=self._links.indices,
            strength=self._links.data,
            diagonal=kappa + self._strength_of_links + visits,
            tolerance=largest_residual**2,
        )
        _relax(equations, right, self._solution)

    def _waits(self, passages: Float64, waited: Float64) -> Float64:
        """Return the seconds that a robot waits per metre through each place: (P,).

        They are the seconds waited around the place, over the metres driven around it.
        So a path that passes beside the place where robots stood has the same wait.

        Parameters
        ----------
        passages : (P,) float64
            How often robots passed each place; a passage is a side of a place long.
        waited : (P,) float64
            The seconds that robots waited at each place, in all passages.
        """
        reach = round(2 * self.side / self._spacing)  # links: two sides of a place
        seconds_around = self._mean_around(waited, reach)
        passages_around = self._mean_around(passages, reach)
        waits = seconds_around / (passages_around + WAIT_PLACES) / self.side
        # Robots wait in unknown places, too: they wait there for the mean of known
        # places. One place of long waits says nothing of other places, so the
        # surroundings of the longest wait do not count.
        is_longest_wait = np.zeros(len(waits))
        is_longest_wait[waited.argmax()] = 1
        is_elsewhere = self._mean_around(is_longest_wait, 2 * reach) == 0
        waits_elsewhere = float(waits @ (self.known * is_elsewhere))
        mean_wait = waits_elsewhere / (FEW_PLACES + float(self.known.sum()))
        waits_in_unknown: Float64 = mean_wait * (1 - self.known)
        return waits + waits_in_unknown

    def _mean_around(self, values: Float64, reach: int) -> Float64:
        """Return for each place a weighted mean of the values around it: (P,).

        `values` (P,) are those of places. The mean is over the places up to `reach`
        links away, of which none is behind a wall.
        """
        # Each round takes the mean of a place and its neighbours: four in the open.
        for _ in range(reach):
            sum_of_neighbours = self._links @ values
            values = (values + sum_of_neighbours) / 5
        return values

    def paint(self, name: str, optimism: Float64 | float, fastest: float) -> Float32:
        """Return the slowness of each cell over that of the fastest place.

        (H, W) float32: 1 to MAX_SLOWNESS, in steps of 2 %, and 1 in occupied cells.
        While no value changes, the array is the very object of the last call, so that
        fields need no repair.

        Parameters
        ----------
        name : str
            A name for the layer, under which the array is kept for the next call.
        optimism : (P,) float64, or float
            The logarithm by which each place is assumed to be faster than expected.
        fastest : float
            The log slowness of the fastest place.
        """
        log = np.log(self.slowness) - optimism - fastest  # (P,)
        possible_log = np.clip(log, 0, math.log(MAX_SLOWNESS))
        steps = np.rint(possible_log / math.log(1 + STEP)).astype(np.int64)
        values = STEPS[steps]  # (P,)
        painted = self._painted.get(name)
        if painted is None or not np.array_equal(values, painted.values):
            painted = Painted(values, self.to_cells(values, occupied=1))
            self._painted[name] = painted
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
