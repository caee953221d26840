"""Proves which moves a propagation network takes for possible, for all cell costs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import MAX_COST_MULTIPLIER, MOVES, OCCUPIED, UNKNOWN, MoveRule
from ddqn_planner.model.move_costs import CENTRE, every_patch, legal_in_patches

if TYPE_CHECKING:
    from ddqn_planner.model.networks import PropagationQNetwork

Float32: TypeAlias = NDArray[np.float32]
Float64: TypeAlias = NDArray[np.float64]

# Shapes: P = patterns of occupied cells around a free one, 256 for each rule, A = 8
# actions, F = filters, I = inputs, C = 18 inputs for costs and unknown cells, U =
# outputs of a layer, B = a batch of decisions or patches, V = 101 values of a free
# cell: the costs 0 to 99, and last unknown.

MOVE_RULES: Final = (MoveRule.ROBOT_SAFE, MoveRule.CORNER_CUTTING)
# The inputs of a network that observes costs: whether each cell of the patch is
# occupied (9), its cost, 0 to 0.99 (9), whether it is unknown (9), and the rule (1).
OCCUPIED_INPUTS = slice(0, 9)
COSTS = slice(9, 27)  # the inputs for costs and unknown cells
RULE_INPUTS = slice(27, None)
# The numbers that the planner adds for a multiplier: 28 inputs, a bias, and the 1.
TERMS_OF_MULTIPLIER = COSTS.stop + 3
NO_CERTIFICATE = (
    "nothing can be proved: the moves depend on the whole map, not on 3x3 patches"
)
MAX_FILTERS = 256  # for more, the proof would take seconds, and it is not tried
# The relative error of a float32 operation, and as much for errors in float64.
ROUNDING = 2.0**-23


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
    network: PropagationQNetwork, move_rules: Sequence[MoveRule] = MOVE_RULES
) -> Certificate:
    """Prove which moves a network takes for possible; bound its costs' errors.

    A decision is whether an action is possible in a pattern, that is where certain
    cells of a 3x3 patch are occupied, under a rule. It is proved if it is right for all
    costs of the free cells, and whichever of them are unknown. Decisions under each of
    the `move_rules` are tried.

    Examples
    --------
    >>> from ddqn_planner import Planner
    >>> from ddqn_planner.model.certificate import certify
    >>> certificate = certify(Planner.load("any_map").network)
    >>> certificate.proved, certificate.wrong
    (True, 0)
    """
    # Shapes: N = 512 patches, Q = the N patches of the first rule, then of the next, P
    # = patterns: those of the Q patches whose centre is free. A = 8 actions, I =
    # inputs, 9 = the cells of a patch.
    patch_N9 = every_patch()
    features = [network.features(patch_N9, rule) for rule in move_rules]
    legal_QA = np.concatenate([legal_in_patches(patch_N9, rule) for rule in move_rules])
    is_pattern_Q = np.tile(patch_N9[:, CENTRE] != OCCUPIED, len(move_rules))
    decisions = int(is_pattern_Q.sum()) * len(MOVES)
    if network.sizes["filters"] > MAX_FILTERS:
        return Certificate(decisions, decisions, 0, 0.0, math.inf)
    with np.errstate(over="ignore", invalid="ignore"):  # a broken model may overflow
        # All patches of a rule at once, as in the planner: so the floats are equal.
        tries_QA = np.concatenate([network.tries(inputs) for inputs in features])
        most_tries = float(tries_QA[legal_QA].max())
        feature_PI = np.concatenate(features)[is_pattern_Q]
        legal_PA = legal_QA[is_pattern_Q]
        margins = logit_margins(network, feature_PI, legal_PA)
        is_proved_PA = margins.margin > 0  # False for NaN
        wrong = _count_wrong(network, feature_PI, legal_PA, margins, ~is_proved_PA)
        error = _multiplier_error(network, feature_PI, legal_PA)
    open_decisions = int(np.count_nonzero(~is_proved_PA))
    margin = 0.0
    if is_proved_PA.any():
        margin = float(margins.margin[is_proved_PA].min())
    return Certificate(
        decisions=decisions,
        undecided=open_decisions - wrong,
        wrong=wrong,
        margin=margin,
        multiplier_error=error,
        tries=most_tries,
    )


class Margins(NamedTuple):
    """Lower bounds of the distance of each logit from 0 on its right side.

    A logit is the number of which the network computes an action's probability. It
    should be above 0 for a legal action and below 0 for any other.
    """

    margin: Float64  # (P, A): for all costs and unknown cells; above 0 if proved
    # How much the bound grows with each input for a cost or an unknown cell.
    gain: Float64  # (C, P, A)


def _count_wrong(
    network: PropagationQNetwork,
    feature_PI: Float32,
    legal_PA: NDArray[np.bool_],
    margins: Margins,
    open_PA: NDArray[np.bool_],
) -> int:
    """Return how many open decisions are wrong for the costs of the least margin.

    A decision is whether an action is possible in a pattern of occupied cells. For each
    open one, the network itself decides, with the costs where its bound is worst.
    Shapes: P patterns, A = 8 actions, I inputs, B open decisions, 9 cells of a patch.

    Parameters
    ----------
    network : PropagationQNetwork
    feature_PI : (P, I) float32
        The inputs of each pattern.
    legal_PA : (P, A) bool
        Which actions are legal: these should be possible, and no others.
    margins : Margins
        What each cost or unknown cell adds to the bound of a decision.
    open_PA : (P, A) bool
        The decisions that are not proved; B of them.
    """
    pattern_B, action_B = np.nonzero(open_PA)
    # 1. The costs of the least margin: each free cell has a cost of 0, the greatest
    # cost, or is unknown. A cost of 0 adds nothing to the margin. A network that does
    # not observe costs has gains (0, 9, B): its examples have costs of 0.
    gain_29PA = margins.gain.reshape(-1, 9, *legal_PA.shape)
    gain_29B = gain_29PA[:, :, pattern_B, action_B]
    gain_39B = np.pad(gain_29B, ((1, 0), (0, 0), (0, 0)))
    value_3 = np.array([0, OCCUPIED - 1, UNKNOWN], np.int8)
    worst_B9 = value_3[gain_39B.argmin(axis=0)].T
    # 2. The inputs of a patch with these costs and the pattern's occupied cells, for
    # the pattern's own move rule.
    occupied_B9 = feature_PI[pattern_B, OCCUPIED_INPUTS] > 0
    example_B9 = np.where(occupied_B9, OCCUPIED, worst_B9)
    example_BI = network.features(example_B9, MOVE_RULES[0])
    example_BI[:, RULE_INPUTS] = feature_PI[pattern_B, RULE_INPUTS]
    # 3. The network's decision for it.
    success_BA = network.success(example_BI)
    is_possible_B = success_BA[np.arange(len(action_B)), action_B] > 0.5
    is_legal_B = legal_PA[pattern_B, action_B]
    return int(np.count_nonzero(is_possible_B != is_legal_B))


def logit_margins(
    network: PropagationQNetwork, feature_PI: Float32, legal_PA: NDArray[np.bool_]
) -> Margins:
    """Bound how far each logit is on its right side of 0, for all costs.

    The logit of an action is the number from which the network computes the action's
    probability. It should be above 0 for a legal action, and below 0 for any other.

    Shapes: P patterns of occupied cells, A = 8 actions, F filters, I inputs, C = 18 of
    these for costs and unknown cells.

    Parameters
    ----------
    network : PropagationQNetwork
        Its layers are convolution, hidden and moves, with a ReLU between two layers.
    feature_PI : (P, I) float32
        The inputs of each pattern; those for costs and unknown cells are 0.
    legal_PA : (P, A) bool
        Which actions are legal.

    Returns
    -------
    Margins
        The bounds, (P, A), and how much they grow with each cost, (C, P, A).
    """
    tensors: dict[str, Float64] = {
        name: tensor.astype(np.float64) for name, tensor in network.tensors.items()
    }
    lines_of_convolution, lines_of_hidden = _lines_of_layers(tensors, feature_PI)

    # 1. A lower bound of each logit that is linear in the inputs (CROWN, Zhang et al.
    # 2018). It is computed from the logits back through the layers; at each layer,
    # sign * logit >= bound + weight @ the outputs of the layer's ReLUs. The sign is 1
    # for a legal action.
    sign_AP: Float64 = np.where(legal_PA, 1.0, -1.0).T
    bound_AP: Float64 = sign_AP * tensors["moves.bias"][:, None]
    weight_APF: Float64 = sign_AP[..., None] * tensors["moves.weight"][:, None]
    for layer, lines in (
        ("hidden", lines_of_hidden),
        ("convolution", lines_of_convolution),
    ):
        # Each ReLU is replaced by a line: with a negative weight by the line above it,
        # with a positive weight by the line below.
        bound_AP += (np.minimum(weight_APF, 0) * lines.distance).sum(axis=2)
        weight_APF *= np.where(weight_APF > 0, lines.lower_slope, lines.slope)
        # The lines' inputs are the layer's outputs.
        bound_AP += weight_APF @ tensors[f"{layer}.bias"]
        weight_APF = weight_APF @ tensors[f"{layer}.weight"]
    weight_API = weight_APF  # after the first layer, the weights of the inputs
    bound_AP += (weight_API * feature_PI).sum(axis=2)

    # 2. The least that costs and unknown cells may add, and rounding errors.
    gain_CPA: Float64 = weight_API[..., COSTS].transpose(2, 1, 0)
    least_sum_PA, _ = _extremes(gain_CPA, feature_PI)
    greatest_of_input = [
        ("convolution", np.ones_like(feature_PI[0])),
        ("hidden", lines_of_convolution.greatest),
        ("moves", lines_of_hidden.greatest),
    ]
    rounding_A = _rounding_error(network, greatest_of_input)
    margin_PA = bound_AP.T + least_sum_PA - rounding_A
    return Margins(margin_PA, gain_CPA)


def _lines_of_layers(
    tensors: dict[str, Float64], feature_PI: Float32
) -> tuple[_Lines, _Lines]:
    """Return the lines around the ReLUs of the convolution and of the hidden layer.

    The inputs of a ReLU are bounded by the least and greatest sums for all costs and
    unknown cells. With one slope for both lines around a ReLU, one product gives the
    bounds of the hidden layer (Fast-Lin, Weng et al. 2018).

    Shapes: P patterns of occupied cells, F filters, I inputs, C = 18 of these for costs
    and unknown cells.

    Parameters
    ----------
    tensors : dict of str to float64 array
        The weights (outputs, inputs) and the biases of the network's layers.
    feature_PI : (P, I) float32
        The inputs of each pattern; those for costs and unknown cells are 0.
    """
    # Copies, as products with transposed arrays are slow.
    weight_IF: Float64 = tensors["convolution.weight"].T.copy()
    hidden_FF: Float64 = tensors["hidden.weight"].T.copy()
    # 1. The convolution: its outputs without costs, and what costs may add.
    base_PF: Float64 = feature_PI @ weight_IF + tensors["convolution.bias"]
    least_PF, greatest_PF = _extremes(weight_IF[COSTS, None], feature_PI)
    lines_of_convolution = _Lines(base_PF + least_PF, base_PF + greatest_PF)

    # 2. The hidden layer. A ReLU of the convolution is replaced by its lower line; the
    # upper line, with the same slope, lies above it by `distance`.
    slope_PF = lines_of_convolution.slope
    distance_PF = lines_of_convolution.distance
    base_PF = (slope_PF * base_PF) @ hidden_FF + tensors["hidden.bias"]
    weight_CPF: Float64 = (slope_PF * weight_IF[COSTS, None]) @ hidden_FF
    least_PF, greatest_PF = _extremes(weight_CPF, feature_PI)
    least_PF += distance_PF @ np.minimum(hidden_FF, 0)
    greatest_PF += distance_PF @ np.maximum(hidden_FF, 0)
    lines_of_hidden = _Lines(base_PF + least_PF, base_PF + greatest_PF)
    return lines_of_convolution, lines_of_hidden


class _Lines:
    """Lines around the ReLUs of a layer, whose inputs are bounded.

    The ReLU of x, max(x, 0), lies below the line slope * x + distance. It lies above
    the line slope * x, and also above lower_slope * x, which fits better.
    """

    def __init__(self, least_PF: Float64, greatest_PF: Float64) -> None:
        """Take the least and the greatest input of each of F ReLUs, for P patterns.

        For all inputs x between, max(x, 0) is at most slope * x + distance, and at
        least slope * x and lower_slope * x.
        """
        greatest_output_PF: Float64 = np.maximum(greatest_PF, 0)
        below_0_PF: Float64 = np.minimum(least_PF, 0)  # the part of the inputs below 0
        # If an input may have both signs, the upper line leads from the point (least,
        # 0) to (greatest, greatest). Else it is the ReLU itself: x, or 0. A tiny
        # divisor takes the place of 0 where no input differs from 0.
        width_PF = greatest_output_PF - below_0_PF
        tiny = np.finfo(np.float64).tiny
        self.slope = greatest_output_PF / np.maximum(width_PF, tiny)
        self.distance = -below_0_PF * self.slope
        self.lower_slope = (greatest_PF > -least_PF).astype(np.float64)  # 0 or 1
        # (F,): the greatest output of each ReLU for all patterns.
        self.greatest = greatest_output_PF.max(axis=0).astype(np.float32)


def _extremes(weight_CPU: Float64, feature_PI: Float32) -> tuple[Float64, Float64]:
    """Return the least and the greatest sum that costs and unknown cells may add.

    Both are (P, U), for U outputs of a layer in P patterns of occupied cells.

    Parameters
    ----------
    weight_CPU : (18, P or 1, U)
        The weights of the 9 inputs for costs, 0 to 0.99, then of the 9 that are 1 for
        unknown cells; or (0, ...) for a network without such inputs.
    feature_PI : (P, I) float32
        The inputs of each pattern. The first 9 are 1 for occupied cells.
    """
    cells = len(weight_CPU) // 2  # 9, or 0
    is_free_9P1: Float32 = 1 - feature_PI.T[:cells, :, None]
    weight_29PU = weight_CPU.reshape(2, cells, *weight_CPU.shape[1:])
    # A free cell of a cost adds at most the weight of its cost, an unknown cell the
    # weight for unknown, and a free cell of cost 0 adds 0.
    term_29PU: Float64 = weight_29PU * is_free_9P1
    least_9PU = term_29PU.min(axis=0, initial=0)
    greatest_9PU = term_29PU.max(axis=0, initial=0)
    return least_9PU.sum(axis=0), greatest_9PU.sum(axis=0)


def _multiplier_error(
    network: PropagationQNetwork, feature_PI: Float32, legal_PA: NDArray[np.bool_]
) -> float:
    """Bound the relative error of legal moves' cost multipliers, for all costs.

    The network computes a multiplier as 1 + max(0, sum of weighted inputs). Shapes: P
    patterns, A = 8 actions, I inputs, 2 = the cells before and after a move.

    Parameters
    ----------
    network : PropagationQNetwork
    feature_PI : (P, I) float32
        The inputs of each pattern; those for costs and unknown cells are 0.
    legal_PA : (P, A) bool
        Which actions are legal in each pattern.
    """
    if not network.uses_costs:  # it gives 1 in place of MAX_COST_MULTIPLIER at most
        return 1 - 1 / MAX_COST_MULTIPLIER
    weight_AI = network.tensors["prices.weight"]
    weight_IA: Float64 = weight_AI.T.astype(np.float64, order="C")
    bias_A = network.tensors["prices.bias"].astype(np.float64)
    # 1. Which inputs are those of a move's two cells: of the 3x3 patch, the cell before
    # the move and the cell after it.
    action_A = np.arange(len(MOVES))
    cell_2A = CENTRE + np.outer([0, 1], MOVES @ [1, 3])  # 0 to 8
    cost_input_2A = COSTS.start + cell_2A
    unknown_input_2A = cost_input_2A + 9
    # 2. What the other inputs add: they should add nothing, so their least and greatest
    # sums are enough.
    other_weight_IA: Float64 = weight_IA.copy()
    for input_2A in (cell_2A, cost_input_2A, unknown_input_2A):
        other_weight_IA[input_2A, action_A] = 0
    base_PA: Float64 = feature_PI @ other_weight_IA + bias_A
    least_PA, greatest_PA = _extremes(other_weight_IA[COSTS, None], feature_PI)
    size_A: Float64 = np.abs(other_weight_IA).sum(axis=0) + np.abs(bias_A)
    # 3. For each rule and action, every pair of costs of the two cells is tried.
    errors = [0.0]
    for cuts_corners in (False, True):
        # The last input of a pattern tells the rule.
        is_of_rule_P1: NDArray[np.bool_] = feature_PI[:, -1:] == cuts_corners
        legal_of_rule_PA = legal_PA & is_of_rule_P1
        for action in np.flatnonzero(legal_of_rule_PA.any(axis=0)).tolist():
            is_legal_P = legal_of_rule_PA[:, action]
            other_inputs = _OtherInputs(
                least=float((base_PA + least_PA)[is_legal_P, action].min()),
                greatest=float((base_PA + greatest_PA)[is_legal_P, action].max()),
                sum_of_sizes=float(size_A[action]),
            )
            cost_weight_2 = weight_IA[cost_input_2A[:, action], action]
            unknown_weight_2 = weight_IA[unknown_input_2A[:, action], action]
            errors.append(
                _error_of_pairs(cost_weight_2, unknown_weight_2, other_inputs)
            )
    error = float(np.max(errors))  # NaN if one of them is
    return math.inf if math.isnan(error) else error


class _OtherInputs(NamedTuple):
    """What an action's bias and all inputs except those for its two cells add up to."""

    least: float  # for all legal patterns, costs and unknown cells
    greatest: float
    sum_of_sizes: float  # the sum of the weights' and the bias's absolute values


