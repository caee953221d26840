"""What drives tell of all free places of a map: a Gaussian Markov random field."""

from __future__ import annotations

import math
from functools import cached_property
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

CORRELATION = 1.0  # metres: how far the slowness of a place tells of that of others
STEP = 0.02  # slowness is told in steps of this share: fields need no repair for less
ACCURACY = 0.01  # of the log slowness: no place is farther from the solution of its equations
OVER_RELAXATION = 1.4  # of the solver: neighbours agree sooner
FEW_PLACES = 16.0  # it is assumed that so many were driven where nothing was slow
# By how much what all places have in common must change before they are told: noise and variance
# by a share, logarithms as they are.
NEWS, NEWS_OF_LOG = 0.1, 0.02


class Posterior:
    """The posterior of each place of a map: a connected part of a block of free cells.

    The log slowness of a place is normal around what the map lets expect. Neighbours are alike,
    but not through walls. `mean` (P,) and `known` (P,) belong to the places: the log slowness, and
    the share of it that was seen rather than expected.
    """

    def __init__(self, grid: GridMap, side: float) -> None:
        self.grid = grid
        self.size = max(1, round(side / grid.resolution))
        self.spacing = self.size * grid.resolution
        self.place, self.middle = _places_of(grid, self.size)  # (H, W), -1 where occupied
        count = len(self.middle)
        self.links = _links_of(self.place, self.size, count)
        self.degree = np.asarray(self.links.sum(axis=1), dtype=np.float64)
        # The solution of linear equations: real, what was seen beyond what is expected; imaginary,
        # the share that is known.
        self.solution = np.zeros(count, dtype=np.complex128)
        self.prior: Prior | None = None
        self.foretold = np.zeros(count, dtype=np.float32)  # by the prior
        self.expected, self.waits = np.zeros(count), np.zeros(count)
        # Noise, variance, what the prior is worth (two), surplus of the mean.
        self.common = (0.0,) * 5
        self.painted: tuple[float, NDArray[np.float32]] | None = None
        self.steps = np.zeros(0)

    @cached_property
    def tree(self) -> Any:
        """Finds places by their middle cells."""
        from scipy.spatial import KDTree

        return KDTree(self.middle)

    @property
    def mean(self) -> Float64:
        """The expected log slowness of driving at each place."""
        return self.expected + self.solution.real + self.common[4] * (1 - self.known)

    @property
    def known(self) -> Float64:
        """The share of each place's log slowness that was seen: 0 to 1."""
        return np.clip(self.solution.imag, 0, 1)

    @property
    def unknown(self) -> Float64:
        """The share of the standard deviation of each place's log slowness that is left."""
        return np.sqrt(1 - self.known)

    @property
    def slowness(self) -> Float64:
        """Expected seconds of each place over those at nominal speed, with waits."""
        return np.exp(self.mean) + self.waits

    def places_at(self, position: Float64) -> Int64:
        """Return the place of each position (N, 2), the nearest within a place's side, or -1."""
        cells, free = cells_of(position, self.grid)
        x, y = cells[free].T
        places = np.full(len(cells), -1)
        places[free] = self.place[y, x]
        if not free.all():
            away, near = self.tree.query(cells[~free], distance_upper_bound=1.5 * self.size)
            places[~free] = np.where(np.isfinite(away), near, -1)
        return places

    def update(self, evidence: Evidence) -> None:
        """Take what changed in the evidence, and solve again around it."""
        common = evidence.noise, evidence.place_variance, *evidence.trust, evidence.surplus
        change = np.abs(np.array(common) - self.common)
        least = [NEWS * common[0], NEWS * common[1], *[NEWS_OF_LOG] * 3]
        is_new = evidence.prior is not self.prior
        if is_new and evidence.prior is not None:
            x, y = self.middle.T
            self.foretold = evidence.prior.log_slowness(map_features(self.grid)[y, x])
        if is_new or (change > least).any():
            self.prior, self.common = evidence.prior, common
            self.expected = common[2] + common[3] * self.foretold.astype(np.float64)
        noise, variance = self.common[:2]
        places = self.places_at(evidence.table[:, 3:5])
        inside = places >= 0
        weight, log = evidence.table[inside, :2].T
        # A lattice whose links have strength 1 has about the variance ln(32 / kappa) / 4 pi;
        # 1 is added for cells of many metres, where that would be negative.
        kappa = (self.spacing / CORRELATION) ** 2
        scale = variance / (math.log1p(32 / kappa) / (4 * math.pi)) / noise
        known = scale * np.bincount(places[inside], weight, len(self.waits))
        # Half of the noise is added, as the mean of its exponential is more than 1.
        seen = scale * np.bincount(places[inside], log + weight * noise / 2, len(self.waits))
        right = seen - known * self.expected + 1j * known
        diagonal = kappa + self.degree + known
        residual = right + self.links @ self.solution - diagonal * self.solution
        # The equations map the same error everywhere to its product with these, and greater errors
        # to greater residuals: residuals up to that product prove that no error is greater.
        most = ACCURACY * (diagonal - self.degree)
        wrong = np.abs(residual) > most
        queue, waiting = np.argsort(~wrong, kind="stable"), np.count_nonzero(wrong)
        links = self.links.indptr, self.links.indices, self.links.data
        _relax(*links, diagonal, most, residual, self.solution, queue, waiting, wrong)
        self._wait(evidence)

    def _wait(self, evidence: Evidence) -> None:
        """Spread the expected waits over the places around, so that a crossing costs each once."""
        from scipy.sparse.csgraph import connected_components

        self.waits[:] = 0
        known, of_each = self.known, [0.0]
        radius = evidence.wait_radius
        width = max(math.pi / 2 * radius, self.spacing)  # the mean way through a disc
        for position, seconds in evidence.expected_waits():
            at = self.places_at(position[None])[0]
            if at >= 0:
                cells = radius / self.grid.resolution
                near = np.array(self.tree.query_ball_point(self.middle[at], cells))
                parts = connected_components(self.links[near][:, near])[1]
                near = near[parts == parts[near == at]]
                wait = seconds * evidence.nominal_speed / width
                self.waits[near] += wait
                of_each.append(wait * known[near].sum())
        # Robots wait where nobody drove, too; but one place of waits says nothing of others.
        self.waits += (sum(of_each) - max(of_each)) / (FEW_PLACES + known.sum()) * (1 - known)

    def paint(self, hope: Float64, fastest: float) -> NDArray[np.float32]:
        """Return (H, W) float32: the slowness over that of the fastest place, which has this log.

        Each place counts as faster by its hope (P,), a logarithm, too.
        """
        log = np.log(self.slowness) - hope - fastest
        steps = np.rint(np.clip(log, 0, math.log(MAX_SLOWNESS)) / math.log(1 + STEP))
        if self.painted is None or self.painted[0] != fastest:
            box: tuple[slice, ...] = (slice(None), slice(None))
            slowness = np.ones(self.place.shape, dtype=np.float32)
        else:
            x, y = self.middle[steps != self.steps].T
            if not len(x):
                return self.painted[1]
            box = tuple(slice(max(v.min() - self.size, 0), v.max() + self.size + 1) for v in (y, x))
            slowness = self.painted[1].copy()  # maps have the old one
        values = np.append(np.exp(steps * math.log(1 + STEP)), 1.0).astype(np.float32)
        np.minimum(values, MAX_SLOWNESS, out=values)
        slowness[box] = values.take(self.place[box], mode="wrap")
        self.steps, self.painted = steps, (fastest, slowness)
        return slowness

    def over(self, values: Float64, occupied: float) -> NDArray[np.float32]:
        """Return (H, W) float32: of each cell the value of its place."""
        return np.append(values, occupied).astype(np.float32).take(self.place, mode="wrap")


