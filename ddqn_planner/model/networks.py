"""The Q-networks as the planner uses them: trained tensors, evaluated by NumPy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import LENGTHS, MOVES, OCCUPIED, UNKNOWN, Cell, GridMap, MoveRule
from ddqn_planner.model.certificate import MOVE_RULES, Certificate, certify
from ddqn_planner.model.move_costs import (
    MAX_MULTIPLIER,
    VALUES,
    MoveCosts,
    every_patch,
    legal_in_patches,
    unique_patches,
)
from ddqn_planner.robot.body_certificate import BodyCertificate

Array: TypeAlias = NDArray[np.float32]

# Shapes: A = 8 actions, B = a batch, I and O = inputs and outputs of a layer, P = patches, F =
# filters, L = windows of a convolution, K = F * L, U = outputs after it, C = cells, one more for
# what is outside the map.

# A move of at least this probability counts as one that always succeeds: the sigmoid function never
# reaches 1, and its rest must not decide between paths.
CERTAIN = 0.99
NOISE = 0.02  # weights of prices below that count as 0: training leaves some where none belong
BATCH = 2**12  # patches per evaluation: the layers' outputs then fit into a cache

# The paper (section 4) uses four values and does not give them. With ours the robot stands out.
# With a smaller value for the robot, the many obstacles outweigh it and training is less stable.
FREE, OBSTACLE, GOAL, ROBOT = 0.0, -0.1, 1.0, 3.0


class ModelFileError(ValueError):
    """A model file cannot be used; the message says why and what to do."""


class QNetwork:
    """A trained Q-network, of `sizes` and `tensors`: what it says of a map's moves."""

    name: ClassVar[str]  # in model files and hyper-parameters
    size_names: ClassVar[tuple[str, ...]]
    max_size: ClassVar[int] = 4096
    doubles: ClassVar[frozenset[str]] = frozenset()  # tensors that are float64

    def __init__(self, sizes: Mapping[str, int], tensors: Mapping[str, Array]) -> None:
        self.sizes = dict(sizes)
        self.tensors = dict(tensors)

    @classmethod
    def shapes(cls, sizes: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
        """Return the shape of each tensor: the weights and biases of the layers."""
        return {
            f"{layer}.{part}": shape if part == "weight" else shape[:1]
            for layer, shape in cls._layers(sizes).items()
            for part in ("weight", "bias")
        }

    @classmethod
    def _layers(cls, sizes: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
        """Return the shape of each layer's weights."""
        raise NotImplementedError

    def supports(self, shape: tuple[int, int]) -> bool:
        """Say whether the network can plan on maps of shape (H, W)."""
        return True

    def certificate(self, move_rule: MoveRule) -> Certificate | BodyCertificate | None:
        """Return what is proved of its moves; None if they depend on the whole map."""
        return None

    def move_costs(self, grid: GridMap, move_rule: MoveRule) -> MoveCosts | None:
        """Return the costs of a map's moves if proved: the possible ones are the legal ones."""
        return None

    def q_values(self, grid: GridMap, goal: Cell, move_rule: MoveRule) -> Array:
        """Return Q(s, a) of every cell toward one goal, if it does not follow from costs."""
        raise NotImplementedError

    def _layer(self, name: str, input_BI: Array) -> Array:
        """Return the output of a fully connected layer: (B, O)."""
        with np.errstate(
            over="ignore", invalid="ignore"
        ):  # a broken model may overflow
            output_BO: Array = input_BI @ self.tensors[f"{name}.weight"].T
            output_BO += self.tensors[f"{name}.bias"]
        return output_BO


def observation_background(
    occupancy: NDArray[np.bool_], goal: Cell
) -> NDArray[np.float32]:
    """Return the part of the observation that stays the same while the robot moves: (C,)."""
    background = np.where(occupancy, OBSTACLE, FREE).astype(np.float32)
    background[goal[1], goal[0]] = GOAL
    return background.ravel()


class PaperQNetwork(QNetwork):
    """The paper's network (Fig. 3), for maps of its own size: a 3x3 convolution, dense layers."""

    # The paper gives no padding. Without ours of 1, no filter covers the last row and column of a
    # map of even size. Its text can mean a hidden layer of `hidden_units`; 0 is for none.
    name = "paper"
    size_names = ("height", "width", "filters", "hidden_units")

    @classmethod
    def _layers(cls, sizes: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
        height, width, filters, units = (sizes[name] for name in cls.size_names)
        features = filters * ((height + 1) // 2) * ((width + 1) // 2)
        hidden = {"hidden": (units, features)} if units else {}
        last = {"fully_connected": (len(MOVES), units or features)}
        return {"convolution": (filters, 1, 3, 3), **hidden, **last}

    def supports(self, shape: tuple[int, int]) -> bool:
        """Say whether maps of shape (H, W) have the network's size."""
        return shape == (self.sizes["height"], self.sizes["width"])

    def q_values(self, grid: GridMap, goal: Cell, move_rule: MoveRule) -> Array:
        """Evaluate a robot in each cell: Q(s, a) toward one goal, (8, H, W), whatever the rule."""
        # In double precision: differences of large sums stay exact enough, and do not overflow.
        tensors = [
            self.tensors[name].astype(np.float64) for name in self.shapes(self.sizes)
        ]
        kernel_F9, bias_F, layer_UK, layer_bias_U, *last = tensors
        kernel_9F, filters = kernel_F9.reshape(-1, 9).T, len(bias_F)
        cut_L9, cells = window_cells(grid.occupancy.shape), grid.occupancy.size
        layer_LFU = layer_UK.reshape(-1, filters, len(cut_L9)).T.copy()
        shown = np.append(
            observation_background(grid.occupancy, goal), 0.0
        )  # 0 outside the map
        before_LF = shown[cut_L9] @ kernel_9F + bias_F
        after_LF = np.maximum(before_LF, 0)
        output_CU = np.tile(
            layer_bias_U + np.tensordot(after_LF, layer_LFU, 2), (cells + 1, 1)
        )
        # Each window is seen with a robot in each of its cells. What that changes adds up.
        robot_L9F = (ROBOT - shown[cut_L9])[..., None] * kernel_9F
        change_L9F = np.maximum(before_LF[:, None] + robot_L9F, 0) - after_LF[:, None]
        change_9LU = (change_L9F @ layer_LFU).swapaxes(0, 1)
        for cell_L, change_LU in zip(cut_L9.T, change_9LU, strict=True):
            output_CU[cell_L] += change_LU
        if last:
            output_CU = np.maximum(output_CU, 0) @ last[0].T + last[1]
        with np.errstate(over="ignore"):
            q_AC: Array = output_CU[:-1].T.astype(np.float32)
        return q_AC.reshape(-1, *grid.occupancy.shape)


def window_cells(shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return the cells of each window of the convolution, (L, 9), or H * W outside the map."""
    cells = shape[0] * shape[1]
    padded = np.pad(np.arange(cells).reshape(shape), 1, constant_values=cells)
    cut = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))[::2, ::2]
    cell_L9: NDArray[np.int64] = cut.reshape(-1, 9)
    return cell_L9


class PropagationQNetwork(QNetwork):
    """A Q-network for maps of any size: Q(s, a) = p(s, a) (r + γ V(s')) + (1 - p(s, a)) r_o."""

    # Learned is p(s, a), from the 3x3 patch. Related: value iteration networks (VIN, Tamar et al.
    # 2016) learn their reward too, and VProp (Nardelli et al. 2019) how values propagate.
    name = "propagation"
    size_names = ("filters",)
    inputs: ClassVar[int] = 9  # features
    uses_costs: ClassVar[bool] = (
        False  # whether the features tell costs and the move rule
    )

    def __init__(self, sizes: Mapping[str, int], tensors: Mapping[str, Array]) -> None:
        prices = {name: t for name, t in tensors.items() if name.startswith("prices")}
        clear = {name: np.where(np.abs(t) < NOISE, 0, t) for name, t in prices.items()}
        super().__init__(sizes, {**tensors, **clear})
        # What holds for all maps, so that it is computed once: by the rules, and by the arguments
        # of `_proved_costs`. A cache of a bound method would keep the network in a cycle.
        self._certificates: dict[tuple[MoveRule, ...], Certificate] = {}
        self._proved: dict[tuple[MoveRule, bool, bool], MoveCosts | None] = {}

    @classmethod
    def _layers(cls, sizes: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
        filters, outputs = sizes["filters"], len(MOVES)
        layers: dict[str, tuple[int, ...]] = {"convolution": (filters, cls.inputs)}
        layers |= {"hidden": (filters, filters), "moves": (outputs, filters)}
        return {**layers, "prices": (outputs, cls.inputs)} if cls.uses_costs else layers

    @classmethod
    def features(cls, patch_B9: NDArray[np.int8], move_rule: MoveRule) -> Array:
        """Return which cells of patches are occupied, (B, 9), see `patches`.

        Then, with costs, which cells cost what, 0..1, and which are unknown; the rule: (B, 28).
        """
        occupied, unknown = patch_B9 == OCCUPIED, patch_B9 == UNKNOWN
        cost_B9 = np.where(occupied | unknown, 0, patch_B9) / 100
        rule_B1 = np.full((len(patch_B9), 1), move_rule.cuts_corners)
        others = [cost_B9, unknown, rule_B1] if cls.uses_costs else []
        return np.concatenate([occupied, *others], axis=1, dtype=np.float32)

    def success(self, feature_BI: Array) -> Array:
        """Return p(s, a) in 0..1: (B, 8), given features (B, I)."""
        hidden_BF = np.maximum(self._layer("convolution", feature_BI), 0)
        hidden_BF = np.maximum(self._layer("hidden", hidden_BF), 0)
        # The sigmoid function, without overflow.
        p_BA: Array = 0.5 + 0.5 * np.tanh(0.5 * self._layer("moves", hidden_BF))
        return p_BA

    def tries(self, feature_BI: Array) -> Array:
        """Return 1/p, or 1 from `CERTAIN` on; infinite if p is at most 1/2, or NaN: (B, 8)."""
        p_BA = self.success(feature_BI)
        p_BA = np.where(p_BA >= CERTAIN, np.float32(1), p_BA)
        tries_BA: Array = np.where(
            p_BA > 0.5, 1 / np.maximum(p_BA, 0.5), np.float32(np.inf)
        )
        return tries_BA

    def multiplier(self, feature_BI: Array) -> Array:
        """Return the cost multiplier of each move, at least 1: (B, 8), given features (B, I)."""
        if not self.uses_costs:
            return np.ones((len(feature_BI), len(MOVES)), dtype=np.float32)
        multiplier_BA: Array = 1 + np.maximum(self._layer("prices", feature_BI), 0)
        return multiplier_BA

    def certificate(self, move_rule: MoveRule) -> Certificate:
        """Return what is proved of its moves: under all rules, or the one it was trained for."""
        rules = MOVE_RULES if self.uses_costs else (move_rule,)
        if rules not in self._certificates:
            self._certificates[rules] = certify(self, rules)
        return self._certificates[rules]

    def move_costs(self, grid: GridMap, move_rule: MoveRule) -> MoveCosts | None:
        """Return the costs of a map's moves if the possible ones are exactly the legal ones."""
        timed = grid.slowness is not None
        with_costs = self.uses_costs and grid.cost is not None and not timed
        kind = move_rule, with_costs, timed
        if kind not in self._proved:
            self._proved[kind] = self._proved_costs(*kind)
        costs = self._proved[kind]
        return costs and costs.on(grid)

    def _proved_costs(
        self, move_rule: MoveRule, with_costs: bool, timed: bool
    ) -> MoveCosts | None:
        """Return the costs of moves without what depends on the map."""
        patch_P9 = every_patch()
        legal_PA = legal_in_patches(patch_P9, move_rule)
        if with_costs:
            return self._sums_of_prices(move_rule, legal_PA)
        table_PA = self._costs_of(patch_P9, move_rule, timed)
        table_PA[patch_P9[:, 4] == OCCUPIED] = np.inf
        is_right = np.array_equal(np.isfinite(table_PA), legal_PA)
        return MoveCosts.of_table(table_PA) if is_right else None

    def _sums_of_prices(
        self, move_rule: MoveRule, legal_PA: NDArray[np.bool_]
    ) -> MoveCosts | None:
        """Return costs that are sums over the two cells of a move, if they are proved to be."""
        if not self.certificate(move_rule).proved:
            return None
        lengths_PA = np.where(legal_PA, LENGTHS, np.inf).astype(np.float32)
        costs = MoveCosts.of_table(lengths_PA)
        # The layer is linear, so that its output is a sum over the patch's cells.
        weight_AI, bias_A = self.tensors["prices.weight"], self.tensors["prices.bias"]
        occupied_9A, cost_9A, unknown_9A = weight_AI[:, :27].T.reshape(3, 9, -1)
        terms_9AL = np.empty((9, len(MOVES), VALUES), dtype=np.float32)
        terms_9AL[..., 0], terms_9AL[..., -1] = unknown_9A, occupied_9A
        terms_9AL[..., 1:-1] = cost_9A[..., None] * (np.arange(OCCUPIED) / 100)
        terms_9AL[4] += (bias_A + weight_AI[:, 27] * move_rule.cuts_corners)[:, None]
        actions, after = np.arange(len(MOVES)), 4 + MOVES @ [1, 3]
        terms_2AL = np.stack([terms_9AL[4], terms_9AL[after, actions]])
        terms_2AL[..., -1] = terms_2AL[..., -2]  # no move leads there
        terms_9AL[4] = terms_9AL[after, actions] = 0
        greatest = 1 + float(terms_2AL.max(axis=2).sum(axis=0).max())
        if terms_9AL.any() or terms_2AL.min() < 0 or greatest > MAX_MULTIPLIER:
            return None  # what a move costs does not follow from its two cells
        from_on = np.minimum.accumulate(terms_2AL[..., ::-1], axis=2)[..., ::-1]
        low_L = 1 + np.minimum(terms_2AL[..., :1], from_on).sum(axis=0).min(axis=0)
        terms = terms_2AL.ravel() + np.float32(0.5)
        return costs._replace(terms=terms, highest=costs.highest * greatest, low=low_L)

    def believed_costs(self, grid: GridMap, move_rule: MoveRule) -> MoveCosts:
        """Return the costs of a map's moves, right or not: Q is minus the cheapest path's cost."""
        # A move counts as possible where p > 1/2, and is tried until it succeeds. The progress and
        # detour terms of the paper's reward (section 4.2) add up to a constant along a path.
        timed = grid.slowness is not None
        patch_C, patch_P9 = None, every_patch()
        if self.uses_costs and grid.cost is not None and not timed:
            patch_C, patch_P9 = unique_patches(grid.occupancy, grid.cost)
        return MoveCosts.of_table(self._costs_of(patch_P9, move_rule, timed)).on(
            grid, patch_C
        )

    def _costs_of(
        self, patch_P9: NDArray[np.int8], move_rule: MoveRule, timed: bool
    ) -> Array:
        """Return each move's cost, infinite if not possible, or the tries if `timed`: (P, 8)."""
        costs = []
        for batch_B9 in np.split(patch_P9, range(BATCH, len(patch_P9), BATCH)):
            feature_BI = self.features(batch_B9, move_rule)
            multiplier_BA = np.minimum(self.multiplier(feature_BI), MAX_MULTIPLIER)
            cost_BA = LENGTHS * self.tries(feature_BI)
            cost_BA *= 1 if timed else multiplier_BA
            # Comparisons with NaN are false, and NumPy's minimum and maximum keep it.
            costs.append(np.where(multiplier_BA >= 1, cost_BA, np.inf))
        return np.concatenate(costs, dtype=np.float32)


class AnyMapQNetwork(PropagationQNetwork):
    """A propagation network that knows both move rules and learns r(s, a) = -length * m(s, a)."""

    name = "any_map"
    inputs = 28
    uses_costs = True
