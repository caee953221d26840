"""Proves which moves a propagation network takes for possible, whatever the cells cost."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import MAX_COST_MULTIPLIER, MOVES, OCCUPIED, UNKNOWN, MoveRule
from ddqn_planner.model.move_costs import every_patch, legal_in_patches

if TYPE_CHECKING:
    from ddqn_planner.model.networks import PropagationQNetwork

Float64: TypeAlias = NDArray[np.float64]

# Shapes: P = 256 patterns of occupied cells around a free one, A = 8 actions, F = filters,
# I = inputs, C = 18 inputs for costs and unknown cells, U = outputs of a layer, B = a batch,
# V = 101 values of a free cell: the costs 0 to 99, and last unknown.

MOVE_RULES: Final = (MoveRule.ROBOT_SAFE, MoveRule.CORNER_CUTTING)
CENTRE = 4  # the robot's cell in a patch
COSTS = slice(9, 27)  # the inputs for costs and unknown cells
NO_CERTIFICATE = (
    "nothing can be proved: the moves depend on the whole map, not on 3x3 patches"
)
MAX_FILTERS = 256  # for more, the proof would take seconds, and it is not tried
ROUNDING = (
    2.0**-23
)  # a float32 operation's relative error, and as much for errors in float64


@dataclass(frozen=True)
class Certificate:
    """What is proved about a network, for all costs and unknown cells."""

    decisions: int  # whether an action is possible in a pattern under a rule: how many there are
    undecided: int  # those that are neither proved nor known to be wrong
    wrong: int  # those that some known costs make wrong
    margin: float  # least proved distance of a right decision's logit from 0; 0 if none is right
    multiplier_error: (
        float  # bound on the relative error of legal moves' learned cost multipliers
    )
    tries: float = (
        1.0  # the most that a legal move is expected to take: 1/p, or 1 if certain
    )

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
        """Bound on the cost of a planned path over the optimum, minus 1; infinite if not proved."""
        if not self.proved or self.multiplier_error >= 1:
            return math.inf
        # Each move, so each path, has a learned cost of 1 - e to (1 + e) tries of its true cost.
        return (1 + self.cost_error) / (1 - self.multiplier_error) - 1

    def __str__(self) -> str:
        if not self.proved:
            text = f"not proved: {self.undecided:,} of {self.decisions:,} decisions are open, "
            return f"{text}{self.wrong:,} are wrong"
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
    """Prove what a network takes for possible under some rules, and bound its costs' errors."""
    every_P9 = every_patch()
    features = [network.features(every_P9, rule) for rule in move_rules]
    legal_PA = np.concatenate([legal_in_patches(every_P9, rule) for rule in move_rules])
    is_free_P = np.tile(every_P9[:, CENTRE] != OCCUPIED, len(move_rules))
    decisions = int(is_free_P.sum()) * len(MOVES)
    if network.sizes["filters"] > MAX_FILTERS:
        return Certificate(decisions, decisions, 0, 0.0, math.inf)
    with np.errstate(over="ignore", invalid="ignore"):  # a broken model may overflow
        # Of all patches at once, as the planner does it: the same floats.
        tries = float(np.concatenate([*map(network.tries, features)])[legal_PA].max())
        feature_PI, legal_PA = np.concatenate(features)[is_free_P], legal_PA[is_free_P]
        margin_PA, weight_CPA = _margins(network, feature_PI, legal_PA)
        right_PA = margin_PA > 0  # False for NaN
        pattern, action = np.nonzero(~right_PA)
        # The costs that make their bounded function least: for each free cell 0, 99 or unknown.
        gain_K9B = weight_CPA.reshape(-1, 9, *legal_PA.shape)[:, :, pattern, action]
        gain_K9B = np.pad(gain_K9B, ((1, 0), (0, 0), (0, 0)))
        worst_B9 = np.array([0, OCCUPIED - 1, UNKNOWN], np.int8)[
            gain_K9B.argmin(axis=0)
        ].T
        example_B9 = np.where(feature_PI[pattern, :9] > 0, OCCUPIED, worst_B9)
        example_BI = network.features(example_B9, move_rules[0])
        example_BI[:, 27:] = feature_PI[pattern, 27:]  # the rule
        possible_B = network.success(example_BI)[np.arange(len(action)), action] > 0.5
        wrong = int(np.count_nonzero(possible_B != legal_PA[pattern, action]))
        error = _multiplier_error(network, feature_PI, legal_PA)
    margin = float(margin_PA[right_PA].min()) if right_PA.any() else 0.0
    return Certificate(decisions, len(action) - wrong, wrong, margin, error, tries)


