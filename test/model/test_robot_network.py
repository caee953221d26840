"""What is proved of a robot's body, beside brute force, and what its model file
holds.
"""

import json
from copy import deepcopy
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import safetensors.numpy
from hypothesis import example, given
from hypothesis import strategies as st

from ddqn_planner.grid import MoveRule
from ddqn_planner.model import (
    ModelFileError,
    ModelMetadata,
    RobotNetwork,
    load_model,
    model_bytes,
    model_of,
    save_model,
)
from ddqn_planner.robot.body_certificate import certify_body
from ddqn_planner.robot.footprint import read_footprint, swept_cells
from ddqn_planner.robot.motions import Motions, make_motions


@cache
def body_and_motions(motion: str = "differential") -> tuple[np.ndarray, Motions]:
    """A body of 0.88 x 0.48 m, on cells of 0.25 m."""
    footprint = read_footprint(
        "[[0.59, 0.24], [-0.29, 0.24], [-0.29, -0.24], [0.59, -0.24]]"
    )
    return footprint, make_motions(motion, 1.0, 0.25)


@cache
def _exact(motion: str) -> RobotNetwork:
    network = RobotNetwork.untrained(*body_and_motions(motion))
    network.tensors["weight"][network.swept_by_unit] = 2.0
    network.tensors["threshold"][:] = 1.0
    return network


def exact(motion: str = "differential") -> RobotNetwork:
    """A robot that knows its body: each swept cell outweighs the threshold."""
    return deepcopy(_exact(motion))


def metadata_of(network: RobotNetwork) -> ModelMetadata:
    return ModelMetadata(
        "robot", network.sizes, MoveRule.ROBOT_SAFE, 0.5, "", 7, 3, "1.0.0"
    )


def is_right(network: RobotNetwork) -> bool:
    """Whether no pattern of a swept cell, and of cells that are not swept, is decided
    wrongly.
    """
    weights, swept = (
        network.of_primitives(network.tensors["weight"]),
        network.swept_by_unit,
    )
    rng = np.random.default_rng(0)
    for weight, body, unit in zip(
        weights, network.of_primitives(swept), network.unit, strict=True
    ):
        threshold, weight = network.tensors["threshold"][unit], np.maximum(weight, 0)
        others = weight[~body]
        patterns = [
            others,
            others[:0],
            *(rng.permutation(others)[:n] for n in (1, 5, 50)),
        ]
        if not all(pattern.sum(dtype="f4") < threshold for pattern in patterns):
            return False
        if not (weight[body] > threshold).all():
            return False
    return True


@pytest.mark.parametrize("motion", ["differential", "ackermann", "omnidirectional"])
def test_one_unit_serves_the_quarter_turns_of_a_primitive(motion: str) -> None:
    footprint, motions = body_and_motions(motion)
    network = exact(motion)
    assert len(network.unit) == 4 * network.sizes["units"]
    np.testing.assert_array_equal(network.swept(), swept_cells(footprint, motions))
    assert str(network.certificate()).startswith(
        f"proved: all {network.swept().sum():,} cells"
    )
    # Primitives that are no quarter turns of each other have units of their own.
    bent = tuple(
        np.vstack([p[:1], p[1:-1] + np.array([0, 0.3 * (i < 9), 0]), p[-1:]])
        for i, p in enumerate(motions.poses)
    )
    # Their ways are longer.
    bent_motions = replace(motions, poses=bent, cost=2 * motions.cost)
    other = RobotNetwork.untrained(footprint, bent_motions)
    assert other.sizes["units"] > network.sizes["units"]
    other.tensors["weight"][other.swept_by_unit] = 2.0
    other.tensors["threshold"][:] = 1.0
    expected = swept_cells(footprint, bent_motions)
    np.testing.assert_array_equal(other.swept(), expected)


