"""What drives tell of all free places of a map: a Gaussian Markov random field."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place
from ddqn_planner.experience.prior import Prior, map_features
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import MAX_SLOWNESS

if TYPE_CHECKING:
    from ddqn_planner.experience.evidence import Evidence

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

NOISE = 0.1  # variance of the log slowness of one visit
CORRELATION = 1.0  # metres: how far the slowness of a place tells of that of others
STEP = 0.02  # slowness is told in steps of this share: fields need no repair for less
STEPS = (1 + STEP) ** np.arange(1 + round(math.log(MAX_SLOWNESS) / math.log(1 + STEP)))
STEPS = np.minimum(STEPS, MAX_SLOWNESS).astype(np.float32)
ACCURACY = (
    0.01  # of the log slowness: no place is farther from the solution of its equations
)
OVER_RELAXATION = 1.4  # of the solver: neighbours agree sooner
WAIT_PLACES = (
    0.1  # so many places around each one are assumed to be driven without a wait
)
FEW_PLACES = 16.0  # it is assumed that so many were driven where nothing was slow
# Standard deviations of the log time of a drive: on ways that are known, and that are not.
DRIVE_NOISE, UNSURE = 0.05, 0.42


class Posterior:
    """The posterior of each place of a map: a connected part of a block of free cells.

    The log slowness of a place is normal around what the map lets expect. Neighbours are alike,
    but not through walls.
    """

    def __init__(self, grid: GridMap, side: float) -> None:
        from scipy.ndimage import distance_transform_edt

        self.grid = grid
        self.size = max(1, round(side / grid.resolution))
        self.spacing = self.size * grid.resolution
        self.place, self.middle = _places_of(
            grid, self.size
        )  # (H, W), -1 where occupied
        away, (y, x) = distance_transform_edt(self.place < 0, return_indices=True)
        self.nearest = np.where(away <= 1.5 * self.size, self.place[y, x], -1)
        count = len(self.middle)
        self.links = _links_of(self.place, self.size, count)
        self.linked = self.links.sum(axis=1)
        # The solution of linear equations: real, what was seen beyond what is expected; imaginary,
        # the share that is known.
        self.solution = np.zeros(count, dtype=np.complex128)
        self.prior: Prior | None = None
        self.foretold = np.zeros(count)  # by the prior
        self.painted: dict[
            str, tuple[NDArray[Any], NDArray[Any]]
        ] = {}  # steps, and the map

    def time(self, seconds: Float64, places: Int64) -> tuple[float, float]:
        """Return the seconds of a path, given those in its places, and their log's deviation."""
        total = float(seconds.sum())
        unknown = float(seconds @ self.unknown[places] / total)
        return total, math.hypot(DRIVE_NOISE, UNSURE * unknown)

    def places_at(self, position: Float64) -> Int64:
        """Return the place of each position (N, 2), the nearest within a place's side, or -1."""
        cells, inside = cells_of(position, self.grid)
        x, y = cells.T
        return np.where(inside, self.nearest[y, x], -1)

    def update(self, evidence: Evidence) -> None:
        """Take what changed in the evidence, and solve again."""
        if evidence.prior is not self.prior:
            self.prior = evidence.prior
            x, y = self.middle.T
            features = map_features(self.grid)[y, x]
            self.foretold[:] = self.prior.log_slowness(features) if self.prior else 0
        self.expected = evidence.trust[0] + evidence.trust[1] * self.foretold
        places = self.places_at(evidence.table[:, 5:])
        on, count = places >= 0, len(self.middle)
        sums: list[Any] = [
            np.bincount(places[on], rows[on], count) for rows in evidence.table[:, :4].T
        ]
        weight, log, passed, waited = sums
        # A lattice whose links have strength 1 has about the variance ln(32 / kappa) / 4 pi;
        # 1 is added for cells of many metres, where that would be negative.
        kappa = (self.spacing / CORRELATION) ** 2
        scale = evidence.variance / (math.log1p(32 / kappa) / (4 * math.pi)) / NOISE
        visits = scale * weight
        # Half of the noise is added, as the mean of its exponential is more than 1.
        seen = scale * (log + weight * NOISE / 2)
        right = seen - visits * self.expected + 1j * visits
        # The equations map the same error everywhere to its product with these, and greater errors
        # to greater residuals: residuals up to that product prove that no error is greater.
        most = (ACCURACY * (kappa + visits)) ** 2
        diagonal = kappa + self.linked + visits
        links = self.links.indptr, self.links.indices, self.links.data
        _relax(*links, diagonal, most, right, self.solution)
        # Of each place: the share of its log slowness that was seen, that of its standard deviation
        # which is left, and expected seconds over those at nominal speed, with waits.
        self.known = np.clip(self.solution.imag, 0, 1)
        self.unknown = np.sqrt(1 - self.known)
        self.mean = (
            self.expected + self.solution.real + evidence.surplus * (1 - self.known)
        )
        self.slowness = np.exp(self.mean)
        if waited.any():
            self.slowness += evidence.nominal_speed * self._waits(
                passed, waited, evidence.side
            )

    def _waits(self, passed: Float64, waited: Float64, side: float) -> Float64:
        """Return the seconds that a robot waits for each metre through each place.

        They are those waited around it, over the metres driven around it. So each way through costs
        what a passage did, also beside the place where robots stood.
        """
        reach = round(2 * side / self.spacing)
        seconds, places = self._around(waited, reach), self._around(passed, reach)
        waits = seconds / (places + WAIT_PLACES) / side
        # Robots wait where nobody drove, too; but one place of waits says nothing of others.
        most = np.zeros(len(waits))
        most[waited.argmax()] = 1
        others = self.known * (self._around(most, 2 * reach) == 0)
        elsewhere = float(waits @ others) / (FEW_PLACES + float(self.known.sum()))
        return waits + elsewhere * (1 - self.known)

    def _around(self, values: Float64, reach: int) -> Float64:
        """Return a weighted mean of the places around each one, none of them behind a wall."""
        for _ in range(reach):
            values = (values + self.links @ values) / 5
        return values

    def paint(
        self, name: str, hope: Float64 | float, fastest: float
    ) -> NDArray[np.float32]:
        """Return (H, W) float32: the slowness over that of the fastest place, which has this log.

        Each place counts as faster by its hope (P,), a logarithm, too.
        """
        log = np.log(self.slowness) - hope - fastest
        steps = np.rint(np.clip(log, 0, math.log(MAX_SLOWNESS)) / math.log(1 + STEP))
        return self.layer(name, STEPS.take(steps.astype(np.int64)), 1)

    def layer(self, name: str, values: NDArray[Any], occupied: int) -> NDArray[Any]:
        """Return the same as `over`, and the same array while no value changes."""
        if name not in self.painted or not np.array_equal(
            values, self.painted[name][0]
        ):
            self.painted[name] = values, self.over(values, occupied)
        return self.painted[name][1]

    def over(self, values: NDArray[Any], occupied: int) -> NDArray[Any]:
        """Return (H, W): of each cell the value of its place."""
        return np.append(values, values.dtype.type(occupied)).take(
            self.place, mode="wrap"
        )


