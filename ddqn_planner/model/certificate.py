"""Proves which moves a propagation network takes for possible, for all cell costs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import MAX_COST_MULTIPLIER, MOVES, OCCUPIED, UNKNOWN, MoveRule
from ddqn_planner.model.move_costs import CENTRE, every_patch, legal_in_patches

Float32: TypeAlias = NDArray[np.float32]
Float64: TypeAlias = NDArray[np.float64]

# Shapes: P = patterns of occupied cells around a free one, 256 for each rule, A = 8
# actions, F = filters, I = inputs, C = 18 inputs for costs and unknown cells, U =
# outputs of a layer, B = a batch, V = 101 values of a free cell: the costs 0 to 99, and
# last unknown.

MOVE_RULES: Final = (MoveRule.ROBOT_SAFE, MoveRule.CORNER_CUTTING)
COSTS = slice(9, 27)  # the inputs for costs and unknown cells
NO_CERTIFICATE = (
    "nothing can be proved: the moves depend on the whole map, not on 3x3 patches"
)
MAX_FILTERS = 256  # for more, the proof would take seconds, and it is not tried
# The relative error of a float32 operation, and as much for errors in float64.
ROUNDING = 2.0**-23


class PatchNetwork(Protocol):
    """A network whose moves follow from 3x3 patches, see `PropagationQNetwork`."""

    uses_costs: ClassVar[bool]
    sizes: dict[str, int]
    tensors: dict[str, Float32]

    @classmethod
    def features(cls, patch_B9: NDArray[np.int8], move_rule: MoveRule) -> Float32:
        """Return the inputs for patches: (B, I)."""

    def success(self, feature_BI: Float32) -> Float32:
        """Return p(s, a): (B, A)."""

    def tries(self, feature_BI: Float32) -> Float32:
        """Return how often a move is tried: (B, A)."""


@dataclass(frozen=True)
class Certificate:
    """What is proved about a network, for all costs and unknown cells."""

    # A decision is whether an action is possible in a pattern under a rule.
    decisions: int  # all of them
    undecided: int  # decisions neither proved nor known to be wrong
    wrong: int  # decisions that are wrong for some known costs
    # The least proved distance of a right decision's logit from 0; 0 if none is right.
    margin: float
    # A bound on the relative error of the learned cost multipliers of legal moves.
    multiplier_error: float
    # The most tries that a legal move is expected to take: 1/p, or 1 if it is certain.
    tries: float = 1.0

    @property
    def proved(self) -> bool:
        """Whether all decisions are right."""
        return self.undecided == self.wrong == 0 and math.isfinite(
            self.multiplier_error
        )

    @property
    def cost_error(self) -> float:
        """Bound on the relative error of the learned costs of legal moves."""
        return (1 + self.multiplier_error) * self.tries - 1

    @property
    def path_error(self) -> float:
        """Bound on the cost of a planned path over the optimum, minus 1.

        It is infinite if nothing is proved.
        """
        if not self.proved or self.multiplier_error >= 1:
            return math.inf
        # Each move, and so each path, has a learned cost of (1 - error) to
        # (1 + error) * tries of its true cost.
        return (1 + self.cost_error) / (1 - self.multiplier_error) - 1

    def __str__(self) -> str:
        if not self.proved:
            decisions = f"{self.undecided:,} of {self.decisions:,} decisions are open"
            return f"not proved: {decisions}, {self.wrong:,} are wrong"
        text = f"proved: all {self.decisions:,} decisions, margin {self.margin:.1f}"
        if math.isinf(self.path_error):
            return text
        costs, paths = _percent(self.cost_error), _percent(self.path_error)
        return f"{text}; costs within {costs}, so paths within {paths} of the optimum"


def _percent(error: float) -> str:
    """Return a bound in percent, rounded up."""
    return f"{math.ceil(error * 1e4) / 100:g} %"


def certify(
    network: PatchNetwork, move_rules: Sequence[MoveRule] = MOVE_RULES
) -> Certificate:
    """Prove which moves a network takes for possible; bound its costs' errors."""
    every_P9 = every_patch()
    features = [network.features(every_P9, rule) for rule in move_rules]
    legal_PA = np.concatenate([legal_in_patches(every_P9, rule) for rule in move_rules])
    is_free_P = np.tile(every_P9[:, CENTRE] != OCCUPIED, len(move_rules))
    decisions = int(is_free_P.sum()) * len(MOVES)
    if network.sizes["filters"] > MAX_FILTERS:
        return Certificate(decisions, decisions, 0, 0.0, math.inf)
    with np.errstate(over="ignore", invalid="ignore"):  # a broken model may overflow
        # Of all patches of a rule at once, as in the planner: so the floats are equal.
        tries_PA = np.concatenate([network.tries(inputs) for inputs in features])
        tries = float(tries_PA[legal_PA].max())
        feature_PI = np.concatenate(features)[is_free_P]
        legal_PA = legal_PA[is_free_P]
        margins = logit_margins(network, feature_PI, legal_PA)
        right_PA = margins.margin > 0  # False for NaN
        wrong = _count_wrong(network, feature_PI, legal_PA, margins, ~right_PA)
        error = _multiplier_error(network, feature_PI, legal_PA)
    open_decisions = int(np.count_nonzero(~right_PA))
    margin = float(margins.margin[right_PA].min()) if right_PA.any() else 0.0
    return Certificate(
        decisions=decisions,
        undecided=open_decisions - wrong,
        wrong=wrong,
        margin=margin,
        multiplier_error=error,
        tries=tries,
    )


