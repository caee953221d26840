"""How much memory a training takes, and how much there is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from ddqn_planner.model import NETWORKS, PropagationQNetwork
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters

REMEDY: Final = (
    "take a smaller map, or smaller filters, batch_size, environments or replay_capacity"
)


class MemoryShortageError(ValueError):
    """A training cannot fit into the memory that is available."""


def check_memory(scenarios: Sequence[Scenario], parameters: HyperParameters) -> int:
    """Return what a training takes, bytes; see `training_bytes`.

    Raises
    ------
    MemoryShortageError
        If that is more than what is available.
    """
    needed, available = training_bytes(scenarios, parameters), available_bytes()
    if needed > available:
        raise MemoryShortageError(
            f"the training takes about {megabytes(needed)} of memory, and {megabytes(available)} "
            f"are available; {REMEDY}"
        )
    return needed


def megabytes(count: int) -> str:
    """Return a number of bytes as text."""
    return f"{count / 1e6:,.0f} MB"


def training_bytes(scenarios: Sequence[Scenario], parameters: HyperParameters) -> int:
    """Return about how much memory a training takes at its peak, beside the program itself.

    The numbers count the float32 and int64 arrays that are alive at once in the environment, the
    encoder, an update and a save; `test/training/test_memory.py` holds them against processes.
    """
    grid, p = scenarios[0].grid, parameters
    cells, maps = grid.width * grid.height, len(scenarios)
    network = NETWORKS[p.network]
    shapes = network.shapes(p.network_sizes((grid.height, grid.width)))
    weights = sum(map(math.prod, shapes.values()))

    # Per cell of each map: legal moves, two tables of rewards, free cells, what lies in the cells.
    tables = maps * cells * (8 + 2 * 8 * 4 + 8 + 4)
    # Made on the way: distances, neighbours and moves, float64 and int64, of one map at a time.
    tables += cells * 8 * 8 * 4
    if not issubclass(network, PropagationQNetwork):
        patches = (grid.height + 1) // 2 * ((grid.width + 1) // 2)
        # An update: observations and their 3x3 patches of states and next states, then features,
        # their gradient, and what it is made of. A step: the same of one state per environment.
        update = p.batch_size * (4 * cells + 18 * patches + 3 * p.filters * patches)
        step = p.environments * (2 * cells + 9 * patches + p.filters * patches)
        batch = 4 * max(update, step)
    else:
        # Per cell of each map: what is seen, and two layers or then six arrays of the propagation.
        batch = maps * cells * 4 * (network.features + max(2 * p.filters, 6 * 8))
    # Both networks, the gradient and Adam's two means stay. A save copies all of them except the
    # gradient twice, and the replay buffer, 40 bytes per transition, too.
    kept = 5 * 4 * weights + 40 * p.replay_capacity
    saved = 2 * (4 * 4 * weights + 40 * p.replay_capacity)
    return tables + kept + max(batch, saved)


def available_bytes() -> int:
    """Return the memory that a process may still take, as Linux says; without it, 2^63 - 1."""
    available = 2**63 - 1
    with suppress(OSError, KeyError, ValueError):
        available = _numbers("/proc/meminfo")["MemAvailable:"] * 1024
    # The limit of a container; what it caches of files it can give back.
    with suppress(OSError, KeyError, ValueError):
        limit = int(Path("/sys/fs/cgroup/memory.max").read_text())
        available = min(available, limit - _numbers("/sys/fs/cgroup/memory.stat")["anon"])
    return available


def _numbers(path: str) -> dict[str, int]:
    """Return what a file of the kernel says: a name and a number on each line."""
    lines = map(str.split, Path(path).read_text().splitlines())
    return {name: int(number) for name, number, *_ in lines}
