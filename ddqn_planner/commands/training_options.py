"""Options of the commands that train into a folder, and such a training."""

import signal
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

from ddqn_planner.commands.options import Option, add_options
from ddqn_planner.files import check_writable
from ddqn_planner.grid.arguments import as_seed
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters

if TYPE_CHECKING:
    from ddqn_planner.training.run import TrainingRun


def add_training_options(
    parser: ArgumentParser, out: str, defaults: HyperParameters
) -> None:
    """Add the options ``--out`` and ``--seed``, and one for each hyper-parameter.

    `out` is the default folder, and `defaults` has those of the hyper-parameters.
    """
    add_options(
        parser,
        Option("out", Path, out, "folder of the run"),
        Option("seed", int, 0, "seed of the training"),
    )
    for field in fields(defaults):
        kind = field.metadata.get("choices") or type(field.default)
        name = field.name.replace("_", "-")
        default = getattr(defaults, field.name)
        add_options(parser, Option(name, kind, default, field.metadata["source"]))


def run_training(
    options: Namespace, make_scenarios: Callable[[], Sequence[Scenario]]
) -> "TrainingRun":
    """Train into the folder ``--out`` until step ``--steps`` or a signal to stop.

    `make_scenarios` returns the scenarios to train on. It is called after the options
    were checked, as it may take seconds. Returns the run, which is closed.
    """
    as_seed(options.seed)
    check_writable(options.out / "model.safetensors", "--out")
    # Not for the help, and not for options that are refused.
    import torch
    from tqdm import tqdm

    from ddqn_planner.training.run import TrainingRun

    # As fast as two for such small networks, and always the same result.
    torch.set_num_threads(1)
    values = {
        field.name: getattr(options, field.name) for field in fields(HyperParameters)
    }
    parameters = HyperParameters(**values)
    with TrainingRun(options.out, make_scenarios(), parameters, options.seed) as run:
        trainer = run.trainer
        print(run.description)
        # Python's own handler would raise an exception within a step. The run looks at
        # its requests between two steps.
        for number in (signal.SIGINT, signal.SIGTERM):
            earlier_handler = signal.signal(number, lambda *_: run.requests.add("stop"))
            run.callback(signal.signal, number, earlier_handler)
        # disable=None: no bar if the output is not a terminal.
        with tqdm(total=parameters.steps, initial=trainer.steps, disable=None) as bar:
            for progress in run.steps():
                bar.update(progress.step - bar.n)
                for episode in progress.episodes:
                    figures = {
                        "episode": episode.number,
                        "average reward": episode.average_reward,
                    }
                    bar.set_postfix(figures, refresh=False)
        if run.requests:
            print(f"stopped at step {trainer.steps}; run the same command to resume")
    if run.save_error:
        raise OSError(run.save_error)
    print(f"{trainer.steps} steps, {trainer.episodes} episodes, saved {run.model_path}")
    return run
