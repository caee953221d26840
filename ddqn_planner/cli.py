"""``ddqn-planner``: planning and training from a shell."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import ddqn_planner as api
from ddqn_planner.files import WorkFolder, differences, write_atomically
from ddqn_planner.plan_command import add_map_options, plan, read_map
from ddqn_planner.resources import find_map, with_remedy

# A command imports what it needs, and no other command's libraries: the names of `api` do so, too.
if TYPE_CHECKING:
    from ddqn_planner.training.environment import Scenario
    from ddqn_planner.training.hyper_parameters import HyperParameters
    from ddqn_planner.training.run import TrainingRun


class HelpFormatter(argparse.HelpFormatter):
    """Shows the default of each option that has one."""

    def _get_help_string(self, action: argparse.Action) -> str:
        has_default = action.default not in (None, "", argparse.SUPPRESS) and action.nargs != 0
        return f"{action.help} (default: %(default)s)" if has_default else str(action.help)


def exit_code(program: str, run: Callable[[], int]) -> int:
    """Return what a program returns, or 2 after a line that names its error."""
    try:
        return run()
    except (OSError, ValueError, ImportError, MemoryError, OverflowError) as error:
        print(f"{program}: {with_remedy(error)}", file=sys.stderr)
        return 2


def train(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> int:
    """Train a model on a map file, into a folder. Run the same command again to resume."""
    from ddqn_planner.training.environment import Scenario
    from ddqn_planner.training.evaluation import evaluate
    from ddqn_planner.training.hyper_parameters import HyperParameters

    add_map_options(parser, "corner_cutting")
    _add_training_options(parser, "runs/train", HyperParameters())
    options = parser.parse_args(arguments)
    map_file, start, goal = read_map(options)
    scenario, rule = Scenario(map_file.grid(), start, goal), api.MoveRule(options.move_rule)
    run = _run_training(options, lambda: [scenario], rule)
    field = run.trainer.planner().q_field(scenario.grid, goal)
    evaluation, plan = evaluate(field, scenario.grid, rule), field.rollout(start)
    print(
        f"the greedy rollout solves {evaluation.solved} of {evaluation.starts} starts, mean length "
        f"{evaluation.mean_ratio:.4f} of the optimum; from the start "
        + (f"{plan.length:.2f} cells" if plan.cells else "it is trapped")
    )
    return 0


def train_any_map(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> int:
    """Train a model for any map on small random maps. Run the same command again to resume."""
    from ddqn_planner.training.any_map import ANY_MAP, MAPS, random_scenarios

    parser.add_argument("--maps", type=int, default=MAPS, metavar="N", help="number of maps")
    _add_training_options(parser, "runs/any_map", ANY_MAP)
    options = parser.parse_args(arguments)
    if options.maps < 1:
        raise ValueError(f"--maps is {options.maps}; give at least 1")
    draw = partial(random_scenarios, options.seed, options.maps)
    _run_training(options, draw, api.MoveRule.ROBOT_SAFE)
    return 0


def train_robot(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> int:
    """Train a model of a robot with a body and a heading. Exit code 1 if it cannot be proved."""
    from tqdm import tqdm

    from ddqn_planner.model import save_model
    from ddqn_planner.training.robot import ROBOT, RobotTrainer

    for name, kind, default, words in (
        ("footprint", str, None, "'[[x, y], ...]', metres, or a radius, as in Nav2's costmaps"),
        ("padding", float, 0.0, "metres by which the body counts as larger: room for a controller"),
        ("motion", str, None, "differential, ackermann or omnidirectional"),
        ("turning-radius", float, 0.0, "of its bends, metres; ackermann needs it"),
        ("resolution", float, 0.05, "of the maps, metres per cell"),
        ("lattice", str, None, "a file of Nav2's lattice generator, instead of these three"),
        ("out", str, "my_robot.safetensors", "the model's file"),
        ("seed", int, 0, "seed of the training"),
        ("steps", int, ROBOT.steps, "transitions after which to give up"),
    ):
        parser.add_argument(f"--{name}", type=kind, default=default, metavar="X", help=words)
    options = parser.parse_args(arguments)
    how = options.turning_radius, options.resolution, options.lattice, options.seed, options.padding
    trainer = RobotTrainer(options.footprint, options.motion, *how)
    with tqdm(total=options.steps, disable=None) as bar:
        for certificate in trainer.run(options.steps):
            bar.update(trainer.steps - bar.n)
            bar.set_postfix(weak=certificate.weak, forbidden=certificate.forbidden, refresh=False)
    print(f"{trainer.steps:,} transitions: {certificate}")
    if certificate.proved:
        save_model(options.out, trainer.network, trainer.metadata())
    else:
        print("not saved; give more --steps, or another --seed or --resolution", file=sys.stderr)
    return int(not certificate.proved)


def _add_training_options(
    parser: argparse.ArgumentParser, out: str, parameters: HyperParameters
) -> None:
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


def _run_training(
    options: Any, scenarios: Callable[[], Sequence[Scenario]], move_rule: api.MoveRule
) -> TrainingRun:
    """Train into ``--out`` until ``--steps`` or a signal to stop; return the closed run."""
    import torch  # before the scenarios are made, which may take seconds
    from tqdm import tqdm

    from ddqn_planner.training.hyper_parameters import HyperParameters
    from ddqn_planner.training.run import TrainingRun

    torch.set_num_threads(1)  # as fast as two for such small networks, and always the same result
    values = {entry.name: getattr(options, entry.name) for entry in fields(HyperParameters)}
    parameters = HyperParameters(**values)
    with ExitStack() as stack:
        run = TrainingRun(options.out, scenarios(), move_rule, parameters, options.seed)
        trainer = stack.enter_context(closing(run)).trainer
        print(run.description)
        interrupted = threading.Event()
        # An exception could interrupt a step; a flag is read between two steps.
        for number in (signal.SIGINT, signal.SIGTERM):
            before = signal.signal(number, lambda *_: interrupted.set())
            stack.callback(signal.signal, number, before)
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


def certify(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> int:
    """Prove which moves a model takes for possible, for all costs and unknown cells.

    It bounds the costs of planned paths, too. The exit code is 1 if there is no proof.
    """
    from ddqn_planner.model import load_model
    from ddqn_planner.model.certificate import NO_CERTIFICATE

    parser.add_argument("model", nargs="?", default="any_map", help="name or file")
    network, metadata = load_model(parser.parse_args(arguments).model)
    certificate = network.certificate(metadata.move_rule)
    print(certificate or NO_CERTIFICATE)
    return 0 if certificate and certificate.proved else 1


def learn(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> int:
    """Learn from a robot's recorded drives how long places take, and what of it the map tells."""
    from ddqn_planner.experience.drives import EXPERIENCE, LOCK, RECORD, Drive
    from ddqn_planner.experience.recordings import read_recording

    words = "trainers' folders, bags, MCAP files, or CSV files with the columns seconds, x, y"
    parser.add_argument("drives", type=Path, nargs="+", help=words)
    parser.add_argument("--map", required=True, help="ROS map YAML, or name of a shipped map")
    for name, kind, default, words in (
        ("out", Path, None, "by default experience.npz in the first folder, or beside the file"),
        ("experience", Path, None, "older file that the drives add to; else all is learned anew"),
        ("nominal-speed", float, None, "a first guess, m/s; by default 0.5, or --experience's"),
        ("robot-width", float, None, "metres; by default 0.5, or --experience's"),
        ("topic", str, "", "MCAP: of poses or transforms, by default that with most of them"),
        ("frame", str, "map", "MCAP: the map's frame"),
        ("robot-frame", str, "", "MCAP: by default any that ends in base_link"),
    ):
        parser.add_argument(f"--{name}", type=kind, default=default, metavar="X", help=words)
    options = parser.parse_args(arguments)
    grid = api.load_map(find_map(options.map))
    of_robot = {"nominal_speed": options.nominal_speed, "robot_width": options.robot_width}
    given = {name: value for name, value in of_robot.items() if value is not None}
    if options.experience:
        experience = api.Experience.load(options.experience)
        if changed := differences({name: getattr(experience, name) for name in given}, given):
            raise ValueError(f"{options.experience} has {changed}; leave those options out")
    else:
        experience = api.Experience(**{"nominal_speed": 0.5, **given})
    drives: list[Drive] = []
    with ExitStack() as stack:
        for source in options.drives:
            if (source / RECORD).is_file():
                stack.callback(WorkFolder(source, [LOCK, RECORD], "drives", "records").close)
            how = options.topic, options.frame, options.robot_frame
            name, found = read_recording(source, grid, *how)
            print(f"{source}: {name}")
            drives += found
        for drive in drives:
            drive.teach(experience, grid)
        try:
            from ddqn_planner.training.prior import prior_of

            experience.prior = prior_of(grid, experience.evidence.table, experience.prior)
        except ImportError as error:
            print(f"the map's prior is not trained: {with_remedy(error)}")
        first = options.drives[0]
        out = options.out or (first if first.is_dir() else first.parent) / EXPERIENCE
        write_atomically(out, experience.to_bytes())  # not `save`, which adds to an older file
    minutes = sum(drive.seconds[-1] - drive.seconds[0] for drive in drives) / 60
    print(f"{len(drives)} drives, {sum(d.metres for d in drives):.0f} m, {minutes:.1f} min")
    print(f"speed in the open: {experience.learned_speed:.2f} m/s")
    print(f"saved {out}")
    return 0


