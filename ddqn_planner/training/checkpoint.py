"""The file format of checkpoints: safetensors, a description in JSON, and a digest."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from ddqn_planner.files import kind_of, open_regular

CHECKPOINT = "checkpoint.safetensors"  # in the folder of a training
CHECKPOINT_KEY = "ddqn_planner_checkpoint"
DIGEST_KEY = "sha256"
HEAD = 4096  # bytes; the key is among the first 200 of a checkpoint


class CheckpointError(ValueError):
    """A checkpoint cannot be resumed; the message says why and what to do."""


def digest_of(text: str, tensors: Mapping[str, NDArray[Any]]) -> str:
    """Return SHA-256 of a checkpoint's description and arrays, in hexadecimal."""
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        digest.update(name.encode())
        digest.update(tensors[name].ravel().data)
    return digest.hexdigest()


def check_checkpoint(path: Path) -> None:
    """Raise a CheckpointError unless a file is a checkpoint, which may be broken.

    It is one by its content, or by the name that it has in the folder of a training.
    """
    remedy = "give the path of a checkpoint"
    try:
        with open_regular(path) as file:  # safe_open would wait for a pipe
            head = file.read(HEAD)
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no such file; {remedy}") from None
    except OSError as error:
        raise CheckpointError(
            f"{path}: cannot be read ({error.strerror}); check its rights"
        ) from None
    except ValueError:  # of a folder or a pipe
        if path.name == CHECKPOINT:
            remedy = f"{remedy}, or train into another folder"
        raise CheckpointError(f"{path}: is {kind_of(path)}; {remedy}") from None
    if path.name != CHECKPOINT and CHECKPOINT_KEY.encode() not in head:
        raise CheckpointError(f"{path}: is no checkpoint; {remedy}")


def reason_of(error: Exception) -> str:
    """Return in words why a checkpoint cannot be read."""
    if isinstance(error, KeyError):
        return f"it lacks {error}"
    return str(error) or type(error).__name__
