"""Measures how much sooner a robot arrives that remembers times, in many worlds."""

import argparse
import itertools
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Final

# Before NumPy is imported. On a busy machine, several threads are ten times as slow as
# one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import driving_kinds as kinds
import driving_scenes as scenes
import driving_worlds as worlds
import numpy as np
from driving_learners import LEARNERS
from driving_missions import KNOWN, Job, Result, planner, run
from driving_worlds import RULE, SPEED, drive
from figures import draw_times, save_figure
from random_maps import generate_map
from tables import table, write_report
from trainings import in_parallel, make_folder, parser_of

from ddqn_planner import Experience, GridMap
from ddqn_planner.cli import exit_code
from ddqn_planner.commands.options import file_of
from ddqn_planner.grid.noise import random_requests

Options = argparse.Namespace
Sections = dict[str, str]
Stages = Sequence[tuple[int, int]]

STAGES: Final = ((0, 20), (20, 50), (50, 100))
LATE: Final = STAGES[-1]
# New to the world, and after all that is slow has moved.
MOVED_STAGES: Final = ((0, 10), (10, 50), (100, 110), (110, 150))
NEW_STAGES: Final = ((0, 5), (0, 20))
# What is slow on the map where the robot learned, and on those that are new to it.
PRIORS: Final = (("clearance", "clearance"), ("discs", "discs"), ("clearance", "discs"))
NEW_MAPS: Final = ("warehouse", "blobs", "halls")
EXPERIENCE: Final = "experience"
SHORTEST: Final = "shortest path"
WORSE: Final = 1.0  # percentage points over the shortest path that count as worse
SMOOTHED: Final = 10  # missions that a point of the curve averages
SETS: Final = {
    "figures": ("Laws of others, never looked at", kinds.FOR_FIGURES),
    "choosing": ("Laws of others, for choosing", kinds.FOR_CHOOSING),
    "standing": ("Standing laws", kinds.STANDING),
    "former": ("Former laws", (*kinds.FORMER, *kinds.FORMER_ON_OTHER_MAPS)),
}


def compared(options: Options) -> Sections:
    """Compare all learners on each set of worlds."""
    sections = {}
    for title, kinds_of_set in options.sets.items():
        results = _runs(kinds_of_set, tuple(LEARNERS), options)
        learned = [result for result in results if result.learner == EXPERIENCE]
        results += [result.of_shortest_path() for result in learned]
        sections[title] = _by_class(results)
        sections[f"{title}, by law"] = _by_law(results)
        sections[f"{title}, expected times"] = _forecasts(learned)
        if "From mission to mission" not in sections:
            curve = _curve(options.out / "curve.png", results)
            sections["From mission to mission"] = curve
    return sections


def limit(options: Options) -> Sections:
    """Compare with those who know the mean times of places, and of turns.

    It is measured in worlds where turns or directions take time.
    """
    sections = {}
    for title, kinds_of_set in options.sets.items():
        names = [kind for kind in kinds_of_set if kinds.class_of(kind) == kinds.TURNS]
        if not names:
            continue
        results = _runs(names, (EXPERIENCE, *KNOWN), options)
        learned = [result for result in results if result.learner == EXPERIENCE]
        results += [result.of_shortest_path() for result in learned]
        sections[f"{title}, limits of turns and directions"] = _by_law(results)
    return sections


def faulty(options: Options) -> Sections:
    """Measure the worlds with faults."""
    sections = {}
    for title, kinds_of_set in options.sets.items():
        results = _runs(kinds_of_set, (EXPERIENCE,), options, is_faulty=True)
        sections[f"{title}, with faults"] = _by_class(results)
        sections[f"{title}, expected times with faults"] = _forecasts(results)
    return sections


def moved(options: Options) -> Sections:
    """Measure what happens when all slow zones move."""
    names = [
        kind
        for kind in (*kinds.FORMER, *kinds.FORMER_ON_OTHER_MAPS)
        if kinds.law_of(kind) in ("discs", "mixture")
    ]
    results = _runs(names, (EXPERIENCE,), options, missions=150, is_moved=True)
    return {"All slow zones move": _by_class(results, MOVED_STAGES)}


def priors(options: Options) -> Sections:
    """Measure missions on a new map, with a prior from another map and without."""
    rows = []
    for source, law in PRIORS[: 1 if options.quick else None]:
        names = [f"{name}-{law}" for name in (*NEW_MAPS, *options.maps_found)]
        untaught, taught = (
            _runs(names, (EXPERIENCE,), options, missions=20, prior_from=prior_from)
            for prior_from in ("", f"rooms-{source}")
        )
        title = f"{source}, then {law}"
        cells = [_mean(untaught, first, end) for first, end in NEW_STAGES]
        rows.append([title, "without", *cells])
        cells = []
        for first, end in NEW_STAGES:
            differences = [
                with_prior.above(first, end) - without_prior.above(first, end)
                for with_prior, without_prior in zip(taught, untaught, strict=True)
            ]
            difference = _with_error(differences, "+")
            cells.append(f"{_mean(taught, first, end)} ({difference})")
        rows.append([title, "with", *cells])
    return {"A map never driven": table(f"worlds | prior | {_names(NEW_STAGES)}", rows)}