@given(
    st.integers(0, 2**32 - 1),
    st.floats(-3, 1),
    st.sampled_from(["weight", "threshold"]),
)
@example(0, -6e-8, "weight")
def test_a_damaged_robot_is_refused_or_right(
    seed: int, exponent: float, name: str
) -> None:
    network, random = exact(), np.random.default_rng(seed)
    network.tensors[name].flat[random.integers(network.tensors[name].size)] += (
        random.choice([-1, 1]) * 10**exponent
    )
    certificate = network.certificate()
    assert certificate.proved == (certificate.margin > 0)
    # A margin that float32 sums may make up for proves nothing, even if they happen to
    # be right.
    assert certificate.proved == is_right(network) or -1e-4 < certificate.margin <= 0
    if not certificate.proved:
        with pytest.raises(ModelFileError, match=r"not proved: .*train-robot"):
            network.swept()


def test_a_weight_below_0_makes_up_for_no_other() -> None:
    network = exact()
    cells = np.flatnonzero(~network.swept_by_unit[0])[:2]
    network.tensors["weight"][0].flat[cells] = 1.5, -1.0
    certificate = network.certificate()
    assert (certificate.weak, certificate.forbidden) == (0, 4)


def test_the_proof_is_that_of_all_patterns_of_a_small_body() -> None:
    network, random = exact(), np.random.default_rng(3)
    seen = set()
    for _ in range(40):
        # Only nine cells have weights, so that all their patterns can be tried.
        cells = random.choice(network.tensors["weight"][0].size, 9, replace=False)
        weight, body = (
            np.zeros(network.tensors["weight"][0].size, "f4"),
            np.zeros(9, np.bool_),
        )
        body[: random.integers(1, 9)] = True
        weight[cells] = np.where(
            body, random.uniform(0.9, 2, 9), random.uniform(0, 0.25, 9)
        )
        patterns = [list(p) for n in range(10) for p in combinations(range(9), n)]
        possible = [1 - weight[cells[p]].sum() > 0 for p in patterns]
        right = possible == [not body[p].any() for p in patterns]
        network.tensors["weight"][:] = weight.reshape(
            network.tensors["weight"][0].shape
        )
        swept = np.zeros(weight.size, np.bool_)
        swept[cells[body]] = True
        network.swept_by_unit = np.broadcast_to(
            swept.reshape(network.tensors["weight"].shape[1:]),
            network.tensors["weight"].shape,
        )
        assert network.certificate().proved == right
        seen.add(right)
    assert seen == {True, False}


def test_a_robots_file_comes_back(tmp_path: Path) -> None:
    network, path = exact("ackermann"), tmp_path / "robot.safetensors"
    save_model(path, network, metadata_of(network))
    loaded, metadata = load_model(path)
    assert isinstance(loaded, RobotNetwork)
    assert metadata == metadata_of(network)
    for name, tensor in network.tensors.items():
        np.testing.assert_array_equal(loaded.tensors[name], tensor)
    np.testing.assert_array_equal(loaded.swept(), network.swept())
    motions, given = loaded.motions, body_and_motions("ackermann")[1]
    for name in ("angles", "start", "end", "offset", "cost"):
        np.testing.assert_array_equal(getattr(motions, name), getattr(given, name))
    for one, other in zip(motions.poses, given.poses, strict=True):
        np.testing.assert_array_equal(one, other)
    assert model_bytes(loaded, metadata) == path.read_bytes()


DAMAGED = [
    ("primitive", n, value) for n, value in ((0, 16), (0, 0.5), (1, -1), (2, 9), (5, 0))
]
DAMAGED += [("primitive", 4, -1), ("resolution", 0, -1), ("resolution", 0, 0.1)]
DAMAGED += [("pose", 0, 2), ("pose", 2, 1), ("footprint", 0, -9), ("angle", 3, 0)]


@pytest.mark.parametrize(("name", "place", "value"), DAMAGED)
def test_a_robot_without_sense_is_refused(name: str, place: int, value: float) -> None:
    network = exact()
    network.tensors[name] = network.tensors[name].copy()
    network.tensors[name].flat[place] = value
    content = model_bytes(network, metadata_of(network))
    with pytest.raises(ValueError, match=r"train|give"):
        cast(RobotNetwork, model_of(content)[0]).swept()


