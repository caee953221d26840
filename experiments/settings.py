"""What the paper's experiments have in common: two profiles, the options, and the folders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from trainings import MOVE_RULE, Evaluations, Training, read_evaluations

from ddqn_planner.grid import Cell, Noise, shortest_distances
from ddqn_planner.planning import Planner
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters

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


@dataclass(frozen=True)
class Settings:
    """The options of ``reproduce.py``."""

    out: Path
    """Folder of the trainings, tables, figures and the report."""
    seeds: int
    """Trainings per table row, with the seeds 0, 1, and so on; at least 1."""
    quick: bool = False
    """Train too briefly to learn anything, so that everything runs in little time."""
    noise: tuple[Noise, ...] = tuple(Noise)
    hidden_units: tuple[int, ...] = HIDDEN_UNITS
    """With the noise the readings of goal iii: hidden layers of the paper's network."""
    backend: str = "loky"
    """Where the trainings run; see `in_parallel`."""

    def folders(self, name: str) -> list[Path]:
        """Return the folders of the trainings with a name, one per seed."""
        return [self.out / "trainings" / name / f"seed_{seed}" for seed in range(self.seeds)]

    def trainings(
        self,
        parameters_of: Mapping[str, HyperParameters],
        scenarios: Sequence[Scenario],
        evaluation_interval: int = 250,
    ) -> list[Training]:
        """Return one training per name and seed, shortened if the settings say quick."""
        return [
            Training(folder, self.shorten(parameters), tuple(scenarios), seed, evaluation_interval)
            for name, parameters in parameters_of.items()
            for seed, folder in enumerate(self.folders(name))
        ]

    def shorten(self, parameters: HyperParameters) -> HyperParameters:
        """Return the parameters, with fewer steps if the settings say quick."""
        return replace(parameters, steps=min(parameters.steps, 1_000 if self.quick else 10**9))

    def evaluations(self, name: str) -> list[Evaluations]:
        """Return the evaluations of the trainings with a name, one table per seed."""
        return [read_evaluations(folder) for folder in self.folders(name)]

    def planners(self, name: str, file: str = "model.safetensors") -> list[Planner]:
        """Load the planners that the trainings with a name produced, one per seed."""
        return [Planner.load(folder / file) for folder in self.folders(name)]


def optimal_length(scenario: Scenario) -> float:
    """Return the length of the shortest path from start to goal, cells."""
    distances = shortest_distances(scenario.grid, scenario.goal, MOVE_RULE)
    return float(distances[scenario.start[::-1]])
