"""Measures how much sooner a robot arrives that remembers times, in many worlds."""

import argparse
import itertools
import math
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

# Before NumPy is imported. On a busy machine, several threads are ten times as slow as
# one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import driving_worlds as worlds
import numpy as np
from driving_learners import LEARNERS
from driving_missions import Job, Result, planner, run, run_in
from driving_worlds import (
    HELD_OUT,
    HELD_OUT_SEED,
    ON_FILES,
    RULE,
    SPEED,
    TUNING,
    World,
    drive,
)
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
LONG_STAGES: Final = ((0, 200), (200, 600), (600, 1000))
# New to the world, and after all that is slow has moved.
MOVED_STAGES: Final = ((0, 10), (10, 50), (100, 110), (110, 150))
NEW_STAGES: Final = ((0, 5), (0, 20))
# What is slow on the map where the robot learned, and on those that are new to it.
PRIORS: Final = (("clearance", "clearance"), ("discs", "discs"), ("clearance", "discs"))
NEW_MAPS: Final = ("warehouse", "blobs", "halls")
EXPERIENCE: Final = "experience"
SHORTEST: Final = "shortest path"
HELD_OUT_SET: Final = "Held-out worlds"
DRAWN: Final = (EXPERIENCE, SHORTEST, "Gaussian process", "Markov field")
SMOOTHED: Final = 10  # missions that a point of the curve averages
DOOR_WAITS: Final = (10, 30, 60)  # seconds
DOOR_DRIVES: Final = 40
ZONE_NOISES: Final = (0.02, 0.035, 0.05)  # metres
ZONE_RATES: Final = (10, 50)  # poses per second
ZONE_WIDTHS: Final = (0.2, 0.35, 0.5)  # metres, of the robot
ZONE_DRIVES: Final = 10


def compared(options: Options) -> Sections:
    """Compare all learners on each set of worlds."""
    sections = {}
    for title, kinds in options.sets.items():
        results = _runs(kinds, tuple(LEARNERS), options)
        results_by_learner = _by(results, "learner")
        rows = []
        rows_by_kind = {kind: [_short(kind)] for kind in kinds}
        for learner, results_of_learner in results_by_learner.items():
            over_shortest = {}
            for kind, results_of_kind in _by(results_of_learner, "kind").items():
                ratios = [result.over_shortest(0, 20) for result in results_of_kind]
                over_shortest[kind] = np.mean(ratios)
                percentages = [f"{value:.1f}" for value in _above(results_of_kind)]
                rows_by_kind[kind].append(", ".join(percentages))
            worst = max(over_shortest, key=over_shortest.__getitem__)
            excess = 100 * over_shortest[worst] - 100
            cells = _percent(_above(results_of_learner))
            rows.append([learner, *cells, f"{excess:+.1f} % ({_short(worst)})"])
        columns = "worst kind over the shortest path, 1 to 20"
        sections[title] = table(f"missions | {_names(STAGES)} | {columns}", rows)
        header = " | ".join(["kind", *LEARNERS])
        sections[f"{title}, by kind"] = table(header, [*rows_by_kind.values()])
        if title == HELD_OUT_SET:
            drawn = {name: results_by_learner[name] for name in DRAWN}
            curve = _curve(options.out / "curve.png", drawn)
            sections["From mission to mission"] = curve
            forecasts = _forecasts(results_by_learner[EXPERIENCE])
            sections["Expected times"] = forecasts
    return sections


def faulty(options: Options) -> Sections:
    """Measure the held-out worlds with faults."""
    results = _runs(options.sets[HELD_OUT_SET], (EXPERIENCE,), options, is_faulty=True)
    text = table(
        f"missions | {_names(STAGES)}", [["with faults", *_percent(_above(results))]]
    )
    return {"Faults": text, "Expected times with faults": _forecasts(results)}


def long(options: Options) -> Sections:
    """Measure a thousand missions."""
    return _every_kind("A thousand missions", LONG_STAGES, options, missions=1000)


def moved(options: Options) -> Sections:
    """Measure what happens when all slow zones move."""
    title, hidden = "All slow zones move", ("discs", "mixture")
    return _every_kind(
        title, MOVED_STAGES, options, hidden, missions=150, is_moved=True
    )


