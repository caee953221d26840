"""Learn from a robot's recorded drives how long places take."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from ddqn_planner.experience import Experience
from ddqn_planner.experience.drives import EXPERIENCE, LOCK, RECORD, Drive, read_drives
from ddqn_planner.experience.recordings import drives_of, read_csv, read_mcap
from ddqn_planner.files import claim
from ddqn_planner.grid import load_map
from ddqn_planner.resources import find_map


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    words = "a trainer's folder, a CSV file with the columns seconds, x, y, or an MCAP file"
    add("drives", type=Path, help=words)
    add("--map", required=True, help="ROS map YAML, or name of a shipped map")
    words = "by default experience.npz in the folder, or beside the file"
    add("--out", type=Path, metavar="FILE", help=words)
    words = "the robot's speed where nothing slows it down, metres per second"
    add("--nominal-speed", type=float, default=0.5, metavar="X", help=words)
    add("--robot-width", type=float, default=0.5, metavar="X", help="metres")
    words = "MCAP: the topic of the poses, by default the one with most poses; or /tf"
    add("--topic", default="", help=words)
    add("--frame", default="map", help="MCAP: the map's frame")
    add("--robot-frame", default="base_link", help="MCAP: the robot's frame, for /tf")


def run(options: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    source: Path = options.drives
    grid = load_map(find_map(options.map))
    experience = Experience(options.nominal_speed, options.robot_width)
    with ExitStack() as stack:
        if source.is_dir():
            if not (source / RECORD).is_file():
                remedy = "give a trainer's folder, or the .mcap file in a bag's"
                raise ValueError(f"{source} holds no {RECORD}; {remedy}")
            stack.enter_context(claim(source, [LOCK, RECORD], "drives", "records"))
        drives = read(source, options)
        for drive in drives:
            drive.teach(experience, grid)
        if not drives:
            raise ValueError(f"{source} holds no drive; drive on")
        out = options.out or (source if source.is_dir() else source.parent) / EXPERIENCE
        experience.save(out)
    slowness, known = experience.slowness(grid), experience.uncertainty(grid) < 0.9
    seconds = sum(float(np.ptp(drive.seconds)) for drive in drives)
    print(f"{len(drives)} drives, {sum(d.metres for d in drives):.0f} m, {seconds / 60:.1f} min")
    free = known & ~grid.occupancy
    print(f"known now: {free.sum() / max((~grid.occupancy).sum(), 1):.0%} of the free cells")
    if free.any():
        middle, slow = np.quantile(slowness[free], (0.5, 0.95))
        print(f"seconds over nominal ones there: median {middle:.2f}, slowest 5 % from {slow:.2f}")
    print(f"saved {out}")
    return 0


def read(source: Path, options: argparse.Namespace) -> list[Drive]:
    """Return the drives of a folder or a file."""
    if source.is_dir():
        return list(read_drives(source / RECORD))
    ending = source.suffix.lower()
    if ending == ".mcap":
        topic, samples = read_mcap(source, options.topic, options.frame, options.robot_frame)
        print(f"{len(samples)} poses of {topic}")
        return drives_of(samples)
    if ending == ".csv":
        if source.name == RECORD:
            return list(read_drives(source))
        return drives_of(read_csv(source))
    raise ValueError(f"{source} is no folder, and ends in neither .csv nor .mcap; give one of them")
