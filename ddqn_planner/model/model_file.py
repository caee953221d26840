"""Model files: safetensors with JSON metadata. Nothing in them is unpickled."""

import json
import os
import reprlib
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final, get_origin

import numpy as np
import safetensors.numpy
from safetensors import SafetensorError

from ddqn_planner.files import as_path, kind_of, read_file, write_atomically
from ddqn_planner.grid import MoveRule
from ddqn_planner.model.networks import (
    AnyMapQNetwork,
    ModelFileError,
    PaperQNetwork,
    PropagationQNetwork,
    QNetwork,
)
from ddqn_planner.model.robot_network import RobotNetwork
from ddqn_planner.resources import PACKAGE, find_resource

METADATA_KEY = "ddqn_planner"
MODEL_SUFFIX = ".safetensors"
MAX_FILE_BYTES = 2**28  # a larger file is refused before it is read

NETWORKS: Final[dict[str, type[QNetwork]]] = {
    network.name: network
    for network in (PaperQNetwork, PropagationQNetwork, AnyMapQNetwork, RobotNetwork)
}


@dataclass(frozen=True)
class ModelMetadata:
    """The description of a network in its model file."""

    network: str  # a name in `NETWORKS`
    sizes: dict[str, int]  # a value for each of its `size_names`
    move_rule: MoveRule  # under which it was trained
    gamma: float  # the discount γ of its Q values, 0..1
    map_fingerprint: str  # of the first map on which it was trained
    steps: int  # of its training
    seed: int
    package_version: str


# The types of its entries in JSON.
TYPES: Any = {f.name: (get_origin(f.type) or f.type,) for f in fields(ModelMetadata)}
TYPES |= {"move_rule": (str,), "gamma": (float, int)}


def package_version() -> str:
    """Return the version of the installed package, or "unknown" in a bare source tree."""
    from importlib import metadata  # slow to import, and planning does not need it

    try:
        return metadata.version(PACKAGE)
    except metadata.PackageNotFoundError:
        return "unknown"


def find_model(name: str | Path) -> Path:
    """Return the file of a model given by path, or by the name of a shipped one."""
    try:
        path = as_path(name, "the model")
    except ValueError as error:
        raise ModelFileError(str(error)) from None
    if path.suffix == MODEL_SUFFIX or path.name != str(name):
        if kind := kind_of(path):
            raise ModelFileError(
                f"the model {str(path)!r} is {kind}; give a model file"
            )
        if os.path.exists(path):
            return path
        raise ModelFileError(f"there is no model file {str(path)!r}; check the path")
    try:
        return find_resource("models", f"{name}{MODEL_SUFFIX}")
    except FileNotFoundError as error:
        problem = f"there is no shipped model {str(name)!r}: {error}"
        remedy = f"give one of these or the path of a {MODEL_SUFFIX} file"
        raise ModelFileError(f"{problem}; {remedy}") from None


def save_model(path: str | Path, network: QNetwork, description: ModelMetadata) -> None:
    """Write a model file; the old file stays complete until the new one is."""
    write_atomically(as_path(path), model_bytes(network, description))


def model_bytes(network: QNetwork, description: ModelMetadata) -> bytes:
    """Return what a model file holds."""
    text = json.dumps(asdict(description))
    return bytes(safetensors.numpy.save(network.tensors, {METADATA_KEY: text}))


def load_model(name: str | Path) -> tuple[QNetwork, ModelMetadata]:
    """Read a model file, given by path or a shipped model's name; else raise ModelFileError."""
    path = find_model(name)
    try:
        content = read_file(path, MAX_FILE_BYTES)
    except OSError as error:
        problem = f"cannot be read ({error.strerror}); check its rights"
        raise ModelFileError(f"{path}: {problem}") from None
    except ValueError as error:
        raise ModelFileError(str(error)) from None
    try:
        return model_of(content)
    except ValueError as error:
        raise ModelFileError(f"{path}: {error}") from None


def model_of(data: bytes) -> tuple[QNetwork, ModelMetadata]:
    """Return the model of which `model_bytes` made the bytes; a ValueError if they are none."""
    try:
        tensors = safetensors.numpy.load(data)
    except (
        SafetensorError,
        KeyError,
    ) as error:  # or of numbers that NumPy does not have
        problem = f"cannot be read as safetensors ({error}); it is truncated or of another kind"
        raise ValueError(f"{problem}: save or copy it again") from None
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    text = (header.get("__metadata__") or {}).get(METADATA_KEY)
    if text is None:
        found = f"is safetensors, but no model of {PACKAGE} (it has no metadata {METADATA_KEY!r})"
        raise ValueError(
            f"{found}; give a file that ddqn-planner or trainer_node saved"
        )
    try:
        description = _parse(json.loads(text))
    except (ValueError, RecursionError) as error:
        raise ValueError(
            f"its metadata is wrong ({error}); train the model again"
        ) from None
    network_class, sizes = NETWORKS[description.network], description.sizes
    held = {name: (tensor.dtype.name, tensor.shape) for name, tensor in tensors.items()}
    expected = {
        name: ("float64" if name in network_class.doubles else "float32", shape)
        for name, shape in network_class.shapes(sizes).items()
    }
    if held != expected:
        raise ValueError(
            f"holds tensors {reprlib.repr(held)}, not {expected}; train it again"
        )
    if not all(np.isfinite(tensor).all() for tensor in tensors.values()):
        raise ValueError("its weights are not all finite; train it again")
    return network_class(sizes, tensors), description


def _parse(values: object) -> ModelMetadata:
    if not isinstance(values, dict):
        raise ValueError(f"it is {reprlib.repr(values)}; it must be a JSON object")
    wrong = sorted(values.keys() ^ TYPES.keys())
    if wrong:
        raise ValueError(f"it lacks, or should not have, {reprlib.repr(wrong)}")
    for key, types in TYPES.items():
        if type(values[key]) not in types:
            names = " or ".join(known.__name__ for known in types)
            raise ValueError(
                f"{key} is {reprlib.repr(values[key])}; it must be {names}"
            )
    network, sizes = values["network"], values["sizes"]
    if network not in NETWORKS:
        raise ValueError(
            f"network is {reprlib.repr(network)}; this version knows {[*NETWORKS]}"
        )
    if (
        network == "paper"
    ):  # missing in files of version 0.1.0, whose networks have none
        sizes = {"hidden_units": 0, **sizes}
    size_names = NETWORKS[network].size_names
    if sizes.keys() != set(size_names):
        raise ValueError(
            f"sizes is {reprlib.repr(sizes)}; it must have {[*size_names]}"
        )
    for name, size in sizes.items():
        least, most = 0 if name == "hidden_units" else 1, NETWORKS[network].max_size
        if type(size) is not int or not least <= size <= most:
            limits = f"{least} to {most}"
            raise ValueError(
                f"size {name} is {reprlib.repr(size)}; it must lie in {limits}"
            )
    if not 0 <= values["gamma"] <= 1:
        raise ValueError(f"gamma is {values['gamma']}; it must lie in 0 to 1")
    move_rule = values["move_rule"]
    if move_rule == "unit":  # until version 0.9; the same moves are legal
        move_rule = MoveRule.CORNER_CUTTING
    return ModelMetadata(**{**values, "sizes": sizes, "move_rule": MoveRule(move_rule)})
