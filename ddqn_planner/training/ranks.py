"""Training one model in several processes: what they tell each other, by torch.distributed.

``torchrun`` starts the processes and tells each its rank, 0 to world size - 1. A process that was
started by itself is rank 0 of 1.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

import torch
from torch import Tensor, distributed


def join() -> None:
    """Join the processes that ``torchrun`` has started, if it has."""
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        distributed.init_process_group("gloo")


def leave() -> None:
    """Leave them."""
    if _joined():
        distributed.destroy_process_group()


def rank() -> int:
    """Return the number of this process, from 0."""
    return distributed.get_rank() if _joined() else 0


def world_size() -> int:
    """Return the number of processes, at least 1."""
    return distributed.get_world_size() if _joined() else 1


def average(gradients: Sequence[Tensor]) -> Sequence[Tensor]:
    """Return the mean of the gradients of all processes; each must call this as often."""
    if not _joined():
        return gradients
    together = torch.cat([gradient.flatten() for gradient in gradients])
    distributed.all_reduce(together)
    together /= world_size()
    parts = torch.split(together, [gradient.numel() for gradient in gradients])
    return [part.view_as(gradient) for part, gradient in zip(parts, gradients, strict=True)]


def greatest(value: int) -> int:
    """Return the greatest value of all processes; each must call this as often."""
    if not _joined():
        return value
    shared = torch.tensor(value)
    distributed.all_reduce(shared, distributed.ReduceOp.MAX)
    return int(shared)


def _joined() -> bool:
    return distributed.is_available() and distributed.is_initialized()
