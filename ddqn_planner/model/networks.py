"""The Q-networks as the planner uses them: trained tensors, evaluated by NumPy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import LENGTHS, MOVES, OCCUPIED, UNKNOWN, Cell, GridMap, MoveRule
from ddqn_planner.model.certificate import MOVE_RULES, Certificate, certify
from ddqn_planner.model.move_costs import (
    CENTRE,
    COST_CODES,
    MAX_MULTIPLIER,
    OCCUPIED_CODE,
    MoveCosts,
    every_patch,
    legal_in_patches,
    unique_patches,
)
from ddqn_planner.robot.body_certificate import BodyCertificate

Array: TypeAlias = NDArray[np.float32]

# Shapes: A = 8 actions, B = a batch, I and O = inputs and outputs of a layer, P =
# patches, F = filters. In the paper's network, L = windows of the convolution, U =
# outputs of the layer after it, C = cells, with one more that stands for all outside
# the map. In cost multipliers, L = the codes of a cell's cost, see `move_costs`.

# A move of at least this probability counts as one that always succeeds: the sigmoid
# function never reaches 1, and the difference must not decide between paths.
CERTAIN = 0.99
# Weights of cost multipliers below this count as 0: training leaves some where none
# belong.
NOISE = 0.02
BATCH = 2**12  # patches per evaluation: the layers' outputs then fit into a cache

# The paper (section 4) uses four values and does not give them. With ours the robot
# stands out. With a smaller value for the robot, the many obstacles outweigh it and
# training is less stable.
FREE, OBSTACLE, GOAL, ROBOT = 0.0, -0.1, 1.0, 3.0


class ModelFileError(ValueError):
    """A model file cannot be used; the message says why and what to do."""


class QNetwork:
    """A trained Q-network: what its tensors say of a map's moves.

    Parameters
    ----------
    sizes : mapping of str to int
        A size for each of `size_names`, such as the filters.
    tensors : mapping of str to array
        The weights and biases, by name; their shapes follow from the sizes.
    """

    name: ClassVar[str]  # in model files and hyper-parameters
    size_names: ClassVar[tuple[str, ...]]
    max_size: ClassVar[int] = 4096
    # Sizes that files of older versions do not name, as theirs are always these.
    former_sizes: ClassVar[Mapping[str, int]] = {}
    # Tensors that files of older versions lack, and what these stand for.
    former_tensors: ClassVar[Mapping[str, NDArray[np.generic]]] = {}
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
        """Return the costs of a map's moves, or None.

        None means that it is not proved of the network that exactly the legal moves are
        possible.
        """
        return None

    def q_values(self, grid: GridMap, goal: Cell, move_rule: MoveRule) -> Array:
        """Return Q(s, a) of every cell toward one goal: (8, H, W).

        Networks whose Q follows from costs of moves do not have this method.
        """
        raise NotImplementedError

    def _layer(self, name: str, input_BI: Array) -> Array:
        """Return the outputs (B, O) of a fully connected layer for inputs (B, I).

        The layer's tensors are `name`.weight, (O, I), and `name`.bias, (O,).
        """
        with np.errstate(
            over="ignore", invalid="ignore"
        ):  # a broken model may overflow
            output_BO: Array = input_BI @ self.tensors[f"{name}.weight"].T
            output_BO += self.tensors[f"{name}.bias"]
        return output_BO


def observation_background(
    occupancy: NDArray[np.bool_], goal: Cell
) -> NDArray[np.float32]:
    """Return the value of each cell in the observation without the robot: (H * W,).

    The observation is what the paper's network sees. `occupancy` is (H, W), `goal`
    (x, y).
    """
    background = np.where(occupancy, OBSTACLE, FREE).astype(np.float32)
    background[goal[1], goal[0]] = GOAL
    return background.ravel()


class PaperQNetwork(QNetwork):
    """The paper's network (Fig. 3), for maps of its own size.

    It has a 3x3 convolution and fully connected layers.
    """

    # The paper gives no padding. Without our padding of 1, no filter covers the last
    # row and column of a map of even size. The paper's text can mean a hidden layer of
    # `hidden_units`; 0 stands for none.
    name = "paper"
    size_names = ("height", "width", "filters", "hidden_units")
    former_sizes: ClassVar = {"hidden_units": 0}  # until version 0.1.0

    @classmethod
    def _layers(cls, sizes: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
        """Return the shape of each layer's weights: first the outputs, then the inputs.

        The convolution has a step of 2 cells, so it has a window for every second cell
        of every second row.
        """
        filters = sizes["filters"]
        units = sizes["hidden_units"]  # 0 for no hidden layer
        windows = ((sizes["height"] + 1) // 2) * ((sizes["width"] + 1) // 2)
        features = filters * windows  # outputs of the convolution
        layers: dict[str, tuple[int, ...]] = {"convolution": (filters, 1, 3, 3)}
        if units:
            layers["hidden"] = (units, features)
        layers["fully_connected"] = (len(MOVES), units or features)
        return layers

    def supports(self, shape: tuple[int, int]) -> bool:
        """Say whether maps of shape (H, W) have the network's size."""
        return shape == (self.sizes["height"], self.sizes["width"])

    def q_values(self, grid: GridMap, goal: Cell, move_rule: MoveRule) -> Array:
        """Return Q(s, a) of a robot in each cell toward one goal: (8, H, W).

        The move rule does not matter: the network was trained for one.
        """
        # In double precision: differences of large sums stay exact enough, and do not
        # overflow.
        tensors = {
            name: self.tensors[name].astype(np.float64)
            for name in self.shapes(self.sizes)
        }
        # Shapes: C = cells where the robot may be, and one that stands for all outside
        # the map; U = hidden units, A = 8 actions.
        if self.sizes["hidden_units"] > 0:
            output_CU = _outputs_by_robot_cell(grid, goal, tensors, "hidden")
            hidden_CU = np.maximum(output_CU, 0)
            last_UA = tensors["fully_connected.weight"].T
            output_CA = hidden_CU @ last_UA + tensors["fully_connected.bias"]
        else:
            output_CA = _outputs_by_robot_cell(grid, goal, tensors, "fully_connected")
        q_CA = output_CA[:-1]  # without the cell that stands for all outside the map
        with np.errstate(over="ignore"):
            q_AC: Array = q_CA.T.astype(np.float32)
        return q_AC.reshape(-1, *grid.occupancy.shape)


