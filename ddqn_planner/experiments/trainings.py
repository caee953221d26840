"""Trainings that are evaluated as they go, many at once, each in a folder of its own."""

from __future__ import annotations

import csv
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from ddqn_planner.experiments.profiles import MOVE_RULE
from ddqn_planner.files import write_csv
from ddqn_planner.grid import MOVES, legal_moves, neighbours
from ddqn_planner.planning import Plan, Planner
from ddqn_planner.training.environment import GridVectorEnvironment, Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.run import TrainingRun
from ddqn_planner.training.trainer import Trainer
from ddqn_planner.training.value_iteration import value_iteration

Job = TypeVar("Job")


@dataclass(frozen=True)
class Training:
    """One training of an experiment.

    Parameters
    ----------
    name : str
        Folder below the output folder; trainings that differ in more than the seed differ in it.
    parameters : HyperParameters
    scenarios : tuple of Scenario
    seed : int
    evaluation_interval : int
        Environment steps between two evaluations.
    """

    name: str
    parameters: HyperParameters
    scenarios: tuple[Scenario, ...]
    seed: int
    evaluation_interval: int

    def folder(self, out: Path) -> Path:
        """Return the folder of this training."""
        return training_folder(out, self.name, self.seed)


def training_folder(out: Path, name: str, seed: int) -> Path:
    """Return the folder of a training below the output folder."""
    return out / "trainings" / name / f"seed_{seed}"


@dataclass(frozen=True)
class TrainingEvaluation:
    """The greedy walks of a network in training, from the start of each of its scenarios."""

    step: int
    """Environment steps."""
    updates: int
    episodes: int
    seconds: float
    """Wall clock since the training began, evaluations included."""
    solved: int
    """Scenarios whose walk by legal moves reaches the end."""
    solved_unmasked: int
    """The same for the greatest Q of all moves, where an illegal one ends the walk."""
    length: float
    """Mean length of the solved ones, cells; NaN if there is none."""
    overestimation: float
    """Mean of max_a Q(s, a) - V*(s) over the free cells of the first scenario, V* the exact value
    of the best policy; NaN for a network whose Q is not the return."""


def in_parallel(job: Callable[[Job, Path], None], jobs: Sequence[Job], out: Path) -> None:
    """Call ``job(each, out)`` in as many processes as there are cores.

    Raises
    ------
    Exception
        The first that a job raises. Those under way are then ended, and the others not begun.
    """
    spawn = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(os.cpu_count(), spawn, _prepare_process) as pool,
        # disable=None: no bar where the output is no terminal.
        tqdm(total=len(jobs), unit="training", disable=None) as bar,
    ):
        futures = [pool.submit(job, each, out) for each in jobs]
        try:
            for future in as_completed(futures):
                future.result()
                bar.update()
        except BaseException:
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def _prepare_process() -> None:
    torch.set_num_threads(1)
    # Ctrl-C reaches every process of a shell's job; what then ends is up to the first one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def train(training: Training, out: Path) -> None:
    """Train and evaluate, or go on where an interrupted training stopped.

    The folder gets what `TrainingRun` writes, ``evaluations.csv``, and in ``kept.safetensors`` the
    last of the networks that solved the most scenarios.

    Raises
    ------
    CheckpointError, FolderError
        If the folder holds another training or what no training wrote, or is in use.
    OSError
        If the folder cannot be written.
    """
    folder = training.folder(out)
    run = TrainingRun(folder, training.scenarios, MOVE_RULE, training.parameters, training.seed)
    try:
        _train(training, run)
    finally:
        run.close()
    if run.save_error:
        raise OSError(run.save_error)


