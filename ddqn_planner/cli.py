"""``ddqn-planner``: planning and training from a shell."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Final

from ddqn_planner.libraries import with_remedy

COMMANDS: Final = {
    "plan": "plan a path on a map file",
    "train": "train a model on a map file",
    "train-any-map": "train a model for any map on random maps",
    "certify": "prove which moves a model takes for possible",
    "learn": "learn from recorded drives how long places take",
}
"""Each is a module of `ddqn_planner.commands`."""


class HelpFormatter(argparse.HelpFormatter):
    """Shows the default of each option that has one."""

    def _get_help_string(self, action: argparse.Action) -> str:
        has_default = action.default not in (None, argparse.SUPPRESS) and action.nargs != 0
        return f"{action.help} (default: %(default)s)" if has_default else str(action.help)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code.

    0 done, 1 no path or no proof, 2 bad input or a missing library, 130 interrupted.
    """
    # NumPy is not yet imported. For small products one thread is as fast as several, and on a busy
    # machine several are ten times as slow.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(prog="ddqn-planner", description=__doc__.replace("`", ""))
    commands = parser.add_subparsers(required=True, metavar="|".join(COMMANDS))

    def run() -> int:
        for name, words in COMMANDS.items():
            command = commands.add_parser(name, help=words, formatter_class=HelpFormatter)
            if name in arguments[:1]:  # the other commands' modules would take long to import
                module = import_module(f"ddqn_planner.commands.{name.replace('-', '_')}")
                command.description = module.__doc__
                command.set_defaults(run=module.run)
                module.add_options(command)
        options = parser.parse_args(arguments)
        return int(options.run(options))

    return exit_code(parser.prog, run)


def exit_code(program: str, run: Callable[[], int]) -> int:
    """Return what a program returns, or 2 after a line that names its error."""
    try:
        return run()
    except (OSError, ValueError, ImportError, MemoryError) as error:
        print(f"{program}: {with_remedy(error)}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