def _places_of(grid: GridMap, size: int) -> tuple[NDArray[np.int32], Int64]:
    """Return the place of each cell, and a cell (x, y) of each place, near its block's middle."""
    from scipy.ndimage import label

    # Between the blocks are rows and columns that connect nothing.
    rows, columns = (np.arange(cells) + np.arange(cells) // size for cells in grid.occupancy.shape)
    apart = np.zeros((rows[-1] + 1, columns[-1] + 1), dtype=np.bool_)
    apart[np.ix_(rows, columns)] = ~grid.occupancy
    place = label(apart, output=np.int32)[0][np.ix_(rows, columns)] - 1
    y, x = np.nonzero(place >= 0)
    middle = (size - 1) / 2
    order = np.argsort(np.hypot(x % size - middle, y % size - middle), kind="stable")
    cells = np.column_stack([x, y])[order]
    return place, cells[np.unique(place[y, x][order], return_index=True)[1]]


def _links_of(place: NDArray[np.int32], size: int, count: int) -> Any:
    """Return how strongly places are linked, by the share of a block's side that they have."""
    from scipy.sparse import csr_array

    links = csr_array((count, count))
    for one, other in ((place[:, :-1], place[:, 1:]), (place[:-1], place[1:])):
        linked = (one != other) & (one >= 0) & (other >= 0)
        weights = np.full(np.count_nonzero(linked), 1 / size)
        links += csr_array((weights, (one[linked], other[linked])), shape=(count, count))
    return (links + links.T).tocsr()


@in_place
def _relax(*arrays: Any) -> None:
    """Solve (diagonal - links) x = right from where residuals are too great."""
    begins, to, weights, diagonal, most, residual, x, queue, waiting, waits = arrays
    first = 0
    while waiting > 0:
        place = queue[first]
        first = first + 1 if first + 1 < queue.size else 0
        waiting -= 1
        waits[place] = False
        change = OVER_RELAXATION * residual[place] / diagonal[place]
        x[place] += change
        residual[place] -= change * diagonal[place]
        for link in range(begins[place], begins[place + 1] + 1):
            near = to[link] if link < begins[place + 1] else place
            if near != place:
                residual[near] += weights[link] * change
            if not waits[near] and abs(residual[near]) > most[near]:
                waits[near] = True
                end = first + waiting
                queue[end if end < queue.size else end - queue.size] = near
                waiting += 1


def cells_of(position: Float64, grid: GridMap) -> tuple[Int64, NDArray[np.bool_]]:
    """Return the cells of positions, (N, 2) as (x, y), and which of them are free: (N,)."""
    origin_x, origin_y, yaw = grid.origin
    x, y = position[:, 0] - origin_x, position[:, 1] - origin_y
    cos, sin = math.cos(yaw), math.sin(yaw)
    along = np.column_stack([cos * x + sin * y, cos * y - sin * x])
    cells = np.floor(along / grid.resolution).astype(np.int64)
    last = np.array([grid.width - 1, grid.height - 1])
    x, y = np.clip(cells, 0, last).T
    inside = ((cells >= 0) & (cells <= last)).all(axis=1)
    free: NDArray[np.bool_] = inside & ~grid.occupancy[y, x]
    return cells, free
