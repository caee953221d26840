import json
import os
import pickle
import random
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from limits import memory_grows_less_than
from networks import random_network
from strategies import RULES, Place, grids_with_costs, json_values

from ddqn_planner.grid import MoveRule
from ddqn_planner.model import (
    ModelFileError,
    ModelMetadata,
    QNetwork,
    load_model,
    save_model,
)
from ddqn_planner.model.move_costs import MAX_MULTIPLIER
from ddqn_planner.planning import Planner
from ddqn_planner.planning.field import network_field

SIZED = {"height": 4, "width": 5, "filters": 2, "hidden_units": 0}
METADATA = ModelMetadata(
    "paper", SIZED, MoveRule.ROBOT_SAFE, 0.95, "0123456789", 7, 3, "0.1.0"
)

# Every example writes the same file anew.
same_folder = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture
def network() -> QNetwork:
    return random_network("paper", **METADATA.sizes)


@pytest.fixture
def model_path(tmp_path: Path, network: QNetwork) -> Path:
    path = tmp_path / "model.safetensors"
    save_model(path, network, METADATA)
    return path


OLD = {"height": 4, "width": 5, "filters": 2}  # a file of an old version
KINDS = [("paper", SIZED), ("paper", {**SIZED, "hidden_units": 3}), ("paper", OLD)]
KINDS += [(kind, {"filters": 3}) for kind in ("propagation", "any_map")]


@pytest.mark.parametrize(("kind", "sizes"), KINDS)
def test_a_saved_model_comes_back(
    tmp_path: Path, kind: str, sizes: dict[str, int]
) -> None:
    path, units = (
        tmp_path / "model.safetensors",
        {"hidden_units": 0} if kind == "paper" else {},
    )
    network = random_network(kind, **(units | sizes))
    description = replace(METADATA, network=kind, sizes=sizes)
    save_model(path, network, description)
    loaded, metadata = load_model(path)
    assert metadata == replace(description, sizes=units | sizes)
    assert type(loaded) is type(network)
    path.write_bytes(bytes(path.stat().st_size))  # what is loaded stays as it is
    for key, tensor in network.tensors.items():
        np.testing.assert_array_equal(loaded.tensors[key], tensor)


def test_a_file_with_a_wrong_byte_or_cut_off_is_a_model_or_refused(
    model_path: Path,
) -> None:
    content = model_path.read_bytes()
    for length in np.linspace(0, len(content) - 1, 50).astype(int):
        model_path.write_bytes(content[:length])
        with pytest.raises(ModelFileError, match="truncated"):
            load_model(model_path)
    chance = random.Random(0)
    header = 8 + int.from_bytes(content[:8], "little")
    refused = 0
    places = [*range(8), *(chance.randrange(header) for _ in range(200))]
    for place in [
        *places,
        *(chance.randrange(header, len(content)) for _ in range(50)),
    ]:
        changed = bytearray(content)
        changed[place] ^= chance.randrange(1, 256)
        model_path.write_bytes(changed)
        try:
            network, _ = load_model(model_path)
        except ModelFileError:
            refused += 1
        else:
            assert all(np.isfinite(tensor).all() for tensor in network.tensors.values())
    assert refused > 100


MISSING = object()


def save_as(path: Path, weights: QNetwork, /, **changes: object) -> None:
    description = {**asdict(METADATA), **changes}
    description = {
        key: value for key, value in description.items() if value is not MISSING
    }
    content = safetensors.numpy.save(
        weights.tensors, {"ddqn_planner": json.dumps(description)}
    )
    path.write_bytes(content)


def test_a_model_of_the_old_move_rule_unit_cuts_corners(
    tmp_path: Path, network: QNetwork
) -> None:
    path = tmp_path / "model.safetensors"
    save_as(path, network, move_rule="unit")
    _, metadata = load_model(path)
    assert metadata.move_rule is MoveRule.CORNER_CUTTING


def test_wrong_metadata_is_refused_by_name(tmp_path: Path, network: QNetwork) -> None:
    path = tmp_path / "model.safetensors"
    for name, value, named in (
        *(("network", "resnet", "resnet"), ("move_rule", "flying", "flying")),
        *(("extra", 1, "extra"), ("sizes", {**OLD, "depth": 1}, "depth")),
        *(("sizes", {**OLD, "filters": n}, f"filters is {n}") for n in (10**9, 0)),
        ("sizes", {**OLD, "hidden_units": -1}, "hidden_units is -1"),
        *(
            ("sizes", {**OLD, key: 6}, "holds tensors")
            for key in ("hidden_units", "height")
        ),
        ("sizes", [], r"sizes is \[\]; it must be dict"),
        ("gamma", "high", "gamma is 'high'; it must be float or int"),
        *(("gamma", float("nan"), "gamma is nan"), ("steps", 1.5, r"steps is 1\.5")),
        ("seed", MISSING, r"metadata is wrong .*\['seed'\]"),
    ):
        save_as(path, network, **{name: value})
        with pytest.raises(ModelFileError, match=named):
            load_model(path)


JSON = json_values(st.none() | st.booleans() | st.integers() | st.floats() | st.text())
SIZES = st.dictionaries(st.sampled_from(["height", "width", "filters"]), JSON)
CHANGES = st.dictionaries(
    st.sampled_from([*asdict(METADATA)]) | st.text(), JSON, min_size=1
)


@same_folder
@given(CHANGES | st.fixed_dictionaries({"sizes": SIZES}))
def test_any_metadata_is_a_models_or_refused(
    tmp_path: Path, changes: dict[str, Any]
) -> None:
    path = tmp_path / "model.safetensors"
    save_as(path, random_network("paper", **METADATA.sizes), **changes)
    try:
        _, read = load_model(path)
    except ModelFileError:
        return
    assert json.loads(json.dumps(asdict(read))) == {**asdict(METADATA), **changes}