def _train(training: Training, run: TrainingRun) -> None:
    folder, trainer = run.folder, run.trainer
    evaluations = [e for e in read_evaluations(folder) if e.step <= trainer.steps]
    seconds = evaluations[-1].seconds if evaluations else 0.0
    optimum = optimal_value(trainer.environment)
    began = time.perf_counter() - seconds
    for _ in run.steps():
        if trainer.steps // training.evaluation_interval > len(evaluations):
            best = max((evaluation.solved for evaluation in evaluations), default=-1)
            evaluations.append(evaluate_training(trainer, optimum, time.perf_counter() - began))
            columns = [entry.name for entry in fields(TrainingEvaluation)]
            write_csv(folder / "evaluations.csv", columns, map(astuple, evaluations))
            if evaluations[-1].solved >= best:
                trainer.save_model(folder / "kept.safetensors")


def evaluate_training(
    trainer: Trainer, optimum: NDArray[np.float32], seconds: float
) -> TrainingEvaluation:
    """Walk from the start of each scenario with the network as it is now.

    Parameters
    ----------
    trainer : Trainer
    optimum : (C,) float32
        See `optimal_value`.
    seconds : float
        Since the training began.
    """
    planner = trainer.planner()
    walks, unmasked = walk_from_starts(planner, trainer.scenarios)
    lengths = [walk.length for walk in walks if walk.cells]
    return TrainingEvaluation(
        step=trainer.steps,
        updates=trainer.updates,
        episodes=trainer.episodes,
        seconds=round(seconds, 3),
        solved=len(lengths),
        solved_unmasked=solved(unmasked),
        length=float(np.mean(lengths)) if lengths else float("nan"),
        overestimation=_overestimation(trainer, planner, optimum),
    )


def walk_from_starts(
    planner: Planner, scenarios: Sequence[Scenario]
) -> tuple[list[Plan], list[Plan]]:
    """Walk from the start of each scenario by legal moves, and by the greatest Q of all moves."""
    fields = [planner.q_field(scenario.grid, scenario.goal) for scenario in scenarios]
    starts = [scenario.start for scenario in scenarios]
    return (
        [field.rollout(start) for field, start in zip(fields, starts, strict=True)],
        [field.unmasked().rollout(start) for field, start in zip(fields, starts, strict=True)],
    )


def solved(walks: Sequence[Plan]) -> int:
    """Count the walks that reach the end."""
    return sum(bool(walk.cells) for walk in walks)


def _overestimation(trainer: Trainer, planner: Planner, optimum: NDArray[np.float32]) -> float:
    if trainer.parameters.network != "paper":
        return float("nan")
    scenario = trainer.scenarios[0]
    q = planner.q_field(scenario.grid, scenario.goal).q
    free = ~scenario.grid.occupancy
    free[scenario.goal[1], scenario.goal[0]] = False
    return float((q.max(axis=0) - optimum.reshape(free.shape))[free].mean())


def optimal_value(environment: GridVectorEnvironment) -> NDArray[np.float32]:
    """Return V* of the first scenario, exact by value iteration: (C,) float32."""
    scenario, parameters = environment.scenarios[0], environment.parameters
    legal = legal_moves(scenario.grid.occupancy, MOVE_RULE).reshape(1, len(MOVES), -1)
    return_SAC = value_iteration(
        legal.astype(np.float32),
        environment.free_reward[:1],
        environment.goal[:1],
        neighbours(environment.shape),
        parameters.gamma,
        parameters.obstacle_reward,
    )
    q_SAC = np.where(legal, return_SAC, np.float32(parameters.obstacle_reward))
    value_C: NDArray[np.float32] = q_SAC[0].max(axis=0)
    return value_C


def read_evaluations(folder: Path) -> list[TrainingEvaluation]:
    """Read ``evaluations.csv`` of a training's folder; empty if there is none."""
    path = folder / "evaluations.csv"
    if not path.exists():
        return []
    whole = {entry.name for entry in fields(TrainingEvaluation) if entry.type == "int"}
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return [
        TrainingEvaluation(**{k: int(v) if k in whole else float(v) for k, v in row.items()})  # type: ignore[arg-type]
        for row in rows
    ]