def _error_of_pairs(
    cost_weight_2: Float64, unknown_weight_2: Float64, other_inputs: _OtherInputs
) -> float:
    """Bound the relative error of an action's multiplier, for all pairs of cell values.

    A move leads from a cell before to a cell after it. Each of the two is free with a
    cost of 0 to 99, or unknown: V = 101 values. The multiplier should be 1 for two
    cells of cost 0 and grow with their mean cost, where unknown counts like 100.

    Parameters
    ----------
    cost_weight_2 : (2,)
        The weights of the inputs for the costs of the cell before and the cell after.
        The input for a cost of 0 to 99 is a hundredth of the cost.
    unknown_weight_2 : (2,)
        The weights of the inputs that are 1 if the cell before, or after, is unknown.
    other_inputs : _OtherInputs
        The least and the greatest sum of all that is added for other inputs, and the
        sum of the absolute values of their weights.
    """
    # 1. The true multipliers, by the value of the cell before and of the cell after.
    share_V = _terms_of_values(1.0, 1.0)  # of the greatest surcharge, 0 to 1
    mean_share_VV = (share_V[:, None] + share_V) / 2
    true_VV = 1 + (MAX_COST_MULTIPLIER - 1) * mean_share_VV

    # 2. The network's multipliers, 1 plus a surcharge of 0 or more, lie between bounds.
    # By how much the upper bound is too high, and the lower bound too low.
    before_V = _terms_of_values(cost_weight_2[0], unknown_weight_2[0])
    after_V = _terms_of_values(cost_weight_2[1], unknown_weight_2[1])
    sum_VV = before_V[:, None] + after_V
    greatest_VV = 1 + np.maximum(sum_VV + other_inputs.greatest, 0)
    least_surcharge_VV = np.maximum(sum_VV + other_inputs.least, 0)
    excess_VV = greatest_VV - true_VV
    shortfall_VV = (true_VV - 1) - least_surcharge_VV

    # 3. The planner adds the terms and the 1 in float32, with an error each time.
    size_of_pair_VV = 1 + np.abs(before_V)[:, None] + np.abs(after_V)
    size_VV = size_of_pair_VV + other_inputs.sum_of_sizes
    rounding_VV = TERMS_OF_MULTIPLIER * ROUNDING * size_VV
    error_VV = (np.maximum(excess_VV, shortfall_VV) + rounding_VV) / true_VV
    return float(error_VV.max())


