"""Trains the prior: a small network that predicts from the map how slow places are."""

from typing import NamedTuple

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
    """Train a prior on the places that were driven and are free on the map `grid`.

    `places` has sums of what was seen at N places of the world. Fewer than
    FEWEST_PLACES places on free cells change nothing: the result is the prior `older`.
    The same `seed` gives the same prior.
    """
    cells, is_inside = cells_of(places.position, grid)
    x = cells[:, 0]
    y = cells[:, 1]
    is_usable = is_inside & ~grid.occupancy[y, x] & (places.weight > 0)
    if is_usable.sum() < FEWEST_PLACES:
        return older
    weight = places.weight[is_usable]  # (M,), as the arrays that follow
    log_slowness = places.sum_of_log[is_usable] / weight
    features = map_features(grid)[y[is_usable], x[is_usable]]  # (M, FEATURES)
    # The columns are those of `Prior.replay`.
    rows = np.column_stack(
        [
            places.position[is_usable],
            features,
            log_slowness,
            np.minimum(weight, LARGEST_WEIGHT),
        ]
    )
    return train_prior(rows.astype(np.float32), older, seed)


class _Columns(NamedTuple):
    """The columns of the table `Prior.replay`, which has a row for each of N places."""

    position: Float32  # (N, 2): metres
    features: Float32  # (N, FEATURES)
    log_slowness: Float32  # (N,)
    weight: Float32  # (N,)

    @classmethod
    def of(cls, rows: Float32) -> "_Columns":
        """Return the columns of rows, which share their memory."""
        return cls(rows[:, :2], rows[:, 2:-2], rows[:, -2], rows[:, -1])


def train_prior(new: Float32, older: Prior | None = None, seed: int = 0) -> Prior:
    """Train a prior on the places of a map, and on those of an older prior again.

    Several networks are trained, of which all but the last leave out some places. Their
    errors for the places left out tell how long to train, and by which share to believe
    the predictions; a prior that cannot predict these places is believed by 0. The
    prediction is the log slowness of a place: the logarithm of the time there over that
    at nominal speed.

    Parameters
    ----------
    new
        Places of one map, in the order in which they were first driven: a row for each,
        as in `Prior.replay`.
    older
        A prior whose places are learned again, so that the new prior predicts other
        maps, too. If none of its places lies on this map, and it predicts the new
        places better than the new prior does, it is returned itself.
    seed
        Of all random draws.
    """
    random = np.random.default_rng(as_seed(seed))
    old = new[:0]  # no rows
    if older is not None:
        old = _not_measured_anew(older.replay, new)
    places = _Columns.of(np.concatenate([old, new]))  # N places, first the old ones
    new_places = _Columns.of(new)
    # (F,) for F features, as the scale.
    mean: Float32 = places.features.mean(axis=0)
    scale: Float32 = np.maximum(places.features.std(axis=0), SMALLEST_SCALE)
    # (N, F)
    scaled: Float32 = np.clip((places.features - mean) / scale, -UNUSUAL, UNUSUAL)
    # Other maps may be slower as a whole: this column of inputs learns their level.
    count = len(places.weight)
    is_old = (np.arange(count) < len(old)).astype(np.float32)  # (N,)
    level = np.average(new_places.log_slowness, weights=new_places.weight)
    target = places.log_slowness - level  # (N,)
    weight: Float32 = places.weight / places.weight.mean()  # (N,)
    block = _blocks(count)  # (N,): places in a row are one block
    training = _train(
        np.column_stack([scaled, is_old]),
        target,
        weight,
        left_out=_left_out(block, random),
        seed=seed,
    )
    share = _share_to_believe(block, weight, training.predicted, target)
    if older is not None:
        # If a place of the older prior lies on this map, it was measured anew.
        is_new_map = len(old) == len(older.replay)
        predicted = share * training.predicted[len(old) :]  # of the new places
        predicted_by_older = older.log_slowness(new_places.features)
        error = _error(predicted, new_places)
        if is_new_map and _error(predicted_by_older, new_places) < error:
            return older
    replay = [_some_rows(old, random), _some_rows(new, random)]
    # The prior is the last network, which has learned from all places. Its prediction
    # is the level plus the share of what the two parts of the network predict.
    last = _Weights(*(tensor[-1] for tensor in training.weights))
    arrays = {
        "mean": mean,
        "scale": scale,
        "level": level,
        "direct": share * last.direct[:FEATURES, 0].numpy(),
        "weights_1": last.weights_1,
        "bias_1": last.bias_1[0],
        "weights_2": last.weights_2,
        "bias_2": last.bias_2[0],
        "weights_3": share * last.weights_3[:, 0].numpy(),
        "replay": np.concatenate(replay),
    }
    return Prior(
        **{name: np.asarray(array, np.float32) for name, array in arrays.items()}
    )


def _not_measured_anew(old: Float32, new: Float32) -> Float32:
    """Return the old rows whose place is that of no new row.

    Rows are those of `Prior.replay`. Two rows are of the same place if their positions
    and features are equal: all columns but the last two.
    """
    measured = {place.tobytes() for place in new[:, :-2]}
    is_other_place = [place.tobytes() not in measured for place in old[:, :-2]]
    return old[is_other_place]


