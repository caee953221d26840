"""Trainings with regular evaluations: many in parallel, each in a folder of its own."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

import joblib
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from ddqn_planner.cli import HelpFormatter
from ddqn_planner.files import write_csv
from ddqn_planner.grid import LENGTHS, MoveRule, legal_moves, neighbours, shortest_distances
from ddqn_planner.planning import Plan, Planner
from ddqn_planner.training.environment import GridVectorEnvironment, Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.networks import value_iteration
from ddqn_planner.training.run import TrainingRun
from ddqn_planner.training.trainer import Trainer

MOVE_RULE: Final = MoveRule.CORNER_CUTTING
"""The rule under which the paper's 22.97 is the shortest path (docs/reproduction.md)."""

BACKENDS: Final = ("loky", "ray", "dask", "sequential")
"""Of joblib: this machine's cores, two kinds of cluster, or one training after the other."""

Evaluations: TypeAlias = NDArray[Any]
"""A table of evaluations during a training, with the columns of `evaluate_training`."""

SUPERVISED_BATCH, SUPERVISED_LEARNING_RATE = 128, 0.003


@dataclass(frozen=True)
class Training:
    """One training of an experiment; ``evaluation_interval`` is in environment steps."""

    folder: Path
    parameters: HyperParameters
    scenarios: tuple[Scenario, ...]
    seed: int
    evaluation_interval: int


def parser_of(program: str, description: str | None, out: str) -> argparse.ArgumentParser:
    """Return a parser with the options of an experiment with seeds."""
    parser = argparse.ArgumentParser(program, None, description, formatter_class=HelpFormatter)
    add = parser.add_argument
    add("--seeds", type=int, default=5, metavar="N", help="trainings, or worlds of each kind")
    add("--out", type=Path, default=Path(out), help="folder of what is written")
    add("--quick", action="store_true", help="a short trial, into the folder quick")
    words = "what runs the work: this machine's cores, or a cluster"
    add("--backend", choices=BACKENDS, default="loky", help=words)
    add("--page", type=Path, metavar="FILE", help="a page of the docs that gets the results too")
    return parser


def make_folder(options: argparse.Namespace) -> Path:
    """Check the seeds; make and return the folder of the report."""
    if options.seeds < 1:
        raise ValueError(f"--seeds is {options.seeds}; give at least 1")
    out: Path = options.out / "quick" if options.quick else options.out
    out.mkdir(parents=True, exist_ok=True)
    return out


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
        # Ray's backend has no generator: its bar jumps to the end.
        results = joblib.Parallel(return_as="list" if backend == "ray" else "generator")(jobs)
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
        before = read_evaluations(folder)
        before = before[before["step"] <= trainer.steps]
        rows = [dict(zip(before.dtype.names or (), row, strict=True)) for row in before.tolist()]
        optimum = optimal_value(trainer.environment)
        began = time.perf_counter() - (rows[-1]["seconds"] if rows else 0.0)
        for _ in run.steps():
            if trainer.steps // training.evaluation_interval > len(rows):
                best = max((row["solved"] for row in rows), default=-1)
                rows.append(evaluate_training(trainer, optimum, time.perf_counter() - began))
                write_csv(folder / "evaluations.csv", [*rows[0]], [[*row.values()] for row in rows])
                if rows[-1]["solved"] >= best:
                    trainer.save_model(folder / "kept.safetensors")
    if run.save_error:
        raise OSError(run.save_error)


def evaluate_training(
    trainer: Trainer, optimum: NDArray[np.float32], seconds: float
) -> dict[str, float]:
    """Return figures of the current network's rollouts from the start of each scenario.

    The over-estimation is the mean of max_a Q(s, a) - V*(s) over the free cells of the first
    scenario, V* the `optimal_value`; NaN for a network whose Q is not the return.
    """
    planner = trainer.planner()
    plans, unmasked = rollouts(planner, trainer.scenarios)
    lengths = [plan.length for plan in plans if plan.cells]
    overestimation = np.nan
    if trainer.parameters.network == "paper":
        scenario = trainer.scenarios[0]
        q = planner.q_field(scenario.grid, scenario.goal).q
        free = ~scenario.grid.occupancy
        free[scenario.goal[::-1]] = False
        overestimation = float((q.max(axis=0) - optimum.reshape(free.shape))[free].mean())
    return {
        "step": trainer.steps,
        "updates": trainer.updates,
        "episodes": trainer.episodes,
        "seconds": round(seconds, 3),
        "solved": len(lengths),
        "solved_unmasked": solved(unmasked),
        "length": float(np.mean(lengths)) if lengths else np.nan,
        "overestimation": overestimation,
    }


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


def read_evaluations(folder: Path) -> Evaluations:
    """Read ``evaluations.csv`` of a training's folder; empty if there is none."""
    path = folder / "evaluations.csv"
    if not path.exists():
        return np.empty(0, [("step", np.float64)])
    evaluations: Evaluations = np.genfromtxt(path, delimiter=",", names=True, ndmin=1)
    return evaluations


def train_supervised(training: Training) -> None:
    """Train a network by cross-entropy on the best moves, for as many updates as it has steps.

    This is a yardstick and not a planner: the exact oracle gives the first moves of all shortest
    paths from every cell of every training map. What the network fails to learn even then is a
    limit of its architecture, not of how it learns. It writes ``model.safetensors``, and does
    nothing if that exists.
    """
    path = training.folder / "model.safetensors"
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(training.scenarios, MOVE_RULE, training.parameters, training.seed)
    best_SCA = np.stack([best_moves(scenario) for scenario in training.scenarios])
    scenario, cell = np.nonzero(best_SCA.any(axis=2))
    random = np.random.default_rng(training.seed)
    optimiser = torch.optim.Adam(trainer.network.parameters(), SUPERVISED_LEARNING_RATE)
    steps = training.parameters.steps
    decay = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.05, steps)
    for _ in range(steps):
        drawn = random.integers(len(cell), size=SUPERVISED_BATCH)
        states = trainer.encoder.states(scenario[drawn], cell[drawn])
        best_BA = torch.from_numpy(best_SCA[scenario[drawn], cell[drawn]])
        loss = cross_entropy(trainer.network(states), best_BA)
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
        decay.step()
    trainer.save_model(path)


def cross_entropy(q_BA: Tensor, best_BA: Tensor) -> Tensor:
    """Return the mean of -log of the probability that softmax(Q) gives to the best moves."""
    best_B = q_BA.masked_fill(~best_BA, -torch.inf).logsumexp(dim=1)
    return (q_BA.logsumexp(dim=1) - best_B).mean()


def best_moves(scenario: Scenario) -> NDArray[np.bool_]:
    """Return the moves that begin a shortest path: (C, 8) bool, none where there is no path."""
    occupancy = scenario.grid.occupancy
    distance = shortest_distances(scenario.grid, scenario.goal, MOVE_RULE).ravel()
    onward_AC = np.append(distance, np.inf)[neighbours(occupancy.shape)] + LENGTHS[:, None]
    legal_AC = legal_moves(occupancy, MOVE_RULE).reshape(len(LENGTHS), -1)
    through_AC = np.where(legal_AC, onward_AC, np.inf)
    best: NDArray[np.bool_] = (np.isfinite(through_AC) & (through_AC <= distance + 1e-9)).T
    return best