class Margins(NamedTuple):
    """How far each logit is on its right side of 0, at least, for all costs."""

    margin: Float64  # (P, A)
    # How much the bound grows with each cost and unknown cell, of which it is a sum.
    gain: Float64  # (C, P, A)


def _count_wrong(
    network: PatchNetwork,
    feature_PI: Float32,
    legal_PA: NDArray[np.bool_],
    margins: Margins,
    open_PA: NDArray[np.bool_],
) -> int:
    """Return how many open decisions are wrong for the costs of the least margin."""
    pattern_B, action_B = np.nonzero(open_PA)
    # The margin is least where each free cell has the cost 0, the greatest cost, or is
    # unknown.
    gain_29B = margins.gain.reshape(-1, 9, *legal_PA.shape)[:, :, pattern_B, action_B]
    gain_39B = np.pad(gain_29B, ((1, 0), (0, 0), (0, 0)))  # a cost of 0 adds nothing
    value_3 = np.array([0, OCCUPIED - 1, UNKNOWN], np.int8)
    worst_B9 = value_3[gain_39B.argmin(axis=0)].T
    occupied_B9 = feature_PI[pattern_B, :9] > 0
    example_B9 = np.where(occupied_B9, OCCUPIED, worst_B9)
    example_BI = network.features(example_B9, MOVE_RULES[0])
    example_BI[:, 27:] = feature_PI[pattern_B, 27:]  # the rule of the pattern
    success_BA = network.success(example_BI)
    possible_B = success_BA[np.arange(len(action_B)), action_B] > 0.5
    return int(np.count_nonzero(possible_B != legal_PA[pattern_B, action_B]))


