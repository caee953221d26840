import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as numpy_st
from networks import random_network
from strategies import Place, grids_with_costs, grids_with_free_cell

from ddqn_planner import MoveRule
from ddqn_planner.grid import MAX_COST_MULTIPLIER, OCCUPIED, UNKNOWN
from ddqn_planner.grid.moves import MOVES
from ddqn_planner.grid.oracle import shortest_distances
from ddqn_planner.model import ModelMetadata, PropagationQNetwork, load_model
from ddqn_planner.model.certificate import (
    MAX_FILTERS,
    MOVE_RULES,
    Certificate,
    certify,
    logit_margins,
)
from ddqn_planner.model.move_costs import every_patch, legal_in_patches
from ddqn_planner.planning import Planner
from ddqn_planner.planning.segments import cost_along

GUARANTEES = Path(__file__).resolve().parents[2] / "docs" / "guarantees.md"

PATCHES = every_patch()[every_patch()[:, 4] == 0]
CELLS = [4 + 3 * dy + dx for dx, dy in MOVES.tolist()]
"""The place in a patch that each action leads to."""


@st.composite
def patches(draw: st.DrawFn) -> np.ndarray:
    """Patches with a free centre: (20, 9) int8."""
    values = st.sampled_from([0, 0, 1, 40, 99, UNKNOWN, OCCUPIED, OCCUPIED])
    patch_B9: np.ndarray = draw(numpy_st.arrays(np.int8, (20, 9), elements=values))
    patch_B9[patch_B9[:, 4] == OCCUPIED, 4] = 0
    return patch_B9


def any_map() -> PropagationQNetwork:
    """The shipped network, with tensors that a test may change."""
    network, _ = load_model("any_map")
    assert isinstance(network, PropagationQNetwork)
    return network


def right_network(name: str, move_rule: MoveRule | None = None) -> PropagationQNetwork:
    """A network that is right under the rule that it observes, or under the given one.

    Each logit is 5 less 10 for each occupied cell that the move needs free. The costs
    are exact.
    """
    network = random_network(name, scale=0, filters=16)
    assert isinstance(network, PropagationQNetwork)
    tensors = network.tensors
    for action, target in enumerate(CELLS):
        tensors["convolution.weight"][action, target] = 1
        if action % 2 and move_rule is not MoveRule.CORNER_CUTTING:
            sides = [CELLS[action - 1], CELLS[(action + 1) % 8]]
            tensors["convolution.weight"][8 + action, sides] = 1
        if name == "any_map":
            tensors["convolution.weight"][8 + action, 27] = -2
            for cell in (4, target):
                tensors["prices.weight"][action, [9 + cell, 18 + cell]] = 2
        tensors["moves.weight"][action, [action, 8 + action]] = -10
    tensors["hidden.weight"][:] = np.eye(16)
    tensors["moves.bias"][:] = 5
    return network


def logits(network: PropagationQNetwork, feature_BI: np.ndarray) -> np.ndarray:
    tensors, output_BF = network.tensors, feature_BI
    for layer in ("convolution", "hidden", "moves"):
        input_BF = np.maximum(output_BF, 0)  # the features are 0 or more
        output_BF = input_BF @ tensors[f"{layer}.weight"].T + tensors[f"{layer}.bias"]
    return output_BF


CERTIFICATE = certify(any_map())


@given(patches(), st.sampled_from(MoveRule))
def test_decisions_and_costs_are_as_certified(
    patch_B9: np.ndarray, rule: MoveRule
) -> None:
    network, certificate = any_map(), CERTIFICATE
    feature_BI, legal_BA = (
        network.features(patch_B9, rule),
        legal_in_patches(patch_B9, rule),
    )
    np.testing.assert_array_equal(network.success(feature_BI) > 0.5, legal_BA)
    distance_BA = np.where(legal_BA, 1, -1) * logits(network, feature_BI)
    assert distance_BA.min() >= certificate.margin
    share_B9 = np.where(patch_B9 == UNKNOWN, 1, patch_B9 / 100)
    multiplier_B9 = 1 + (MAX_COST_MULTIPLIER - 1) * share_B9
    true_BA = (
        multiplier_B9[:, [4]] + multiplier_B9[:, CELLS]
    ) / 2  # the mean of both cells
    error_BA = np.abs(network.multiplier(feature_BI) - true_BA) / true_BA
    assert error_BA[legal_BA].max(initial=0) <= certificate.multiplier_error


NAMES, SCALES = (
    st.sampled_from(["propagation", "any_map"]),
    st.sampled_from([0.1, 0.5, 3.0]),
)


@given(patches(), st.sampled_from(MOVE_RULES), NAMES, st.integers(0, 99), SCALES)
def test_no_margin_of_any_network_is_above_a_sampled_one(
    patch_B9: np.ndarray, rule: MoveRule, name: str, seed: int, scale: float
) -> None:
    network = random_network(name, seed, scale, filters=6)
    assert isinstance(network, PropagationQNetwork)
    plain_B9 = np.where(patch_B9 == OCCUPIED, OCCUPIED, 0).astype(np.int8)
    legal_BA = legal_in_patches(patch_B9, rule)
    margins = logit_margins(network, network.features(plain_B9, rule), legal_BA)
    sampled_BA = np.where(legal_BA, 1, -1) * logits(
        network, network.features(patch_B9, rule)
    )
    assert (margins.margin <= sampled_BA).all()