def speed(_: Options) -> Sections:
    """Measure the CPU time to learn from 1,000 poses, and to plan again.

    The map has 1000 x 1000 cells.
    """
    random = np.random.default_rng(0)
    grid = GridMap(generate_map("office", (1000, 1000), random), 0.05)
    world = worlds.make_world(grid, "mixture", random)
    requests = random_requests(world.grid.occupancy, RULE, 6, random)
    goal = requests[0][1]
    experience = Experience(SPEED)
    clock = 0.0
    times = []
    for number in range(25):
        start = requests[number % 6][0]
        cells = planner().plan(experience.apply(grid), start, goal).cells
        measured = drive(cells[:1001], world, clock, random)
        rows_of_poses = np.linspace(0, len(measured.seconds) - 1, 1000)
        poses = rows_of_poses.astype(np.int64)
        clock += measured.duration
        middle = cells[: len(cells) // 2 + 1][-1]
        moments = [time.thread_time()]
        experience.record(measured.seconds[poses], measured.positions[poses])
        moments.append(time.thread_time())
        learned_map = experience.apply(grid)
        moments.append(time.thread_time())
        planner().plan(learned_map, middle, goal)
        moments.append(time.thread_time())
        steps = 1e3 * np.diff(moments)
        times.append([*steps, steps.sum()])
    columns = np.array(times[5:]).T
    names = ("record", "apply", "plan again", "all")
    rows = [
        [name, f"{np.median(milliseconds):.1f}", f"{milliseconds.max():.1f}"]
        for name, milliseconds in zip(names, columns, strict=True)
    ]
    header = "1,000 poses on 1000 x 1000 cells | median [ms] | worst [ms]"
    return {"Speed": table(header, rows)}


FIGURES: Final[dict[str, Callable[[Options], Sections]]] = {
    "compared": compared,
    "limit": limit,
    "hall": scenes.hall,
    "one_wait": scenes.one_wait,
    "doors": scenes.doors,
    "two_speeds": scenes.two_speeds,
    "zones": scenes.zones,
    "faulty": faulty,
    "moved": moved,
    "priors": priors,
    "speed": speed,
}


def _runs(
    names: Sequence[str], learners: Sequence[str], options: Options, **more: Any
) -> list[Result]:
    """Run each kind of a set with each learner and seed."""
    settings = {"missions": 100, "exploration": options.exploration, **more}
    settings |= {"missions": 10} if options.quick else {}
    jobs = [
        Job(kind, kinds.first_seed(kind) + number, learners, **settings)
        for kind, number in itertools.product(names, range(options.seeds))
    ]
    results = in_parallel(run, jobs, options.backend, "world")
    return list(itertools.chain.from_iterable(results))


def _groups(
    results: Iterable[Result], name: Callable[[Result], str]
) -> dict[str, list[Result]]:
    """Return the results by a name of each, in the same order."""
    groups: dict[str, list[Result]] = {}
    for result in results:
        groups.setdefault(name(result), []).append(result)
    return groups


def _by_class(results: Sequence[Result], stages: Stages = STAGES) -> str:
    """Return a table of the time above the best possible, by class and learner."""
    rows = []
    classes = _groups(results, lambda result: kinds.class_of(result.kind))
    if len(classes) > 1:
        classes = {"all": list(results), **classes}
    for name, results_of_class in classes.items():
        learners = _groups(results_of_class, lambda result: result.learner)
        for learner, group in learners.items():
            cells = [_mean(group, first, end) for first, end in stages]
            first, end = stages[-1]
            worse = [result.over_shortest(first, end) > WORSE for result in group]
            rows.append([name, learner, *cells, f"{sum(worse)} of {len(group)}"])
    header = f"worlds | learner | {_names(stages)} | worse than the shortest path"
    return table(header, rows)


def _by_law(results: Sequence[Result]) -> str:
    """Return a table of the last stage, by law."""
    rows = []
    laws = _groups(results, lambda result: kinds.law_of(result.kind))
    for law, results_of_law in laws.items():
        learners = _groups(results_of_law, lambda result: result.learner)
        cells = [_mean(group, *LATE) for group in learners.values()]
        experience = learners[EXPERIENCE]
        differences = [result.over_shortest(*LATE) for result in experience]
        early = _mean(experience, *STAGES[0])
        intervals = f"{100 * _share_within(experience):.0f} %"
        rows.append(
            [law, len(experience), early, *cells, _with_error(differences), intervals]
        )
    names = " | ".join(f"{learner}, {_names([LATE])}" for learner in learners)
    header = (
        f"law | worlds | {EXPERIENCE}, {_names(STAGES[:1])} | {names} | "
        "experience over the shortest path | within the 90 % interval"
    )
    return table(header, rows)


def _share_within(results: Sequence[Result]) -> float:
    """Return the share of late missions whose time was in its interval of 90 %."""
    first, end = LATE
    late = np.concatenate([result.forecast[first:end] for result in results])
    if not len(late):
        return math.nan
    measured, _, low, high, _ = late.T
    return float(np.mean((low <= measured) & (measured <= high)))


def _mean(results: Sequence[Result], first: int, end: int) -> str:
    """Return the mean percentage above the best possible, with its error."""
    if first >= len(results[0].seconds):
        return ""
    return f"{_with_error([result.above(first, end) for result in results])} %"


def _with_error(values: Sequence[float], sign: str = "") -> str:
    """Return the mean of values with its standard error."""
    mean = f"{np.mean(values):{sign}.1f}"
    if len(values) < 2:
        return mean
    return f"{mean} ± {np.std(values, ddof=1) / math.sqrt(len(values)):.1f}"


def _names(stages: Stages) -> str:
    """Return the names of columns."""
    return " | ".join(f"{first + 1} to {end}" for first, end in stages)


def _forecasts(results: Sequence[Result]) -> str:
    """Return how far the expected times of missions were from the measured ones."""
    every = np.concatenate([result.forecast for result in results])
    groups = {"all whose path is half new": every[every[:, 4] >= 0.5]}
    for first, end in ((0, 5), LATE):
        some = np.concatenate([result.forecast[first:end] for result in results])
        groups[f"{first + 1} to {end}"] = some
    rows: list[list[object]] = []
    for name, forecast in sorted(groups.items()):
        if not len(forecast):
            continue
        measured, expected, low, high, _ = forecast.T
        error = np.abs(expected / measured - 1).mean()
        inside = ((low <= measured) & (measured <= high)).mean()
        width = np.median((high - low) / expected)
        ratio = measured.sum() / expected.sum()
        shares = [f"{share:.1%}" for share in (error, inside, width)]
        rows.append([name, len(measured), *shares, f"{ratio:.2f}"])
    header = "missions | drives | MAPE | within the 90 % interval | width of it, median"
    return table(f"{header} | measured over expected", rows)


def _curve(path: Path, results: Sequence[Result]) -> str:
    """Draw the total time over the best possible, where places are slow."""
    slow = [result for result in results if kinds.class_of(result.kind) == kinds.PLACES]
    learners = _groups(slow or results, lambda result: result.learner)
    seconds = {
        name: [np.sum([result.seconds for result in group], axis=0)]
        for name, group in learners.items()
    }
    best = np.sum([result.best for result in learners[EXPERIENCE]], axis=0)
    width = min(SMOOTHED, len(best))
    figure, _ = draw_times(seconds, [best], width, banded=EXPERIENCE)
    title = "Time over the best possible, from mission to mission"
    return save_figure(figure, path, title)


def measure(options: Options) -> int:
    """Run the experiment, write its tables, figures and ``report.md``, and print it."""
    options.maps_found = (
        sorted(map(str, options.maps.rglob("*.yaml"))) if options.maps else []
    )
    if options.maps and not options.maps_found:
        raise ValueError(f"{options.maps}: found no ROS map (.yaml); check the path")
    options.out = make_folder(options)
    options.sets = dict(SETS[name] for name in options.set or SETS)
    if on_files := [
        f"{path}-{law}" for path in options.maps_found for law in kinds.ON_FILES
    ]:
        options.sets["Maps from files"] = on_files
    if options.quick:
        options.sets = {title: names[:2] for title, names in options.sets.items()}
    sections = Sections()
    for name in options.figure or FIGURES:
        sections |= FIGURES[name](options)
    print(write_report(options.out, sections, options.page))
    print(f"saved {options.out / 'report.md'}")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; return the exit code."""
    parser = parser_of("driving.py", __doc__, "runs/driving")
    add = parser.add_argument
    add(
        "--maps",
        type=file_of,
        metavar="FOLDER",
        help="measure on the ROS maps of a folder too",
    )
    add(
        "--figure",
        action="append",
        choices=FIGURES,
        help="measure some of the figures alone",
    )
    add(
        "--set",
        action="append",
        choices=SETS,
        help="measure in some sets of worlds alone",
    )
    words = "what `Experience.apply` is given, if it is not its default"
    add("--exploration", type=float, metavar="SHARE", help=words)
    options = parser.parse_args(arguments)
    return exit_code(parser.prog, lambda: measure(options))


if __name__ == "__main__":
    sys.exit(main())