def _margins(
    network: PropagationQNetwork,
    feature_PI: NDArray[np.float32],
    legal_PA: NDArray[np.bool_],
) -> tuple[Float64, Float64]:
    """Bound how far on its right side of 0 each logit is, (P, A), and its gains by C: (C, P, A)."""
    # Two lines enclose a ReLU, so two linear functions a logit (CROWN, Zhang et al. 2018). With one
    # slope for both, one product gives the bounds of a hidden layer (Fast-Lin, Weng et al. 2018).
    tensors = {
        name: tensor.astype(np.float64) for name, tensor in network.tensors.items()
    }
    # Copies, as arrays in another order than the rest are slow.
    weight_IF, hidden_FF = (
        tensors["convolution.weight"].T.copy(),
        tensors["hidden.weight"].T.copy(),
    )
    base_PF = feature_PI @ weight_IF + tensors["convolution.bias"]
    low_PF, high_PF = _extremes(weight_IF[COSTS, None], feature_PI)
    first = _Lines(base_PF + low_PF, base_PF + high_PF)

    # With the upper line's slope for both lines, only their distance differs.
    base_PF = (first.slope * base_PF) @ hidden_FF + tensors["hidden.bias"]
    low_PF, high_PF = _extremes(
        (first.slope * weight_IF[COSTS, None]) @ hidden_FF, feature_PI
    )
    low_PF += first.distance @ np.minimum(hidden_FF, 0)
    high_PF += first.distance @ np.maximum(hidden_FF, 0)
    second = _Lines(base_PF + low_PF, base_PF + high_PF)

    # Back from the logits: what a positive weight multiplies is at least its lower line.
    sign_AP = np.where(legal_PA, 1.0, -1.0).T
    bound_AP = sign_AP * tensors["moves.bias"][:, None]
    weight_APF = sign_AP[..., None] * tensors["moves.weight"][:, None]
    for layer, lines in (("hidden", second), ("convolution", first)):
        bound_AP += (np.minimum(weight_APF, 0) * lines.distance).sum(axis=2)
        weight_APF *= np.where(weight_APF > 0, lines.lower_slope, lines.slope)
        bound_AP += weight_APF @ tensors[f"{layer}.bias"]
        weight_APF = weight_APF @ tensors[f"{layer}.weight"]
    bound_AP += (weight_APF * feature_PI).sum(axis=2)
    weight_CPA = weight_APF[..., COSTS].transpose(2, 1, 0)
    low_PA, _ = _extremes(weight_CPA, feature_PI)
    ones_I = np.ones_like(feature_PI[0])
    layers = [
        ("convolution", ones_I),
        ("hidden", first.greatest),
        ("moves", second.greatest),
    ]
    return bound_AP.T + low_PA - _rounding_error(network, layers), weight_CPA


class _Lines:
    """Lines around ReLUs of bounded inputs: slope * x + distance above, slope * x below."""

    def __init__(self, low_PF: Float64, high_PF: Float64) -> None:
        above, below = np.maximum(high_PF, 0), np.minimum(low_PF, 0)
        self.slope = above / np.maximum(above - below, np.finfo(np.float64).tiny)
        self.distance = -below * self.slope
        # Below it lies this line too, of slope 0 or 1: whichever is nearer to the ReLU.
        self.lower_slope = (high_PF > -low_PF).astype(np.float64)
        self.greatest = above.max(axis=0).astype(np.float32)


def _extremes(
    weight_CPU: Float64, feature_PI: NDArray[np.float32]
) -> tuple[Float64, Float64]:
    """Return the least and greatest sums, (P, U), of costs and unknown cells with weights."""
    # A free cell has a cost of 0 to 1, or it is unknown.
    cells = len(weight_CPU) // 2
    choice_29PU = weight_CPU.reshape(2, cells, *weight_CPU.shape[1:])
    choice_29PU = choice_29PU * (1 - feature_PI.T[:cells, :, None])
    low_9PU, high_9PU = (
        choice_29PU.min(axis=0, initial=0),
        choice_29PU.max(axis=0, initial=0),
    )
    return low_9PU.sum(axis=0), high_9PU.sum(axis=0)


