"""Measure what driving teaches, with many seeds, and write tables and figures."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from driving_worlds import KINDS, SPEED, drive
from matplotlib.colors import LogNorm
from matplotlib.patheffects import withStroke
from missions import (
    LEARNED,
    MOVED_AT,
    PLANNERS,
    RECOVERED,
    SHORTEST,
    STAGES,
    Job,
    Result,
    jobs_of,
    map_files,
    run,
    update_times,
)
from numpy.typing import NDArray
from tables import write_table
from trainings import BACKENDS, in_parallel

from ddqn_planner.cli import HelpFormatter, exit_code
from ddqn_planner.experience import Experience
from ddqn_planner.files import write_atomically
from ddqn_planner.grid import MoveRule
from ddqn_planner.pictures import draw_obstacles
from ddqn_planner.planning import Planner

BARS = {"1 to 20": 1.08, "21 to 50": 1.04, "51 to 100": 1.02}
COLOURS = dict(zip(PLANNERS, ("#0072B2", "#777777", "#D55E00", "#009E73"), strict=True))
VISITED = 0.95
"""Uncertainty of a cell below which the robot was near."""
SMOOTHED = 10
"""Missions that a point of the curve averages."""


def report(
    out: Path, seeds: int, quick: bool = False, maps: Path | None = None, backend: str = "loky"
) -> str:
    """Run the experiment, write its tables, figures and ``report.md``, and return the text."""
    out.mkdir(parents=True, exist_ok=True)
    results = in_parallel(run, jobs_of(KINDS, seeds, quick), backend, "world")
    plain = [result for result in results if not result.job.faults]
    faulty = [result for result in results if result.job.faults]
    sections = [
        _stages(out / "stages.csv", plain),
        _worlds(out / "worlds.csv", plain),
        _forecasts(out / "forecasts.csv", plain, faulty),
        _faults(out / "faults.csv", plain, faulty),
        _moved(out / "moved.csv", plain),
        _times(out / "times.csv"),
        _curve(out / "driving_curve.png", plain),
        _picture(out / "driving_map.png"),
    ]
    if maps is not None:
        results = in_parallel(run, jobs_of(map_files(maps), seeds, quick), backend, "world")
        of_maps = [result for result in results if not result.job.faults]
        sections.append("### Maps from files\n\n" + _stages(out / "maps.csv", of_maps))
        sections.append(_worlds(out / "maps_worlds.csv", of_maps))
    text = "\n\n".join(section for section in sections if section) + "\n"
    write_atomically(out / "report.md", text.encode())
    return text


def _stages(path: Path, plain: Sequence[Result]) -> str:
    """Return the time over that of the planner that knows: medians, and the worst world."""
    rows = []
    for name in PLANNERS:
        row = [name]
        for stage in STAGES.values():
            ratios = [result.ratio(name, *stage) for result in plain]
            row.append(f"{np.median(ratios):.3f} ({min(ratios):.3f} to {max(ratios):.3f})")
        rows.append(row)
    rows.append(["bar", *(f"{bar:.2f}" for bar in BARS.values())])
    return write_table(path, ["missions", *STAGES], rows)


def _worlds(path: Path, plain: Sequence[Result]) -> str:
    """Return the same for each world, and the time over that of the shortest path."""
    rows = []
    for result in plain:
        ratios = [result.ratio(LEARNED, *stage) for stage in STAGES.values()]
        end = MOVED_AT
        shortest = result.ratio(LEARNED, 0, end) / result.ratio(SHORTEST, 0, end)
        values = [f"{ratio:.3f}" for ratio in [*ratios, shortest]]
        rows.append([Path(result.job.kind).stem, result.job.seed, *values])
    return write_table(path, ["world", "seed", *STAGES, "over the shortest path"], rows)


def _forecasts(path: Path, plain: Sequence[Result], faulty: Sequence[Result]) -> str:
    """Return how far the expected time of a mission was from the measured one, after 50."""
    rows = []
    for label, results in (("as it is", plain), ("with faults", faulty)):
        forecast = np.concatenate([result.forecast[50:MOVED_AT] for result in results])
        measured, expected, low, high = forecast.T
        error = np.abs(expected / measured - 1).mean()
        inside = ((low <= measured) & (measured <= high)).mean()
        width = np.median((high - low) / expected)
        rows.append([label, len(forecast), f"{error:.1%}", f"{inside:.1%}", f"{width:.1%}"])
    header = ["drives", "missions", "MAPE", "within the 90 % interval", "width of it, median"]
    return write_table(path, header, rows)


def _faults(path: Path, plain: Sequence[Result], faulty: Sequence[Result]) -> str:
    """Return what faults change."""
    rows = []
    for label, results in (("as it is", plain), ("with faults", faulty)):
        medians = [
            np.median([result.ratio(LEARNED, *stage) for result in results])
            for stage in STAGES.values()
        ]
        rows.append([label, *(f"{median:.3f}" for median in medians)])
    return write_table(path, ["drives", *STAGES], rows)


def _moved(path: Path, plain: Sequence[Result]) -> str:
    """Return the time after all slow zones moved; empty if the missions ended before."""
    plain = [result for result in plain if result.job.missions >= RECOVERED[1]]
    if not plain:
        return ""
    stages = {
        "91 to 100": (90, 100),
        "101 to 110": (100, 110),
        "111 to 120": (110, 120),
        "121 to 140": (120, 140),
        "141 to 150": RECOVERED,
    }
    rows = []
    for name in PLANNERS:
        medians = [np.median([r.ratio(name, *stage) for r in plain]) for stage in stages.values()]
        rows.append([name, *(f"{median:.3f}" for median in medians)])
    return write_table(path, ["missions", *stages], rows)


def _times(path: Path) -> str:
    """Return how long an update takes."""
    times = update_times()
    times = np.column_stack([times, times.sum(axis=1)])
    names = ("record", "apply", "plan again", "all")
    rows = [
        [name, f"{np.median(column):.1f}", f"{column.max():.1f}"]
        for name, column in zip(names, times.T, strict=True)
    ]
    return write_table(
        path, ["1,000 poses on 1000 x 1000 cells", "median [ms]", "worst [ms]"], rows
    )


def _curve(path: Path, plain: Sequence[Result]) -> str:
    """Draw the time over the best possible from mission to mission."""
    figure, axes = plt.subplots(figsize=(7.2, 3.6), layout="constrained")
    for name in PLANNERS:
        ratios = np.array([_smoothed(r.seconds[name]) / _smoothed(r.best) for r in plain])
        mission = np.arange(ratios.shape[1]) + SMOOTHED
        axes.plot(mission, np.median(ratios, axis=0), color=COLOURS[name], linewidth=2, label=name)
        if name == LEARNED:
            low, high = np.quantile(ratios, (0.1, 0.9), axis=0)
            axes.fill_between(mission, low, high, color=COLOURS[name], alpha=0.18, linewidth=0)
    if mission[-1] > MOVED_AT:
        axes.axvline(MOVED_AT, color="black", linewidth=1, linestyle=":")
        axes.text(MOVED_AT + 1, axes.get_ylim()[1], "all slow zones move", va="top", fontsize=9)
    axes.axhline(1, color="black", linewidth=0.8)
    axes.set(xlabel="mission", ylabel="time over the best possible")
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
    return _saved(figure, path, "Time over the best possible, from mission to mission")


def _smoothed(seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.convolve(seconds, np.ones(SMOOTHED), mode="valid")


def _picture(path: Path, kind: str = "office", seed: int = 1, missions: int = 50) -> str:
    """Draw the true and the learned slowness of a world, with the routes of a mission."""
    world, planner = Job(kind, seed, missions).world(), Planner.load("any_map")
    grid, experience, clock = world.grid, Experience(SPEED), 0.0
    random = np.random.default_rng(seed)
    rule = MoveRule.ROBOT_SAFE
    for _ in range(missions):
        start, goal = (world.stations[i] for i in random.choice(len(world.stations), 2, False))
        cells = planner.plan(experience.apply(grid), start, goal, rule).cells
        measured = drive(cells, world, clock, random)
        experience.record(measured.seconds, measured.positions)
        clock += measured.duration
    truth = world.slowness(clock)
    grids = {
        "shortest": (grid, "#555555", ":"),
        "learned": (experience.apply(grid), COLOURS[LEARNED], "-"),
        "best possible": (world.known(clock), "#CC79A7", "--"),
    }
    stations = [(a, b) for a in world.stations for b in world.stations if a < b]

    def seconds(on: Any, start: Any, goal: Any) -> float:
        x, y = np.transpose(planner.plan(on, start, goal, rule).cells)
        return float(truth[y, x].sum())

    # The mission on which knowing matters most.
    start, goal = max(stations, key=lambda s: seconds(grid, *s) - seconds(world.known(clock), *s))
    figure, both = plt.subplots(1, 2, figsize=(11, 5.6), layout="constrained")
    visited = experience.uncertainty(grid) < VISITED
    learned = np.where(visited, experience.slowness(grid), np.nan)
    for axes, slowness, title in (
        (both[0], truth, "what nobody told the robot: true slowness"),
        (both[1], learned, f"what it learned from {missions} missions (grey: never there)"),
    ):
        shown = np.where(grid.occupancy, np.nan, slowness)
        axes.set_facecolor("#e6e6e6")
        image = axes.imshow(shown, origin="lower", cmap="YlOrRd", norm=LogNorm(1, 8))
        draw_obstacles(axes, grid)
        for name, (on, colour, style) in grids.items():
            x, y = np.transpose(planner.plan(on, start, goal, rule).cells)
            outline = [withStroke(linewidth=4, foreground="white")]
            axes.plot(x, y, style, color=colour, linewidth=2.2, label=name, path_effects=outline)
        axes.scatter(*np.transpose(world.stations), 40, color="black", zorder=4)
        axes.set(xticks=[], yticks=[])
        axes.set_title(title, loc="left", fontsize=11)
    bar = figure.colorbar(image, ax=both, label="seconds over seconds at nominal speed", shrink=0.8)
    bar.set_ticks([1, 2, 4, 8], labels=["1", "2", "4", "8"])
    bar.minorticks_off()
    figure.legend(*both[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return _saved(figure, path, "True and learned slowness, and the routes")


def _saved(figure: Any, path: Path, caption: str) -> str:
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return f"![{caption}]({path.name})"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; return the exit code."""
    parser = argparse.ArgumentParser("driving.py", None, __doc__, formatter_class=HelpFormatter)
    add = parser.add_argument
    add("--seeds", type=int, default=5, metavar="N", help="worlds of each kind")
    add("--out", type=Path, default=Path("runs/driving"), help="folder of the report")
    add("--maps", type=Path, metavar="FOLDER", help="measure on the ROS maps of a folder too")
    add("--quick", action="store_true", help="fewer missions, into the folder quick")
    words = "what drives the missions: this machine's cores, or a cluster"
    add("--backend", choices=BACKENDS, default="loky", help=words)
    options = parser.parse_args(arguments)
    return exit_code(parser.prog, lambda: run_report(options))


def run_report(options: argparse.Namespace) -> int:
    """Run the program with its options; return the exit code."""
    if options.seeds < 1:
        raise ValueError(f"--seeds is {options.seeds}; give at least 1")
    out = options.out / "quick" if options.quick else options.out
    print(report(out, options.seeds, options.quick, options.maps, options.backend))
    print(f"saved {out / 'report.md'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
