"""The two profiles that every experiment compares, and the four variants of its ablation."""

from __future__ import annotations

from typing import Any, Final

from ddqn_planner.grid import Cell, MoveRule
from ddqn_planner.training.hyper_parameters import HyperParameters

MOVE_RULE: Final = MoveRule.CORNER_CUTTING
"""The rule under which the paper's 22.97 is the shortest path (docs/reproduction.md)."""

HIDDEN_UNITS: Final = (0, 128)
"""Sizes of the hidden layer with which goal iii tries the paper's network; 0 for none."""

START_DEAD_END: Final[frozenset[Cell]] = frozenset(
    {(6, 6), (4, 6), (4, 7), (4, 8), (5, 6), (5, 7), (5, 8), (6, 7), (6, 8), (7, 6), (7, 7)}
)
"""The paper's dilemma on its rebuilt map: the start and ten more cells."""

PROFILES: Final[dict[str, HyperParameters]] = {
    "paper": HyperParameters(),
    "propagation": HyperParameters(
        network="propagation",
        filters=64,
        learning_rate=0.001,
        batch_size=128,
        target_interval=100,
        steps=15_000,
    ),
}
"""``paper``: its network, observation and Table 1, our choice where it is silent. ``propagation``:
the same rewards and initialisation, with another network and fewer steps."""

VARIANTS: Final[dict[str, dict[str, Any]]] = {
    "plain": {"p_r": 0.0, "alpha": 0.0, "beta": 0.0},
    "initialisation": {"alpha": 0.0, "beta": 0.0},
    "reward": {"p_r": 0.0},
    "both": {},
}
"""Plain Double DQN, each improvement alone, and both: what each sets."""
