"""Trains the prior: a small network that foretells from the map how slow places are."""

from typing import Any

import numpy as np
import torch
from torch import nn

from ddqn_planner.experience.posterior import cells_of
from ddqn_planner.experience.prior import (
    FEATURES,
    UNUSUAL,
    Float32,
    Prior,
    map_features,
)
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import as_seed

UNITS = 16
RIDGE = 10.0  # the weight of so many places speaks against each linear prediction
LEARNING_RATE, WEIGHT_DECAY = 0.01, 0.3
STEPS, CHECKED = 60, 5  # at most so many; the held-out error is seen every so many
SMALLEST_SCALE = 0.1  # a feature that hardly varies tells nothing of maps where it does
FOLDS = 6  # networks that each leave out a part of the places; one more learns from all
BLOCKS, PLACES = (
    12,
    (8, 32),
)  # near places are alike: so many in a row are left out together
DOUBT = (
    2.0  # what is foretold must be so many standard errors from nothing to be believed
)
REPLAYED = (
    512  # places of older maps, and as many of this one, are kept to learn from again
)
FEWEST_PLACES = 32  # from which a prior is learned
MOST = 6.0  # weight of a place: those on every way do not govern all


def prior_of(
    grid: GridMap, table: Any, older: Prior | None, seed: int = 0
) -> Prior | None:
    """Train a prior on places of `Evidence.table` that are free on a map; few change nothing."""
    cells, inside = cells_of(table[:, 5:], grid)
    x, y = cells.T
    seen = inside & ~grid.occupancy[y, x] & (table[:, 0] > 0)
    if seen.sum() < FEWEST_PLACES:
        return older
    weight, log = table[seen, :2].T
    features = map_features(grid)[y[seen], x[seen]]
    new = np.column_stack(
        [table[seen, 5:], features, log / weight, np.minimum(weight, MOST)]
    )
    return train_prior(new.astype(np.float32), older, seed)


def train_prior(new: Float32, older: Prior | None = None, seed: int = 0) -> Prior:
    """Train a prior on places, in rows as those of `Prior.replay`.

    They come in the order in which they were first driven. How long to train, and how much to
    believe the result, is what foretells places best that were left out: none of it, if none does.
    On a new map an older prior stays as long as it foretells these places better. Later its places
    are replayed, so that what it knew of other maps is not forgotten.
    """
    random = np.random.default_rng(as_seed(seed))
    old = new[:0] if older is None else older.replay
    known = {row.tobytes() for row in new[:, :-2]}  # a later drive tells of them anew
    old = old[[row.tobytes() not in known for row in old[:, :-2]]]
    rows = np.concatenate([old, new])
    x, target, weight = rows[:, 2:-2], rows[:, -2], rows[:, -1] / rows[:, -1].mean()
    mean, scale = x.mean(axis=0), np.maximum(x.std(axis=0), SMALLEST_SCALE)
    level = np.average(new[:, -2], weights=new[:, -1])
    # Other maps may be slower as a whole: theirs is a level of its own.
    is_old = (np.arange(len(rows)) < len(old)).astype(np.float32)
    x = np.column_stack([np.clip((x - mean) / scale, -UNUSUAL, UNUSUAL), is_old])
    target, block = (
        target - level,
        np.arange(len(rows)) // np.clip(len(rows) // BLOCKS, *PLACES),
    )
    left_out = (
        random.permutation(block[-1] + 1)[block] % FOLDS
        == np.arange(FOLDS + 1)[:, None]
    )
    foretold, trained = _train(
        x, target, weight, left_out.astype(np.float32), seed=seed
    )
    fit, size = (
        np.bincount(block, weight * foretold * one) for one in (target, foretold)
    )
    share = fit.sum() / max(size.sum(), 1e-9)
    error = np.linalg.norm(fit - share * size) / max(size.sum(), 1e-9)
    doubt = (
        DOUBT * error / max(share * (1 - 2 / len(fit)), 1e-9)
    )  # fewer blocks, greater errors
    share = min(share, 1) * (1 - min(doubt, 1) ** 2)
    if older is not None and len(old) == len(
        older.replay
    ):  # it has seen none of these places
        own, others = (share * foretold)[len(old) :], older.log_slowness(new[:, 2:-2])
        if _error(others, new) < _error(own, new):
            return older
    direct, *layers, last = (array[-1].squeeze() for array in trained)
    kept = [
        part[np.sort(random.permutation(len(part))[:REPLAYED])] for part in (old, new)
    ]
    network = share * direct[:FEATURES], *layers, share * last, np.concatenate(kept)
    return Prior(
        *(np.asarray(array, np.float32) for array in (mean, scale, level, *network))
    )


def _error(foretold: Float32, places: Float32) -> float:
    """Return how far off the log slowness of places is foretold, whatever their level."""
    off, weight = places[:, -2] - foretold, places[:, -1]
    return float(weight @ (off - np.average(off, weights=weight)) ** 2)


def _train(*arrays: Float32, seed: int) -> tuple[Float32, list[Float32]]:
    """Return what places left out are foretold, (N,), and the weights of all networks."""
    x, target, weight, left_out = map(torch.from_numpy, arrays)
    generator, networks = torch.Generator().manual_seed(seed), len(left_out)
    layers = (FEATURES, UNITS), (1, UNITS), (UNITS, UNITS), (1, UNITS), (UNITS, 1)
    sizes = (FEATURES + 1, 1), *layers
    parameters = [torch.zeros(networks, *size) for size in sizes]
    direct, weights_1, bias_1, weights_2, bias_2, weights_3 = parameters
    for layer in weights_1, weights_2:
        layer += (
            torch.randn(layer.shape[1:], generator=generator) / layer.shape[1] ** 0.5
        )
    # The best linear prediction is where they begin; few steps then bend it.
    learned = (1 - left_out) * weight
    moments = torch.einsum("kn,ni,nj->kij", learned, x, torch.column_stack([x, target]))
    penalty = RIDGE * torch.eye(FEATURES + 1)
    direct += torch.linalg.solve(moments[..., :-1] + penalty, moments[..., -1:])
    trained = [array.requires_grad_() for array in parameters]
    optimiser = torch.optim.AdamW(trained, LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    learned = learned / learned.sum(dim=1, keepdim=True).clamp(min=1e-9)
    x, least = x.expand(networks, -1, -1), float("inf")
    for step in range(STEPS + 1):
        hidden = torch.baddbmm(bias_1, x[..., :FEATURES], weights_1).tanh()
        hidden = torch.baddbmm(bias_2, hidden, weights_2).tanh()
        output = (x @ direct + hidden @ weights_3)[..., 0]
        loss = nn.functional.huber_loss(
            output, target.expand_as(output), reduction="none"
        )
        error = (loss * left_out * weight).sum().item()
        if step % CHECKED == 0 and error < least:
            least, foretold = error, (output * left_out).sum(dim=0).detach().numpy()
            best = [array.detach().numpy().copy() for array in parameters]
        optimiser.zero_grad()
        (learned * loss).sum().backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    return foretold, best
