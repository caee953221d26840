"""Model files: safetensors with JSON metadata. Nothing in them is unpickled."""

from __future__ import annotations

import json
import os
import reprlib
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Final

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open

from ddqn_planner.files import write_atomically
from ddqn_planner.grid import MoveRule
from ddqn_planner.model.networks import PaperQNetwork
from ddqn_planner.model.propagation import AnyMapQNetwork, PropagationQNetwork
from ddqn_planner.resources import PACKAGE, find_resource

METADATA_KEY = "ddqn_planner"
MODEL_SUFFIX = ".safetensors"
MAX_SIZE = 4096
"""Largest network size (height, width, filters, hidden units) that a model file may ask for."""

MAX_FILE_BYTES = 2**28
"""A larger file is refused before it is read."""


AnyQNetwork = PaperQNetwork | PropagationQNetwork | AnyMapQNetwork

SIZES: Final = {
    "paper": ("height", "width", "filters", "hidden_units"),
    "propagation": ("filters",),
    "any_map": ("filters",),
}
"""The arguments of each kind of network."""

FIELD_TYPES: Final[dict[str, tuple[type, ...]]] = {
    "network": (str,),
    "sizes": (dict,),
    "move_rule": (str,),
    "gamma": (float, int),
    "map_fingerprint": (str,),
    "steps": (int,),
    "seed": (int,),
    "package_version": (str,),
}
"""What JSON makes of each entry of `ModelMetadata`."""


class ModelFileError(ValueError):
    """A model file cannot be used; the message says why and what to do."""


@dataclass(frozen=True)
class ModelMetadata:
    """What a model file says of its network.

    Parameters
    ----------
    network : str
        Kind of network: ``"paper"``, ``"propagation"`` or ``"any_map"``.
    sizes : dict
        The arguments of the network's class, see `SIZES`.
    move_rule : MoveRule
        The rule under which it was trained.
    gamma : float
        The discount γ of its Q values, 0..1.
    map_fingerprint : str
        `GridMap.fingerprint` of the map (the first of several) on which it was trained.
    steps : int
        Environment steps of its training.
    seed : int
    package_version : str
    """

    network: str
    sizes: dict[str, int]
    move_rule: MoveRule
    gamma: float
    map_fingerprint: str
    steps: int
    seed: int
    package_version: str


def package_version() -> str:
    """Return the version of the installed package, or "unknown" in a bare source tree."""
    try:
        return metadata.version(PACKAGE)
    except metadata.PackageNotFoundError:
        return "unknown"


def find_model(name: str | Path) -> Path:
    """Return the file of a model given by path, or by the name of a shipped one.

    Raises
    ------
    ModelFileError
        If there is neither such a file nor such a shipped model.
    """
    if Path(name).suffix == MODEL_SUFFIX or Path(name).name != str(name):
        if os.path.isfile(name):
            return Path(name)
        raise ModelFileError(f"there is no model file {str(name)!r}; check the path")
    try:
        return find_resource("models", f"{name}{MODEL_SUFFIX}")
    except FileNotFoundError as error:
        raise ModelFileError(
            f"there is no shipped model {str(name)!r}: {error}; give one of these or the path of "
            f"a {MODEL_SUFFIX} file"
        ) from None