def _places_of(grid: GridMap, size: int) -> tuple[Int64, Int64]:
    """Return the place of each cell, and a cell (x, y) of each place, near its block's middle."""
    from scipy.ndimage import label

    # Between the blocks are rows and columns that connect nothing.
    rows, columns = (
        np.arange(cells) + np.arange(cells) // size for cells in grid.occupancy.shape
    )
    apart = np.zeros((rows[-1] + 1, columns[-1] + 1), dtype=np.bool_)
    apart[np.ix_(rows, columns)] = ~grid.occupancy
    place = label(apart, output=np.int64)[0][np.ix_(rows, columns)] - 1
    y, x = np.nonzero(place >= 0)
    middle = (size - 1) / 2
    order = np.argsort(np.hypot(x % size - middle, y % size - middle), kind="stable")
    cells = np.column_stack([x, y])[order]
    return place, cells[np.unique(place[y, x][order], return_index=True)[1]]


def _links_of(place: Int64, size: int, count: int) -> Any:
    """Return how strongly places are linked, by the share of a block's side that they have."""
    from scipy.sparse import csr_array

    sides = (place[:, :-1], place[:, 1:]), (place[:-1], place[1:])
    one, other = np.hstack([[one.ravel(), other.ravel()] for one, other in sides])
    linked = (one != other) & (one >= 0) & (other >= 0)
    ends = one[linked], other[linked]
    links = csr_array((np.full(len(ends[0]), 1 / size), ends), shape=(count, count))
    return (links + links.T).tocsr()


@in_place
def _relax(*arrays: Any) -> None:
    """Solve (diagonal - links) x = right by residuals, until the square of none is too great."""
    begins, to, weights, diagonal, most, residual, x = arrays
    # The residual is given as the right side.
    for place in range(x.size):
        residual[place] -= diagonal[place] * x[place]
        for link in range(begins[place], begins[place + 1]):
            residual[place] += weights[link] * x[to[link]]
    is_solved = False
    while not is_solved:
        is_solved = True
        for place in range(x.size):
            left = residual[place]
            if left.real * left.real + left.imag * left.imag > most[place]:
                is_solved = False
                change = OVER_RELAXATION * left / diagonal[place]
                x[place] += change
                residual[place] -= change * diagonal[place]
                for link in range(begins[place], begins[place + 1]):
                    residual[to[link]] += weights[link] * change


def cells_of(position: Float64, grid: GridMap) -> tuple[Int64, NDArray[np.bool_]]:
    """Return the nearest cells of positions, (N, 2) as (x, y), and which are on the map: (N,)."""
    *origin, yaw = grid.origin
    cos, sin = math.cos(yaw), math.sin(yaw)
    along = (position - origin) @ [[cos, -sin], [sin, cos]]
    cells = np.floor(along / grid.resolution).astype(np.int64)
    nearest = np.clip(cells, 0, [grid.width - 1, grid.height - 1])
    return nearest, (cells == nearest).all(axis=1)