@pytest.mark.parametrize("layer", ["convolution", "hidden", "moves"])
def test_a_margin_counts_the_rounding_errors_of_every_layer(layer: str) -> None:
    network = random_network("any_map", scale=0, filters=2)
    assert isinstance(network, PropagationQNetwork)
    tensors = network.tensors
    # Two units are 1, and are passed on. In one layer they are added to 2**25, in which
    # float32 has no place for them, before that is taken away.
    tensors["convolution.bias"][:] = 1
    tensors["hidden.weight"][:] = np.eye(2)
    tensors["moves.weight"][:, 0] = 1
    tensors[f"{layer}.weight"][:, 1] = 2.0**25
    if layer == "convolution":
        tensors["convolution.weight"][:, 0] = 1
        tensors["convolution.bias"][:] = 0
    tensors[f"{layer}.bias"][:] = -(2.0**25)
    patch_B9 = np.full((1, 9), OCCUPIED, np.int8)
    patch_B9[:, 4] = 0
    feature_BI = network.features(patch_B9, MoveRule.ROBOT_SAFE)
    logit_BA = logits(network, feature_BI)
    assert (logit_BA == 0).all()  # exactly they are 1
    margins = logit_margins(network, feature_BI, np.ones((1, 8), np.bool_))
    assert (margins.margin <= logit_BA).all()


@cache
def unsure_and_noisy(
    share: float, noise: float
) -> tuple[PropagationQNetwork, Certificate]:
    network = any_map()
    for name in ("moves.weight", "moves.bias"):
        network.tensors[name][::2] *= share  # the logits of straight moves
    network.tensors["prices.weight"] += np.random.default_rng(0).normal(
        0, noise, (8, 28)
    )
    return network, certify(network)


GRIDS, NOISES = (
    grids_with_costs() | grids_with_free_cell(),
    st.sampled_from([0.0, 0.02]),
)
SHARES = st.sampled_from([1.0, 0.3, 0.1, 0.01])


@given(GRIDS, st.sampled_from(MOVE_RULES), NOISES, SHARES, st.booleans())
def test_no_path_exceeds_the_certificate(
    place: Place, rule: MoveRule, noise: float, share: float, timed: bool
) -> None:
    grid, goal = place
    if timed:
        slowness = np.linspace(1, 9, grid.occupancy.size, dtype=np.float32)
        grid = replace(
            grid, slowness=slowness.reshape(grid.occupancy.shape), seconds_per_cell=1.0
        )
    network, certificate = unsure_and_noisy(share, noise)
    assert certificate.proved
    assert (noise > 0.0 or share < 1) == (certificate.path_error > 0.03)
    metadata = ModelMetadata("any_map", {"filters": 64}, rule, 1.0, "", 0, 0, "")
    field = Planner(network, metadata).q_field(grid, goal, rule)
    optimum = shortest_distances(grid, goal, rule)
    for start in grid.free_cells()[::3]:
        plan = field.rollout(start)
        assert bool(plan.cells) == math.isfinite(optimum[start[1], start[0]])
        if plan.cells:
            cost = cost_along(plan.cells, grid, rule)
            bound = (1 + certificate.path_error) * optimum[start[1], start[0]]
            assert cost <= bound * (1 + 1e-6)


def test_a_decision_that_only_costs_make_wrong_is_found() -> None:
    network = right_network("any_map")
    assert certify(network).proved
    network.tensors["convolution.weight"][0, 9 + CELLS[3]] = 0.6
    certificate = certify(network)
    # Action 0 seems impossible where the cost beside its target is high.
    assert (certificate.undecided, certificate.wrong) == (0, 2 * 64)
    assert (
        str(certificate) == "not proved: 0 of 4,096 decisions are open, 128 are wrong"
    )


def test_bounds_that_are_too_loose_leave_decisions_open() -> None:
    network = right_network("any_map")
    tensors = network.tensors
    for unit in (8, 10):  # two equal units, whose difference is 0 but has loose bounds
        tensors["convolution.weight"][unit, 9] = 2
        tensors["convolution.bias"][unit] = -1
    tensors["hidden.weight"][8, [8, 10]] = [100, -100]
    tensors["hidden.weight"][10, 10] = 0
    certificate = certify(network)
    assert certificate.wrong == 0
    assert certificate.undecided > 0
    assert not certificate.proved
    assert certificate.path_error == math.inf


@pytest.mark.parametrize("value", [np.nan, np.inf, 3e38])
@pytest.mark.parametrize("name", ["convolution.weight", "moves.weight", "prices.bias"])
def test_a_broken_network_is_not_proved(name: str, value: float) -> None:
    network = any_map()
    network.tensors[name][:] = value
    certificate = certify(network)
    assert not certificate.proved or certificate.path_error == math.inf
    assert not math.isnan(certificate.margin + certificate.multiplier_error)


