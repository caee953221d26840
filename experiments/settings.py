"""What the experiments have in common: their settings, their folders, and statistics over seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from profiles import HIDDEN_UNITS, MOVE_RULE
from trainings import Training, TrainingEvaluation, read_evaluations

from ddqn_planner.grid import Noise, shortest_distances
from ddqn_planner.planning import Planner
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters


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

    def options(self) -> str:
        """Return the options of the command line that give these settings, except the folder."""
        options = [f"--seeds {self.seeds}"]
        if self.noise != tuple(Noise):
            options.append(f"--noise {' '.join(noise.value for noise in self.noise)}")
        if self.hidden_units != HIDDEN_UNITS:
            options.append(f"--hidden-units {' '.join(map(str, self.hidden_units))}")
        return " ".join([*options, *(["--quick"] if self.quick else [])])

    def shorten(self, parameters: HyperParameters) -> HyperParameters:
        """Return the parameters, with fewer steps if the settings say quick."""
        return replace(parameters, steps=min(parameters.steps, 1_000 if self.quick else 10**9))

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

    def evaluations(self, name: str) -> list[list[TrainingEvaluation]]:
        """Return the evaluations of the trainings with a name, one list per seed."""
        return [read_evaluations(folder) for folder in self.folders(name)]

    def planners(self, name: str, file: str = "model.safetensors") -> list[Planner]:
        """Load the planners that the trainings with a name produced, one per seed."""
        return [Planner.load(folder / file) for folder in self.folders(name)]


def optimal_length(scenario: Scenario) -> float:
    """Return the length of the shortest path from start to goal, cells."""
    distances = shortest_distances(scenario.grid, scenario.goal, MOVE_RULE)
    return float(distances[scenario.start[::-1]])


def median_and_range(values: Sequence[float], digits: int = 0) -> str:
    """Return the median, least and greatest value of the seeds: ``"3 (1 to 4)"``.

    Infinity means never; NaN is left out.
    """
    values = [value for value in values if not np.isnan(value)]
    if not values:
        return "none"
    low, middle, high = (
        "never" if np.isinf(v) else f"{v:,.{digits}f}"
        for v in (min(values), float(np.median(values)), max(values))
    )
    return middle if low == high else f"{middle} ({low} to {high})"


def mean_and_worst(ratios: Sequence[Sequence[float] | NDArray[np.float64]]) -> list[str]:
    """Return two cells: the mean and the greatest ratio of each seed; a seed may have none."""
    some = [of_seed for of_seed in ratios if len(of_seed)]
    return [
        median_and_range([float(function(of_seed)) for of_seed in some], 4)
        for function in (np.mean, np.max)
    ]


def first_kept(
    evaluations: Sequence[TrainingEvaluation], holds: Callable[[TrainingEvaluation], bool]
) -> TrainingEvaluation | None:
    """Return the evaluation from which on a condition holds to the end, if there is one."""
    first = None
    for evaluation in reversed(evaluations):
        if not holds(evaluation):
            break
        first = evaluation
    return first