def logit_margins(
    network: PatchNetwork, feature_PI: Float32, legal_PA: NDArray[np.bool_]
) -> Margins:
    """Bound how far each logit is on its right side of 0."""
    # Two lines enclose a ReLU, so two linear functions enclose a logit (CROWN, Zhang et
    # al. 2018). With one slope for both lines, one product gives the bounds of a hidden
    # layer (Fast-Lin, Weng et al. 2018).
    tensors = {
        name: tensor.astype(np.float64) for name, tensor in network.tensors.items()
    }
    # Copies, as arrays in another order than the rest are slow.
    weight_IF = tensors["convolution.weight"].T.copy()
    hidden_FF = tensors["hidden.weight"].T.copy()
    base_PF = feature_PI @ weight_IF + tensors["convolution.bias"]
    low_PF, high_PF = _extremes(weight_IF[COSTS, None], feature_PI)
    first = _Lines(base_PF + low_PF, base_PF + high_PF)

    # With the upper line's slope for both lines, only their distance differs.
    base_PF = (first.slope * base_PF) @ hidden_FF + tensors["hidden.bias"]
    weight_CPF = (first.slope * weight_IF[COSTS, None]) @ hidden_FF
    low_PF, high_PF = _extremes(weight_CPF, feature_PI)
    low_PF += first.distance @ np.minimum(hidden_FF, 0)
    high_PF += first.distance @ np.maximum(hidden_FF, 0)
    second = _Lines(base_PF + low_PF, base_PF + high_PF)

    # Back from the logits, each with its right sign: a positive weight multiplies at
    # least its lower line.
    sign_AP = np.where(legal_PA, 1.0, -1.0).T
    bound_AP = sign_AP * tensors["moves.bias"][:, None]
    weight_APF = sign_AP[..., None] * tensors["moves.weight"][:, None]
    for layer, lines in (("hidden", second), ("convolution", first)):
        bound_AP += (np.minimum(weight_APF, 0) * lines.distance).sum(axis=2)
        weight_APF *= np.where(weight_APF > 0, lines.lower_slope, lines.slope)
        bound_AP += weight_APF @ tensors[f"{layer}.bias"]
        weight_APF = weight_APF @ tensors[f"{layer}.weight"]
    weight_API = weight_APF  # after the first layer, by inputs
    bound_AP += (weight_API * feature_PI).sum(axis=2)
    gain_CPA = weight_API[..., COSTS].transpose(2, 1, 0)
    low_PA, _ = _extremes(gain_CPA, feature_PI)
    greatest_of_input = [
        ("convolution", np.ones_like(feature_PI[0])),
        ("hidden", first.greatest),
        ("moves", second.greatest),
    ]
    rounding_A = _rounding_error(network, greatest_of_input)
    return Margins(bound_AP.T + low_PA - rounding_A, gain_CPA)


class _Lines:
    """Lines around ReLUs of bounded inputs.

    Above a ReLU lies slope * x + distance, and below it slope * x.
    """

    def __init__(self, low_PF: Float64, high_PF: Float64) -> None:
        above = np.maximum(high_PF, 0)
        below = np.minimum(low_PF, 0)
        self.slope = above / np.maximum(above - below, np.finfo(np.float64).tiny)
        self.distance = -below * self.slope
        # Below the ReLU lies this line, too: its slope is 0 or 1, as fits better.
        self.lower_slope = (high_PF > -low_PF).astype(np.float64)
        self.greatest = above.max(axis=0).astype(np.float32)


def _extremes(
    weight_CPU: Float64, feature_PI: NDArray[np.float32]
) -> tuple[Float64, Float64]:
    """Return the least and greatest weighted sums of costs and unknowns: (P, U)."""
    # A free cell has a cost of 0 to 1, or it is unknown.
    cells = len(weight_CPU) // 2
    choice_29PU = weight_CPU.reshape(2, cells, *weight_CPU.shape[1:])
    choice_29PU = choice_29PU * (1 - feature_PI.T[:cells, :, None])
    low_9PU = choice_29PU.min(axis=0, initial=0)
    high_9PU = choice_29PU.max(axis=0, initial=0)
    return low_9PU.sum(axis=0), high_9PU.sum(axis=0)