def test_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    path, tensors = tmp_path / "model.safetensors", {"x": np.zeros(1)}
    texts = ("", "null", "[1, 2", "[" * 10**5, "7", "{}", "1" * 5000)
    contents = [
        safetensors.numpy.save(tensors, {"ddqn_planner": text}) for text in texts
    ]
    for content, refusal in (
        (pickle.dumps(tensors), "another kind"),
        (safetensors.numpy.save(tensors), "no model of"),
        *((content, "metadata is wrong") for content in contents),
    ):
        path.write_bytes(content)
        with pytest.raises(ModelFileError, match=refusal):
            load_model(path)


def test_wrong_tensors_and_weights_are_refused(
    model_path: Path, network: QNetwork
) -> None:
    right, bias = network.tensors, "convolution.bias"
    others: list[dict[str, Any]] = [
        {"more": right[bias]},
        dict.fromkeys(right),
        {bias: None},
    ]
    others += [
        {bias: np.zeros(2)},
        *({bias: np.zeros(n, np.float32)} for n in (3, (1, 2))),
    ]
    broken = [{bias: np.float32([0, n])} for n in (np.nan, np.inf, -np.inf)]
    for refusal, changes in (("holds tensors", others), ("not all finite", broken)):
        for change in changes:
            tensors = {**right, **change}
            network.tensors = {
                key: tensor for key, tensor in tensors.items() if tensor is not None
            }
            save_model(model_path, network, METADATA)
            with pytest.raises(ModelFileError, match=refusal):
                load_model(model_path)


NAMES, SEEDS = st.sampled_from(["any_map", "propagation"]), st.integers(0, 2**32 - 1)


@same_folder
@given(grids_with_costs(), NAMES, RULES, SEEDS, st.floats(-30, 38))
def test_whatever_finite_weights_say_each_q_is_a_length_or_no_way(
    tmp_path: Path, place: Place, kind: str, rule: MoveRule, seed: int, exponent: float
) -> None:
    path, network = tmp_path / "model.safetensors", random_network(kind, filters=3)
    generator = np.random.default_rng(seed)
    for weights in network.tensors.values():
        weights[:] = np.clip(
            generator.normal(size=weights.shape) * 10**exponent, -3e38, 3e38
        )
    save_model(path, network, replace(METADATA, network=kind, sizes={"filters": 3}))
    grid, goal = place
    loaded, _ = load_model(path)
    q = network_field(loaded, grid, goal, rule).q
    longest = 2 * MAX_MULTIPLIER * grid.occupancy.size
    assert (np.isneginf(q) | ((q <= -1) & (q >= -longest))).all()


def test_a_file_that_claims_or_is_gigabytes_takes_no_memory(tmp_path: Path) -> None:
    sizes = {"height": 4096, "width": 4096, "filters": 4096}
    text = json.dumps({**asdict(METADATA), "sizes": sizes})
    tensors = {
        "x": {"dtype": "F32", "shape": [5 * 2**29], "data_offsets": [0, 10 * 2**30]}
    }
    header = json.dumps({"__metadata__": {"ddqn_planner": text}, **tensors}).encode()
    claim, path = (10 * 2**30).to_bytes(8, "little"), tmp_path / "huge.safetensors"
    with memory_grows_less_than(20):
        for begin in (claim, len(header).to_bytes(8, "little") + header, b""):
            path.write_bytes(begin)
            for size in (len(begin), len(begin) + 10 * 2**30):
                os.truncate(path, size)  # a hole: it takes no room
                with pytest.raises(ModelFileError):
                    load_model(path)


def test_what_is_no_regular_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "folder.safetensors").mkdir()
    os.mkfifo(tmp_path / "pipe.safetensors")
    (tmp_path / "zero.safetensors").symlink_to("/dev/zero")
    (tmp_path / "loop.safetensors").symlink_to(tmp_path / "loop.safetensors")
    for name in (
        "folder",
        "pipe",
        "zero",
        "loop",
        "nul\0",
        "lone\ud800",
        "long" * 2000,
        "none",
    ):
        with pytest.raises(
            ModelFileError, match=r"no model file|is a |NUL|half a char|too long"
        ):
            load_model(tmp_path / f"{name}.safetensors")
    for name in ("no_such_model", "no/such.safetensors", "/etc/passwd", "x" * 99):
        with pytest.raises(ModelFileError, match=name):
            load_model(name)


def test_an_unreadable_file_is_refused(plain_folder: Path, network: QNetwork) -> None:
    path = plain_folder / "model.safetensors"
    save_model(path, network, METADATA)
    path.chmod(0)
    with pytest.raises(ModelFileError, match=r"[Pp]ermission denied"):
        load_model(path)


@given(
    st.text()
    | st.sampled_from(["..", ".", "/", "~", "any_map\0", "../any_map", "any_map/"])
)
def test_a_model_of_any_name_is_shipped_or_refused(name: str) -> None:
    with suppress(ModelFileError):
        load_model(name)
        assert name in ("any_map", "dilemma", "differential_robot", "car")


def test_a_model_is_saved_only_where_it_can_be_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    planner = Planner.load("dilemma")
    for name in ("m.pt", "mm", "any_map", Path("m.pt")):
        with pytest.raises(ValueError, match=r"give a name that ends in .safetensors"):
            planner.save(name)
    assert not [*tmp_path.iterdir()]
    for name in ("m.safetensors", "./m.pt", "./any_map", str(tmp_path / "mm")):
        planner.save(name)
        assert Planner.load(name).metadata == planner.metadata
    with pytest.raises(ModelFileError, match=r"give './m\.pt' for the file"):
        Planner.load("m.pt")