def _outputs_by_robot_cell(
    grid: GridMap, goal: Cell, tensors: Mapping[str, NDArray[np.float64]], layer: str
) -> NDArray[np.float64]:
    """Return what a layer after the convolution gives for a robot in each cell: (C, U).

    The layer is linear. So its output is that for the observation without a robot, plus
    a change for each window of the convolution that contains the robot's cell.

    Shapes: C = cells, and at the end one that stands for all outside the map, L =
    windows of 9 cells, F = filters, U = outputs of the layer.

    Parameters
    ----------
    grid : GridMap
    goal : (x, y)
    tensors : mapping of str to float64 array
        The network's tensors, by their names.
    layer : str
        The name of the layer.
    """
    kernel_9F: NDArray[np.float64] = tensors["convolution.weight"].reshape(-1, 9).T
    bias_F = tensors["convolution.bias"]
    cell_L9 = window_cells(grid.occupancy.shape)  # the cells of each window
    # The layer's weights have the shape (U, F * L) in the file.
    weight_UFL = tensors[f"{layer}.weight"].reshape(-1, len(bias_F), len(cell_L9))
    weight_LFU: NDArray[np.float64] = weight_UFL.T.copy()

    # 1. Without the robot. Cells outside the map have the value 0.
    background_C = np.append(observation_background(grid.occupancy, goal), 0.0)
    value_L9 = background_C[cell_L9]
    sum_LF: NDArray[np.float64] = value_L9 @ kernel_9F + bias_F
    feature_LF: NDArray[np.float64] = np.maximum(sum_LF, 0)
    output_U = tensors[f"{layer}.bias"] + np.tensordot(feature_LF, weight_LFU, 2)

    # 2. With the robot in one of the 9 cells of a window, which then has another value.
    increase_L9F = (ROBOT - value_L9)[..., None] * kernel_9F
    feature_L9F = np.maximum(sum_LF[:, None] + increase_L9F, 0)
    change_L9U = (feature_L9F - feature_LF[:, None]) @ weight_LFU

    # 3. Each cell of the map gets the changes of all windows in which it lies. No cell
    # of the map has the same number in two windows: so no index of it occurs twice.
    output_CU = np.tile(output_U, (len(background_C), 1))
    for number in range(9):  # of a cell in its window
        output_CU[cell_L9[:, number]] += change_L9U[:, number]
    return output_CU


