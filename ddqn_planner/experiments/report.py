"""What the experiments' reports have in common: settings, tables, and spreads over seeds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.experiments.figures import Curve
from ddqn_planner.experiments.profiles import HIDDEN_UNITS, MOVE_RULE, PROFILES
from ddqn_planner.experiments.trainings import (
    Training,
    TrainingEvaluation,
    read_evaluations,
    training_folder,
)
from ddqn_planner.grid import Noise
from ddqn_planner.planning import Planner, shortest_distances
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters


@dataclass(frozen=True)
class Settings:
    """What the command line asks for.

    Parameters
    ----------
    out : Path
        Folder of the trainings, tables, figures and the report.
    seeds : int
        Trainings of each kind, with the seeds 0, 1, and so on; at least 1.
    quick : bool
        Train too briefly to learn anything, so that everything is run in little time.
    noise : tuple of Noise
    hidden_units : tuple of int
        The readings of goal iii, each noise with each hidden layer of the paper's network.
    """

    out: Path
    seeds: int
    quick: bool = False
    noise: tuple[Noise, ...] = tuple(Noise)
    hidden_units: tuple[int, ...] = HIDDEN_UNITS

    def options(self) -> str:
        """Return the options of the command line that give these settings, except the folder."""
        options = [f"--seeds {self.seeds}"]
        if self.noise != tuple(Noise):
            options.append(f"--noise {' '.join(noise.value for noise in self.noise)}")
        if self.hidden_units != HIDDEN_UNITS:
            options.append(f"--hidden-units {' '.join(map(str, self.hidden_units))}")
        return " ".join([*options, *(["--quick"] if self.quick else [])])

    def profile(self, name: str) -> HyperParameters:
        """Return the parameters of one of the `PROFILES`."""
        return self.shorten(PROFILES[name])

    def shorten(self, parameters: HyperParameters) -> HyperParameters:
        """Return the parameters, with less steps where the settings say quick."""
        return replace(parameters, steps=min(parameters.steps, 1_000 if self.quick else 10**9))

    def trainings(
        self,
        name: str,
        parameters: HyperParameters,
        scenarios: Sequence[Scenario],
        evaluation_interval: int = 250,
    ) -> list[Training]:
        """Return one training a seed."""
        return [
            Training(name, parameters, tuple(scenarios), seed, evaluation_interval)
            for seed in range(self.seeds)
        ]

    def evaluations(self, name: str) -> list[list[TrainingEvaluation]]:
        """Return the evaluations of the trainings of a name, a list a seed."""
        return [read_evaluations(folder) for folder in self.folders(name)]

    def planners(self, name: str, file: str = "model.safetensors") -> list[Planner]:
        """Return the planners that the trainings of a name gave, one a seed."""
        return [Planner.load(folder / file) for folder in self.folders(name)]

    def folders(self, name: str) -> list[Path]:
        """Return the folders of the trainings of a name, one a seed."""
        return [training_folder(self.out, name, seed) for seed in range(self.seeds)]


def optimal_length(scenario: Scenario) -> float:
    """Return the length of the shortest path from start to goal, cells."""
    distances = shortest_distances(scenario.grid, scenario.goal, MOVE_RULE)
    return float(distances[scenario.start[::-1]])


def evaluation_curve(runs: Sequence[Sequence[TrainingEvaluation]], column: str) -> Curve:
    """Return a column of the evaluations of each seed."""
    values = [[getattr(evaluation, column) for evaluation in run] for run in runs]
    return np.array([e.step for e in runs[0]], dtype=np.float64), np.array(values, dtype=np.float64)


def share_curve(runs: Sequence[Sequence[TrainingEvaluation]]) -> Curve:
    """Return the share of the seeds that are solved from the start."""
    steps, solved = evaluation_curve(runs, "solved")
    return steps, solved.mean(axis=0, keepdims=True)


def spread(values: Sequence[float], digits: int = 0) -> str:
    """Return the median of the seeds, and their least and greatest: ``"3 (1 to 4)"``.

    An infinite value is one that never came about; NaN is left out.
    """
    values = [value for value in values if not np.isnan(value)]
    if not values:
        return "none"
    low, middle, high = (
        "never" if np.isinf(v) else f"{v:,.{digits}f}"
        for v in (min(values), float(np.median(values)), max(values))
    )
    return middle if low == high else f"{middle} ({low} to {high})"


def mean(values: Sequence[float] | NDArray[np.float64]) -> float:
    """Return the mean of those that are not NaN; NaN if there is none."""
    finite = np.asarray(values)[~np.isnan(values)]
    return float(finite.mean()) if finite.size else float("nan")


def worst(values: Sequence[float] | NDArray[np.float64]) -> float:
    """Return the greatest of those that are not NaN; NaN if there is none."""
    finite = np.asarray(values)[~np.isnan(values)]
    return float(finite.max()) if finite.size else float("nan")


def first_kept(
    evaluations: Sequence[TrainingEvaluation], holds: Callable[[TrainingEvaluation], bool]
) -> TrainingEvaluation | None:
    """Return the evaluation from which on something holds to the end, if there is one."""
    first = None
    for evaluation in reversed(evaluations):
        if not holds(evaluation):
            break
        first = evaluation
    return first