def _terms_of_values(cost_weight: float, unknown_weight: float) -> Float64:
    """Return what a free cell adds to a sum, for costs 0 to 99, then unknown: (V,)."""
    share_of_costs = np.arange(OCCUPIED) / OCCUPIED
    return np.append(cost_weight * share_of_costs, unknown_weight)


def _rounding_error(
    network: PropagationQNetwork, greatest_of_input: Sequence[tuple[str, Float32]]
) -> Float32:
    """Bound the float32 rounding errors of the outputs of the last layer: (U,).

    Parameters
    ----------
    network : PropagationQNetwork
        Has a layer of I inputs and U outputs for each of the names.
    greatest_of_input : sequence of (str, (I,) float32)
        The names of the layers, from the first one on, and the greatest value of each
        input of the layer. A layer's outputs, through ReLUs, are the inputs of the
        next.
    """
    # In float32, too: so the bound is infinite where the layers may overflow.
    _, greatest_of_first_layer_I = greatest_of_input[0]
    error_I = np.zeros_like(greatest_of_first_layer_I)  # the first inputs are exact
    for layer, greatest_I in greatest_of_input:
        weight_UI = np.abs(network.tensors[f"{layer}.weight"])
        bias_U = np.abs(network.tensors[f"{layer}.bias"])
        inherited_U = weight_UI @ error_I
        size_U = weight_UI @ greatest_I + inherited_U + bias_U
        # The greatest multiplier stands for all that is done with the last output.
        size_U += MAX_COST_MULTIPLIER
        terms = weight_UI.shape[1] + 2  # of the sum of each output
        error_U = inherited_U + terms * ROUNDING * size_U
        error_I = error_U  # the outputs are the inputs of the next layer
    return error_I
