"""Model files: safetensors with JSON metadata. Nothing in them is unpickled."""

import json
import os
import reprlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray
from safetensors import SafetensorError

from ddqn_planner.files import as_path, is_missing, kind_of, read_file, write_atomically
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
    package_version: str  # that wrote the file


# The types of the entries of `ModelMetadata` in JSON.
TYPES: Final[dict[str, tuple[type, ...]]] = {
    "network": (str,),
    "sizes": (dict,),
    "move_rule": (str,),
    "gamma": (float, int),
    "map_fingerprint": (str,),
    "steps": (int,),
    "seed": (int,),
    "package_version": (str,),
}


def find_model(name: str | Path) -> Path:
    """Return the file of a model, given by its path or by a shipped model's name.

    A ModelFileError says what to do if there is no such file.
    """
    try:
        path = as_path(name, "the model")
    except ValueError as error:
        raise ModelFileError(str(error)) from None
    if _is_path(name, path):
        kind = kind_of(path)  # such as "a pipe"; empty for a regular or missing file
        if kind:
            raise ModelFileError(
                f"the model {str(path)!r} is {kind}; give a model file"
            )
        if is_missing(path):
            raise ModelFileError(
                f"there is no model file {str(path)!r}; check the path"
            )
        return path
    try:
        return find_resource("models", f"{name}{MODEL_SUFFIX}")
    except FileNotFoundError as error:
        problem = f"there is no shipped model {str(name)!r}: {error}"
        remedy = f"give one of these or the path of a {MODEL_SUFFIX} file"
        if os.path.isfile(path):
            remedy = f"give './{path}' for the file of that name"
        raise ModelFileError(f"{problem}; {remedy}") from None


def _is_path(name: str | Path, path: Path) -> bool:
    """Return whether the name of a model is a path: not a shipped model's name.

    `path` is that of `as_path`.
    """
    return path.suffix == MODEL_SUFFIX or path.name != str(name)


def check_model_path(path: str | Path) -> Path:
    """Return the path of a new model file, as `as_path`.

    A ValueError if `load_model` would take it for a shipped model's name.
    """
    file = as_path(path)
    if not _is_path(path, file):
        raise ValueError(
            f"the path {str(path)!r} would be read as a shipped model's name; give a "
            f"name that ends in {MODEL_SUFFIX}"
        )
    return file


def save_model(path: str | Path, network: QNetwork, description: ModelMetadata) -> None:
    """Write a model file; an older file stays until the new one is complete.

    A ValueError says that `load_model` would not read the file by this path.
    """
    write_atomically(check_model_path(path), model_bytes(network, description))


def model_bytes(network: QNetwork, description: ModelMetadata) -> bytes:
    """Return the content of a model file."""
    text = json.dumps(asdict(description))
    return bytes(safetensors.numpy.save(network.tensors, {METADATA_KEY: text}))


def load_model(name: str | Path) -> tuple[QNetwork, ModelMetadata]:
    """Read a model file, given by its path or by a shipped model's name.

    Raises
    ------
    ModelFileError
        If there is no such file, or it cannot be used.
    """
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
    """Return the model in the content of a model file, see `model_bytes`.

    Raises
    ------
    ValueError
        If the bytes are no model; the message says why and what to do.
    """
    try:
        tensors = safetensors.numpy.load(data)
    except (SafetensorError, KeyError) as error:  # KeyError: a type that NumPy lacks
        raise ValueError(
            f"cannot be read as safetensors ({error}); it is truncated or of another "
            "kind: save or copy it again"
        ) from None
    header_length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + header_length])
    text = (header.get("__metadata__") or {}).get(METADATA_KEY)
    if text is None:
        raise ValueError(
            f"is safetensors, but no model of {PACKAGE} (it has no metadata "
            f"{METADATA_KEY!r}); give a file that ddqn-planner or trainer_node saved"
        )
    try:
        description = _description_of(json.loads(text))
    except (ValueError, RecursionError) as error:
        raise ValueError(
            f"its metadata is wrong ({error}); train the model again"
        ) from None
    network_class = NETWORKS[description.network]
    tensors = {**network_class.former_tensors, **tensors}
    _check_tensors(tensors, network_class, description.sizes)
    return network_class(description.sizes, tensors), description


def _check_tensors(
    tensors: Mapping[str, NDArray[np.generic]],
    network_class: type[QNetwork],
    sizes: Mapping[str, int],
) -> None:
    """Raise a ValueError unless the tensors are those of a network of these sizes.

    Their names, dtypes and shapes must be those of the class, all values finite.
    """
    kinds = {
        name: (tensor.dtype.name, tensor.shape) for name, tensor in tensors.items()
    }
    expected = {
        name: ("float64" if name in network_class.doubles else "float32", shape)
        for name, shape in network_class.shapes(sizes).items()
    }
    if kinds != expected:
        raise ValueError(
            f"holds tensors {reprlib.repr(kinds)}, not {expected}; train it again"
        )
    if not all(np.isfinite(tensor).all() for tensor in tensors.values()):
        raise ValueError("its weights are not all finite; train it again")


def _description_of(values: object) -> ModelMetadata:
    """Return a network's description from JSON; a ValueError says what is wrong.

    `values` is the decoded JSON: it should be a dict with the keys of `TYPES`.
    """
    if not isinstance(values, dict):
        raise ValueError(f"it is {reprlib.repr(values)}; it must be a JSON object")
    wrong_keys = sorted(values.keys() ^ TYPES.keys())
    if wrong_keys:
        raise ValueError(f"it lacks, or should not have, {reprlib.repr(wrong_keys)}")
    for key, types in TYPES.items():
        if type(values[key]) not in types:
            names = " or ".join(kind.__name__ for kind in types)
            raise ValueError(
                f"{key} is {reprlib.repr(values[key])}; it must be {names}"
            )
    network = values["network"]
    if network not in NETWORKS:
        raise ValueError(
            f"network is {reprlib.repr(network)}; this version knows {[*NETWORKS]}"
        )
    sizes = _sizes_of(values["sizes"], NETWORKS[network])
    if not 0 <= values["gamma"] <= 1:
        raise ValueError(f"gamma is {values['gamma']}; it must lie in 0 to 1")
    move_rule = values["move_rule"]
    if move_rule == "unit":  # until version 0.9; the same moves are legal
        move_rule = MoveRule.CORNER_CUTTING
    return ModelMetadata(**{**values, "sizes": sizes, "move_rule": MoveRule(move_rule)})


def _sizes_of(
    values: Mapping[str, object], network_class: type[QNetwork]
) -> dict[str, int]:
    """Return the sizes of a network, from JSON; a ValueError says what is wrong.

    `values` should have an int for each of the class's `size_names`.
    """
    size_names = network_class.size_names
    values = {**network_class.former_sizes, **values}
    if values.keys() != set(size_names):
        raise ValueError(
            f"sizes is {reprlib.repr(dict(values))}; it must have {[*size_names]}"
        )
    sizes: dict[str, int] = {}
    for name in size_names:
        size = values[name]
        smallest = 0 if name == "hidden_units" else 1
        largest = network_class.max_size
        if type(size) is not int or not smallest <= size <= largest:
            raise ValueError(
                f"size {name} is {reprlib.repr(size)}; it must lie in {smallest} to "
                f"{largest}"
            )
        sizes[name] = size
    return sizes
