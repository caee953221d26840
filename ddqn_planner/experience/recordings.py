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

# More than this share of poses in walls or outside: the map is another one. The middle
# of a robot keeps away from walls.
OFF_MAP_SHARE = 0.03


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

    Poses with numbers that cannot be true are left out. If the robot moves, but no part
    is a drive, as with times in milliseconds, all is one drive: learning says why it
    cannot be.
    """
    table = np.array(poses.samples, np.float64).reshape(-1, 3)  # seconds, x and y
    is_possible = (np.abs(table) < LATEST).all(axis=1)
    table = table[is_possible]  # (N, 3)
    whole = Drive(DriveEnd.STOPPED, table[:, 0], table[:, 1:])
    if whole.extent < SHORTEST:
        raise ValueError(
            f"{path} holds no drive: in {len(table)} poses with numbers below "
            f"{LATEST:g} the robot comes no farther than {whole.extent:.2g} m; drive "
            "on, and give metres and seconds, not milliseconds or nanoseconds"
        )
    drives: list[Drive] = []
    recorder = DriveRecorder(drives.append)
    for sample in table.tolist():
        recorder.add(*sample)
    recorder.end()
    return Recording(f"{len(table)} poses of {poses.source}", drives or [whole])


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
    corners = np.round([positions.min(axis=0), positions.max(axis=0)], 1).tolist()
    reason = (
        f"{path}: {share:.0%} of the poses lie in walls, in unknown space or outside: "
        f"they go from {' to '.join(map(str, corners))}, the map has {grid.width} x "
        f"{grid.height} cells of {grid.resolution:g} m from {grid.origin[:2]}; give "
        "the map of these poses"
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
    names = [name.strip(' #"\n') for name in header.split(",")]
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
            quotechar='"',
            ndmin=2,
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}; give seconds, x and y") from None
    return list(map(Sample._make, table.tolist()))