def _multiplier_error(
    network: PropagationQNetwork,
    feature_PI: NDArray[np.float32],
    legal_PA: NDArray[np.bool_],
) -> float:
    """Return the greatest relative error of legal moves' cost multipliers, over all costs."""
    if not network.uses_costs:  # 1 instead of at most the greatest one
        return 1 - 1 / MAX_COST_MULTIPLIER
    weight_IA = network.tensors["prices.weight"].T.astype(np.float64, order="C")
    bias_A = network.tensors["prices.bias"].astype(np.float64)
    # Every pair of costs of a move's two cells is looked at. What the layer adds for other inputs
    # should be nothing: their least and greatest sums are enough.
    actions, cell_2A = np.arange(len(MOVES)), CENTRE + np.outer([0, 1], MOVES @ [1, 3])
    cost_2A, unknown_2A = COSTS.start + cell_2A, COSTS.start + 9 + cell_2A
    other_IA = weight_IA.copy()
    for input_2A in (cell_2A, cost_2A, unknown_2A):
        other_IA[input_2A, actions] = 0
    base_PA = feature_PI @ other_IA + bias_A
    low_PA, high_PA = _extremes(other_IA[COSTS, None], feature_PI)
    size_A = np.abs(other_IA).sum(axis=0) + np.abs(bias_A)
    error = 0.0
    for cuts_corners in (False, True):
        legal_of_rule_PA = legal_PA & (feature_PI[:, -1:] == cuts_corners)
        for action in np.flatnonzero(legal_of_rule_PA.any(axis=0)):
            pattern = legal_of_rule_PA[:, action]
            others = _Others(
                low=float((base_PA + low_PA)[pattern, action].min()),
                high=float((base_PA + high_PA)[pattern, action].max()),
                size=float(size_A[action]),
            )
            cost_2 = weight_IA[cost_2A[:, action], action]
            unknown_2 = weight_IA[unknown_2A[:, action], action]
            error = float(np.maximum(error, _error_of_pairs(cost_2, unknown_2, others)))
    return math.inf if math.isnan(error) else error


class _Others(NamedTuple):
    """What the layer of cost multipliers adds for other inputs than the costs of a move's cells."""

    low: float
    high: float
    size: float  # the greatest sum of the terms' sizes


def _error_of_pairs(cost_2: Float64, unknown_2: Float64, others: _Others) -> float:
    """Return the greatest relative error of a multiplier for all 101 x 101 values of two cells.

    The arguments are the weights of the two cells' costs, 0 to 0.99, and of unknown cells.
    """
    share_V = np.append(
        np.arange(OCCUPIED) / OCCUPIED, 1.0
    )  # the last one is of an unknown cell
    before_V, after_V = np.column_stack([cost_2[:, None] * share_V[:-1], unknown_2])
    sum_VV = before_V[:, None] + after_V
    true_VV = 1 + (MAX_COST_MULTIPLIER - 1) * (share_V[:, None] + share_V) / 2
    above_VV = 1 + np.maximum(sum_VV + others.high, 0) - true_VV
    below_VV = true_VV - 1 - np.maximum(sum_VV + others.low, 0)
    # The planner adds them up in float32, and halves of the 1 with them.
    size_VV = 1 + np.abs(before_V)[:, None] + np.abs(after_V) + others.size
    rounding_VV = (COSTS.stop + 3) * ROUNDING * size_VV
    return float(((np.maximum(above_VV, below_VV) + rounding_VV) / true_VV).max())


def _rounding_error(
    network: PropagationQNetwork, layers: Sequence[tuple[str, NDArray[np.float32]]]
) -> NDArray[np.float32]:
    """Bound the rounding errors of layers in float32, given their greatest inputs: (U,) float32."""
    # In float32 too the bound is infinite where the layers may overflow.
    error_U = np.zeros_like(layers[0][1])
    for layer, greatest_I in layers:
        weight_UI = np.abs(network.tensors[f"{layer}.weight"])
        inherited_U = weight_UI @ error_U
        sum_U = (
            weight_UI @ greatest_I
            + inherited_U
            + np.abs(network.tensors[f"{layer}.bias"])
        )
        # The greatest multiplier stands for what is done with the last layer's output.
        sum_U += MAX_COST_MULTIPLIER
        error_U = inherited_U + (weight_UI.shape[1] + 2) * ROUNDING * sum_U
    return error_U
