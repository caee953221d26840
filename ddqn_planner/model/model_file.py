"""Model files: safetensors with JSON metadata. Nothing is ever unpickled."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Final

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from ddqn_planner.files import write_atomically
from ddqn_planner.grid import MoveRule
from ddqn_planner.model.networks import PaperQNetwork
from ddqn_planner.model.propagation import AnyMapQNetwork, PropagationQNetwork
from ddqn_planner.resources import PACKAGE, find_resource

METADATA_KEY = "ddqn_planner"
MODEL_SUFFIX = ".safetensors"
MAX_SIZE = 4096
"""Largest network size (height, width, filters) that a model file may ask for."""


AnyQNetwork = PaperQNetwork | PropagationQNetwork | AnyMapQNetwork

SIZES: Final = {
    "paper": ("height", "width", "filters"),
    "propagation": ("filters",),
    "any_map": ("filters",),
}
"""The arguments of each kind of network."""


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
        if Path(name).is_file():
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
    tensors, text = _read(path)
    try:
        description = _parse(json.loads(text))
        with torch.device("meta"):
            network = new_network(description.network, description.sizes)
    except (TypeError, ValueError, KeyError, RecursionError) as error:
        raise ModelFileError(
            f"{path}: its metadata is wrong ({error}); train the model again"
        ) from None
    expected = {key: tuple(tensor.shape) for key, tensor in network.state_dict().items()}
    found = {key: tuple(tensor.shape) for key, tensor in tensors.items()}
    if expected != found:
        raise ModelFileError(f"{path}: holds tensors {found}, not {expected}; train it again")
    if not all(t.dtype == torch.float32 and bool(t.isfinite().all()) for t in tensors.values()):
        raise ModelFileError(f"{path}: its weights are not all finite float32; train it again")
    network.load_state_dict(tensors, assign=True)
    return network.requires_grad_(False), description


def new_network(kind: str, sizes: dict[str, int]) -> AnyQNetwork:
    """Return a network with random weights; see `ModelMetadata` for the parameters."""
    if kind == "any_map":
        return AnyMapQNetwork(**sizes)
    if kind == "propagation":
        return PropagationQNetwork(**sizes)
    return PaperQNetwork(**sizes)


def _read(path: Path) -> tuple[dict[str, Tensor], str]:
    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get(METADATA_KEY)
            if text is None:
                raise ModelFileError(
                    f"{path}: is safetensors, but no model of {PACKAGE} (it has no metadata "
                    f"{METADATA_KEY!r}); give a file that ddqn-planner or trainer_node saved"
                )
            return {key: file.get_tensor(key) for key in file.keys()}, text  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise ModelFileError(
            f"{path}: cannot be read as safetensors ({error}); it is truncated or of another "
            "kind: save or copy it again"
        ) from None


def _parse(values: dict[str, Any]) -> ModelMetadata:
    if values["network"] not in SIZES:
        raise ValueError(f"network is {values['network']!r}; this version knows {[*SIZES]}")
    sizes = values["sizes"]
    for name in SIZES[values["network"]]:
        if type(sizes[name]) is not int or not 1 <= sizes[name] <= MAX_SIZE:
            raise ValueError(f"size {name} is {sizes[name]!r}; it must lie in 1 to {MAX_SIZE}")
    return ModelMetadata(**{**values, "move_rule": MoveRule(values["move_rule"])})