def test_a_sum_that_float32_may_round_up_to_the_threshold_proves_nothing() -> None:
    random = np.random.default_rng(0)
    swept = np.zeros((1, 41, 41), np.bool_)
    swept[0, 20, 20] = True
    weight = random.uniform(1e-4, 1e-3, swept.shape).astype(np.float32)
    weight[swept] = 10
    others = weight[~swept]
    total = others.sum(dtype=np.float64)
    threshold = np.nextafter(np.float32(total), np.float32(np.inf))
    assert total < threshold
    orders = [random.permutation(others) for _ in range(20)]
    assert max(np.cumsum(order)[-1] for order in orders) > threshold
    for share, is_proved in ((1.0, False), (1.01, True)):
        certificate = certify_body(
            weight, np.array([threshold * share], np.float32), swept, np.zeros(1, int)
        )
        assert certificate.proved == is_proved


CHANGES = {
    "a tenth": lambda array: array / 10,
    "less": lambda array: array * 0.9,
    "ten times": lambda array: array * 10,
    "negated": lambda array: -array,
    "backward": lambda array: array[::-1],
    "infinite": lambda array: array * np.inf,
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("name", [*exact().tensors, "cost"])
def test_a_damaged_model_is_refused_or_keeps_what_bounds_rely_on(
    name: str, change: str
) -> None:
    network = exact("ackermann")
    tensors = network.tensors
    with np.errstate(invalid="ignore"):
        if name == "cost":
            primitive = tensors["primitive"].copy()
            primitive[:, 4] = CHANGES[change](primitive[:, 4])
            tensors["primitive"] = primitive
        else:
            tensors[name] = np.ascontiguousarray(CHANGES[change](tensors[name]))
    problem = ""
    try:
        content = model_bytes(network, metadata_of(network))
        loaded = cast(RobotNetwork, model_of(content)[0])
        swept = loaded.swept()
    except ValueError as error:
        problem = str(error)
    if problem:
        assert "train" in problem or "give" in problem
        return
    # Then it is a model of the same proof: each primitive costs its way at least, and
    # what it sweeps is forbidden.
    motions = loaded.motions
    np.testing.assert_array_equal(swept, swept_cells(loaded.footprint, motions))
    for cost, poses in zip(motions.cost.tolist(), motions.poses, strict=True):
        assert cost >= 0.999 * np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()


def test_a_model_whose_motions_cost_too_little_is_not_proved() -> None:
    network = exact()
    primitive = network.tensors["primitive"].copy()
    primitive[:, 4] /= 10
    network.tensors["primitive"] = primitive
    loaded = cast(RobotNetwork, model_of(model_bytes(network, metadata_of(network)))[0])
    certificate = loaded.certificate()
    assert not certificate.proved
    # Turns on the spot may cost any share of a cell.
    drives = int(network.motions.offset.any(axis=1).sum())
    assert certificate.cheap == drives
    assert f"{drives} of {certificate.primitives} cost less" in str(certificate)
    with pytest.raises(ModelFileError, match=r"cost less than the way.*train-robot"):
        loaded.swept()


def test_a_file_from_before_cusps_is_read_as_one_whose_cusps_cost_nothing() -> None:
    network = exact()
    assert network.motions.cusp == 0
    data = model_bytes(network, metadata_of(network))
    tensors = safetensors.numpy.load(data)
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])["__metadata__"]
    assert tensors.pop("cusp") == 0
    old, _ = model_of(safetensors.numpy.save(tensors, header))
    assert isinstance(old, RobotNetwork)
    assert old.motions.cusp == 0
    assert np.array_equal(old.motions.cost, network.motions.cost)
    with pytest.raises(ValueError, match="damaged"):
        RobotNetwork(network.sizes, {**network.tensors, "cusp": np.array([-1.0])})
