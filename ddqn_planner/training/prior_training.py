"""Trains the prior: a small network that predicts from the map how slow places are."""

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ddqn_planner.experience.places import Places
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
LEARNING_RATE = 0.01
WEIGHT_DECAY = 0.3
STEPS = 60  # at most
STEPS_PER_CHECK = 5  # of the error for the places that a network leaves out
SMALLEST_SCALE = 0.1  # a feature that hardly varies tells nothing of maps where it does
FOLDS = 6  # networks that each leave out some places; another one learns from all
# Places in a row are alike: so many blocks of them are left out together.
BLOCKS = 12
SMALLEST_BLOCK = 8  # places
LARGEST_BLOCK = 32
DOUBT = 2.0  # a prediction counts if it is so many standard errors from nothing
REPLAYED = 512  # places of older maps, and as many of this one, to learn from again
FEWEST_PLACES = 32  # from which a prior is learned
LARGEST_WEIGHT = 6.0  # of a place: those on every path do not govern all
MIN_SUM = 1e-9  # in place of a sum of 0 that divides


def prior_of(
    grid: GridMap, places: Places, older: Prior | None, seed: int = 0
) -> Prior | None:
    """Train a prior on the places that are free on a map; few change nothing."""
    cells, inside = cells_of(places.position, grid)
    x, y = cells.T
    seen = inside & ~grid.occupancy[y, x] & (places.weight > 0)
    if seen.sum() < FEWEST_PLACES:
        return older
    weight = places.weight[seen]
    log = places.sum_of_log[seen] / weight
    limited_weight = np.minimum(weight, LARGEST_WEIGHT)
    features = map_features(grid)[y[seen], x[seen]]
    new = np.column_stack([places.position[seen], features, log, limited_weight])
    return train_prior(new.astype(np.float32), older, seed)


