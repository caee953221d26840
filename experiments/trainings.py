"""The paper's trainings: two profiles, many in parallel, a folder for each."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, TypeAlias

import joblib
import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from ddqn_planner.commands.options import file_of
from ddqn_planner.files import write_atomically, write_csv
from ddqn_planner.grid import LENGTHS, neighbours
from ddqn_planner.model import PaperQNetwork
from ddqn_planner.planning import Plan, Planner
from ddqn_planner.training.compiled_learner import (
    evaluate,
    evaluate_common_windows,
    networks_of,
)
from ddqn_planner.training.environment import (
    GridVectorEnvironment,
    Scenario,
    paper_scenario,
)
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.run import TrainingRun
from ddqn_planner.training.trainer import Trainer
from ddqn_planner.training.value_iteration import value_iteration

SCENARIO: Final = paper_scenario()
MOVE_RULE: Final = SCENARIO.move_rule  # by it the paper's 22.97 is the shortest path
BACKENDS: Final = (
    "loky",
    "ray",
    "dask",
    "sequential",
)  # of joblib: this machine, or a cluster
# Of the paper's network for goal iii; 0 for no hidden layer, as we read its text.
HIDDEN_UNITS: Final = (0,)
# How far from the path new obstacles lie, in cells, by two readings of section 5.3: the
# "free positions that make up the optimal path", or their eight neighbours too.
NOISE: Final = {"on_path": 0, "near_path": 1}
PROFILES: Final[dict[str, HyperParameters]] = {
    # Its network, observation and Table 1, our choice where it is silent.
    "paper": HyperParameters(),
    # The same rewards and initialisation, with another network and fewer steps.
    "propagation": HyperParameters(
        network="propagation",
        filters=64,
        learning_rate=0.001,
        learning_rate_decay=1.0,
        batch_size=128,
        target_interval=100,
        steps=10_000,
    ),
}

Evaluations: TypeAlias = NDArray[Any]
"""A table of evaluations during a training, with the columns of `evaluate_training`."""


@dataclass(frozen=True)
class Training:
    """One training of an experiment.

    ``evaluation_interval`` is in environment steps.
    """

    folder: Path
    parameters: HyperParameters
    scenarios: tuple[Scenario, ...]
    seed: int
    evaluation_interval: int
    trainer_class: type[Trainer] = Trainer


@dataclass(frozen=True)
class Settings:
    """The options of ``reproduce.py``."""

    out: Path  # folder of the trainings, tables, figures and the report
    seeds: int  # trainings per table row, with the seeds 0, 1, and so on
    quick: bool = False  # train too briefly to learn anything
    noise: tuple[str, ...] = tuple(NOISE)
    hidden_units: tuple[int, ...] = HIDDEN_UNITS
    backend: str = "loky"

    def folders(self, name: str) -> list[Path]:
        """Return the folders of the trainings with a name, one per seed."""
        return [
            self.out / "trainings" / name / f"seed_{seed}" for seed in range(self.seeds)
        ]

    def trainings(
        self,
        parameters_of: Mapping[str, HyperParameters],
        scenarios: Sequence[Scenario] | Callable[[int], Sequence[Scenario]],
        evaluation_interval: int = 250,
        trainer_class: type[Trainer] = Trainer,
    ) -> list[Training]:
        """Return one training per name and seed; `scenarios` may depend on the seed."""
        max_steps = 1_000 if self.quick else 10**9
        trainings = []
        for name, parameters in parameters_of.items():
            steps = min(parameters.steps, max_steps)
            for seed, folder in enumerate(self.folders(name)):
                training = Training(
                    folder,
                    replace(parameters, steps=steps),
                    tuple(scenarios(seed) if callable(scenarios) else scenarios),
                    seed,
                    evaluation_interval,
                    trainer_class,
                )
                trainings.append(training)
        return trainings

    def evaluations(self, name: str) -> list[Evaluations]:
        """Return the evaluations of the trainings with a name, one table per seed."""
        return [read_csv(folder / "evaluations.csv") for folder in self.folders(name)]

    def planners(self, name: str, file: str = "model.safetensors") -> list[Planner]:
        """Load the planners that the trainings with a name produced, one per seed."""
        return [Planner.load(folder / file) for folder in self.folders(name)]


def parser_of(
    program: str, description: str | None, out: str
) -> argparse.ArgumentParser:
    """Return a parser with the options of an experiment with seeds."""
    parser = argparse.ArgumentParser(
        program,
        None,
        description,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add(
        "--seeds",
        type=int,
        default=5,
        metavar="N",
        help="trainings, or worlds of each kind",
    )
    add("--out", type=file_of, default=Path(out), help="folder of what is written")
    add("--quick", action="store_true", help="a short trial, into the folder quick")
    words = "what runs the work: this machine's cores, or a cluster"
    add("--backend", choices=BACKENDS, default="loky", help=words)
    add(
        "--page",
        type=file_of,
        metavar="FILE",
        help="a page of the docs that gets the results too",
    )
    return parser


def make_folder(options: argparse.Namespace) -> Path:
    """Check the seeds; make and return the folder of the report."""
    if options.seeds < 1:
        raise ValueError(f"--seeds is {options.seeds}; give at least 1")
    out: Path = options.out / "quick" if options.quick else options.out
    out.mkdir(parents=True, exist_ok=True)
    return out


def in_parallel(
    job: Callable[[Any], Any],
    items: Sequence[Any],
    backend: str = "loky",
    unit: str = "training",
) -> list[Any]:
    """Return ``job(item)`` for each item, in order.

    The first exception ends all jobs.
    """
    if backend == "ray":
        from ray.util.joblib import register_ray

        register_ray()
    elif backend == "dask":
        from distributed import Client

        # Of the scheduler that DASK_SCHEDULER_ADDRESS names, else of this machine.
        Client()
    jobs = (joblib.delayed(_in_one_thread)(job, item) for item in items)
    with joblib.parallel_config(backend, n_jobs=-1):
        # Ray's backend has no generator: its bar jumps to the end.
        results = joblib.Parallel(
            return_as="list" if backend == "ray" else "generator"
        )(jobs)
        # disable=None: no bar if the output is not a terminal.
        return list(tqdm(results, total=len(items), unit=unit, disable=None))


def _in_one_thread(job: Callable[[Any], Any], item: Any) -> Any:
    torch.set_num_threads(1)
    return job(item)


def train(training: Training) -> None:
    """Train and evaluate, or resume.

    The last network that solved the most scenarios is saved, too.
    """
    folder = training.folder
    run = TrainingRun(
        folder,
        training.scenarios,
        training.parameters,
        training.seed,
        training.trainer_class,
    )
    with closing(run):
        trainer = run.trainer
        before = read_csv(folder / "evaluations.csv")
        before = before[before["step"] <= trainer.steps]
        rows = [
            dict(zip(before.dtype.names or (), row, strict=True))
            for row in before.tolist()
        ]
        optimum = optimal_value(trainer.environment)
        for _ in run.steps(training.evaluation_interval):
            if trainer.steps // training.evaluation_interval > len(rows):
                best = max((row["solved"] for row in rows), default=-1)
                rows.append(evaluate_training(trainer, optimum))
                write_csv(
                    folder / "evaluations.csv",
                    [*rows[0]],
                    [[*row.values()] for row in rows],
                )
                if rows[-1]["solved"] >= best:
                    write_atomically(folder / "kept.safetensors", trainer.model_bytes())
    if run.save_error:
        raise OSError(run.save_error)


def evaluate_training(
    trainer: Trainer, optimum: NDArray[np.float32]
) -> dict[str, float]:
    """Return figures of the network's rollouts from each scenario's start."""
    planner = trainer.planner()
    lengths, unmasked = rollouts(planner, trainer.environment)
    # The mean of max_a Q(s, a) - V*(s) over the free cells, where Q is the return.
    overestimation = np.nan
    if trainer.parameters.network == "paper":
        scenario = trainer.scenarios[0]
        q = planner.q_field(scenario.grid, scenario.goal).q
        free = ~scenario.grid.occupancy
        free[scenario.goal[::-1]] = False
        overestimation = float(
            (q.max(axis=0) - optimum.reshape(free.shape))[free].mean()
        )
    return {
        "step": trainer.steps,
        "updates": trainer.updates,
        "episodes": trainer.episodes,
        "solved": int(np.isfinite(lengths).sum()),
        "solved_unmasked": int(np.isfinite(unmasked).sum()),
        "length": float(np.nanmean(lengths)) if np.isfinite(lengths).any() else np.nan,
        "overestimation": overestimation,
    }


def rollouts(
    planner: Planner, environment: GridVectorEnvironment
) -> NDArray[np.float64]:
    """Return the length from each start, with action masking and without: (2, S).

    It is NaN where the rollout is trapped.
    """
    network = planner.network
    if isinstance(network, PaperQNetwork):
        return _rollouts_of_paper(network, environment)
    masked = []
    unmasked = []
    for scenario in environment.scenarios:
        field = planner.q_field(scenario.grid, scenario.goal)
        masked.append(_length(field.rollout(scenario.start)))
        unmasked.append(_length(field.unmasked().rollout(scenario.start)))
    return np.array([masked, unmasked])


def _length(plan: Plan) -> float:
    """Return the length of a plan; NaN if there is no path."""
    return plan.length if plan.cells else np.nan


def _rollouts_of_paper(
    network: PaperQNetwork, environment: GridVectorEnvironment
) -> NDArray[np.float64]:
    """Roll out on all maps at once: whole fields take 10 to 20 times as long."""
    maps = np.arange(len(environment.start))
    background = environment.background
    exact: Any = background.astype(np.float64)
    tensors = {name: network.tensors[name] for name in network.shapes(network.sizes)}
    windows, (compiled,) = networks_of(exact, environment.shape, [tensors], len(maps))
    evaluate_common_windows(compiled, windows)
    lengths = np.zeros((2, len(maps)))
    for length, is_masked in zip(lengths, (True, False), strict=True):
        cell = environment.start.copy()
        is_visited = np.zeros(background.shape, np.bool_)
        is_driving = cell != environment.goal
        while is_driving.any():
            is_visited[maps, cell] = True
            evaluate(compiled, windows, maps, cell)
            q = compiled.q.astype(np.float32)
            is_legal = environment.legal[maps, :, cell]
            action = np.where(is_legal | (not is_masked), q, -np.inf).argmax(axis=1)
            moves = is_driving & is_legal[maps, action]
            cell = np.where(moves, environment.next_cell[action, cell], cell)
            step = np.where(is_visited[maps, cell], np.nan, LENGTHS[action])
            length += np.where(is_driving, step, 0)
            is_driving = np.isfinite(length) & (cell != environment.goal)
    return lengths


def optimal_value(environment: GridVectorEnvironment) -> NDArray[np.float32]:
    """Return V* of the first scenario, exact by value iteration: (C,) float32."""
    legal_CA = environment.legal[0].T
    parameters = environment.parameters
    (return_CA,), _ = value_iteration(
        legal_CA[None].astype(np.float32),
        environment.free_reward[:1].swapaxes(1, 2),
        environment.goal[:1],
        neighbours(environment.shape),
        parameters.gamma,
        parameters.obstacle_reward,
    )
    obstacle_reward = np.float32(parameters.obstacle_reward)
    return np.array(np.where(legal_CA, return_CA, obstacle_reward).max(axis=1))


def read_csv(path: Path) -> NDArray[Any]:
    """Return the columns of a file by their names; none if there is no file."""
    if not path.exists():
        return np.empty(0, [("step", np.float64)])
    return np.genfromtxt(path, delimiter=",", names=True, ndmin=1, encoding="utf-8")