def test_the_proof_of_a_large_network_is_not_tried() -> None:
    network = random_network("any_map", filters=MAX_FILTERS + 1)
    assert isinstance(network, PropagationQNetwork)
    assert certify(network) == Certificate(4096, 4096, 0, 0.0, math.inf)


def test_a_network_without_costs_is_certified_exactly_under_its_rule() -> None:
    rule = MoveRule.ROBOT_SAFE
    network = right_network("propagation", rule)
    certificate = certify(network, [rule])
    assert certificate.proved
    assert certificate.decisions == 2048
    assert certificate.margin == pytest.approx(5, abs=1e-3)
    differing = legal_in_patches(PATCHES, MOVE_RULES[0]) != legal_in_patches(
        PATCHES, MOVE_RULES[1]
    )
    both = certify(network)
    assert (both.decisions, both.undecided, both.wrong) == (4096, 0, differing.sum())
    of_rules = [network.certificate(rule) for rule in MOVE_RULES]
    assert [bool(one and one.proved) for one in of_rules] == [True, False]
    assert network.certificate(rule) is of_rules[0]


def test_the_error_of_the_costs_is_the_greatest_one() -> None:
    network = right_network("any_map")
    exact = certify(network)
    assert exact.margin == pytest.approx(5, abs=1e-3)
    assert 0 < exact.multiplier_error < 1e-4
    network.tensors["prices.bias"][3] = 0.1
    assert certify(network).multiplier_error == pytest.approx(0.1, abs=1e-4)
    network.tensors["prices.bias"][
        3
    ] = -0.1  # the learned multiplier is at least 1 all the same
    network.tensors["prices.weight"][3, 0] = -0.2
    certificate = certify(network)
    # 0.3 too little, where the true one is 1.3: beside an occupied cell, and with costs
    # of 15.
    error = 0.3 / 1.3
    assert certificate.multiplier_error == pytest.approx(error, abs=1e-4)
    assert certificate.path_error == pytest.approx(
        (1 + error) / (1 - error) - 1, abs=1e-3
    )


VALUES = np.array([*range(OCCUPIED), UNKNOWN], np.int8)
"""Those that a free cell may have."""


@pytest.mark.parametrize("rule", MOVE_RULES)
def test_the_error_of_the_costs_is_that_of_the_worst_of_all_pairs_of_cells(
    rule: MoveRule,
) -> None:
    network = any_map()
    before, after = (values.ravel() for values in np.meshgrid(VALUES, VALUES))
    errors = []
    for action, cell in enumerate(CELLS):
        patch_B9 = np.zeros((len(before), 9), np.int8)
        patch_B9[:, 4], patch_B9[:, cell] = before, after
        share_2B = np.where(patch_B9 == UNKNOWN, 1, patch_B9 / 100).T[[4, cell]]
        true_B = 1 + (MAX_COST_MULTIPLIER - 1) * share_2B.mean(axis=0)
        learned_B = network.multiplier(network.features(patch_B9, rule))[:, action]
        errors.append(np.abs(learned_B / true_B - 1).max())
    assert max(errors) <= CERTIFICATE.multiplier_error <= max(errors) + 1e-5
    assert CERTIFICATE.multiplier_error < 0.0011
    assert CERTIFICATE.path_error < 0.0022


@pytest.mark.parametrize("cell", [0, 8])
@pytest.mark.parametrize("sign", [-1, 1])
def test_the_error_of_the_costs_includes_what_is_added_for_other_cells(
    cell: int, sign: int
) -> None:
    network = right_network("any_map")
    # An unknown cell 0 or 8, which is neither end of the action to +x, changes its
    # multiplier.
    network.tensors["prices.weight"][0, 18 + cell] = sign * 0.5
    worst = 0.5 if sign > 0 else 0.5 / 1.5
    assert certify(network).multiplier_error == pytest.approx(worst, abs=1e-4)
    network.tensors["prices.weight"][0, cell] = sign * 1.0  # an occupied one even more
    worst = 1.0 if sign > 0 else 1 / 2
    assert certify(network).multiplier_error == pytest.approx(worst, abs=1e-4)


def test_an_error_under_one_move_rule_alone_is_found() -> None:
    network = right_network("any_map")
    network.tensors["prices.weight"][5, 27] = 0.25
    assert certify(network).multiplier_error == pytest.approx(0.25, abs=1e-4)
    assert certify(network, [MoveRule.ROBOT_SAFE]).multiplier_error < 1e-4


def test_certify_prints_the_documented_proof(console: Any) -> None:
    printed = console("certify any_map").out
    assert printed.startswith("proved: all 4,096 decisions, ")
    assert printed in GUARANTEES.read_text(encoding="utf-8")
    why = "the moves depend on the whole map, not on 3x3 patches"
    assert console("certify dilemma", status=1).out == f"nothing can be proved: {why}\n"
