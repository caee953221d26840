"""Trainings with regular evaluations: many in parallel, each in a folder of its own."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any, Final

import joblib
import numpy as np
import torch
from numpy.typing import NDArray
from profiles import MOVE_RULE
from tqdm import tqdm

from ddqn_planner.files import write_csv
from ddqn_planner.grid import neighbours
from ddqn_planner.planning import Plan, Planner
from ddqn_planner.training.environment import GridVectorEnvironment, Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.run import TrainingRun
from ddqn_planner.training.trainer import Trainer
from ddqn_planner.training.value_iteration import value_iteration

BACKENDS: Final = ("loky", "ray", "dask", "sequential")
"""Of joblib: this machine's cores, two kinds of cluster, or one training after the other."""


@dataclass(frozen=True)
class Training:
    """One training of an experiment; ``evaluation_interval`` is in environment steps."""

    folder: Path
    parameters: HyperParameters
    scenarios: tuple[Scenario, ...]
    seed: int
    evaluation_interval: int


@dataclass(frozen=True)
class TrainingEvaluation:
    """The greedy rollouts of a network in training, from the start of each of its scenarios."""

    step: int
    """Environment steps."""
    updates: int
    episodes: int
    seconds: float
    """Wall-clock time since the training began, with evaluations."""
    solved: int
    """Scenarios whose rollout reaches the end."""
    solved_unmasked: int
    """The same without action masking: an illegal action ends the rollout."""
    length: float
    """Mean length of the solved ones, cells; NaN if there are none."""
    overestimation: float
    """Mean of max_a Q(s, a) - V*(s) over the free cells of the first scenario, V* the exact value
    of the best policy; NaN for a network whose Q is not the return."""


def in_parallel(
    job: Callable[[Any], Any], items: Sequence[Any], backend: str = "loky", unit: str = "training"
) -> list[Any]:
    """Return ``job(item)`` for each item, in order: as many at a time as there are cores.

    The first exception of a job is raised: running jobs are ended, and no others start.
    """
    if backend == "ray":
        from ray.util.joblib import register_ray

        register_ray()
    elif backend == "dask":
        from distributed import Client

        Client()  # of the scheduler that DASK_SCHEDULER_ADDRESS names, else of this machine
    jobs = (joblib.delayed(_in_one_thread)(job, item) for item in items)
    with joblib.parallel_config(backend, n_jobs=-1):
        results = joblib.Parallel(return_as="generator")(jobs)
        # disable=None: no bar if the output is not a terminal.
        return list(tqdm(results, total=len(items), unit=unit, disable=None))


def _in_one_thread(job: Callable[[Any], Any], item: Any) -> Any:
    torch.set_num_threads(1)
    return job(item)


def train(training: Training) -> None:
    """Train and evaluate, or resume an interrupted training.

    The folder gets what `TrainingRun` writes, ``evaluations.csv``, and in ``kept.safetensors`` the
    last of the networks that solved the most scenarios. Errors are those of `TrainingRun`.
    """
    folder = training.folder
    with closing(
        TrainingRun(folder, training.scenarios, MOVE_RULE, training.parameters, training.seed)
    ) as run:
        trainer = run.trainer
        evaluations = [e for e in read_evaluations(folder) if e.step <= trainer.steps]
        optimum = optimal_value(trainer.environment)
        began = time.perf_counter() - (evaluations[-1].seconds if evaluations else 0.0)
        for _ in run.steps():
            if trainer.steps // training.evaluation_interval > len(evaluations):
                best = max((evaluation.solved for evaluation in evaluations), default=-1)
                seconds = time.perf_counter() - began
                evaluations.append(evaluate_training(trainer, optimum, seconds))
                columns = [entry.name for entry in fields(TrainingEvaluation)]
                write_csv(folder / "evaluations.csv", columns, map(astuple, evaluations))
                if evaluations[-1].solved >= best:
                    trainer.save_model(folder / "kept.safetensors")
    if run.save_error:
        raise OSError(run.save_error)


def evaluate_training(
    trainer: Trainer, optimum: NDArray[np.float32], seconds: float
) -> TrainingEvaluation:
    """Make rollouts with the current network; see `optimal_value` for `optimum`."""
    planner = trainer.planner()
    plans, unmasked = rollouts(planner, trainer.scenarios)
    lengths = [plan.length for plan in plans if plan.cells]
    overestimation = float("nan")
    if trainer.parameters.network == "paper":
        scenario = trainer.scenarios[0]
        q = planner.q_field(scenario.grid, scenario.goal).q
        free = ~scenario.grid.occupancy
        free[scenario.goal[::-1]] = False
        overestimation = float((q.max(axis=0) - optimum.reshape(free.shape))[free].mean())
    return TrainingEvaluation(
        step=trainer.steps,
        updates=trainer.updates,
        episodes=trainer.episodes,
        seconds=round(seconds, 3),
        solved=len(lengths),
        solved_unmasked=solved(unmasked),
        length=float(np.mean(lengths)) if lengths else float("nan"),
        overestimation=overestimation,
    )


def rollouts(planner: Planner, scenarios: Sequence[Scenario]) -> tuple[list[Plan], list[Plan]]:
    """Return the rollout from the start of each scenario, with and without action masking."""
    fields = [(planner.q_field(s.grid, s.goal), s.start) for s in scenarios]
    return (
        [field.rollout(start) for field, start in fields],
        [field.unmasked().rollout(start) for field, start in fields],
    )


def solved(plans: Sequence[Plan]) -> int:
    """Count the plans that reach the end."""
    return sum(bool(plan.cells) for plan in plans)


def optimal_value(environment: GridVectorEnvironment) -> NDArray[np.float32]:
    """Return V* of the first scenario, exact by value iteration: (C,) float32."""
    legal, parameters = environment.legal[:1], environment.parameters
    (return_AC,) = value_iteration(
        legal.astype(np.float32),
        environment.free_reward[:1],
        environment.goal[:1],
        neighbours(environment.shape),
        parameters.gamma,
        parameters.obstacle_reward,
    )
    value_C: NDArray[np.float32]
    value_C = np.where(legal[0], return_AC, np.float32(parameters.obstacle_reward)).max(axis=0)
    return value_C


def read_evaluations(folder: Path) -> list[TrainingEvaluation]:
    """Read ``evaluations.csv`` of a training's folder; empty if there is none."""
    path = folder / "evaluations.csv"
    if not path.exists():
        return []
    types = {
        entry.name: int if entry.type == "int" else float for entry in fields(TrainingEvaluation)
    }
    with path.open(newline="", encoding="utf-8") as file:
        return [
            TrainingEvaluation(**{k: types[k](v) for k, v in row.items()})  # type: ignore[arg-type]
            for row in csv.DictReader(file)
        ]