def window_cells(shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return the numbers y * W + x of the 9 cells of each window: (L, 9).

    The windows of the convolution are squares of 3x3 cells around every second cell of
    every second row of a map of shape (H, W). The number H * W stands for all cells
    outside the map.
    """
    cells = shape[0] * shape[1]
    padded = np.pad(np.arange(cells).reshape(shape), 1, constant_values=cells)
    windows_around_cells = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    windows = windows_around_cells[::2, ::2]
    cell_L9: NDArray[np.int64] = windows.reshape(-1, 9)
    return cell_L9


class PropagationQNetwork(QNetwork):
    """A Q-network for maps of any size.

    Q(s, a) = p(s, a) (r + γ V(s')) + (1 - p(s, a)) r_o.
    """

    # Learned is p(s, a), from the 3x3 patch. Related: value iteration networks (VIN,
    # Tamar et al. 2016) learn their reward, too; VProp (Nardelli et al. 2019) learns
    # how values propagate.
    name = "propagation"
    size_names = ("filters",)
    inputs: ClassVar[int] = 9  # features
    uses_costs: ClassVar[bool] = (
        False  # whether the features tell costs and the move rule
    )

    def __init__(self, sizes: Mapping[str, int], tensors: Mapping[str, Array]) -> None:
        """Keep the tensors, and set tiny weights of cost multipliers to 0.

        `tensors` has a weight and a bias for each layer, by name: "hidden.weight".
        """
        super().__init__(sizes, tensors)
        for name, tensor in tensors.items():
            if name.startswith("prices"):
                self.tensors[name] = np.where(np.abs(tensor) < NOISE, 0, tensor)
        # What is proved holds for all maps, so it is computed once: certificates by the
        # rules, costs by the arguments of `_proved_costs`. A cache of a bound method
        # would keep the network in a cycle of references.
        self._certificates: dict[tuple[MoveRule, ...], Certificate] = {}
        self._proved: dict[tuple[MoveRule, bool, bool], MoveCosts | None] = {}

    @classmethod
    def _layers(cls, sizes: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
        """Return the shape (outputs, inputs) of each layer's weights."""
        filters = sizes["filters"]
        layers: dict[str, tuple[int, ...]] = {
            "convolution": (filters, cls.inputs),
            "hidden": (filters, filters),
            "moves": (len(MOVES), filters),
        }
        if cls.uses_costs:
            layers["prices"] = (len(MOVES), cls.inputs)
        return layers

    @classmethod
    def features(cls, patch_B9: NDArray[np.int8], move_rule: MoveRule) -> Array:
        """Return the I inputs of the network for B patches: (B, I).

        `patch_B9` has the cells of each patch: costs -1 (unknown) to 99, or 100 for
        occupied. A network without costs has 9 inputs, whether each cell is occupied.
        One with costs has 28: the same 9, each cell's cost from 0 to 0.99, whether each
        cell is unknown, and whether corners may be cut.
        """
        occupied_B9: NDArray[np.bool_] = patch_B9 == OCCUPIED
        if not cls.uses_costs:
            plain_BI: Array = occupied_B9.astype(np.float32)
            return plain_BI
        unknown_B9: NDArray[np.bool_] = patch_B9 == UNKNOWN
        cost_B9 = np.where(occupied_B9 | unknown_B9, 0, patch_B9) / 100
        rule_B1 = np.full((len(patch_B9), 1), move_rule.cuts_corners)
        features = [occupied_B9, cost_B9, unknown_B9, rule_B1]
        feature_BI: Array = np.concatenate(features, axis=1, dtype=np.float32)
        return feature_BI

    def success(self, feature_BI: Array) -> Array:
        """Return the probability p(s, a) that each move succeeds, 0..1: (B, 8).

        `feature_BI` has the inputs for B patches; see `features`.
        """
        filtered_BF = np.maximum(self._layer("convolution", feature_BI), 0)
        hidden_BF = np.maximum(self._layer("hidden", filtered_BF), 0)
        logit_BA = self._layer("moves", hidden_BF)
        # The sigmoid function, without overflow.
        p_BA: Array = 0.5 + 0.5 * np.tanh(0.5 * logit_BA)
        return p_BA

    def tries(self, feature_BI: Array) -> Array:
        """Return how many tries each move takes in B patches, 1/p: (B, 8).

        It is 1 for a p of `CERTAIN` or more, and infinite if p is at most 1/2, or NaN:
        then the move counts as impossible. `feature_BI` has the inputs for B patches;
        see `features`.
        """
        p_BA = self.success(feature_BI)
        p_BA = np.where(p_BA >= CERTAIN, np.float32(1), p_BA)
        finite_tries_BA = 1 / np.maximum(p_BA, 0.5)
        tries_BA: Array = np.where(p_BA > 0.5, finite_tries_BA, np.float32(np.inf))
        return tries_BA

    def multiplier(self, feature_BI: Array) -> Array:
        """Return the cost multiplier of each move in B patches, 1 or more: (B, 8).

        `feature_BI` has the inputs for B patches; see `features`.
        """
        if not self.uses_costs:
            return np.ones((len(feature_BI), len(MOVES)), dtype=np.float32)
        multiplier_BA: Array = 1 + np.maximum(self._layer("prices", feature_BI), 0)
        return multiplier_BA

    def certificate(self, move_rule: MoveRule) -> Certificate:
        """Return the proof of its moves.

        A network that knows the move rule is proved for all rules.
        """
        rules = MOVE_RULES if self.uses_costs else (move_rule,)
        if rules not in self._certificates:
            self._certificates[rules] = certify(self, rules)
        return self._certificates[rules]

    def move_costs(self, grid: GridMap, move_rule: MoveRule) -> MoveCosts | None:
        """Return the costs of a map's moves, or None.

        None means that it is not proved that exactly the legal moves are possible, or
        that a move's cost follows from its two cells. On a map of expected times, its
        slowness replaces its costs.
        """
        has_times = grid.slowness is not None
        with_costs = self.uses_costs and grid.cost is not None and not has_times
        key = move_rule, with_costs, has_times  # what costs for any map depend on
        if key not in self._proved:
            self._proved[key] = self._proved_costs(move_rule, with_costs, has_times)
        costs = self._proved[key]
        return None if costs is None else costs.on_map(grid)

    def _proved_costs(
        self, move_rule: MoveRule, with_costs: bool, has_times: bool
    ) -> MoveCosts | None:
        """Return costs for any map, or None unless exactly legal moves are possible.

        Parameters
        ----------
        move_rule : MoveRule
        with_costs, has_times : bool
            Whether the costs, or the expected times, of a map's cells count.
        """
        # P = 512 patches without costs, A = 8 actions
        patch_P9 = every_patch()
        legal_PA = legal_in_patches(patch_P9, move_rule)
        if with_costs:
            return self._sums_of_prices(move_rule, legal_PA)
        table_PA = self._costs_of(patch_P9, move_rule, has_times)
        table_PA[patch_P9[:, CENTRE] == OCCUPIED] = np.inf
        is_right = np.array_equal(np.isfinite(table_PA), legal_PA)
        return MoveCosts.of_table(table_PA) if is_right else None

    def _sums_of_prices(
        self, move_rule: MoveRule, legal_PA: NDArray[np.bool_]
    ) -> MoveCosts | None:
        """Return costs for any map, whose multipliers are sums over a move's two cells.

        Return None if the network's multipliers are no such sums, or its moves are not
        proved.

        Shapes: 9 = the cells of a patch, A = 8 actions, L = the codes of a cell's cost
        (0 unknown, 1 to 100 for costs 0 to 99, 101 occupied), P = 512 patches.

        Parameters
        ----------
        move_rule : MoveRule
        legal_PA : (512, 8) bool
            Which moves are legal, by patch number.
        """
        if not self.certificate(move_rule).proved:
            return None
        # A multiplier is 1 plus the terms of the 9 cells around a move.
        term_9AL = self._price_terms(move_rule)
        action_A = np.arange(len(MOVES))
        target_A = CENTRE + MOVES @ [1, 3]  # the cell to which each move leads, 0 to 8
        # The terms of the cell before a move, and of the cell after it.
        term_2AL: Array = np.stack([term_9AL[CENTRE], term_9AL[target_A, action_A]])
        # No move leads to an occupied cell, so any term will do for it.
        term_2AL[..., OCCUPIED_CODE] = term_2AL[..., OCCUPIED_CODE - 1]
        # The terms of all other cells should be 0.
        other_9AL: Array = term_9AL.copy()
        other_9AL[CENTRE] = 0
        other_9AL[target_A, action_A] = 0
        highest_multiplier_A = 1 + term_2AL.max(axis=2).sum(axis=0)
        highest_multiplier = float(highest_multiplier_A.max())
        is_right = not other_9AL.any() and term_2AL.min() >= 0
        if not is_right or highest_multiplier > MAX_MULTIPLIER:
            return None
        lengths_PA = np.where(legal_PA, LENGTHS, np.inf).astype(np.float32)
        costs = MoveCosts.of_table(lengths_PA)
        half = np.float32(0.5)  # of the 1 to which both terms are added
        return costs._replace(
            terms=term_2AL.ravel() + half,
            highest=costs.highest * highest_multiplier,
            least_by_cost_code=_least_multipliers(term_2AL),
        )

    def _price_terms(self, move_rule: MoveRule) -> Array:
        """Return what each cell of the patch adds to a cost multiplier: (9, 8, L).

        The indices are the cell, the action and the code of the cell's cost: 0 unknown,
        1 to 100 for costs 0 to 99, 101 occupied. The layer is linear, so a multiplier
        is 1 plus the sum of these terms over the cells.
        """
        weight_AI = self.tensors["prices.weight"]
        # The weights of the inputs for the 9 cells, without that of the move rule.
        weight_of_cells_AI = weight_AI[:, :27]
        occupied_9A: Array
        cost_9A: Array
        unknown_9A: Array
        occupied_9A, cost_9A, unknown_9A = weight_of_cells_AI.T.reshape(3, 9, -1)
        share_of_costs = np.arange(OCCUPIED) / 100  # the inputs for costs 0 to 99
        term_9AL = np.empty((9, len(MOVES), COST_CODES), dtype=np.float32)
        term_9AL[..., 0] = unknown_9A
        term_9AL[..., 1:OCCUPIED_CODE] = cost_9A[..., None] * share_of_costs
        term_9AL[..., OCCUPIED_CODE] = occupied_9A
        # What depends on no cell, bias and rule, is added to the terms of the centre.
        rule_A = weight_AI[:, 27] * move_rule.cuts_corners
        term_9AL[CENTRE] += (self.tensors["prices.bias"] + rule_A)[:, None]
        return term_9AL

    def believed_costs(self, grid: GridMap, move_rule: MoveRule) -> MoveCosts:
        """Return the costs of a map's moves as predicted, also where they are wrong.

        A move counts as possible if the network predicts that it succeeds with a
        probability above 1/2, and it is tried until it succeeds: its cost is its length
        times its tries and its multiplier. The progress and detour terms of the paper's
        reward (section 4.2) add up to a constant along a path, so they are left out.
        """
        has_times = grid.slowness is not None
        if self.uses_costs and grid.cost is not None and not has_times:
            # P rows of the table, one for each patch that occurs on the map.
            patch_number, patch_P9 = unique_patches(grid.occupancy, grid.cost)
            table_PA = self._costs_of(patch_P9, move_rule, has_times)
            return MoveCosts.of_table(table_PA).on_map(grid, patch_number)
        # Without costs there are 512 patches, whose numbers are read from the map.
        table_PA = self._costs_of(every_patch(), move_rule, has_times)
        return MoveCosts.of_table(table_PA).on_map(grid)

    def _costs_of(
        self, patch_P9: NDArray[np.int8], move_rule: MoveRule, has_times: bool
    ) -> Array:
        """Return each move's cost in P patches, infinite if not possible: (P, 8).

        The cost is the move's length times its expected tries and its multiplier. With
        `has_times` it is without the multiplier, which follows from the map's expected
        times. The patches (P, 9), see `patches`, are evaluated in batches of B; I =
        inputs, A = 8 actions.
        """
        costs = []
        for batch_B9 in np.split(patch_P9, range(BATCH, len(patch_P9), BATCH)):
            feature_BI = self.features(batch_B9, move_rule)
            multiplier_BA = np.minimum(self.multiplier(feature_BI), MAX_MULTIPLIER)
            cost_BA = LENGTHS * self.tries(feature_BI)
            if not has_times:
                cost_BA *= multiplier_BA
            # A multiplier of a broken model may be NaN: then the comparison is false.
            costs.append(np.where(multiplier_BA >= 1, cost_BA, np.inf))
        return np.concatenate(costs, dtype=np.float32)


def _least_multipliers(term_2AL: Array) -> Array:
    """Return a lower bound of the multipliers on a map, by its least cost code: (L,).

    Element c holds for maps of which each cell has the cost code c, a greater one, or 0
    for unknown. `term_2AL` has what the cell before a move and the cell after it add to
    the multiplier, by action and cost code.
    """
    # The least term of the codes from each code on: from the greatest code down.
    greatest_first_2AL = term_2AL[..., ::-1]
    least_known_2AL = np.minimum.accumulate(greatest_first_2AL, axis=2)[..., ::-1]
    unknown_2A1 = term_2AL[..., :1]
    least_2AL = np.minimum(unknown_2A1, least_known_2AL)
    least_L: Array = 1 + least_2AL.sum(axis=0).min(axis=0)
    return least_L


class AnyMapQNetwork(PropagationQNetwork):
    """A propagation network that knows both move rules and costs of cells.

    It learns r(s, a) = -length * m(s, a).
    """

    name = "any_map"
    inputs = 28
    uses_costs = True