def priors(options: Options) -> Sections:
    """Measure missions on a new map, with a prior from another map and without."""
    rows = []
    for source, hidden in PRIORS[: 1 if options.quick else None]:
        kinds = [f"{name}-{hidden}" for name in (*NEW_MAPS, *options.maps_found)]
        untaught, taught = (
            _runs(kinds, (EXPERIENCE,), options, missions=20, prior_from=prior_from)
            for prior_from in ("", f"rooms-{source}")
        )
        cells = []
        percentages = _percent(_above(taught, NEW_STAGES))
        for percentage, (first, end) in zip(percentages, NEW_STAGES, strict=False):
            differences = [
                100 * (with_prior.ratio(first, end) - without_prior.ratio(first, end))
                for with_prior, without_prior in zip(taught, untaught, strict=True)
            ]
            error = np.std(differences) / math.sqrt(len(differences))
            cells.append(f"{percentage} ({np.mean(differences):+.1f} ± {error:.1f})")
        title = f"{source}, then {hidden}"
        rows.append([title, "without", *_percent(_above(untaught, NEW_STAGES))])
        rows.append([title, "with", *cells])
    return {"A map never driven": table(f"worlds | prior | {_names(NEW_STAGES)}", rows)}


def doors(options: Options) -> Sections:
    """Count the drives through a door where the robot waits.

    Another door is 6 s farther.
    """
    occupancy = np.zeros((40, 40), dtype=np.bool_)
    occupancy[20] = True
    occupancy[20, 10:13] = False
    occupancy[20, 24:27] = False
    stations = [(11, 8), (11, 32)]
    rows = []
    for seconds in DOOR_WAITS:
        waits = np.zeros(occupancy.shape)
        waits[20, 10:13] = seconds
        always = np.ones(occupancy.shape)
        world = World(GridMap(occupancy, 0.25), always, [], stations, waits)
        passages = []  # of each seed
        for seed in range(options.seeds):
            job = Job("doors", seed, EXPERIENCE, DOOR_DRIVES, options.exploration)
            result = run_in(job, world, Experience(SPEED))
            # The shortest path leads through it, and the detour takes less time.
            is_through = result.seconds > result.shortest - 1e-6
            passages.append(np.count_nonzero(is_through))
        rows.append([f"{seconds} s", f"{np.mean(passages):.1f}", max(passages)])
    return {"Doors": table(f"wait | drives through it, of {DOOR_DRIVES} | most", rows)}


def zones(_: Options) -> Sections:
    """Measure the learned slowness of a zone whose slowness is 4.0.

    The poses are of several kinds.
    """
    grid = GridMap(np.zeros((20, 80), dtype=np.bool_), 0.25)
    always = np.ones((20, 80))
    always[:, 32:48] = 4
    path = [(x, 10) for x in range(2, 78)]
    world = World(grid, always, [], [path[0], path[-1]])
    rows = []
    for noise, rate in itertools.product(ZONE_NOISES, ZONE_RATES):
        learned = []
        for width in ZONE_WIDTHS:
            experience = Experience(SPEED, width)
            random = np.random.default_rng(0)
            clock = 0.0
            for number in range(ZONE_DRIVES):
                route = path if number % 2 == 0 else path[::-1]
                measured = drive(route, world, clock, random, noise, rate)
                experience.record(measured.seconds, measured.positions)
                clock += measured.duration
            slowness = experience.slowness(grid)[10, 36:44].mean()
            learned.append(f"{slowness:.2f}")
        rows.append([f"{100 * noise:g} cm", f"{rate} Hz", *learned])
    widths = " | ".join(f"robot_width {width}" for width in ZONE_WIDTHS)
    return {"A zone of slowness 4.0": table(f"noise of poses | rate | {widths}", rows)}


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
    "faulty": faulty,
    "long": long,
    "moved": moved,
    "priors": priors,
    "doors": doors,
    "zones": zones,
    "speed": speed,
}


def _runs(
    kinds: Sequence[str], learners: Sequence[str], options: Options, **more: Any
) -> list[Result]:
    """Run each kind of a set with each learner and seed."""
    first = 0 if kinds[0] in TUNING else HELD_OUT_SEED
    given = {"missions": 100, "exploration": options.exploration, **more}
    given |= {"missions": 10} if options.quick else {}
    drawn = itertools.product(kinds, range(first, first + options.seeds), learners)
    jobs = [Job(kind, seed, learner, **given) for kind, seed, learner in drawn]
    return in_parallel(run, jobs, options.backend, "world")


def _by(results: Sequence[Result], name: str) -> dict[str, list[Result]]:
    """Return the results by their kind or learner, in the same order."""
    groups: dict[str, list[Result]] = {}
    for result in results:
        groups.setdefault(getattr(result.job, name), []).append(result)
    return groups


