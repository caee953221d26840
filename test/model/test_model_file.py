from __future__ import annotations

import json
import pickle
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch

from ddqn_planner.grid import GridMap, MoveRule
from ddqn_planner.model import (
    ModelFileError,
    ModelMetadata,
    PaperQNetwork,
    load_model,
    new_network,
    save_model,
)

METADATA = ModelMetadata(
    network="paper",
    sizes={"height": 4, "width": 5, "filters": 2},
    move_rule=MoveRule.ROBOT_SAFE,
    gamma=0.95,
    map_fingerprint="0123456789abcdef",
    steps=7,
    seed=3,
    package_version="0.1.0",
)


@pytest.fixture
def network() -> PaperQNetwork:
    return PaperQNetwork(4, 5, filters=2)


@pytest.fixture
def model_path(tmp_path: Path, network: PaperQNetwork) -> Path:
    path = tmp_path / "model.safetensors"
    save_model(path, network, METADATA)
    return path


def test_a_saved_model_comes_back_the_same(model_path: Path, network: PaperQNetwork) -> None:
    loaded, metadata = load_model(model_path)
    assert metadata == METADATA
    request = GridMap(np.zeros((4, 5))), (1, 1), MoveRule.ROBOT_SAFE
    np.testing.assert_array_equal(loaded.q_values(*request), network.q_values(*request))


@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused(model_path: Path, fraction: float) -> None:
    content = model_path.read_bytes()
    model_path.write_bytes(content[: int(len(content) * fraction)])
    with pytest.raises(ModelFileError, match="truncated"):
        load_model(model_path)


def test_a_pickle_is_not_run(tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self) -> tuple[object, ...]:
            return (Path(tmp_path / "exploded").touch, ())

    path = tmp_path / "model.safetensors"
    path.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(ModelFileError, match="another kind"):
        load_model(path)
    assert not (tmp_path / "exploded").exists()


def save_as(path: Path, weights: PaperQNetwork, **changes: object) -> None:
    description = {**asdict(METADATA), **changes}
    content = safetensors.torch.save(
        weights.state_dict(), {"ddqn_planner": json.dumps(description)}
    )
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"network": "resnet"}, "resnet"),
        ({"move_rule": "flying"}, "flying"),
        ({"sizes": {"height": 4, "width": 5, "filters": 10**9}}, "filters is 1000000000"),
        ({"sizes": {"height": 4, "width": 5, "filters": "2"}}, "filters is '2'"),
        ({"sizes": {"height": 4, "width": 5}}, "filters"),
        ({"sizes": {"height": 6, "width": 5, "filters": 2}}, "holds tensors"),
        ({"extra": 1}, "extra"),
    ],
)
def test_wrong_metadata_is_refused_by_name(
    tmp_path: Path, network: PaperQNetwork, changes: dict[str, object], named: str
) -> None:
    path = tmp_path / "model.safetensors"
    save_as(path, network, **changes)
    with pytest.raises(ModelFileError, match=named):
        load_model(path)


@pytest.mark.parametrize("kind", ["propagation", "any_map"])
def test_a_network_for_any_size_comes_back_the_same(tmp_path: Path, kind: str) -> None:
    path, network = tmp_path / "model.safetensors", new_network(kind, {"filters": 3})
    description = replace(METADATA, network=kind, sizes={"filters": 3})
    save_model(path, network, description)
    loaded, read = load_model(path)
    assert read == description
    request = GridMap(np.zeros((3, 6))), (5, 2), MoveRule.CORNER_CUTTING
    np.testing.assert_array_equal(loaded.q_values(*request), network.q_values(*request))


def test_safetensors_of_another_program_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    path.write_bytes(safetensors.torch.save({"weight": torch.zeros(2)}))
    with pytest.raises(ModelFileError, match="no model of ddqn_planner"):
        load_model(path)


def test_weights_that_are_not_finite_are_refused(tmp_path: Path, network: PaperQNetwork) -> None:
    with torch.no_grad():
        network.fully_connected.bias[0] = torch.nan
    path = tmp_path / "model.safetensors"
    save_model(path, network, METADATA)
    with pytest.raises(ModelFileError, match="finite"):
        load_model(path)


@pytest.mark.parametrize("name", ["no_such_model", "no/such.safetensors", "/etc/passwd"])
def test_a_missing_or_foreign_file_is_named(name: str) -> None:
    with pytest.raises(ModelFileError, match=name):
        load_model(name)


def test_a_model_that_cannot_be_written_leaves_the_old_one(
    model_path: Path, network: PaperQNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = model_path.read_bytes()

    def full_disk(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full_disk)
    with pytest.raises(OSError, match="No space left"):
        save_model(model_path, network, replace(METADATA, steps=8))
    assert model_path.read_bytes() == before
    assert list(model_path.parent.iterdir()) == [model_path]
