"""What a map says of how slow its places are likely to be: also where nobody has driven."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import Occupancy
from ddqn_planner.grid.body import clearance

Float32 = NDArray[np.float32]

FEATURES = 11
REACH = 3.0  # metres: what is farther away says nothing
NARROW = 0.7, 1.2, 2.0  # metres: free widths up to which a way counts as narrow
SQUARES = 0.5, 1.0, 2.0  # metres: half the sides of squares whose share of free space counts
UNUSUAL = 3.0  # standard deviations: features are no farther off than those of training

FEWEST_PLACES = 32  # from which a prior is learned
RIDGE = 10.0  # the weight of so many places speaks against each weight of the prior
SMALLEST_SCALE = 0.1  # a feature that hardly varies tells nothing of maps where it does
PARTS = 6  # each is foretold by the others
BLOCKS, PLACES = 12, (8, 32)  # near places are alike: so many in a row are left out together
DOUBT = 2.0  # what is foretold must be so many standard errors from nothing to be believed
REPLAYED = 512  # places of older maps, and as many of this one, are kept to learn from again


def map_features(grid: GridMap) -> Float32:
    """Return what the map says around each cell: (H, W, FEATURES). A wall stands around it."""
    occupied = grid.occupancy if grid.obstacles is None else grid.obstacles
    cells = clearance(np.pad(occupied, 1, constant_values=True))[1:-1, 1:-1].astype(np.float32)
    metres = np.minimum((cells - 0.5) * np.float32(grid.resolution), REACH)
    widths = _widths(occupied, grid.resolution), _widths(occupied.T, grid.resolution).T
    narrow, wide = np.minimum(*widths), np.maximum(*widths)
    near, middle, far = (_free_share(occupied, side / grid.resolution) for side in SQUARES)
    steps = [1 / (1 + np.exp(7 * (narrow / width - 1))) for width in NARROW]
    door = steps[1] * (far - near)
    features = [np.exp(-metres / 0.25), np.exp(-metres / 0.75), metres, *steps]
    features += [np.log(np.maximum(wide, 0.1)), door, near, middle, far]
    return np.moveaxis(np.stack(features), 0, -1)


def _widths(occupied: Occupancy, resolution: float) -> Float32:
    """Return how many metres of its row are free around each cell: (H, W)."""
    at = np.arange(occupied.shape[1], dtype=np.int32)
    left = np.maximum.accumulate(np.where(occupied, at, -1), axis=1)
    right = np.minimum.accumulate(np.where(occupied, at, len(at))[:, ::-1], axis=1)[:, ::-1]
    cells = np.maximum(right - left - 1, 0).astype(np.float32)
    return np.asarray(np.minimum(cells * np.float32(resolution), 2 * REACH))


def _free_share(occupied: Occupancy, reach: float) -> Float32:
    """Return the free share of the square around each cell that reaches so many cells: (H, W)."""
    from scipy.ndimage import uniform_filter1d

    whole, rest = divmod(max(2 * reach - 1, 0) / 2, 1)
    share = (~occupied).astype(np.float32)
    for axis in (0, 1):
        # A side of 3.5 cells lies between those of 3 and 5 cells.
        sizes = 2 * int(whole) + 1, 2 * int(whole) + 3
        small, large = (n * uniform_filter1d(share, n, axis, None, "constant") for n in sizes)
        share = (small + np.float32(rest) * (large - small)) / np.float32(2 * (whole + rest) + 1)
    return share


class Prior(NamedTuple):
    """Foretells log slowness from F features, linearly."""

    mean: Float32  # (F,) of the features in training
    scale: Float32  # (F,): their standard deviations
    level: Float32  # (): the mean log slowness in training
    weights: Float32  # (F,)
    replay: Float32  # (N, F + 2): features, log slowness and weight of places, to learn on from

    def log_slowness(self, features: Float32) -> Float32:
        """Return the expected log slowness of places: (..., F) to (...,)."""
        x = np.clip((features - self.mean) / self.scale, -UNUSUAL, UNUSUAL)
        return np.asarray(self.level + x @ self.weights)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Prior:
        """Return the prior of these arrays by name; a ValueError if they are no prior's."""
        try:
            prior = cls(
                *(arrays[name].astype(np.float32, casting="same_kind") for name in cls._fields)
            )
            shapes = (FEATURES,), (FEATURES,), (), (FEATURES,), (len(prior.replay), FEATURES + 2)
            possible = shapes == tuple(array.shape for array in prior)
            possible &= bool(np.isfinite(np.concatenate([array.ravel() for array in prior])).all())
            possible &= bool((prior.scale > 0).all() and (prior.replay[:, -1] >= 0).all())
        except (KeyError, TypeError):
            possible = False
        if not possible:
            raise ValueError("its prior cannot be true")
        return prior


def train_prior(
    features: Any, log_slowness: Any, weights: Any, older: Prior | None = None
) -> Prior:
    """Train a prior on N places: features (N, F), mean log slowness (N,) and its weight (N,).

    The places come in the order in which they were first driven. How much to believe the result is
    what foretells places best that were left out: not at all, if it foretells none. The places of
    an older prior are replayed, so that what it knew of other maps is not forgotten.
    """
    random = np.random.default_rng(0)
    new = np.column_stack([features, log_slowness, weights]).astype(np.float32)
    old = new[:0] if older is None else older.replay
    known = {row.tobytes() for row in new[:, :FEATURES]}  # a later drive tells of them anew
    old = old[[row.tobytes() not in known for row in old[:, :FEATURES]]]
    rows = np.concatenate([old, new]).astype(np.float64)
    x, target, weight = rows[:, :FEATURES], rows[:, FEATURES], rows[:, -1] / rows[:, -1].mean()
    mean, scale = x.mean(axis=0), np.maximum(x.std(axis=0), SMALLEST_SCALE)
    level = np.average(new[:, FEATURES], weights=new[:, -1])
    # Other maps may be slower as a whole: theirs is a level of its own.
    is_old = np.arange(len(rows)) < len(old)
    x = np.column_stack([np.clip((x - mean) / scale, -UNUSUAL, UNUSUAL), is_old])
    target, block = target - level, np.arange(len(rows)) // np.clip(len(rows) // BLOCKS, *PLACES)

    def fitted(learned: NDArray[np.bool_]) -> NDArray[np.float64]:
        moments = (x * (learned * weight)[:, None]).T
        return np.linalg.solve(moments @ x + RIDGE * np.eye(FEATURES + 1), moments @ target)

    foretold = np.zeros(len(x))
    for part in range(PARTS):
        left_out = block % PARTS == part
        foretold[left_out] = x[left_out] @ fitted(~left_out)
    fit, size = (np.bincount(block, weight * foretold * one) for one in (target, foretold))
    share = fit.sum() / max(size.sum(), 1e-9)
    error = np.linalg.norm(fit - share * size) / max(size.sum(), 1e-9)
    doubt = DOUBT * error / max(share * (1 - 2 / len(fit)), 1e-9)  # fewer blocks, greater errors
    share = min(share, 1) * (1 - min(doubt, 1) ** 2)
    kept = [part[np.sort(random.permutation(len(part))[:REPLAYED])] for part in (old, new)]
    believed = share * fitted(np.ones(len(x), dtype=np.bool_))[:FEATURES]
    arrays = mean, scale, level, believed, np.concatenate(kept)
    return Prior(*(np.asarray(array, dtype=np.float32) for array in arrays))