def _every_kind(
    title: str,
    stages: Stages,
    options: Options,
    hidden: tuple[str, ...] = ("",),
    **more: Any,
) -> Sections:
    """Return what `Experience` reaches in each set of worlds, and in each kind."""
    rows, of_kinds = [], []
    for name, kinds in options.sets.items():
        chosen = [kind for kind in kinds if kind.endswith(hidden)]
        results = _runs(chosen, (EXPERIENCE,), options, **more)
        last = {}
        for kind, own in _by(results, "kind").items():
            last[_short(kind)] = _above(own, stages)[-1]
            of_kinds.append([_short(kind), *_percent(_above(own, stages))])
        worst = max(last, key=lambda kind: last[kind])
        rows.append(
            [name, *_percent(_above(results, stages)), f"{last[worst]:.1f} % ({worst})"]
        )
    header = f"missions | {_names(stages)}"
    tables = table(f"{header} | worst kind at last", rows), table(header, of_kinds)
    return {title: tables[0], f"{title}, by kind": tables[1]}


def _above(results: Sequence[Result], stages: Stages = STAGES) -> list[float]:
    """Return the mean time above the best possible in each stage, in percent."""
    return [
        100 * float(np.mean([result.ratio(first, end) for result in results]) - 1)
        for first, end in stages
        if first < len(results[0].seconds)
    ]


def _percent(values: Sequence[float]) -> list[str]:
    return [f"{value:.1f} %" for value in values]


def _names(stages: Stages) -> str:
    """Return the names of columns."""
    return " | ".join(f"{first + 1} to {end}" for first, end in stages)


def _short(kind: str) -> str:
    """Return the name of a kind, without the folder and the ending of a file."""
    return Path(kind).name.replace(".yaml", "")


def _forecasts(results: Sequence[Result]) -> str:
    """Return how far the expected times of missions were from the measured ones."""
    every = np.concatenate([result.forecast for result in results])
    groups = {"all whose path is half new": every[every[:, 4] >= 0.5]}
    for first, end in ((0, 5), (50, 100)):
        some = np.concatenate([result.forecast[first:end] for result in results])
        groups[f"{first + 1} to {end}"] = some
    rows: list[list[object]] = []
    for name, forecast in sorted(groups.items()):
        measured, expected, low, high, _ = forecast.T
        if len(measured):
            error = np.abs(expected / measured - 1).mean()
            inside = ((low <= measured) & (measured <= high)).mean()
            width, ratio = (
                np.median((high - low) / expected),
                measured.sum() / expected.sum(),
            )
            shares = [f"{share:.1%}" for share in (error, inside, width)]
            rows.append([name, len(measured), *shares, f"{ratio:.2f}"])
    header = "missions | drives | MAPE | within the 90 % interval | width of it, median"
    return table(f"{header} | measured over expected", rows)


def _curve(path: Path, results: Mapping[str, Sequence[Result]]) -> str:
    seconds = {
        name: [result.seconds for result in own] for name, own in results.items()
    }
    best = [result.best for result in results[EXPERIENCE]]
    figure, _ = draw_times(
        seconds, best, min(SMOOTHED, len(best[0])), banded=EXPERIENCE
    )
    return save_figure(
        figure, path, "Time over the best possible, from mission to mission"
    )


def measure(options: Options) -> int:
    """Run the experiment, write its tables, figures and ``report.md``, and print it."""
    options.maps_found = (
        sorted(map(str, options.maps.rglob("*.yaml"))) if options.maps else []
    )
    if options.maps and not options.maps_found:
        raise ValueError(f"{options.maps}: found no ROS map (.yaml); check the path")
    options.out = make_folder(options)
    options.sets = {HELD_OUT_SET: HELD_OUT, "Worlds for tuning": TUNING}
    if found := [
        f"{path}-{hidden}" for path in options.maps_found for hidden in ON_FILES
    ]:
        options.sets["Maps from files"] = found
    if options.quick:
        options.sets = {title: kinds[:2] for title, kinds in options.sets.items()}
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
    words = "what `Experience.apply` is given (default: %(default)s)"
    add("--exploration", type=float, default=0.1, metavar="SHARE", help=words)
    options = parser.parse_args(arguments)
    return exit_code(parser.prog, lambda: measure(options))


if __name__ == "__main__":
    sys.exit(main())