def warm_up(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> int:
    """Compile all that plans need, so that no node compiles it. Run it where the nodes run."""
    from ddqn_planner.warm_up import warm_up as stages

    parser.add_argument("model", nargs="?", default="any_map", help="name or file")
    planner, began = api.Planner.load(parser.parse_args(arguments).model), time.perf_counter()
    for _ in stages(planner, learns=True):
        pass
    print(f"compiled, or loaded, in {time.perf_counter() - began:.1f} s")
    return 0


FUNCTIONS: Final = plan, train, train_any_map, train_robot, certify, warm_up, learn
COMMANDS: Final = {function.__name__.replace("_", "-"): function for function in FUNCTIONS}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return 0 done, 1 no path or proof, 2 bad input or a missing library."""
    # NumPy is not yet imported. For small products one thread is as fast as several, and on a busy
    # machine several are ten times as slow.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(prog="ddqn-planner", description=str(__doc__).replace("`", ""))
    names = parser.add_subparsers(required=True, metavar="|".join(COMMANDS))
    parsers = {}
    for name, command in COMMANDS.items():
        words, _, _ = str(command.__doc__).partition(".")
        parsers[name] = names.add_parser(
            name, help=words, description=command.__doc__, formatter_class=HelpFormatter
        )
    if not arguments or arguments[0] not in COMMANDS:
        parser.parse_args(arguments)  # ends with the help, or an error
    name, *others = arguments
    return exit_code(parser.prog, lambda: COMMANDS[name](parsers[name], others))