def save_model(path: str | Path, network: AnyQNetwork, description: ModelMetadata) -> None:
    """Write a model file; the old file stays whole until the new one is.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    tensors = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    content = safetensors.torch.save(tensors, {METADATA_KEY: json.dumps(asdict(description))})
    write_atomically(Path(path), content)


def load_model(name: str | Path) -> tuple[AnyQNetwork, ModelMetadata]:
    """Read a model file.

    Parameters
    ----------
    name : str or Path
        Name of a shipped model, or the path of a ``.safetensors`` file.

    Raises
    ------
    ModelFileError
        If the file is missing, truncated, not safetensors, or not a model of this package.
    """
    path = find_model(name)
    try:
        with path.open("rb"):  # safetensors says of a file that it may not read that there is none
            return _load(path)
    except OSError as error:
        raise ModelFileError(f"{path}: cannot be read ({error}); check its rights") from None
    except SafetensorError as error:
        raise ModelFileError(
            f"{path}: cannot be read as safetensors ({error}); it is truncated or of another "
            "kind: save or copy it again"
        ) from None


def new_network(kind: str, sizes: dict[str, int]) -> AnyQNetwork:
    """Return a network with random weights; see `ModelMetadata` for the parameters."""
    if kind == "any_map":
        return AnyMapQNetwork(**sizes)
    if kind == "propagation":
        return PropagationQNetwork(**sizes)
    return PaperQNetwork(**sizes)


def _load(path: Path) -> tuple[AnyQNetwork, ModelMetadata]:
    size = os.path.getsize(path)
    if size > MAX_FILE_BYTES:
        raise ModelFileError(f"{path}: has {size} bytes; give a model of at most {MAX_FILE_BYTES}")
    with safe_open(path, framework="pt") as file:
        text = (file.metadata() or {}).get(METADATA_KEY)
        if text is None:
            raise ModelFileError(
                f"{path}: is safetensors, but no model of {PACKAGE} (it has no metadata "
                f"{METADATA_KEY!r}); give a file that ddqn-planner or trainer_node saved"
            )
        try:
            description = _parse(json.loads(text))
            with torch.device("meta"):
                network = new_network(description.network, description.sizes)
        except (ValueError, RecursionError) as error:
            raise ModelFileError(
                f"{path}: its metadata is wrong ({error}); train the model again"
            ) from None
        weights = network.state_dict()
        expected = {key: ("F32", [*tensor.shape]) for key, tensor in weights.items()}
        slices = {key: file.get_slice(key) for key in file.keys()}  # noqa: SIM118
        found = {key: (part.get_dtype(), part.get_shape()) for key, part in slices.items()}
        if expected != found:
            raise ModelFileError(
                f"{path}: holds tensors {reprlib.repr(found)}, not {expected}; train it again"
            )
        # Copies: the tensors of an open file change, or end the process, when the file does.
        tensors = {key: file.get_tensor(key).clone() for key in found}
    if not all(bool(tensor.isfinite().all()) for tensor in tensors.values()):
        raise ModelFileError(f"{path}: its weights are not all finite; train it again")
    network.load_state_dict(tensors, assign=True)
    return network.requires_grad_(False), description


def _parse(values: object) -> ModelMetadata:
    if not isinstance(values, dict):
        raise ValueError(f"it is {reprlib.repr(values)}; it must be a JSON object")
    wrong = sorted(values.keys() ^ FIELD_TYPES.keys())
    if wrong:
        raise ValueError(f"it lacks, or should not have, {reprlib.repr(wrong)}")
    for key, types in FIELD_TYPES.items():
        if type(values[key]) not in types:
            names = " or ".join(known.__name__ for known in types)
            raise ValueError(f"{key} is {reprlib.repr(values[key])}; it must be {names}")
    network, sizes = values["network"], values["sizes"]
    if network not in SIZES:
        raise ValueError(f"network is {reprlib.repr(network)}; this version knows {[*SIZES]}")
    if network == "paper":  # files of version 0.1.0 do not name it: their networks have none
        sizes = {**sizes, "hidden_units": sizes.get("hidden_units", 0)}
    if sizes.keys() != set(SIZES[network]):
        raise ValueError(f"sizes is {reprlib.repr(sizes)}; it must have {[*SIZES[network]]}")
    for name, size in sizes.items():
        least = 0 if name == "hidden_units" else 1
        if type(size) is not int or not least <= size <= MAX_SIZE:
            raise ValueError(
                f"size {name} is {reprlib.repr(size)}; it must lie in {least} to {MAX_SIZE}"
            )
    if not 0 <= values["gamma"] <= 1:
        raise ValueError(f"gamma is {values['gamma']}; it must lie in 0 to 1")
    return ModelMetadata(**{**values, "sizes": sizes, "move_rule": MoveRule(values["move_rule"])})
