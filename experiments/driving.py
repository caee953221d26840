"""Measure how much sooner a robot arrives that remembers how long places took, in many worlds."""

import argparse
import itertools
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

# Before NumPy is imported. On a busy machine, several threads are ten times as slow as one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import driving_worlds as worlds
import numpy as np
from driving_learners import LEARNERS
from driving_missions import Job, Result, run
from driving_worlds import (
    HELD_OUT,
    HELD_OUT_SEED,
    ON_FILES,
    RULE,
    SPEED,
    TUNING,
    drive,
)
from random_maps import generate_map
from tables import table, write_report
from trainings import in_parallel, make_folder, parser_of

from ddqn_planner import Experience, GridMap, Planner
from ddqn_planner.cli import exit_code
from ddqn_planner.grid.noise import random_requests

MISSIONS, QUICK_MISSIONS = 100, 10
STAGES: Final = ((0, 20), (20, 50), (50, 100))
EXPERIENCE, SHORTEST = "experience", "shortest path"


def _runs(
    kinds: Sequence[str], learners: Sequence[str], options: argparse.Namespace, **more: object
) -> list[Result]:
    """Run each kind with each learner and seed."""
    first = HELD_OUT_SEED if kinds[0] not in TUNING else 0
    seeds, missions = range(first, first + options.seeds), options.missions
    given = {"missions": missions, "exploration": options.exploration, **more}
    drawn = itertools.product(kinds, seeds, learners)
    jobs = [Job(kind, seed, learner, **given) for kind, seed, learner in drawn]
    return in_parallel(run, jobs, options.backend, "world")


def _stages_of(
    results: Sequence[Result], stages: Sequence[tuple[int, int]] = STAGES
) -> list[float]:
    """Return the mean time above the best possible in each stage that was reached, in percent."""
    reached = [stage for stage in stages if stage[0] < len(results[0].seconds)]
    return [100 * float(np.mean([r.ratio(*stage) for r in results]) - 1) for stage in reached]


def _header_of(stages: Sequence[tuple[int, int]]) -> str:
    """Return the names of columns."""
    return " | ".join(f"{first + 1} to {end}" for first, end in stages)


def _tuning(options: argparse.Namespace) -> int:
    """Print a line for each kind of world for tuning, and the mean."""
    results = _runs(TUNING, options.learner, options)
    for learner in options.learner:
        own = [result for result in results if result.job.learner == learner]
        print(
            f"{learner:24} {'  '.join(f'{a + 1:3}-{b:3}' for a, b in STAGES)}  over shortest 1-20"
        )
        for kind in (*TUNING, "mean"):
            of_kind = [result for result in own if kind in (result.job.kind, "mean")]
            over = 100 * np.mean([result.over_shortest(0, 20) for result in of_kind]) - 100
            line = "  ".join(f"{value:7.1f}" for value in _stages_of(of_kind))
            print(f"{kind:24} {line}  {over:7.1f}")
    return 0


def _compare(title: str, kinds: Sequence[str], options: argparse.Namespace) -> dict[str, str]:
    """Return the tables of a set of worlds: all learners, and each kind."""
    results = _runs(kinds, tuple(LEARNERS), options)
    rows, of_kinds = [], []
    for learner in LEARNERS:
        own = [result for result in results if result.job.learner == learner]
        over = {
            kind: np.mean([r.over_shortest(0, 20) for r in own if r.job.kind == kind])
            for kind in kinds
        }
        worst = max(over, key=lambda kind: over[kind])
        stages = [f"{value:.1f} %" for value in _stages_of(own)]
        rows.append([learner, *stages, f"{100 * over[worst] - 100:+.1f} % ({worst})"])
    for kind in kinds:
        cells = []
        for learner in LEARNERS:
            own = [r for r in results if (r.job.learner, r.job.kind) == (learner, kind)]
            cells.append(", ".join(f"{value:.0f}" for value in _stages_of(own)))
        of_kinds.append([kind, *cells])
    header = f"missions | {_header_of(STAGES)} | worst kind over the shortest path, 1 to 20"
    return {
        title: table(header, rows),
        f"{title}, by kind": table(" | ".join(["kind", *LEARNERS]), of_kinds),
    }


def _times() -> str:
    """Return the CPU time to learn from 1,000 poses on 1000 x 1000 cells, and to plan again."""
    random = np.random.default_rng(0)
    occupancy = generate_map("office", (1000, 1000), random)
    grid, planner = GridMap(occupancy, 0.05), Planner.load("any_map")
    world = worlds.make_world(grid, "mixture", random)
    requests = random_requests(world.grid.occupancy, RULE, 6, random)
    goal, experience, clock = requests[0][1], Experience(SPEED), 0.0
    times = []
    for number in range(25):
        cells = planner.plan(experience.apply(grid), requests[number % 6][0], goal).cells
        measured = drive(cells[:1001], world, clock, random)
        some = np.linspace(0, len(measured.seconds) - 1, 1000).astype(np.int64)
        clock += measured.duration
        began = [time.thread_time()]
        experience.record(measured.seconds[some], measured.positions[some])
        began.append(time.thread_time())
        applied = experience.apply(grid)
        began.append(time.thread_time())
        planner.plan(applied, cells[: len(cells) // 2 + 1][-1], goal)
        began.append(time.thread_time())
        steps = 1e3 * np.diff(began)
        times.append([*steps, steps.sum()])
    columns = zip(("record", "apply", "plan again", "all"), np.array(times[5:]).T, strict=True)
    rows = [[name, f"{np.median(ms):.1f}", f"{ms.max():.1f}"] for name, ms in columns]
    return table("1,000 poses on 1000 x 1000 cells | median [ms] | worst [ms]", rows)


def measure(options: argparse.Namespace) -> int:
    """Run the experiment, write its tables, figures and ``report.md``, and print it."""
    if options.tuning:
        return _tuning(options)
    maps = sorted(map(str, options.maps.rglob("*.yaml"))) if options.maps else []
    if options.maps and not maps:
        raise ValueError(f"{options.maps}: found no ROS map (.yaml); check the path")
    out, sections = make_folder(options), dict[str, str]()
    sets = {"Held-out worlds": HELD_OUT, "Worlds for tuning": TUNING}
    if maps:
        sets["Maps from files"] = tuple(f"{path}-{hidden}" for path in maps for hidden in ON_FILES)
    for title, kinds in sets.items():
        sections |= _compare(title, kinds[:2] if options.quick else kinds, options)
    sections["Speed"] = _times()
    print(write_report(out, sections, options.page))
    print(f"saved {out / 'report.md'}")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; return the exit code."""
    parser = parser_of("driving.py", __doc__, "runs/driving")
    add = parser.add_argument
    add("--maps", type=Path, metavar="FOLDER", help="measure on the ROS maps of a folder too")
    add("--tuning", action="store_true", help="print the kinds of worlds for tuning alone")
    add("--learner", action="append", choices=LEARNERS, help="with --tuning")
    add("--missions", type=int, default=MISSIONS)
    add("--exploration", type=float, default=0.0)
    options = parser.parse_args(arguments)
    options.learner = options.learner or [EXPERIENCE]
    options.missions = min(options.missions, QUICK_MISSIONS if options.quick else options.missions)
    return exit_code(parser.prog, lambda: measure(options))


if __name__ == "__main__":
    sys.exit(main())
