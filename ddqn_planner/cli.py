"""``ddqn-planner``: planning and training from a shell."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Final

from ddqn_planner.output import unless_cut_off

# Names and descriptions. The module of a command, `commands.train_any_map` for
# `train-any-map`, is imported when the command runs: it needs libraries that others do
# not need.
COMMANDS: Final = {
    "plan": "Plan a path on a map file, and print it.",
    "train": "Train a model on a map file, into a folder. Run the same command again "
    "to resume.",
    "train-any-map": "Train a model for any map on small random maps. Run the same "
    "command again to resume.",
    "train-robot": "Train a model of a robot with a body and a heading. Exit code 1 if "
    "it cannot be proved.",
    "certify": "Prove which moves a model takes for possible, for all costs and "
    "unknown cells. It bounds the costs of planned paths, too. The exit code is 1 if "
    "there is no proof.",
    "warm-up": "Compile all that plans need, so that no node compiles it. Run it where "
    "the nodes run.",
    "learn": "Learn from a robot's recorded drives how long places take, and what of "
    "it the map tells.",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command with arguments, by default those of the process.

    Returns the exit code: 0 if the command did its work, 1 without a path or a proof, 2
    for bad input or a missing library, 130 after Ctrl-C. A training that another signal
    stopped returns 128 and the number of the signal.
    """
    # NumPy is not yet imported. For small products one thread is as fast as several,
    # and on a busy machine several are ten times as slow.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    words = sys.argv[1:] if arguments is None else arguments
    return exit_code("ddqn-planner", lambda: _run_command(words))


def exit_code(program: str, run: Callable[[], int]) -> int:
    """Run a program, and return its exit code.

    `run` returns the exit code of the program named `program`. If its input is wrong,
    the code is 2 and a line on stderr tells the error; after Ctrl-C it is 130.
    """
    try:
        return unless_cut_off(run)
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        return 130
    except (OSError, ValueError, ImportError, MemoryError, OverflowError) as error:
        # Ctrl-C gives a traceback until `main` runs: the fewer imports before, the
        # better.
        from ddqn_planner.resources import with_remedy

        print(f"{program}: {with_remedy(error)}", file=sys.stderr)
        return 2


def _run_command(arguments: Sequence[str]) -> int:
    """Run the command that the first argument names; return its exit code.

    Without such a command, the help or an error is printed and the process exits.
    """
    parser = argparse.ArgumentParser(
        prog="ddqn-planner", description=str(__doc__).replace("`", "")
    )
    subparsers = parser.add_subparsers(required=True, metavar="|".join(COMMANDS))
    parsers = {}
    for name, description in COMMANDS.items():
        first_sentence = description.split(".")[0]
        parsers[name] = subparsers.add_parser(
            name, help=first_sentence, description=description
        )
    if not arguments or arguments[0] not in COMMANDS:
        from ddqn_planner.version import __version__

        version = f"ddqn-planner {__version__}"
        parser.add_argument(
            "--version", action="version", version=version, help="print the version"
        )
        parser.parse_args(arguments)  # exits after it printed the help, or an error
    name, *options = arguments
    command = import_module(f"ddqn_planner.commands.{name.replace('-', '_')}")
    code: int = command.run(parsers[name], options)
    return code


if __name__ == "__main__":
    sys.exit(main())
