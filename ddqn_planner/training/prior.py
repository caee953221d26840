"""Trains the prior: a small network that foretells from the map how slow places are."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from ddqn_planner.experience.prior import FEATURES, UNUSUAL, Prior

Floats = NDArray[np.floating[Any]]

UNITS = 16
LEARNING_RATE, WEIGHT_DECAY = 0.01, 0.3
STEPS, CHECKED = 200, 5  # at most so many; the held-out error is seen every so many
SMALLEST_SCALE = 0.1  # a feature that hardly varies tells nothing of maps where it does
FOLDS = 6  # networks that each leave out a part of the places; one more learns from all
BLOCK = 32  # places driven one after the other, left out together: near ones are alike
REPLAYED = 512  # places of older maps, and as many of this one, are kept to learn from again


def train_prior(
    features: Floats,
    log_slowness: Floats,
    weights: Floats,
    older: Prior | None = None,
    seed: int = 0,
) -> Prior:
    """Train a prior on N places: features (N, F), mean log slowness (N,) and its weight (N,).

    The places come in the order in which they were first driven. How long to train, and how much to
    believe the result, is what foretells places best that were left out: none of it, if none does.
    The places of an older prior are replayed, so that what it knew of other maps is not forgotten.
    """
    random = np.random.default_rng(seed)
    new = np.column_stack([features, log_slowness, weights]).astype(np.float32)
    old = new[:0] if older is None else older.replay
    known = {row.tobytes() for row in new[:, :FEATURES]}  # a later drive tells of them anew
    old = old[[row.tobytes() not in known for row in old[:, :FEATURES]]]
    rows = np.concatenate([old, new])
    x, target, weight = rows[:, :FEATURES], rows[:, FEATURES], rows[:, -1] / rows[:, -1].mean()
    mean = np.average(x, axis=0, weights=weight)
    variance = np.average((x - mean) ** 2, axis=0, weights=weight)
    scale = np.maximum(np.sqrt(variance), SMALLEST_SCALE)
    level = np.average(new[:, FEATURES], weights=new[:, -1])
    # Other maps may be slower as a whole: theirs is a level of its own.
    is_old = (np.arange(len(rows)) < len(old)).astype(np.float32)
    x = np.column_stack([np.clip((x - mean) / scale, -UNUSUAL, UNUSUAL), is_old])
    block = np.arange(len(rows)) // BLOCK
    left_out = random.permutation(block[-1] + 1)[block] % FOLDS == np.arange(FOLDS + 1)[:, None]
    share, trained = _train(x, target - level, weight, left_out.astype(np.float32), seed=seed)
    direct, *layers, last = (array[-1].squeeze() for array in trained)
    kept = [part[np.sort(random.permutation(len(part))[:REPLAYED])] for part in (old, new)]
    network = share * direct[:FEATURES], *layers, share * last, np.concatenate(kept)
    return Prior(*(np.asarray(array, np.float32) for array in (mean, scale, level, *network)))


def _train(*arrays: NDArray[np.float32], seed: int) -> tuple[float, list[NDArray[np.float32]]]:
    """Return what share of the last network's output to believe, and all networks' weights."""
    x, target, weight, left_out = map(torch.from_numpy, arrays)
    generator, networks = torch.Generator().manual_seed(seed), len(left_out)
    first, second, third = (FEATURES, UNITS), (UNITS, UNITS), (UNITS, 1)
    sizes = (FEATURES + 1, 1), first, (1, UNITS), second, (1, UNITS), third
    parameters = [torch.zeros(networks, *size, requires_grad=True) for size in sizes]
    with torch.no_grad():
        for layer in parameters[1], parameters[3]:
            layer += torch.randn(layer.shape[1:], generator=generator) / layer.shape[1] ** 0.5
    direct, weights_1, bias_1, weights_2, bias_2, weights_3 = parameters
    optimiser = torch.optim.AdamW(parameters, LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    share_learned = (1 - left_out) * weight
    share_learned = share_learned / share_learned.sum(dim=1, keepdim=True).clamp(min=1e-9)
    x = x.expand(networks, -1, -1)
    least = float("inf")
    for step in range(STEPS + 1):
        hidden = torch.baddbmm(bias_1, x[..., :FEATURES], weights_1).tanh()
        hidden = torch.baddbmm(bias_2, hidden, weights_2).tanh()
        output = (x @ direct + hidden @ weights_3)[..., 0]
        loss = nn.functional.huber_loss(output, target.expand_as(output), reduction="none")
        error = (loss * left_out * weight).sum().item()
        if step % CHECKED == 0 and error < least:
            foretold = (output * left_out).sum(dim=0).detach()
            fit = (weight * foretold * target).sum() / ((weight * foretold**2).sum() + 1e-9)
            least, share = error, fit.clamp(0, 1).item()
            best = [array.detach().numpy().copy() for array in parameters]
        optimiser.zero_grad()
        (share_learned * loss).sum().backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    return share, best
