"""What visits tell of places of the world: log slowness, how sure it is, and both on a map."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import MAX_SLOWNESS
from ddqn_planner.grid.grid_map import check_grid, equal

Float64 = NDArray[np.float64]

FARTHEST = 1e7  # metres from the origin of the map: a place beyond is not believed

REACH = 2.5  # how far a visit tells of the places around, in widths of the robot
PRIOR = 1.0  # variance of the log slowness of a place before it is visited; its mean is 0
PRIOR_SUCCESSES = 2.0  # so many are assumed where nothing was driven
NOISE, NOISY_VISITS = 0.1, 50.0  # variance of the log slowness of one visit, as if of so many
OLD_VISITS = 500.0  # the noise of visits is that of about the last so many
OUTLIER = 2.5  # a visit is moved to so many standard deviations from what was expected
MOST = 4.0  # weight of visits that a place keeps: a new visit then counts a fifth

STEP = 0.02  # slowness is told in steps of this share: fields need no repair for less
FADING_STEPS = 4  # so often per half-life all evidence fades: few changes of a map come at once
MOST_AT_ONCE = 2**13  # cells whose slowness is computed at once
REBASE = 2.0**16  # evidence is spread anew when weights have grown so much against the oldest

SHORTEST = 8  # a drive through fewer places says little about how sure expected times are
KEPT, ASSUMED = 64, 8  # drives whose errors count, and drives assumed before, with normal errors
NORMAL = 1.645  # 90 % of a normal distribution lie within so many standard deviations
TAIL = 0.04  # share of errors beyond each bound: not 5 %, as successive drives are alike
PARTS = 256  # of a path, between which it is computed what they have in common
CORRELATED = 5.0  # places so many sides apart have a third of their error in common

STRAIGHT, DIAGONAL = 5, 7  # lengths of moves in whole numbers: within 4 % of the true ones

# Of each place: the weight of its visits, that times their log slowness, the weight of failures,
# where it was visited first, and the driven time when the weights were last faded.
COLUMNS = "weight", "log", "failures", "x", "y", "time"


class Visits(NamedTuple):
    """The V places of a drive, one after the other: where (V, 2), and for how long (V,)."""

    position: Float64
    seconds: Float64
    metres: Float64


class Evidence:
    """What was seen at each place, a square of the world. It fades with the time that is driven."""

    def __init__(self, nominal_speed: float, robot_width: float, half_life: float) -> None:
        self.nominal_speed, self.half_life = nominal_speed, half_life
        self.side, self.reach = robot_width / 2, REACH * robot_width
        self.driven = 0.0
        self.places: dict[tuple[int, int], int] = {}  # the row of each in the table
        self.table = np.zeros((0, len(COLUMNS)))
        self.noise_sums = NOISY_VISITS * NOISE, NOISY_VISITS
        self.errors: list[float] = []  # of the last drives' log times, in standard deviations
        self.spread: Spread | None = None  # over the last map

    @property
    def noise(self) -> float:
        """Variance of the log slowness of one visit."""
        total, visits = self.noise_sums
        return max(total / visits, 1e-4)

    def add(self, visits: Visits) -> None:
        """Learn from the visits of a drive, and from how far its time was from the expected one."""
        rows, noise = self._rows(visits.position), self.noise
        slowness = visits.seconds * self.nominal_speed / visits.metres
        log = np.log(np.clip(slowness, 1 / 3, MAX_SLOWNESS))
        weight, sum_of_log, *_ = self.faded(self.table[rows], self.driven).T
        variance = 1 / (weight / noise + 1 / PRIOR)
        surprise = log - sum_of_log / noise * variance
        most = OUTLIER * np.sqrt(noise + variance)
        believed = np.clip(surprise, -most, most)
        known = weight >= 1
        total, count = self.noise_sums
        total += float((believed**2 / (1 + variance / noise))[known].sum())
        count += int(known.sum())
        surplus = max(count / OLD_VISITS, 1)
        self.noise_sums = total / surplus, count / surplus
        if self.spread is not None:
            self._compare(visits, self.spread)
        self.driven += float(visits.seconds.sum())
        places = self._fade(rows)
        weight = visits.metres / self.side
        np.add.at(self.table[:, 0], rows, weight)
        np.add.at(self.table[:, 1], rows, weight * (log - surprise + believed))
        self.table[places, :3] /= np.maximum(self.table[places, :1] / MOST, 1)

    def add_failure(self, x: float, y: float) -> None:
        """Add a failure."""
        rows = self._rows(np.array([[x, y]]))
        self._fade(rows)
        self.table[rows, 2] += 1

    def _rows(self, position: Float64) -> NDArray[np.int64]:
        """Return the row of each position; new places get one."""
        before = len(self.places)
        keys = map(tuple, np.floor(position / self.side).astype(np.int64).tolist())
        rows = np.array([self.places.setdefault(key, len(self.places)) for key in keys])
        visited, first = np.unique(rows, return_index=True)
        first = first[visited >= before]
        fresh = np.zeros((len(first), len(COLUMNS)))
        fresh[:, 3:5] = position[first]
        self.table = np.concatenate([self.table, fresh])
        return rows

    def share_left(self, seconds: Any) -> Any:
        """Return what share of evidence is left after so many driven seconds."""
        return 0.5 ** (seconds / self.half_life)

    def faded(self, table: Float64, driven: float) -> Float64:
        """Return the weights of rows of the table, faded to a driven time: (N, 3)."""
        weights: Float64 = table[:, :3] * self.share_left(driven - table[:, 5:])
        return weights

    def _fade(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Fade places to the driven time; return each of them once."""
        places = np.unique(rows)
        self.table[places, :3] = self.faded(self.table[places], self.driven)
        self.table[places, 5] = self.driven
        return places

    def _compare(self, visits: Visits, spread: Spread) -> None:
        """Compare the time of a drive with the one expected on the last map."""
        cells, free = cells_of(visits.position, spread.grid)
        x, y = cells[free].T
        if len(x) < SHORTEST:
            return
        metres = visits.metres[free]
        expected = metres / self.nominal_speed * spread.slowness[y, x]
        deviation = self.deviation(expected, metres, spread.variance(x, y))
        error = math.log(visits.seconds[free].sum() / expected.sum()) / deviation
        self.errors = [*self.errors, error][-KEPT:]

    def deviation(self, seconds: Float64, metres: Float64, variance: Float64) -> float:
        """Return the standard deviation of the log time of a drive, from those of its parts."""
        # Each place has a noise of its own; the log slowness of near ones is wrong in the same way.
        share = seconds / seconds.sum()
        of_visits = self.noise * (share**2 * np.maximum(self.side / metres, 1)).sum()
        weighted, at = share * np.sqrt(variance), np.cumsum(metres)
        begins = np.unique(np.linspace(0, len(at) - 1, PARTS).astype(np.int64))
        weighted, at = np.add.reduceat(weighted, begins), at[begins]
        same = np.exp(-np.abs(at[:, None] - at) / (CORRELATED * self.side))
        return float(np.sqrt(weighted @ same @ weighted + of_visits))

    def quantiles(self) -> Float64:
        """Return the lower bound, the mean, and the upper bound of 90 % of the errors of drives."""
        errors = np.concatenate([self.errors, NORMAL * np.linspace(-1.05, 1.05, ASSUMED)])
        # Of n errors and the next one, as many lie outside on each side as of a sample of n + 1.
        tail = TAIL * (1 + 1 / len(errors)) - 1 / len(errors)
        low, high = np.quantile(errors, (max(tail, 0), min(1 - tail, 1)))
        return np.array([low, errors.mean(), high])

    def over(self, grid: GridMap) -> Spread:
        """Return the evidence spread over a map, computed only where it changed."""
        check_grid(grid)
        period = self.half_life / FADING_STEPS
        driven = math.floor(self.driven / period) * period
        spread, self.spread = self.spread, None  # an exception must not leave a part of it
        if (
            spread is None
            or self.share_left(driven - spread.since) <= 1 / REBASE
            or (spread.grid.resolution, spread.grid.origin) != (grid.resolution, grid.origin)
            or not equal(spread.grid.occupancy, grid.occupancy)
        ):
            spread = Spread(grid, driven)
        spread.grid = grid
        spread.update(self, driven)
        self.spread = spread
        return spread

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take what a file keeps; a ValueError if it cannot be true."""
        names = ("places", "evidence", "driven", "noise", "errors")
        places, table, driven, noise, errors = given = [arrays[name] for name in names]
        if not all(array.dtype.kind in "if" and np.isfinite(array).all() for array in given):
            raise ValueError("it holds what is no finite number")
        number = {(x, y): row for row, (x, y) in enumerate(places.tolist())}
        shapes = places.shape, table.shape, driven.shape, noise.shape, errors.shape
        fitting = (len(number), 2), (len(number), len(COLUMNS)), (), (2,), (errors.size,)
        if shapes != fitting or places.dtype.kind != "i":
            raise ValueError(f"its arrays do not fit: they have the shapes {shapes}")
        total, visits = noise.tolist()
        wrong = (table[:, [0, 2]] < 0).any() or (np.abs(table[:, 3:5]) > FARTHEST).any()
        if wrong or (table[:, 5] > driven).any() or total < 0 or visits <= 0:
            raise ValueError("its evidence cannot be true")
        self.places, self.table, self.driven = number, table, float(driven)
        self.noise_sums, self.errors = (total, visits), errors.tolist()


class Spread:
    """Evidence spread over the cells of a map."""

    # The sums are those at the driven time `since`: they all fade further by one factor, `faded`.

    def __init__(self, grid: GridMap, since: float) -> None:
        shape = grid.occupancy.shape
        self.grid, self.since, self.driven = grid, since, since
        self.faded, self.noise = 1.0, NOISE
        # Of weights of visits, of these times log slowness, and of failures.
        self.sums = np.zeros((*shape, 3), dtype=np.float32)
        self.slowness: NDArray[np.float32] = np.ones(shape, dtype=np.float32)
        self.touched = np.zeros(shape, dtype=np.bool_)
        self.table = np.zeros((0, len(COLUMNS)))  # what was spread of `Evidence.table`

    def update(self, evidence: Evidence, driven: float) -> None:
        """Spread what changed, less what was spread of the same places before."""
        before = np.zeros_like(evidence.table)
        before[: len(self.table)] = self.table
        changed = (evidence.table != before).any(axis=1)
        if changed.any():
            before, now = before[changed], evidence.table[changed]
            before, after = (evidence.faded(table, self.since) for table in (before, now))
            more = after.astype(np.float32) - before.astype(np.float32)
            cells = nearest_free(now[:, 3:5], self.grid, evidence.side)
            inside = cells[:, 0] >= 0
            reach = max(evidence.reach / self.grid.resolution, 0.5)
            occupancy, cells, more = self.grid.occupancy, cells[inside], more[inside]
            spread_evidence(occupancy, cells, more, reach, self.sums, self.touched)
            self.table = evidence.table.copy()
        if driven != self.driven:
            self.driven, self.noise = driven, evidence.noise
            self.faded = evidence.share_left(driven - self.since)
            self.touched |= self.sums[..., 0] > 0
        touched, scale = np.flatnonzero(self.touched), np.log(1 + STEP)
        if not len(touched):
            return
        self.slowness = self.slowness.copy()  # maps have the old one
        for cells in np.array_split(touched, 1 + len(touched) // MOST_AT_ONCE):
            sums = self.sums.reshape(-1, 3).take(cells, axis=0).T
            weight, sum_of_log, failures = np.ascontiguousarray(sums, dtype=np.float64) * self.faded
            # Differences of sums may leave a rest below 0.
            weight, failures = np.maximum(weight, 0), np.maximum(failures, 0)
            # Half of the noise is added, as the mean of its exponential is more than 1.
            mean = (sum_of_log / self.noise + weight / 2) / (weight / self.noise + 1 / PRIOR)
            tries = (PRIOR_SUCCESSES + weight + failures) / (PRIOR_SUCCESSES + weight)
            steps = np.rint((np.maximum(mean, 0) + np.log(tries)) / scale)
            np.put(self.slowness, cells, np.minimum(np.exp(steps * scale), MAX_SLOWNESS))
        np.put(self.touched, touched, False)

    def variance(self, x: Any, y: Any) -> Float64:
        """Return the variance of the log slowness of some cells."""
        weight = np.maximum(self.sums[y, x, 0].astype(np.float64), 0) * self.faded
        variance: Float64 = 1 / (weight / self.noise + 1 / PRIOR)
        return variance


def cells_of(position: Float64, grid: GridMap) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
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


def nearest_free(position: Float64, grid: GridMap, metres: float) -> NDArray[np.int64]:
    """Return the free cells of positions, or the nearest within some metres, or (-1, -1)."""
    cells, free = cells_of(position, grid)
    reach = int(metres / grid.resolution)
    result = np.where(free[:, None], cells, -1)
    for index in np.flatnonzero(~free):
        x, y = cells[index].tolist()
        left, bottom = max(x - reach, 0), max(y - reach, 0)
        box = grid.occupancy[bottom : max(y + reach + 1, 0), left : max(x + reach + 1, 0)]
        free_y, free_x = np.nonzero(~box)
        if len(free_x):
            best = np.hypot(free_x + left - x, free_y + bottom - y).argmin()
            result[index] = free_x[best] + left, free_y[best] + bottom
    return result


def spread_evidence(
    occupancy: NDArray[np.bool_],
    cells: NDArray[np.int64],
    amounts: NDArray[np.float32],
    reach: float,
    sums: NDArray[np.float32],
    touched: NDArray[np.bool_],
) -> None:
    """Add amounts (B, 3) of cells (B, 2) to sums (H, W, 3) around them; mark touched (H, W)."""
    # An amount becomes less with the length d of a path, not through walls: (1 - (d / reach)^2)^3.
    lengths = np.arange(int(STRAIGHT * reach) + 1)
    share = ((1 - (lengths / (STRAIGHT * reach)) ** 2) ** 3).astype(np.float32)
    size = 2 * int(reach) + 3  # no path within reach leads to the border
    best, queue = np.empty((size, size), np.int32), np.empty((size * size, 2), np.int32)
    waits = np.zeros((size, size), np.bool_)
    _spread(occupancy, cells, amounts, share, best, queue, waits, sums, touched)


@in_place
def _spread(
    occupancy: Any, cells: Any, amounts: Any, share: Any, best: Any, queue: Any, *arrays: Any
) -> None:
    """Do the work of `spread_evidence`, given shares by the length, and memory."""
    (height, width), (waits, sums, touched) = occupancy.shape, arrays
    size, furthest, middle = best.shape[0], share.size - 1, best.shape[0] // 2
    for number in range(cells.shape[0]):
        left, bottom = cells[number, 0] - middle, cells[number, 1] - middle
        for y in range(size):
            for x in range(size):
                best[y, x] = furthest + 1
        best[middle, middle] = 0
        queue[0, 0] = queue[0, 1] = middle
        first, end = 0, 1
        while first != end:
            x, y = queue[first, 0], queue[first, 1]
            first = first + 1 if first + 1 < queue.shape[0] else 0
            waits[y, x] = False
            row, column, way = bottom + y, left + x, best[y, x]
            for dy in range(-1, 2):
                for dx in range(-1, 2):
                    length = way + (DIAGONAL if dx != 0 and dy != 0 else STRAIGHT)
                    if length >= best[y + dy, x + dx]:
                        continue
                    to_row, to_column = row + dy, column + dx
                    if not (0 <= to_row < height and 0 <= to_column < width):
                        continue
                    corner = occupancy[row, to_column] or occupancy[to_row, column]
                    if corner or occupancy[to_row, to_column]:
                        continue
                    best[y + dy, x + dx] = length
                    if not waits[y + dy, x + dx]:
                        waits[y + dy, x + dx] = True
                        queue[end, 0], queue[end, 1] = x + dx, y + dy
                        end = end + 1 if end + 1 < queue.shape[0] else 0
        for y in range(size):
            for x in range(size):
                if best[y, x] <= furthest:
                    touched[bottom + y, left + x] = True
                    for kind in range(3):
                        part = share[best[y, x]] * amounts[number, kind]
                        sums[bottom + y, left + x, kind] += part
