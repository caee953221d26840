"""The file format of checkpoints: safetensors, a description in JSON, and a digest."""

import hashlib
from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

CHECKPOINT_KEY = "ddqn_planner_checkpoint"
DIGEST_KEY = "sha256"


class CheckpointError(ValueError):
    """A checkpoint cannot be resumed; the message says why and what to do."""


def digest_of(text: str, tensors: Mapping[str, NDArray[Any]]) -> str:
    """Return SHA-256 of a checkpoint's description and arrays, in hexadecimal."""
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        digest.update(name.encode())
        digest.update(tensors[name].ravel().data)
    return digest.hexdigest()