def _blocks(count: int) -> NDArray[np.int64]:
    """Return the number of the block of each of `count` places in a row: (count,)."""
    size = np.clip(count // BLOCKS, SMALLEST_BLOCK, LARGEST_BLOCK)
    block: NDArray[np.int64] = np.arange(count) // size
    return block


def _left_out(block: NDArray[np.int64], random: np.random.Generator) -> Float32:
    """Draw the places that each network leaves out: 1 there, else 0, (FOLDS + 1, N).

    `block` (N,) is the number of each place's block. Each block belongs to one of FOLDS
    folds; network k leaves out the places of fold k, and the last network none.
    """
    fold_of_block = random.permutation(block[-1] + 1) % FOLDS
    network = np.arange(FOLDS + 1)
    is_left_out: NDArray[np.bool_] = fold_of_block[block] == network[:, None]
    return is_left_out.astype(np.float32)


def _some_rows(rows: Float32, random: np.random.Generator) -> Float32:
    """Return `REPLAYED` random rows at most, in their order."""
    drawn = random.permutation(len(rows))[:REPLAYED]
    return rows[np.sort(drawn)]


def _share_to_believe(
    block: NDArray[np.int64], weight: Float32, predicted: Float32, target: Float32
) -> float:
    """Return by which share, 0 to 1, to multiply predictions.

    It is the share with which ``share * predicted`` fits the target best by weighted
    least squares, less a part that grows with the standard error of this share; 0 if
    that error is too large. The errors of the places of a block are not independent.

    Parameters
    ----------
    block
        (N,): the number of the block of each place.
    weight
        (N,): how much each place counts.
    predicted, target
        (N,): the log slowness of each place that was predicted, and that was measured.
    """
    # (blocks,): the sums of each block.
    product = np.bincount(block, weight * predicted * target)
    square = np.bincount(block, weight * predicted * predicted)
    total_square = max(square.sum(), MIN_SUM)
    share = product.sum() / total_square
    error_of_block = product - share * square
    standard_error = np.linalg.norm(error_of_block) / total_square
    # With fewer blocks, the standard error is less certain: it counts for more.
    certain_share = max(share * (1 - 2 / len(product)), MIN_SUM)
    doubt = DOUBT * standard_error / certain_share
    believed: float = min(share, 1) * (1 - min(doubt, 1) ** 2)
    return believed


def _error(predicted: Float32, places: _Columns) -> float:
    """Return the weighted squared error of the predicted log slowness (N,) of places.

    An error that all places have in common does not count.
    """
    error = places.log_slowness - predicted
    common_error = np.average(error, weights=places.weight)
    return float(places.weight @ (error - common_error) ** 2)


class _Weights(NamedTuple):
    """The weights of K networks of `Prior`.

    The inputs of a network are F features, and 1 for a place of another map, else 0.
    """

    direct: Tensor  # (K, F + 1, 1)
    weights_1: Tensor  # (K, F, UNITS)
    bias_1: Tensor  # (K, 1, UNITS)
    weights_2: Tensor  # (K, UNITS, UNITS)
    bias_2: Tensor  # (K, 1, UNITS)
    weights_3: Tensor  # (K, UNITS, 1)


class _Training(NamedTuple):
    """The networks after the step with the least error."""

    # (N,): the log slowness of each place, as the network that left it out predicts it
    predicted: Float32
    weights: _Weights


def _train(
    inputs: Float32, target: Float32, weight: Float32, left_out: Float32, seed: int
) -> _Training:
    """Train K networks on N places, and return them as they were at their best step.

    The best step is that with the least error for the places left out.

    Parameters
    ----------
    inputs, target, weight
        (N, I) features, (N,) log slowness, and (N,) how much each place counts.
    left_out
        (K, N): 1 where network k leaves out a place, else 0. Each place is left out by
        one network.
    seed
        Of the first weights.
    """
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
    """Return K networks for the first step: they predict by a ridge regression.

    `x_NI` are the I inputs of N places, `target_N` is their log slowness, and
    `weight_KN` how much each network counts each place. The hidden layers have random
    weights of the `seed`, and add nothing to the prediction before the first step.
    """
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
    for layer in (weights.weights_1, weights.weights_2):  # changed in place
        _, inputs, units = layer.shape
        layer += torch.randn((inputs, units), generator=generator) / inputs**0.5
    # The normal equations of a ridge regression for each network. The last column of
    # the moments is the right side.
    x_and_target = torch.column_stack([x_NI, target_N])  # (N, I + 1)
    moments = torch.einsum("kn,ni,nj->kij", weight_KN, x_NI, x_and_target)
    penalty = RIDGE * torch.eye(FEATURES + 1)
    left_side = moments[..., :-1] + penalty  # (K, I, I)
    direct = torch.linalg.solve(left_side, moments[..., -1:])
    weights.direct.copy_(direct)
    return weights


def _outputs(weights: _Weights, x_KNI: Tensor) -> Tensor:
    """Return the log slowness that K networks predict for N places: (K, N).

    `x_KNI` are the inputs: the features, and at last 1 for a place of another map.
    """
    features = x_KNI[..., :FEATURES]
    first = torch.baddbmm(weights.bias_1, features, weights.weights_1).tanh()
    second = torch.baddbmm(weights.bias_2, first, weights.weights_2).tanh()
    return (x_KNI @ weights.direct + second @ weights.weights_3)[..., 0]