def train_prior(new: Float32, older: Prior | None = None, seed: int = 0) -> Prior:
    """Train a prior on places, in rows as those of `Prior.replay`.

    Networks that leave out some places tell how long to train, and how much of the
    prediction to believe: none of it, if it does not predict the places left out.

    Parameters
    ----------
    new
        Places of one map, in the order in which they were first driven.
    older
        A prior whose places are replayed, so that it does not forget other maps. On a
        new map it is returned itself as long as it predicts these places better.
    """
    random = np.random.default_rng(as_seed(seed))
    old = new[:0] if older is None else _without(older.replay, new)
    rows = np.concatenate([old, new])
    features = rows[:, 2:-2]
    weight = rows[:, -1] / rows[:, -1].mean()
    mean = features.mean(axis=0)
    scale = np.maximum(features.std(axis=0), SMALLEST_SCALE)
    scaled = np.clip((features - mean) / scale, -UNUSUAL, UNUSUAL)
    # Other maps may be slower as a whole: this column learns their level.
    is_old = (np.arange(len(rows)) < len(old)).astype(np.float32)
    level = np.average(new[:, -2], weights=new[:, -1])
    target = rows[:, -2] - level  # log slowness
    block_size = np.clip(len(rows) // BLOCKS, SMALLEST_BLOCK, LARGEST_BLOCK)
    block = np.arange(len(rows)) // block_size
    fold = random.permutation(block[-1] + 1)[block] % FOLDS
    training = _train(
        np.column_stack([scaled, is_old]),
        target,
        weight,
        left_out=(fold == np.arange(FOLDS + 1)[:, None]).astype(np.float32),
        seed=seed,
    )
    share = _share_to_believe(block, weight, training.predicted, target)
    # All places of the older prior are replayed only where none lies on this map.
    is_new_map = older is not None and len(old) == len(older.replay)
    if older is not None and is_new_map:
        predicted = (share * training.predicted)[len(old) :]
        error_of_older = _error(older.log_slowness(new[:, 2:-2]), new)
        if error_of_older < _error(predicted, new):
            return older
    replay = [_some_rows(old, random), _some_rows(new, random)]
    # The last network leaves out no place.
    direct, weights_1, bias_1, weights_2, bias_2, weights_3 = (
        tensor[-1].numpy() for tensor in training.weights
    )
    arrays = {
        "mean": mean,
        "scale": scale,
        "level": level,
        "direct": share * direct[:FEATURES, 0],
        "weights_1": weights_1,
        "bias_1": bias_1[0],
        "weights_2": weights_2,
        "bias_2": bias_2[0],
        "weights_3": share * weights_3[:, 0],
        "replay": np.concatenate(replay),
    }
    return Prior(
        **{name: np.asarray(array, np.float32) for name, array in arrays.items()}
    )


def _without(old: Float32, new: Float32) -> Float32:
    """Return the rows of places that no new row measures anew."""
    measured = {place.tobytes() for place in new[:, :-2]}
    is_other_place = [place.tobytes() not in measured for place in old[:, :-2]]
    return old[is_other_place]


def _some_rows(rows: Float32, random: np.random.Generator) -> Float32:
    """Return `REPLAYED` random rows at most, in their order."""
    drawn = random.permutation(len(rows))[:REPLAYED]
    return rows[np.sort(drawn)]


def _share_to_believe(
    block: NDArray[np.int64], weight: Float32, predicted: Float32, target: Float32
) -> Any:
    """Return the share of a prediction that fits best; 0 if that is in doubt."""
    fit = np.bincount(block, weight * predicted * target)  # by block
    size = np.bincount(block, weight * predicted * predicted)
    total_size = max(size.sum(), MIN_SUM)
    share = fit.sum() / total_size
    standard_error = np.linalg.norm(fit - share * size) / total_size
    # Of fewer blocks the errors are greater.
    certain_share = max(share * (1 - 2 / len(fit)), MIN_SUM)
    doubt = DOUBT * standard_error / certain_share
    return min(share, 1) * (1 - min(doubt, 1) ** 2)


def _error(predicted: Float32, places: Float32) -> float:
    """Return the error of a predicted log slowness of places, whatever their level."""
    weight = places[:, -1]
    error = places[:, -2] - predicted
    return float(weight @ (error - np.average(error, weights=weight)) ** 2)


class _Weights(NamedTuple):
    """The weights of K networks of `Prior`.

    Their inputs are F features, and whether a place is one of other maps.
    """

    direct: Tensor  # (K, F + 1, 1)
    weights_1: Tensor  # (K, F, UNITS)
    bias_1: Tensor  # (K, 1, UNITS)
    weights_2: Tensor  # (K, UNITS, UNITS)
    bias_2: Tensor  # (K, 1, UNITS)
    weights_3: Tensor  # (K, UNITS, 1)


class _Training(NamedTuple):
    """What `_train` returns, of the step with the least error."""

    predicted: Float32  # (N,): the log slowness of each place, by networks without it
    weights: _Weights


def _train(
    inputs: Float32, target: Float32, weight: Float32, left_out: Float32, seed: int
) -> _Training:
    """Train K networks on N places; network k leaves out those of row k, (K, N)."""
    x_NI = torch.from_numpy(inputs)
    target_N = torch.from_numpy(target)
    weight_N = torch.from_numpy(weight)
    left_out_KN = torch.from_numpy(left_out)
    weight_KN = (1 - left_out_KN) * weight_N
    weights = _initial_weights(x_NI, target_N, weight_KN, seed)
    parameters = [tensor.requires_grad_() for tensor in weights]
    optimiser = torch.optim.AdamW(parameters, LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    share_KN = weight_KN / weight_KN.sum(dim=1, keepdim=True).clamp(min=MIN_SUM)
    x_KNI = x_NI.expand(len(left_out), -1, -1)
    smallest_error = float("inf")
    for step in range(STEPS + 1):
        output_KN = _outputs(weights, x_KNI)
        loss_KN = nn.functional.huber_loss(
            output_KN, target_N.expand_as(output_KN), reduction="none"
        )
        error = (loss_KN * left_out_KN * weight_N).sum().item()
        if step % STEPS_PER_CHECK == 0 and error < smallest_error:
            smallest_error = error
            predicted_N = (output_KN * left_out_KN).sum(dim=0).detach().numpy()
            copies = [tensor.detach().clone() for tensor in parameters]
            best = _Training(predicted_N, _Weights(*copies))
        optimiser.zero_grad()
        (share_KN * loss_KN).sum().backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    return best


def _initial_weights(
    x_NI: Tensor, target_N: Tensor, weight_KN: Tensor, seed: int
) -> _Weights:
    """Return networks that predict as well as linear ones can; few steps bend them."""
    networks = len(weight_KN)
    weights = _Weights(
        direct=torch.zeros(networks, FEATURES + 1, 1),
        weights_1=torch.zeros(networks, FEATURES, UNITS),
        bias_1=torch.zeros(networks, 1, UNITS),
        weights_2=torch.zeros(networks, UNITS, UNITS),
        bias_2=torch.zeros(networks, 1, UNITS),
        weights_3=torch.zeros(networks, UNITS, 1),
    )
    generator = torch.Generator().manual_seed(seed)
    for layer in (weights.weights_1, weights.weights_2):
        _, inputs, units = layer.shape
        layer += torch.randn((inputs, units), generator=generator) / inputs**0.5
    # The normal equations of a ridge regression.
    x_and_target = torch.column_stack([x_NI, target_N])
    moments = torch.einsum("kn,ni,nj->kij", weight_KN, x_NI, x_and_target)
    penalty = RIDGE * torch.eye(FEATURES + 1)
    direct = torch.linalg.solve(moments[..., :-1] + penalty, moments[..., -1:])
    weights.direct.copy_(direct)
    return weights


def _outputs(weights: _Weights, x_KNI: Tensor) -> Tensor:
    """Return what each network predicts of the places: (K, N)."""
    features = x_KNI[..., :FEATURES]
    first = torch.baddbmm(weights.bias_1, features, weights.weights_1).tanh()
    second = torch.baddbmm(weights.bias_2, first, weights.weights_2).tanh()
    return (x_KNI @ weights.direct + second @ weights.weights_3)[..., 0]
