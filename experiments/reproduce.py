"""Train and measure the paper's experiments with many seeds.

Writes tables, figures and a report. Run the same command again to resume.
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import ablation
import any_map
import goal_1
import goal_2
import goal_3
import targets
import torch
from profiles import HIDDEN_UNITS
from settings import Settings
from trainings import BACKENDS, in_parallel, train

from ddqn_planner.cli import HelpFormatter, exit_code
from ddqn_planner.files import write_atomically
from ddqn_planner.grid import Noise

EXPERIMENTS: Final = {
    "goal-1": goal_1,
    "ablation": ablation,
    "goal-2": goal_2,
    "goal-3": goal_3,
    "targets": targets,
    "any-map": any_map,
}
"""Each has a title, ``trainings(settings)``, and ``report(settings)`` for their results."""


def reproduce(names: list[str], settings: Settings) -> str:
    """Run experiments, and write ``report.md`` with its tables (also as CSV) and figures.

    Trainings that an earlier call finished in the same folder are not repeated. Return the report,
    Markdown.
    """
    settings.out.mkdir(parents=True, exist_ok=True)
    modules = {name: EXPERIMENTS[name] for name in names}
    # Experiments share trainings: each folder is trained once.
    trainings = {
        training.folder: training
        for module in modules.values()
        for training in module.trainings(settings)
    }
    in_parallel(train, list(trainings.values()), settings.backend)
    sections = [
        f"## {module.TITLE}\n\n"
        f"`python experiments/reproduce.py --experiment {name} {settings.options()}`\n\n"
        f"{module.report(settings)}"
        for name, module in modules.items()
    ]
    text = "\n\n".join(sections) + "\n"
    write_atomically(settings.out / "report.md", text.encode())
    return text


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; return the exit code."""
    parser = argparse.ArgumentParser("reproduce.py", None, __doc__, formatter_class=HelpFormatter)
    add = parser.add_argument
    add("--experiment", choices=[*EXPERIMENTS, "all"], default="all", help="one, or all")
    add("--seeds", type=int, default=5, metavar="N", help="trainings per table row")
    add("--out", type=Path, default=Path("runs/reproduce"), help="folder of trainings and report")
    noise = [noise.value for noise in Noise]
    add("--noise", nargs="+", choices=noise, default=noise, help="new obstacles of goal iii")
    units = "hidden layers of the paper's network for goal iii"
    add("--hidden-units", nargs="+", type=int, default=[*HIDDEN_UNITS], metavar="N", help=units)
    add("--quick", action="store_true", help="train too briefly to learn, into the folder quick")

    words = "what runs the trainings: this machine's cores, or a cluster"
    add("--backend", choices=BACKENDS, default="loky", help=words)
    options = parser.parse_args(arguments)
    return exit_code(parser.prog, lambda: run(options))


def run(options: argparse.Namespace) -> int:
    """Run the program with its options; return the exit code."""
    if options.seeds < 1:
        raise ValueError(f"--seeds is {options.seeds}; give at least 1")
    torch.set_num_threads(1)  # so that planning times are those of one thread
    names = [*EXPERIMENTS] if options.experiment == "all" else [options.experiment]
    out = options.out / "quick" if options.quick else options.out
    noise = tuple(map(Noise, dict.fromkeys(options.noise)))
    hidden_units = tuple(dict.fromkeys(options.hidden_units))
    settings = Settings(out, options.seeds, options.quick, noise, hidden_units, options.backend)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        print(reproduce(names, settings))
    except KeyboardInterrupt:
        print("interrupted; run the same command to resume", file=sys.stderr)
        return 130
    print(f"saved {out / 'report.md'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
