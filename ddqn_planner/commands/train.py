"""Train a model on a map file, into a folder. Run the same command again to resume."""

from __future__ import annotations

import argparse
import signal
import threading
from collections.abc import Sequence
from contextlib import closing
from dataclasses import fields
from pathlib import Path

import torch
from tqdm import tqdm

from ddqn_planner.commands.options import add_map_options, add_move_rule, read_map
from ddqn_planner.grid import MoveRule
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.evaluation import evaluate
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.run import TrainingRun


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_map_options(parser)
    add_move_rule(parser, "corner_cutting")
    add_training_options(parser, "runs/train", HyperParameters())


def add_training_options(
    parser: argparse.ArgumentParser, out: str, parameters: HyperParameters
) -> None:
    """Add the folder, the seed and each hyper-parameter with its default."""
    parser.add_argument("--out", type=Path, default=Path(out), help="folder of the run")
    parser.add_argument("--seed", type=int, default=0, help="seed of the training")
    for entry in fields(parameters):
        parser.add_argument(
            f"--{entry.name.replace('_', '-')}",
            type=type(entry.default),
            default=getattr(parameters, entry.name),
            choices=entry.metadata.get("choices"),
            help=entry.metadata["source"],
        )


def run(options: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    map_file, start, goal = read_map(options)
    scenario, rule = Scenario(map_file.grid(), start, goal), MoveRule(options.move_rule)
    run = run_training(options, [scenario], rule)
    field = run.trainer.planner().q_field(scenario.grid, goal)
    evaluation, plan = evaluate(field, scenario.grid, rule), field.rollout(start)
    print(
        f"the greedy rollout solves {evaluation.solved} of {evaluation.starts} starts, mean length "
        f"{evaluation.mean_ratio:.4f} of the optimum; from the start "
        + (f"{plan.length:.2f} cells" if plan.cells else "it is trapped")
    )
    return 0


def run_training(
    options: argparse.Namespace, scenarios: Sequence[Scenario], move_rule: MoveRule
) -> TrainingRun:
    """Train into ``--out`` until ``--steps`` or a signal to stop; return the closed run."""
    torch.set_num_threads(1)  # as fast as two for such small networks, and always the same result
    values = {entry.name: getattr(options, entry.name) for entry in fields(HyperParameters)}
    parameters = HyperParameters(**values)
    with closing(TrainingRun(options.out, scenarios, move_rule, parameters, options.seed)) as run:
        trainer = run.trainer
        print(run.description)
        interrupted = threading.Event()
        # An exception could interrupt a step; a flag is read between two steps.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: interrupted.set())
        # disable=None: no bar if the output is not a terminal.
        with tqdm(total=parameters.steps, initial=trainer.steps, disable=None) as bar:
            for finished in run.steps():
                bar.update(trainer.steps - bar.n)
                for episode in finished:
                    figures = {"episode": episode.number, "average reward": episode.average_reward}
                    bar.set_postfix(figures, refresh=False)
                if interrupted.is_set():
                    run.try_to_save()
                    print(f"stopped at step {trainer.steps}; run the same command to resume")
                    break
    if run.save_error:
        raise OSError(run.save_error)
    print(f"{trainer.steps} steps, {trainer.episodes} episodes, saved {run.model_path}")
    return run
