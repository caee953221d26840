"""Options of the commands that train into a folder, and such a training."""

import os
import signal
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ddqn_planner.commands.options import Option, add_options
from ddqn_planner.files import check_writable
from ddqn_planner.grid.arguments import as_seed
from ddqn_planner.training.episodes import Progress
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.scenario import Scenario

if TYPE_CHECKING:
    from ddqn_planner.training.run import TrainingRun


# Ctrl-C, the end of a service, and the end of a terminal.
STOP_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
STANDARD_ERROR: Final = 2  # its file descriptor


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


@contextmanager
def opened_training(
    options: Namespace, make_scenarios: Callable[[], Sequence[Scenario]]
) -> Iterator["TrainingRun"]:
    """Open the run in the folder ``--out``, for a block that trains.

    Within the block, STOP_SIGNALS request the run to stop. After it, an error tells if
    the last save failed.

    Parameters
    ----------
    options
        Those of `add_training_options`.
    make_scenarios
        Returns the scenarios to train on. It is called after the options were checked,
        as it may take seconds.
    """
    as_seed(options.seed)
    check_writable(options.out / "model.safetensors", "--out")
    # Not for the help, and not for options that are refused.
    import torch

    from ddqn_planner.training.run import TrainingRun

    # As fast as two for such small networks, and always the same result.
    torch.set_num_threads(1)
    parameters = hyper_parameters_of(options)
    with TrainingRun(options.out, make_scenarios(), parameters, options.seed) as run:
        # Python's own handler would raise an exception within a step. The run looks at
        # its requests between two steps.
        for number in STOP_SIGNALS:
            earlier_handler = signal.getsignal(number)
            if earlier_handler is not signal.SIG_IGN:  # as nohup has it
                signal.signal(number, partial(_stop, run))
                run.callback(signal.signal, number, earlier_handler)
        yield run
    if run.save_error:
        raise OSError(run.save_error)


def _stop(run: "TrainingRun", number: int, _: object) -> None:
    """Request a run to stop, and say so: the present step may compile for long."""
    run.stop_by_signal(number)
    # Not `print`, which the signal may have interrupted. The terminal may be gone.
    with suppress(OSError):
        os.write(STANDARD_ERROR, b"\nddqn-planner: stopping after the present step\n")


def exit_code_of(run: "TrainingRun") -> int:
    """Return the exit code of a training: 0 if it is complete.

    Otherwise it is 128 and the number of the signal that stopped it, as shells have it.
    """
    if run.is_complete or run.stop_signal is None:
        return 0
    return 128 + run.stop_signal


def stop_report(run: "TrainingRun") -> str:
    """Return in words what is saved of a training that was stopped."""
    return (
        f"stopped at step {run.trainer.steps} and saved in {run.folder}; "
        "run the same command to resume"
    )


def hyper_parameters_of(options: Namespace) -> HyperParameters:
    """Return the hyper-parameters among the options; a ValueError if they are wrong."""
    values = {
        field.name: getattr(options, field.name) for field in fields(HyperParameters)
    }
    return HyperParameters(**values)


def train_with_bar(
    run: "TrainingRun", figures_of: Callable[[Progress], Mapping[str, object]]
) -> None:
    """Train to the last step or until a signal to stop; show a bar on a terminal.

    `figures_of` is called with each progress. It returns what stands beside the bar.
    """
    from tqdm import tqdm

    total = run.trainer.parameters.steps
    # disable=None: no bar if the output is not a terminal.
    with tqdm(total=total, initial=run.trainer.steps, disable=None) as bar:
        for progress in run.steps():
            bar.update(progress.step - bar.n)
            bar.set_postfix(figures_of(progress), refresh=False)


def reward_figures(progress: Progress) -> dict[str, object]:
    """Return the number and the average reward of the last episode, if one ended."""
    if not progress.episodes:
        return {}
    episode = progress.episodes[-1]
    return {"episode": episode.number, "average reward": episode.average_reward}
