"""Recordings of a robot's poses: bags, CSV files, and records of drives."""

from collections.abc import Callable, Sequence
from io import TextIOWrapper
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ddqn_planner.experience.bag_poses import RobotPoses, read_bag
from ddqn_planner.experience.drives import (
    RECORD,
    SHORTEST,
    Drive,
    DriveEnd,
    DriveRecorder,
    Sample,
    read_drives,
)
from ddqn_planner.experience.experience import LATEST
from ddqn_planner.experience.posterior import cells_of
from ddqn_planner.files import open_regular
from ddqn_planner.grid import GridMap

MAX_CSV_BYTES = 2**28  # of a recording: some 8 million poses
COLUMNS = "seconds", "x", "y"

# More than this share of poses earlier than the pose before is no recording of a drive:
# a clock jumps back less often.
BACKWARD_SHARE = 0.1
# More than this share of poses in walls or outside: the map is another one.
OFF_MAP_SHARE = 0.1


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
    record = path if path.name == RECORD else path / RECORD
    if record.is_file():
        recording = Recording(RECORD, list(read_drives(record, on_damage)))
        if not recording.drives:
            raise ValueError(f"{path} holds no drive; drive on")
    else:
        if path.suffix.lower() == ".csv":
            poses = RobotPoses(path.name, read_csv(path), [])
        else:
            poses = read_bag(path, topic, frame, robot_frame)
        for reason in poses.damage:
            on_damage(reason)
        recording = _divided_into_drives(path, poses)
    _check_on_map(path, recording.drives, grid, on_damage)
    return recording


def _divided_into_drives(path: Path, poses: RobotPoses) -> Recording:
    """Divide the poses of the recording at `path` into drives.

    Poses that cannot be true are left out. A ValueError if there is no drive: its text
    says why.
    """
    samples = [
        sample
        for sample in poses.samples
        if all(abs(value) < LATEST for value in sample)  # False for NaN
    ]
    drives: list[Drive] = []
    recorder = DriveRecorder(drives.append)
    for sample in samples:
        recorder.add(*sample)
    recorder.end()
    reason = _why_no_drive(samples, drives)
    if reason:
        raise ValueError(f"{path} holds no drive: {reason}")
    return Recording(f"{len(samples)} poses of {poses.source}", drives)


def _why_no_drive(samples: Sequence[Sample], drives: Sequence[Drive]) -> str:
    """Return why poses are no drive, and what to do; empty if they are one."""
    if len(samples) < 2:
        return (
            f"{len(samples)} poses have finite numbers below {LATEST:g}; give more, in "
            "metres and in seconds, not in milliseconds or nanoseconds"
        )
    table = np.array(samples)  # (N, 3): seconds, x, y
    elapsed = np.diff(table[:, 0])
    if (elapsed < 0).mean() > BACKWARD_SHARE or not elapsed.any():
        return "its time runs backwards or stands still; sort the poses by their times"
    if drives:
        return ""
    extent = Drive(DriveEnd.STOPPED, table[:, 0], table[:, 1:]).extent
    if extent < SHORTEST:
        return f"the robot comes no farther than {extent:.2g} m; drive on"
    return (
        f"the robot takes {np.ptp(table[:, 0]) / extent:.3g} s per metre; give seconds "
        "if its times are milliseconds or nanoseconds"
    )


def _check_on_map(
    path: Path,
    drives: Sequence[Drive],
    grid: GridMap,
    on_damage: Callable[[str], object],
) -> None:
    """Report poses of drives that do not lie on free cells of the map, if many.

    `path` is that of the recording. A ValueError if no pose lies on a free cell.
    """
    positions = np.concatenate([drive.positions for drive in drives])  # (N, 2)
    cells, is_inside = cells_of(positions, grid)
    is_free = is_inside & ~grid.occupancy[cells[:, 1], cells[:, 0]]
    share = 1 - is_free.mean()
    lowest = positions.min(axis=0).round(1).tolist()
    highest = positions.max(axis=0).round(1).tolist()
    width = grid.width * grid.resolution
    height = grid.height * grid.resolution
    reason = (
        f"{path}: {share:.0%} of the poses lie in walls, in unknown space or outside: "
        f"they go from {lowest} to {highest}, the map has {width:.1f} x {height:.1f} m "
        f"from {grid.origin[:2]}; give the map of these poses"
    )
    if not is_free.any():
        raise ValueError(reason)
    if share > OFF_MAP_SHARE:
        on_damage(reason)


def read_csv(path: Path) -> list[Sample]:
    """Return the poses of the CSV file at `path`, with the columns seconds, x and y.

    Empty rows are left out. A ValueError says which column is missing, or which row has
    no numbers.
    """
    content = open_regular(path, MAX_CSV_BYTES)
    with TextIOWrapper(content, "utf-8-sig", errors="replace") as file:
        header, *rows = [line for line in file if line.strip(" ,\n")] or [""]
    names = [name.strip(' "\n') for name in header.split(",")]
    missing = sorted(set(COLUMNS) - set(names))
    if missing:
        raise ValueError(
            f"{path}: the columns {', '.join(missing)} are missing; give seconds, and "
            "x and y in metres in the frame of the map, with commas between them"
        )
    if not rows:
        return []
    columns = [names.index(name) for name in COLUMNS]
    try:
        table = np.loadtxt(
            rows,
            delimiter=",",
            usecols=columns,
            comments=None,
            quotechar='"',
            ndmin=2,
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}; give seconds, x and y") from None
    return list(map(Sample._make, table.tolist()))
