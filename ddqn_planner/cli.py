"""``ddqn-planner``: planning and training from a shell."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import ddqn_planner as api
from ddqn_planner.files import (
    WorkFolder,
    as_path,
    check_distinct,
    check_writable,
    differences,
    write_atomically,
    write_csv,
)
from ddqn_planner.output import unless_cut_off
from ddqn_planner.resources import find_map, with_remedy

# A command imports what it needs, and no other command's libraries: the names of `api` do so, too.
if TYPE_CHECKING:
    from ddqn_planner.grid import Cell, GridMap, MapFile
    from ddqn_planner.training.environment import Scenario
    from ddqn_planner.training.run import TrainingRun

# Options of `plan` that only one kind of model can follow.
CELL_OPTIONS: Final = (
    "robot_radius",
    "move_rule",
    "mode",
    "start_clearing_radius",
    "cells",
)
BODY_OPTIONS: Final = ("yaws", "yaw_tolerance", "bound")
MODEL: Final = "name or file (default: %(default)s)"


def exit_code(program: str, run: Callable[[], int]) -> int:
    """Return what a program returns, or 2 after a line that names its error; 130 after Ctrl-C."""
    try:
        return unless_cut_off(run)
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        return 130
    except (OSError, ValueError, ImportError, MemoryError, OverflowError) as error:
        print(f"{program}: {with_remedy(error)}", file=sys.stderr)
        return 2


def plan(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> int:
    """Plan a path on a map file, and print it."""
    from ddqn_planner.model import find_model
    from ddqn_planner.pictures import picture_format
    from ddqn_planner.warm_up import warm_up

    _add_map_options(parser, None)
    modes = [method.value for method in api.PlanMethod]
    _add_options(
        parser,
        ("model", str, "any_map", "name or file; that of train-robot has a body"),
        ("mode", modes, "greedy", "astar_fallback: search if steps get stuck"),
        (
            "occupied-threshold",
            int,
            65,
            "a cell of this value or more is occupied, percent",
        ),
        ("allow-unknown", bool, False, "treat unknown cells as free"),
        (
            "use-map-costs",
            bool,
            False,
            "free cells cost by their values, unknown ones most",
        ),
        (
            "robot-radius",
            float,
            0.0,
            "distance that the path keeps from obstacles, metres",
        ),
        (
            "clearance-weight",
            float,
            0.0,
            "how strongly to avoid cells near obstacles, 0 to 1",
        ),
        (
            "tolerance",
            float,
            0.0,
            "how far a goal that is occupied or cut off may move, metres",
        ),
        (
            "start-clearing-radius",
            float,
            0.0,
            "obstacles so near to a start do not count, metres",
        ),
        ("yaw-tolerance", float, 0.0, "body: how far such a goal may turn, radians"),
        ("bound", float, 1.0, "body: how many times the least cost a path may have"),
        ("cells", bool, False, "print each cell of the path, as X Y"),
        ("csv", Path, None, "write the path's cells and metres, or its poses"),
        ("json", bool, False, "print JSON instead of text"),
        ("picture", Path, None, "draw map, path, and the value or the body"),
    )
    words = "body: headings in the map frame, radians (default: %(default)s)"
    pair: Any = {"type": float, "nargs": 2, "metavar": ("START", "GOAL")}
    parser.add_argument("--yaws", default=(0, 0), help=words, **pair)
    options = parser.parse_args(arguments)
    for option in ("csv", "picture"):
        file = getattr(options, option)
        if file:
            check_writable(file, f"--{option}")
    if options.picture:
        picture_format(options.picture, "--picture")
    map_file, start, goal = _read_map(options)
    outputs = {"--csv": options.csv, "--picture": options.picture}
    check_distinct(
        outputs, {"--model": find_model(options.model), **_files_of(map_file)}
    )
    planner = api.Planner.load(options.model)
    has_body = planner.pose_planner is not None
    if has_body:
        _refuse_options(parser, arguments, CELL_OPTIONS, "without", options.model)
    else:
        _refuse_options(parser, arguments, BODY_OPTIONS, "with", options.model)
    grid = map_file.grid(
        options.occupied_threshold, options.allow_unknown, options.use_map_costs
    )
    grid = api.inflate(grid, options.robot_radius, options.clearance_weight)
    # So that the time of the plan leaves out how long compiled code takes to load.
    next(warm_up(planner))
    if has_body:
        return _plan_poses(options, planner, grid, start, goal)
    return _plan_cells(options, planner, grid, start, goal)


def _refuse_options(
    parser: argparse.ArgumentParser,
    arguments: Sequence[str],
    names: Sequence[str],
    kind: str,
    model: str,
) -> None:
    """Raise a ValueError if arguments have an option for models with or without a body."""
    # Without defaults, an option has a value only where it was in the arguments.
    no_defaults = argparse.Namespace(**dict.fromkeys(names))
    values = parser.parse_args(arguments, no_defaults)
    for name in names:
        if getattr(values, name) is not None:
            raise ValueError(
                f"--{name.replace('_', '-')} is for models {kind} a body, unlike "
                f"{model}; leave it out, or give another --model"
            )


def _plan_cells(
    options: Any, planner: api.Planner, grid: GridMap, start: Cell, goal: Cell
) -> int:
    import numpy as np

    from ddqn_planner.grid.arguments import as_number

    metres = (0, np.inf, "metres, 0 or more")
    tolerance = as_number("--tolerance", options.tolerance, *metres)
    radius = as_number(
        "--start-clearing-radius", options.start_clearing_radius, *metres
    )
    plan = planner.plan(
        grid,
        start,
        goal,
        move_rule=options.move_rule,
        method=options.mode,
        tolerance=tolerance / grid.resolution,
        start_clearing_radius=radius / grid.resolution,
    )
    optimum = _shortest_length(plan, grid)
    has_field = planner.network.supports((grid.height, grid.width))
    value = None
    if options.picture and plan.cells and has_field:
        value = planner.q_field(grid, plan.cells[-1], plan.move_rule).value
    answer = {
        "cells": plan.cells,
        "method": plan.method.value,
        "length": plan.length,
        "optimum": optimum,
        "move_rule": plan.move_rule.value,
    }
    lines = [f"{x} {y}" for x, y in plan.cells if options.cells]
    if plan.cells:
        lines += _lines_of(plan, grid, optimum)
    rows = [(*cell, *np.round(grid.cell_to_world(cell), 6)) for cell in plan.cells]
    result = _Result(
        answer=answer,
        lines=lines,
        columns=("x", "y", "x_metres", "y_metres"),
        rows=rows,
        picture={
            "title": f"{plan.length:.2f} cells" if plan.cells else plan.status.value,
            "value": value,
        },
    )
    return _show(options, grid, plan, result)


def _shortest_length(plan: api.Plan, grid: GridMap) -> float | None:
    """Return the length of the shortest path between a plan's ends, in cells.

    None without a path, and where it begins in an obstacle.
    """
    from ddqn_planner.grid import path_length
    from ddqn_planner.planning.paths import search

    if not plan.cells or not grid.is_free(plan.cells[0]):
        return None
    without_costs = api.GridMap(grid.occupancy, forbidden=grid.forbidden)
    shortest = search(plan.cells[0], plan.cells[-1], without_costs, plan.move_rule)
    return path_length(shortest)


def _lines_of(plan: api.Plan, grid: GridMap, optimum: float | None) -> list[str]:
    """Return what is printed of a path of cells."""
    from ddqn_planner.grid import path_length

    metres = path_length(plan.path) * grid.resolution
    figures = [f"length {plan.length:.2f} cells"]
    if optimum is not None:
        figures.append(f"optimum {optimum:.2f} under {plan.move_rule.value}")
    if plan.cost is not None:
        figures.append(f"cost {plan.cost:.2f}")
    figures.append(plan.method.value)
    return [
        f"start {plan.cells[0]}, goal {plan.cells[-1]}, {metres:.2f} m",
        ", ".join(figures),
    ]


def _plan_poses(
    options: Any, planner: api.Planner, grid: GridMap, start: Cell, goal: Cell
) -> int:
    import numpy as np

    from ddqn_planner.planning.pose_paths import in_cells

    assert planner.pose_planner is not None
    start_yaw, goal_yaw = options.yaws
    start_pose = (*grid.cell_to_world(start), start_yaw)
    goal_pose = (*grid.cell_to_world(goal), goal_yaw)
    tolerance = options.tolerance, options.yaw_tolerance
    plan = planner.plan_poses(grid, start_pose, goal_pose, tolerance, options.bound)
    metres = plan.length * grid.resolution
    title = f"{metres:.2f} m" if plan.cells else plan.status.value
    ends = plan.poses[[0, -1]] if plan.cells else np.array([start_pose, goal_pose])
    footprint = planner.pose_planner.footprint / grid.resolution
    result = _Result(
        answer={
            "poses": plan.poses.tolist(),
            "metres": metres,
            "cost": plan.cost,
            "bound": plan.bound,
        },
        lines=[
            f"{title}, {len(plan.poses)} poses, at most {plan.bound:.3f} times the "
            "least cost"
        ],
        columns=("x", "y", "yaw"),
        rows=np.round(plan.poses, 6).tolist(),
        picture={
            "title": title,
            "body": (footprint, in_cells(plan.poses, grid), in_cells(ends, grid)),
        },
    )
    return _show(options, grid, plan, result)


class _Result(NamedTuple):
    """A plan as it is shown."""

    answer: dict[str, Any]  # for --json
    lines: list[str]  # of text
    columns: tuple[str, ...]  # for --csv
    rows: list[Any]
    picture: dict[str, Any]  # options of `save_picture`


def _show(options: Any, grid: GridMap, plan: Any, result: _Result) -> int:
    """Print a plan as JSON or text, or why there is none; write the files of options.

    Return the exit code.
    """
    from ddqn_planner.pictures import MAX_TEXT_WIDTH, draw_text, save_picture

    milliseconds = plan.field_ms + plan.rollout_ms
    if options.json:
        answer = {
            "status": plan.status.name,
            "reason": plan.reason,
            **result.answer,
            "planning_seconds": milliseconds / 1e3,
        }
        print(json.dumps(answer))
    elif plan.cells:
        if grid.width <= MAX_TEXT_WIDTH or sys.stdout.isatty():
            print(draw_text(grid, plan.cells))
        print(*result.lines, sep="\n", end=f", planned in {milliseconds:.1f} ms\n")
    else:
        has_body = "body" in result.picture
        is_plain = plan.reason == plan.status.value
        hint = " for the body; --picture shows it" if has_body and is_plain else ""
        print(f"no path: {plan.reason}{hint}", file=sys.stderr)
    if options.csv:
        write_csv(options.csv, result.columns, result.rows)
    if options.picture:
        save_picture(options.picture, grid, plan.cells, **result.picture)
    return 0 if plan.cells else 1


def file_of(argument: str) -> Path:
    """Return the path that an argument names."""
    try:
        return as_path(argument)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _add_options(
    parser: argparse.ArgumentParser, *options: tuple[str, Any, Any, str]
) -> None:
    """Add options: a name, a type or choices, a default, words. A flag is a bool."""
    for name, kind, default, words in options:
        settings: dict[str, Any] = {"default": default, "help": words}
        if kind is bool:
            settings["action"] = "store_true"
        elif isinstance(kind, Sequence):
            settings["choices"] = kind
        else:
            settings["type"] = file_of if kind is Path else kind
            settings["metavar"] = "X"
        if kind is not bool and default not in (None, ""):
            settings["help"] = f"{words} (default: %(default)s)"
        parser.add_argument(f"--{name}", **settings)


def _add_map_options(parser: argparse.ArgumentParser, move_rule: str | None) -> None:
    parser.add_argument(
        "map", help="ROS map YAML, MovingAI .map, or name of a shipped map"
    )
    for name in ("start", "goal"):
        words = f"the {name}'s cell, by default the map file's"
        parser.add_argument(
            f"--{name}", type=int, nargs=2, metavar=("X", "Y"), help=words
        )
    words = "which diagonal moves are legal" + (
        "" if move_rule else ", by default as in training"
    )
    _add_options(
        parser, ("move-rule", [rule.value for rule in api.MoveRule], move_rule, words)
    )


def _files_of(map_file: MapFile) -> dict[str, Path | None]:
    """Return the files of a map by what errors call them."""
    return {f"the map's file {path.name}": path for path in map_file.files}


def _read_map(options: Any) -> tuple[MapFile, Cell, Cell]:
    """Return the map file, the start and the goal that the options give."""
    from ddqn_planner.grid import read_map_file

    map_file = read_map_file(find_map(options.map))
    start = options.start or map_file.start
    goal = options.goal or map_file.goal
    if start is None or goal is None:
        raise ValueError(
            f"{options.map} names no start and goal; give --start X Y and --goal X Y"
        )
    return map_file, tuple(start), tuple(goal)


def train(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> int:
    """Train a model on a map file, into a folder. Run the same command again to resume."""
    from ddqn_planner.training.environment import Scenario
    from ddqn_planner.training.evaluation import evaluate
    from ddqn_planner.training.hyper_parameters import HyperParameters

    _add_map_options(parser, "corner_cutting")
    _add_training_options(parser, "runs/train", HyperParameters())
    options = parser.parse_args(arguments)
    map_file, start, goal = _read_map(options)
    scenario = Scenario(map_file.grid(), start, goal, api.MoveRule(options.move_rule))
    trainer = _run_training(options, lambda: [scenario]).trainer
    field = trainer.planner().q_field(scenario.grid, goal)
    evaluation = evaluate(field, scenario.grid, field.move_rule)
    plan = field.rollout(start)
    print(
        f"the greedy rollout solves {evaluation.solved} of {evaluation.starts} "
        f"starts, mean length {evaluation.mean_ratio:.4f} of the optimum; from the start "
        + (f"{plan.length:.2f} cells" if plan.cells else "it is trapped")
    )
    return 0


def train_any_map(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> int:
    """Train a model for any map on small random maps. Run the same command again to resume."""
    from ddqn_planner.training.any_map import ANY_MAP, MAPS, random_scenarios

    _add_options(parser, ("maps", int, MAPS, "number of maps"))
    _add_training_options(parser, "runs/any_map", ANY_MAP)
    options = parser.parse_args(arguments)
    if options.maps < 1:
        raise ValueError(f"--maps is {options.maps}; give at least 1")
    _run_training(options, lambda: random_scenarios(options.seed, options.maps))
    return 0


def train_robot(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> int:
    """Train a model of a robot with a body and a heading. Exit code 1 if it cannot be proved."""
    from tqdm import tqdm

    from ddqn_planner.grid.arguments import as_whole
    from ddqn_planner.model import save_model
    from ddqn_planner.training.robot import MOST_STEPS, ROBOT, RobotTrainer

    _add_options(
        parser,
        (
            "footprint",
            str,
            None,
            "'[[x, y], ...]', metres, or a radius, as in Nav2's costmaps",
        ),
        (
            "padding",
            float,
            0.0,
            "metres by which the body counts as larger: room for a controller",
        ),
        ("motion", str, None, "differential, ackermann or omnidirectional"),
        ("turning-radius", float, 0.0, "of its bends, metres; ackermann needs it"),
        ("resolution", float, 0.05, "of the maps, metres per cell"),
        (
            "lattice",
            Path,
            None,
            "a file of Nav2's lattice generator, instead of these three",
        ),
        ("out", Path, "my_robot.safetensors", "the model's file"),
        ("seed", int, 0, "seed of the training"),
        ("steps", int, ROBOT.steps, "transitions after which to give up"),
    )
    options = parser.parse_args(arguments)
    as_whole("--steps", options.steps, 1, MOST_STEPS)
    out = as_path(options.out, "--out")
    check_writable(out, "--out")
    check_distinct({"--out": out}, {"--lattice": options.lattice})
    how = (
        options.turning_radius,
        options.resolution,
        options.lattice,
        options.seed,
        options.padding,
    )
    trainer = RobotTrainer(options.footprint, options.motion, *how)
    with tqdm(total=options.steps, disable=None) as bar:
        for certificate in trainer.run(options.steps):
            bar.update(trainer.steps - bar.n)
            bar.set_postfix(
                weak=certificate.weak, forbidden=certificate.forbidden, refresh=False
            )
    print(f"{trainer.steps:,} transitions: {certificate}")
    if certificate.proved:
        save_model(out, trainer.network, trainer.metadata())
    else:
        print(
            "not saved; give more --steps, or another --seed or --resolution",
            file=sys.stderr,
        )
    return int(not certificate.proved)


def _add_training_options(
    parser: argparse.ArgumentParser, out: str, parameters: Any
) -> None:
    _add_options(parser, ("out", Path, out, "folder of the run"))
    _add_options(parser, ("seed", int, 0, "seed of the training"))
    for entry in fields(parameters):
        kind = entry.metadata.get("choices") or type(entry.default)
        name = entry.name.replace("_", "-")
        default = getattr(parameters, entry.name)
        _add_options(parser, (name, kind, default, entry.metadata["source"]))


def _run_training(
    options: Any, scenarios: Callable[[], Sequence[Scenario]]
) -> TrainingRun:
    """Train into ``--out`` until ``--steps`` or a signal to stop; return the closed run."""
    from ddqn_planner.grid.arguments import as_seed

    as_seed(options.seed)
    check_writable(options.out / "model.safetensors", "--out")
    import torch  # before the scenarios are made, which may take seconds
    from tqdm import tqdm

    from ddqn_planner.training.hyper_parameters import HyperParameters
    from ddqn_planner.training.run import TrainingRun

    # As fast as two for such small networks, and always the same result.
    torch.set_num_threads(1)
    values = {
        entry.name: getattr(options, entry.name) for entry in fields(HyperParameters)
    }
    parameters = HyperParameters(**values)
    with TrainingRun(options.out, scenarios(), parameters, options.seed) as run:
        trainer = run.trainer
        print(run.description)
        # An exception could interrupt a step; what is asked for is read between two steps.
        for number in (signal.SIGINT, signal.SIGTERM):
            before = signal.signal(number, lambda *_: run.asked.add("stop"))
            run.callback(signal.signal, number, before)
        # disable=None: no bar if the output is not a terminal.
        with tqdm(total=parameters.steps, initial=trainer.steps, disable=None) as bar:
            for finished in run.steps():
                bar.update(trainer.steps - bar.n)
                for episode in finished:
                    figures = {
                        "episode": episode.number,
                        "average reward": episode.average_reward,
                    }
                    bar.set_postfix(figures, refresh=False)
        if run.asked:
            print(f"stopped at step {trainer.steps}; run the same command to resume")
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

    parser.add_argument("model", nargs="?", default="any_map", help=MODEL)
    network, metadata = load_model(parser.parse_args(arguments).model)
    certificate = network.certificate(metadata.move_rule)
    print(certificate or NO_CERTIFICATE)
    return 0 if certificate and certificate.proved else 1


def _experience_to_teach(options: Any) -> api.Experience:
    """Return the experience of ``--experience``, or a new one of the options."""
    robot = {}
    for name in ("nominal_speed", "robot_width"):
        value = getattr(options, name)
        if value is not None:
            robot[name] = value
    if not options.experience:
        return api.Experience(**{"nominal_speed": 0.5, **robot})
    experience = api.Experience.load(options.experience)
    changed = differences(experience.options, robot)
    if changed:
        raise ValueError(f"{options.experience} has {changed}; leave those options out")
    return experience


def learn(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> int:
    """Learn from a robot's recorded drives how long places take, and what of it the map tells."""
    from ddqn_planner.experience.drives import EXPERIENCE, LOCK, RECORD, Drive
    from ddqn_planner.experience.recordings import read_recording
    from ddqn_planner.grid import read_map_file

    words = "trainers' folders, bags, MCAP files, or CSV files with the columns seconds, x, y"
    parser.add_argument("drives", type=file_of, nargs="+", help=words)
    parser.add_argument(
        "--map", required=True, help="ROS map YAML, or name of a shipped map"
    )
    _add_options(
        parser,
        (
            "out",
            Path,
            None,
            "by default experience.npz in the first folder, or beside the file",
        ),
        (
            "experience",
            Path,
            None,
            "older file that the drives add to; else all is learned anew",
        ),
        (
            "nominal-speed",
            float,
            None,
            "a first guess, m/s; by default 0.5, or --experience's",
        ),
        ("robot-width", float, None, "metres; by default 0.5, or --experience's"),
        (
            "topic",
            str,
            "",
            "MCAP: of poses or transforms, by default that with most of them",
        ),
        ("frame", str, "map", "MCAP: the map's frame"),
        ("robot-frame", str, "", "MCAP: by default any that ends in base_link"),
    )
    options = parser.parse_args(arguments)
    first = options.drives[0]
    out = options.out or (first if first.is_dir() else first.parent) / EXPERIENCE
    check_writable(out, "--out")
    map_file = read_map_file(find_map(options.map))
    recordings = {f"the recording {path}": path for path in options.drives}
    check_distinct({"--out": out}, {**recordings, **_files_of(map_file)})
    grid = map_file.grid()
    experience = _experience_to_teach(options)
    drives: list[Drive] = []
    with ExitStack() as stack:
        for source in options.drives:
            if (source / RECORD).is_file():
                stack.enter_context(
                    WorkFolder(source, [LOCK, RECORD], "drives", "records")
                )
            recording = read_recording(
                source,
                grid,
                topic=options.topic,
                frame=options.frame,
                robot_frame=options.robot_frame,
            )
            print(f"{source}: {recording.source}")
            drives += recording.drives
        reasons = []
        for number, drive in enumerate(drives, 1):
            learned = drive.teach(experience, grid)
            if not learned:
                reasons.append(learned.reason)
                print(f"drive {number} taught nothing: {learned.reason}")
        if len(reasons) == len(drives):
            raise ValueError(
                f"no drive taught anything, and {out} is as before; {reasons[0]}"
            )
        try:
            from ddqn_planner.training.prior_training import prior_of

            experience.prior = prior_of(
                grid, experience.evidence.places, experience.prior
            )
        except ImportError as error:
            print(f"the map's prior is not trained: {with_remedy(error)}")
        # Not `save`, which adds to an older file.
        write_atomically(out, experience.to_bytes())
    minutes = sum(drive.seconds[-1] - drive.seconds[0] for drive in drives) / 60
    print(
        f"{len(drives)} drives, {sum(d.metres for d in drives):.0f} m, {minutes:.1f} min"
    )
    print(f"speed in the open: {experience.learned_speed:.2f} m/s")
    print(f"saved {out}")
    return 0


