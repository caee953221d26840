"""``ddqn-planner``: planning, training and experiments from a shell, without ROS."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import torch
from tqdm import tqdm

from ddqn_planner.benchmarks.evaluation import evaluate
from ddqn_planner.experiments import EXPERIMENTS
from ddqn_planner.experiments.benchmark_maps import (
    COSTS,
    RequestSettings,
    describe_files,
    find_files,
    generated_maps,
    read_maps,
)
from ddqn_planner.experiments.generalisation import Walk, markdown, measure, summarise, write_report
from ddqn_planner.experiments.profiles import HIDDEN_UNITS
from ddqn_planner.grid import Cell, GridMap, MapFile, MoveRule, Noise, inflate, read_map_file
from ddqn_planner.grid.generators import KINDS
from ddqn_planner.pictures.animation import save_animation
from ddqn_planner.pictures.picture import MAX_TEXT_WIDTH, PictureError, draw_text, save_picture
from ddqn_planner.planning import Plan, PlanMethod, Planner, shortest_distances
from ddqn_planner.resources import find_map
from ddqn_planner.training import ranks
from ddqn_planner.training.any_map import ANY_MAP, MAPS, random_scenarios
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.memory import megabytes
from ddqn_planner.training.run import TrainingRun

MOVE_RULES = [rule.value for rule in MoveRule]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code.

    0 done, 1 no path, 2 bad input, 130 interrupted.
    """
    options = _parser().parse_args(arguments)
    if name := getattr(options, "move_rule", None):
        options.move_rule = MoveRule(name)
    torch.set_num_threads(1)  # as fast as two for networks of this size, and the same every time
    try:
        return int(options.command(options))
    except (OSError, ValueError, PictureError) as error:
        print(f"ddqn-planner: {error}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="ddqn-planner", description=__doc__)
    commands = parser.add_subparsers(
        required=True, metavar="plan|train|train-any-map|evaluate|reproduce|watch"
    )
    _add_plan(commands.add_parser("plan", help="plan a path on a map file"))
    for name, add, words, description in (
        (
            "train",
            _add_train,
            "train a model on a map file",
            "Trains into a folder. The same command again goes on where it stopped.",
        ),
        (
            "train-any-map",
            _add_train_any_map,
            "train a model for any map on random maps",
            "Trains into a folder, on small random maps. The same command again goes on where it "
            "stopped. Under torchrun all processes train one model, each on maps of its own.",
        ),
        (
            "evaluate",
            _add_evaluate,
            "measure a model on maps that it never saw",
            "Walks from random starts to random goals, and compares with the exact optimum and "
            "with scipy's Dijkstra: on generated maps, or on those of benchmarks.",
        ),
        (
            "reproduce",
            _add_reproduce,
            "train and measure the paper's experiments",
            "Trains with many seeds, and writes tables, figures and a report. The same command "
            "again goes on where it stopped.",
        ),
        (
            "watch",
            _add_watch,
            "show live what the ROS nodes publish",
            "Opens rerun's viewer: map, value field, plan, and a training's episodes and reward. "
            "It shows what comes after it was started, and the last map, value and plan.",
        ),
    ):
        defaults = argparse.ArgumentDefaultsHelpFormatter
        add(
            commands.add_parser(name, help=words, description=description, formatter_class=defaults)
        )
    return parser


def _add_plan(plan: argparse.ArgumentParser) -> None:
    _add_map_arguments(plan)
    plan.add_argument("--model", default="any_map", help="name or file (%(default)s)")
    plan.add_argument("--move-rule", choices=MOVE_RULES, help="the model's by default")
    plan.add_argument(
        "--mode",
        choices=[method.value for method in PlanMethod],
        default="greedy",
        help="astar_fallback: search where the greedy steps are trapped",
    )
    plan.add_argument(
        "--occupied-threshold",
        type=int,
        default=65,
        metavar="N",
        help="percent: a cell of this value or more is occupied (%(default)s)",
    )
    for name, words in (
        ("allow-unknown", "take unknown cells as free"),
        (
            "use-map-costs",
            "let a free cell cost more, the greater its value; an unknown one costs most",
        ),
    ):
        plan.add_argument(f"--{name}", action="store_true", help=words)
    for name, words in (
        ("robot-radius", "metres that the path keeps from obstacles"),
        ("clearance-weight", "0 to 1: how much dearer cells near to obstacles are"),
        ("tolerance", "metres that a goal may move that is occupied or cut off"),
    ):
        plan.add_argument(f"--{name}", type=float, default=0.0, metavar="X", help=words)
    plan.add_argument("--json", action="store_true", help="print JSON in place of text")
    plan.add_argument("--picture", type=Path, metavar="FILE", help="draw map, value and path")
    plan.add_argument(
        "--animate", type=Path, metavar="FILE", help="draw how value and path grow, a .gif"
    )
    plan.set_defaults(command=_plan)


def _add_train(train: argparse.ArgumentParser) -> None:
    _add_map_arguments(train)
    train.add_argument("--out", type=Path, default=Path("runs/train"), help="folder of the run")
    train.add_argument(
        "--move-rule", choices=MOVE_RULES, default="corner_cutting", help="of the robot"
    )
    _add_training_arguments(train, HyperParameters())
    train.set_defaults(command=_train)


def _add_train_any_map(train: argparse.ArgumentParser) -> None:
    train.add_argument("--out", type=Path, default=Path("runs/any_map"), help="folder of the run")
    train.add_argument("--maps", type=int, default=MAPS, metavar="N", help="to train on")
    _add_training_arguments(train, ANY_MAP)
    train.set_defaults(command=_train_any_map)


def _add_evaluate(evaluate: argparse.ArgumentParser) -> None:
    add = evaluate.add_argument
    add("--model", default="any_map", help="name or file")
    add("--move-rule", choices=MOVE_RULES, default="robot_safe", help="of the robot")
    add(
        "--data",
        type=Path,
        metavar="FOLDER",
        help="of MovingAI .map and .scen, MPD .npz, ROS .yaml, in place of generated maps",
    )
    add("--kinds", nargs="+", choices=KINDS, default=[*KINDS], help="generated")
    add("--sizes", nargs="+", type=int, default=[32, 64, 128, 256], help="sides, cells")
    add("--maps", type=int, default=3, metavar="N", help="of a kind and size")
    add("--requests", type=int, default=200, metavar="N", help="of a map")
    add("--costs", choices=COSTS, default="none", help="costs of free cells")
    add("--seed", type=int, default=0, help="of maps and requests")
    add("--out", type=Path, metavar="FILE", help=".md or .csv, for the tables")
    evaluate.set_defaults(command=_evaluate)


def _add_reproduce(reproduce: argparse.ArgumentParser) -> None:
    add = reproduce.add_argument
    add("--experiment", choices=[*EXPERIMENTS, "all"], default="all", help="one")
    add("--seeds", type=int, default=5, metavar="N", help="trainings of a kind")
    out = Path("runs/reproduce")
    add("--out", type=Path, default=out, help="folder of trainings and report")
    choices = [noise.value for noise in Noise]
    add("--noise", nargs="+", choices=choices, default=choices, help="of goal iii")
    units = [*HIDDEN_UNITS]
    add("--hidden-units", nargs="+", type=int, default=units, metavar="N", help="of goal iii")
    add("--quick", action="store_true", help="run it too briefly to learn, into the folder quick")
    reproduce.set_defaults(command=_reproduce)


def _add_watch(watch: argparse.ArgumentParser) -> None:
    add = watch.add_argument
    add("--save", type=Path, metavar="FILE", help="write a recording (.rrd), open no viewer")
    add("--planner", default="planner", metavar="NODE", help="name of the planner node")
    add("--trainer", default="trainer", metavar="NODE", help="name of the trainer node")
    # rclpy finds them in sys.argv.
    add("--ros-args", nargs="...", default=argparse.SUPPRESS, help="as of any ROS node")
    watch.set_defaults(command=_watch)


def _add_map_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("map", help="ROS map YAML, MovingAI .map, or shipped map's name")
    for name in ("start", "goal"):
        parser.add_argument(
            f"--{name}",
            type=int,
            nargs=2,
            metavar=("X", "Y"),
            help="by default the map file's",
        )


def _add_training_arguments(parser: argparse.ArgumentParser, parameters: HyperParameters) -> None:
    parser.add_argument("--seed", type=int, default=0, help="of the training")
    for entry in fields(HyperParameters):
        parser.add_argument(
            f"--{entry.name.replace('_', '-')}",
            type=type(entry.default),
            default=getattr(parameters, entry.name),
            choices=entry.metadata.get("choices"),
            help=entry.metadata["source"],
        )


def _hyper_parameters(options: argparse.Namespace) -> HyperParameters:
    values = {entry.name: getattr(options, entry.name) for entry in fields(HyperParameters)}
    return HyperParameters(**values)


def _read_map(options: argparse.Namespace) -> tuple[MapFile, Cell, Cell]:
    map_file = read_map_file(find_map(options.map))
    start = tuple(options.start) if options.start else map_file.start
    goal = tuple(options.goal) if options.goal else map_file.goal
    if start is None or goal is None:
        raise ValueError(f"{options.map} names no start and goal; give --start X Y and --goal X Y")
    return map_file, start, goal


def _plan(options: argparse.Namespace) -> int:
    if options.animate and options.animate.suffix.lower() != ".gif":
        raise ValueError(f"--animate is {options.animate}; give a file that ends in .gif")
    if not options.tolerance >= 0:
        raise ValueError(f"--tolerance is {options.tolerance:g}; give metres, 0 or more")
    map_file, start, goal = _read_map(options)
    grid = map_file.grid(options.occupied_threshold, options.allow_unknown, options.use_map_costs)
    grid = inflate(grid, options.robot_radius, options.clearance_weight)
    planner = Planner.load(options.model)
    method, tolerance = PlanMethod(options.mode), options.tolerance / grid.resolution
    began = time.perf_counter()
    plan = planner.plan(grid, start, goal, options.move_rule, method, tolerance)
    seconds = time.perf_counter() - began
    rule = options.move_rule or planner.metadata.move_rule
    if plan.cells:
        goal = plan.cells[-1]  # another where it moved within the tolerance
    _print_plan(options, grid, plan, rule, seconds)
    field = None
    if grid.is_free(goal) and planner.network.supports((grid.height, grid.width)):
        field = planner.q_field(grid, goal, rule)
    if options.picture:
        title = f"{plan.length:.2f} cells" if plan.cells else plan.status.value
        value = field.value if field and plan.cells else None
        save_picture(options.picture, grid, plan.cells, value, title)
    if options.animate:
        value = field.value if field else None
        save_animation(options.animate, grid, start, goal, value, plan.cells)
    return 0 if plan.cells else 1


def _print_plan(
    options: argparse.Namespace, grid: GridMap, plan: Plan, rule: MoveRule, seconds: float
) -> None:
    optimum = None
    if plan.cells and grid.is_free(plan.cells[0]):
        by_length = replace(grid, cost=None)
        optimum = float(shortest_distances(by_length, plan.cells[-1], rule)[plan.cells[0][::-1]])
    if options.json:
        print(json.dumps(_as_dictionary(plan, optimum, rule, seconds)))
    elif plan.cells:
        if grid.width <= MAX_TEXT_WIDTH:
            print(draw_text(grid, plan.cells))
        print("path: " + " ".join(f"({x}, {y})" for x, y in plan.cells))
        print(
            f"length {plan.length:.2f} cells, "
            + (f"optimum {optimum:.2f} under {rule.value}, " if optimum is not None else "")
            + f"{plan.method.value}, planned in {seconds * 1e3:.1f} ms"
        )
    else:
        print(f"no path: {plan.status.value}", file=sys.stderr)


def _as_dictionary(
    plan: Plan, optimum: float | None, rule: MoveRule, seconds: float
) -> dict[str, object]:
    return {
        "status": plan.status.name,
        "reason": plan.status.value,
        "cells": plan.cells,
        "method": plan.method.value,
        "length": plan.length,
        "optimum": optimum,
        "move_rule": rule.value,
        "planning_seconds": seconds,
    }


def _train(options: argparse.Namespace) -> int:
    map_file, start, goal = _read_map(options)
    scenario = Scenario(map_file.grid(), start, goal)
    parameters = _hyper_parameters(options)
    run = TrainingRun(options.out, [scenario], options.move_rule, parameters, options.seed)
    try:
        _train_with_progress(run)
    finally:
        run.close()
    if run.save_error:
        raise OSError(run.save_error)
    field = run.trainer.planner().q_field(scenario.grid, goal)
    evaluation, plan = evaluate(field, scenario.grid, options.move_rule), field.rollout(start)
    print(
        f"{run.trainer.steps} steps, {run.trainer.episodes} episodes: the greedy walk solves "
        f"{evaluation.solved} of {evaluation.starts} starts, mean length "
        f"{evaluation.mean_ratio:.4f} of the optimum; from the start "
        + (f"{plan.length:.2f} cells" if plan.cells else "it is trapped")
    )
    print(f"saved {run.model_path}")
    return 0


def _train_any_map(options: argparse.Namespace) -> int:
    ranks.join()
    try:
        rank, processes = ranks.rank(), ranks.world_size()
        if options.maps < processes:
            raise ValueError(f"--maps is {options.maps}; give at least one a process: {processes}")
        scenarios = random_scenarios(options.seed, options.maps)[rank::processes]
        folder = options.out if rank == 0 else options.out / f"rank_{rank}"
        parameters = _hyper_parameters(options)
        run = TrainingRun(folder, scenarios, MoveRule.ROBOT_SAFE, parameters, options.seed)
        try:
            if ranks.greatest(run.trainer.steps) != -ranks.greatest(-run.trainer.steps):
                raise ValueError(
                    f"the processes were saved at different steps ({folder} at "
                    f"{run.trainer.steps}); train into another folder"
                )
            _train_with_progress(run)
        finally:
            run.close()
        if run.save_error:
            raise OSError(run.save_error)
        if rank == 0:
            print(f"{run.trainer.steps} steps, {run.trainer.episodes} episodes")
            print(f"saved {run.model_path}")
    finally:
        ranks.leave()
    return 0


def _reproduce(options: argparse.Namespace) -> int:
    if options.seeds < 1:
        raise ValueError(f"--seeds is {options.seeds}; give at least 1")
    try:
        from ddqn_planner.experiments.report import Settings
        from ddqn_planner.experiments.reproduce import reproduce
    except ImportError as error:
        raise PictureError(
            f"the experiments need another library ({error}): "
            "pip install 'ddqn_planner[experiments]'"
        ) from None
    names = [*EXPERIMENTS] if options.experiment == "all" else [options.experiment]
    out = options.out / "quick" if options.quick else options.out
    noise = tuple(map(Noise, dict.fromkeys(options.noise)))
    hidden_units = tuple(dict.fromkeys(options.hidden_units))
    settings = Settings(out, options.seeds, options.quick, noise, hidden_units)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        print(reproduce(names, settings))
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from the last checkpoints", file=sys.stderr)
        return 130
    print(f"saved {out / 'report.md'}")
    return 0


def _watch(options: argparse.Namespace) -> int:
    try:
        from ddqn_planner.nodes.watch import watch
    except ImportError as error:
        extra = "watch" if (error.name or "").startswith("rerun") else "ros"
        raise PictureError(
            f"watch needs another library ({error}): pip install 'ddqn_planner[{extra}]'"
            + (", or source ROS 2 Jazzy" if extra == "ros" else "")
        ) from None
    return watch(options.planner, options.trainer, options.save)


def _evaluate(options: argparse.Namespace) -> int:
    if options.maps < 1:
        raise ValueError(f"--maps is {options.maps}; give at least 1")
    if options.out and options.out.suffix.lower() not in (".csv", ".md"):
        raise ValueError(f"--out is {options.out}; give a file that ends in .csv or .md")
    settings = RequestSettings(options.move_rule, options.requests, options.costs, options.seed)
    planner = Planner.load(options.model)
    maps = generated_maps(options.kinds, options.sizes, options.maps, settings)
    if options.data:
        files = find_files(options.data)
        print(f"found in {options.data}: {describe_files(files)}", file=sys.stderr)
        maps = read_maps(files, settings)
    walks: list[Walk] = []
    interrupted = False
    try:
        for walk in measure(planner, tqdm(maps, unit="map", disable=None), options.move_rule):
            walks.append(walk)
    except KeyboardInterrupt:
        interrupted = True
        print("interrupted; what follows is of the maps so far", file=sys.stderr)
    if walks:
        summaries = summarise(walks)
        metadata = planner.metadata
        text = markdown(
            summaries,
            walks,
            f"Model {options.model} ({metadata.network}, {metadata.steps:,} steps, seed "
            f"{metadata.seed}), move rule {options.move_rule.value}, costs {options.costs}, "
            f"requests of seed {options.seed}.",
        )
        print(text, end="")
        if options.out:
            write_report(options.out, summaries, text)
    elif not interrupted:
        raise ValueError(f"{options.data}: none of its files has a request; see above")
    return 130 if interrupted else 0


def _train_with_progress(run: TrainingRun) -> None:
    trainer = run.trainer
    if ranks.rank() == 0:
        print(f"training in {run.folder}, with about {megabytes(run.memory)} of memory")
    interrupted = threading.Event()
    # An exception could strike in the middle of a step; a flag is looked at between two.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: interrupted.set())
    # None: no bar where the output is no terminal.
    quiet = True if ranks.rank() else None
    with tqdm(total=trainer.parameters.steps, initial=trainer.steps, disable=quiet) as bar:
        for finished in run.steps():
            bar.update(trainer.steps - bar.n)
            for episode in finished:
                bar.set_postfix(
                    {"episode": episode.number, "average reward": episode.average_reward},
                    refresh=False,
                )
            # All processes stop at the same step: none waits for another's gradients.
            if ranks.greatest(interrupted.is_set()):
                run.try_to_save()
                print(f"stopped at step {trainer.steps}; the same command goes on from there")
                break


if __name__ == "__main__":
    sys.exit(main())