def _multiplier_error(
    network: PatchNetwork, feature_PI: Float32, legal_PA: NDArray[np.bool_]
) -> float:
    """Return the greatest relative error of legal moves' cost multipliers.

    All costs of cells count.
    """
    if not network.uses_costs:  # 1 instead of at most the greatest multiplier
        return 1 - 1 / MAX_COST_MULTIPLIER
    weight_IA = network.tensors["prices.weight"].T.astype(np.float64, order="C")
    bias_A = network.tensors["prices.bias"].astype(np.float64)
    # Every pair of costs of a move's two cells is tried. The layer should add nothing
    # for the other inputs: their least and greatest sums are enough.
    action_A = np.arange(len(MOVES))
    cell_2A = CENTRE + np.outer([0, 1], MOVES @ [1, 3])  # of the patch
    cost_2A = COSTS.start + cell_2A
    unknown_2A = cost_2A + 9
    other_IA = weight_IA.copy()
    for input_2A in (cell_2A, cost_2A, unknown_2A):
        other_IA[input_2A, action_A] = 0
    base_PA = feature_PI @ other_IA + bias_A
    low_PA, high_PA = _extremes(other_IA[COSTS, None], feature_PI)
    size_A = np.abs(other_IA).sum(axis=0) + np.abs(bias_A)
    errors = [0.0]
    for cuts_corners in (False, True):
        legal_of_rule_PA = legal_PA & (feature_PI[:, -1:] == cuts_corners)
        for action in np.flatnonzero(legal_of_rule_PA.any(axis=0)):
            legal_P = legal_of_rule_PA[:, action]
            other_inputs = _OtherInputs(
                low=float((base_PA + low_PA)[legal_P, action].min()),
                high=float((base_PA + high_PA)[legal_P, action].max()),
                size=float(size_A[action]),
            )
            cost_2 = weight_IA[cost_2A[:, action], action]
            unknown_2 = weight_IA[unknown_2A[:, action], action]
            errors.append(_error_of_pairs(cost_2, unknown_2, other_inputs))
    error = float(np.max(errors))  # NaN if one of them is
    return math.inf if math.isnan(error) else error


class _OtherInputs(NamedTuple):
    """The sum that the layer of multipliers adds for all but the move's two costs."""

    low: float
    high: float
    size: float  # the greatest sum of the terms' sizes


def _error_of_pairs(
    cost_2: Float64, unknown_2: Float64, other_inputs: _OtherInputs
) -> float:
    """Return the greatest relative error of a multiplier for all values of two cells.

    Parameters
    ----------
    cost_2 : (2,)
        The weights of the inputs for the costs of the cell before a move and of the cell
        after it. These inputs are 0 to 0.99.
    unknown_2 : (2,)
        The weights of the inputs that say that the cell before, or after, is unknown.
    other_inputs : _OtherInputs
        The least and the greatest sum of all other inputs, and of their sizes.
    """
    # (V,), V values of a cell: the costs 0 to 0.99, and last unknown, which costs most.
    share_V = np.append(np.arange(OCCUPIED) / OCCUPIED, 1.0)
    before_V = np.append(cost_2[0] * share_V[:-1], unknown_2[0])
    after_V = np.append(cost_2[1] * share_V[:-1], unknown_2[1])
    sum_VV = before_V[:, None] + after_V
    mean_share_VV = (share_V[:, None] + share_V) / 2
    true_VV = 1 + (MAX_COST_MULTIPLIER - 1) * mean_share_VV
    above_VV = 1 + np.maximum(sum_VV + other_inputs.high, 0) - true_VV
    below_VV = true_VV - 1 - np.maximum(sum_VV + other_inputs.low, 0)
    # The planner adds them up in float32, and halves of the 1 with them.
    size_VV = 1 + np.abs(before_V)[:, None] + np.abs(after_V) + other_inputs.size
    rounding_VV = (COSTS.stop + 3) * ROUNDING * size_VV
    error_VV = (np.maximum(above_VV, below_VV) + rounding_VV) / true_VV
    return float(error_VV.max())


def _rounding_error(
    network: PatchNetwork, greatest_of_input: Sequence[tuple[str, Float32]]
) -> Float32:
    """Bound the errors of layers that are computed in float32: (U,).

    Parameters
    ----------
    network : PatchNetwork
    greatest_of_input : sequence of (str, (I,))
        The layers in their order, and how great each of their inputs is at most.
    """
    # In float32, too: so the bound is infinite where the layers may overflow.
    _, first_I = greatest_of_input[0]
    error_U = np.zeros_like(first_I)
    for layer, greatest_I in greatest_of_input:
        weight_UI = np.abs(network.tensors[f"{layer}.weight"])
        inherited_U = weight_UI @ error_U
        bias_U = np.abs(network.tensors[f"{layer}.bias"])
        sum_U = weight_UI @ greatest_I + inherited_U + bias_U
        # The greatest multiplier stands for all that is done with the last output.
        sum_U += MAX_COST_MULTIPLIER
        error_U = inherited_U + (weight_UI.shape[1] + 2) * ROUNDING * sum_U
    return error_U