def warm_up(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> int:
    """Compile all that plans need, so that no node compiles it. Run it where the nodes run."""
    from ddqn_planner.warm_up import warm_up as stages

    parser.add_argument("model", nargs="?", default="any_map", help=MODEL)
    planner = api.Planner.load(parser.parse_args(arguments).model)
    began = time.perf_counter()
    list(stages(planner, learns=True))
    print(f"compiled, or loaded, in {time.perf_counter() - began:.1f} s")
    return 0


FUNCTIONS: Final = plan, train, train_any_map, train_robot, certify, warm_up, learn
COMMANDS: Final = {
    function.__name__.replace("_", "-"): function for function in FUNCTIONS
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return 0 done, 1 no path or proof, 2 bad input or a missing library.

    130 is returned after Ctrl-C.
    """
    # NumPy is not yet imported. For small products one thread is as fast as several, and on a busy
    # machine several are ten times as slow.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    arguments = sys.argv[1:] if arguments is None else arguments
    return exit_code("ddqn-planner", lambda: _run_command(arguments))


def _run_command(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="ddqn-planner", description=str(__doc__).replace("`", "")
    )
    names = parser.add_subparsers(required=True, metavar="|".join(COMMANDS))
    parsers = {}
    for name, command in COMMANDS.items():
        words = str(command.__doc__)
        parsers[name] = names.add_parser(
            name, help=words.split(".")[0], description=words
        )
    if not arguments or arguments[0] not in COMMANDS:
        parser.parse_args(arguments)  # ends with the help, or an error
    name, *options = arguments
    return COMMANDS[name](parsers[name], options)
