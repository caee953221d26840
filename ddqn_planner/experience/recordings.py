"""Recordings of a robot's poses: bags, CSV files, and records of drives."""

import csv
import math
from collections.abc import Callable, Sequence
from io import TextIOWrapper
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ddqn_planner.experience.bag_poses import read_bag
from ddqn_planner.experience.drives import (
    RECORD,
    Drive,
    DriveRecorder,
    Sample,
    read_drives,
)
from ddqn_planner.experience.posterior import cells_of
from ddqn_planner.files import open_regular
from ddqn_planner.grid import GridMap

MAX_CSV_BYTES = 2**28  # of a recording: some 8 million poses
COLUMNS = "seconds", "x", "y"

# More than this share of poses earlier than the pose before is no recording of a drive:
# a clock jumps back less often.
BACKWARD_SHARE = 0.1


class Recording(NamedTuple):
    """The drives of a recording."""

    source: str  # what the poses come from, in words
    drives: list[Drive]


def read_recording(
    path: Path,
    grid: GridMap,
    *,
    topic: str = "",
    frame: str = "map",
    robot_frame: str = "",
    on_damage: Callable[[str], object] = lambda reason: None,
) -> Recording:
    """Return the drives that a recording on a map holds.

    Parameters
    ----------
    path : Path
        An ``episodes.csv`` or a folder with one, a CSV file with seconds, x and y, or a
        bag of ROS 1 or 2: its folder or a file of it.
    grid : GridMap
        The map on which the robot drove.
    topic, frame, robot_frame : str
        Of bags: the topic of poses or transforms, by default the one with most
        poses; the map's frame; and the robot's frame, by default any that ends in
        ``base_link``.
    on_damage : function of a str
        It is called with the reason for each part that cannot be read or believed.

    Raises
    ------
    ValueError
        If nothing can be learned from the recording, with the reason.
    """
    if path.name == RECORD:
        recording = Recording(RECORD, list(read_drives(path, on_damage)))
    elif (path / RECORD).is_file():
        recording = Recording(RECORD, list(read_drives(path / RECORD, on_damage)))
    elif path.suffix.lower() == ".csv":
        recording = _divided_into_drives(path, path.name, read_csv(path))
    else:
        poses = read_bag(path, topic, frame, robot_frame)
        for reason in poses.damage:
            on_damage(reason)
        recording = _divided_into_drives(path, poses.source, poses.samples)
    if not recording.drives:
        raise ValueError(f"{path} holds no drive; drive on")
    _check_on_map(path, recording.drives, grid)
    return recording


def _divided_into_drives(path: Path, name: str, samples: Sequence[Sample]) -> Recording:
    """Divide the poses of a recording into drives.

    `samples` are the poses in the order of the recording; those that are not finite are
    left out. A ValueError if their times run backwards or stand still; its text names
    `path` and the source of the poses, `name`.
    """
    finite = [sample for sample in samples if all(map(math.isfinite, sample))]
    elapsed = np.diff([sample.seconds for sample in finite])
    if len(elapsed):
        runs_backwards = (elapsed < 0).mean() > BACKWARD_SHARE
        stands_still = not elapsed.any()
        if runs_backwards or stands_still:
            raise ValueError(
                f"{path}: the time of {name} runs backwards or stands still; give "
                "poses in the order of their times"
            )
    drives: list[Drive] = []
    recorder = DriveRecorder(drives.append)
    for sample in finite:
        recorder.add(*sample)
    recorder.end()
    return Recording(f"{len(finite)} poses of {name}", drives)


def _check_on_map(path: Path, drives: Sequence[Drive], grid: GridMap) -> None:
    """Raise a ValueError if no pose of any drive lies on a free cell of the map.

    `path` is that of the recording, for the words of the error.
    """
    positions = np.concatenate([drive.positions for drive in drives])  # (N, 2)
    cells, is_inside = cells_of(positions, grid)
    is_free = is_inside & ~grid.occupancy[cells[:, 1], cells[:, 0]]
    if is_free.any():
        return
    lowest = positions.min(axis=0).round(1).tolist()
    highest = positions.max(axis=0).round(1).tolist()
    width = grid.width * grid.resolution
    height = grid.height * grid.resolution
    raise ValueError(
        f"{path}: no pose lies on a free cell of the map: they go from {lowest} to "
        f"{highest}, the map has {width:.1f} x {height:.1f} m from {grid.origin[:2]}; "
        "give the map of these poses, or others"
    )


def read_csv(path: Path) -> list[Sample]:
    """Return the poses of the CSV file at `path`, with the columns seconds, x and y.

    Empty rows are left out. A ValueError says which column is missing, or which row has
    no numbers.
    """
    content = open_regular(path, MAX_CSV_BYTES)
    samples = []
    with TextIOWrapper(content, "utf-8-sig", errors="replace", newline="") as file:
        reader = csv.DictReader(line for line in file if line.strip(" ,\r\n"))
        reader.fieldnames = [name.strip() for name in reader.fieldnames or ()]
        missing = sorted(set(COLUMNS) - set(reader.fieldnames))
        if missing:
            raise ValueError(
                f"{path}: the columns {', '.join(missing)} are missing; give seconds, "
                "and x and y in metres in the frame of the map"
            )
        for row in reader:
            try:
                sample = Sample(*(float(row[name]) for name in COLUMNS))
            except (TypeError, ValueError):
                raise ValueError(
                    f"{path}: {row} has no numbers; give seconds, x and y"
                ) from None
            samples.append(sample)
    return samples
