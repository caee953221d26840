"""How much memory a training takes, and how much is available."""

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
    """A training does not fit into the available memory."""


def check_memory(scenarios: Sequence[Scenario], parameters: HyperParameters) -> int:
    """Return `training_bytes`; a MemoryShortageError if less is available."""
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
    """Return about how many bytes a training takes at its peak, in addition to the program.

    It counts the arrays that exist at the same time in the environment, the encoder, an update and
    a save; `test/training/test_memory.py` compares it with measured processes.
    """
    grid, p = scenarios[0].grid, parameters
    cells, maps = grid.width * grid.height, len(scenarios)
    network = NETWORKS[p.network]
    shapes = network.shapes(p.network_sizes((grid.height, grid.width)))
    weights = sum(map(math.prod, shapes.values()))

    # Per cell of each map: legal moves, two tables of rewards, free cells, the background. Then,
    # for one map at a time: distances, neighbours and moves, float64 and int64.
    tables = maps * cells * (8 + 2 * 8 * 4 + 8 + 4) + cells * 8 * 8 * 4
    if not issubclass(network, PropagationQNetwork):
        patches = (grid.height + 1) // 2 * ((grid.width + 1) // 2)
        # Update: observations and 3x3 patches of states and next states; then features, their
        # gradient, and its inputs. Step: the same of one state per environment, without gradient.
        update = p.batch_size * (4 * cells + 18 * patches + 3 * p.filters * patches)
        step = p.environments * (2 * cells + 9 * patches + p.filters * patches)
        batch = 4 * max(update, step)
    else:
        # Per cell of each map: features, and two layers or the six arrays of the propagation.
        batch = maps * cells * 4 * (network.inputs + max(2 * p.filters, 6 * 8))
    # Two networks, the gradient and Adam's two means stay, with 40 bytes per transition. A save
    # makes two copies of all these except the gradient.
    replay = 40 * p.replay_capacity
    kept = 5 * 4 * weights + replay
    saved = 2 * (4 * 4 * weights + replay)
    return tables + kept + max(batch, saved)


def available_bytes() -> int:
    """Return the memory that a process may still take: what Linux says, elsewhere 2^63 - 1."""
    available = 2**63 - 1
    with suppress(OSError, KeyError, ValueError):
        available = _numbers("/proc/meminfo")["MemAvailable:"] * 1024
    # The limit of a container. Its file cache does not count, since Linux can free it.
    with suppress(OSError, KeyError, ValueError):
        limit = int(Path("/sys/fs/cgroup/memory.max").read_text())
        available = min(available, limit - _numbers("/sys/fs/cgroup/memory.stat")["anon"])
    return available


def _numbers(path: str) -> dict[str, int]:
    """Return the numbers in a file of the kernel that has a name and a number in each line."""
    lines = map(str.split, Path(path).read_text().splitlines())
    return {name: int(number) for name, number, *_ in lines}
