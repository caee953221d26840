"""``ddqn-planner learn``: learns from recorded drives how long places take."""

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from ddqn_planner.commands.options import Option, add_options, file_of, files_of
from ddqn_planner.experience import Experience
from ddqn_planner.experience.drives import EXPERIENCE, LOCK, RECORD, Drive
from ddqn_planner.experience.recordings import read_recording
from ddqn_planner.files import (
    WorkFolder,
    check_distinct,
    check_writable,
    differences,
    write_atomically,
)
from ddqn_planner.grid import GridMap, read_map_file
from ddqn_planner.resources import find_map

OPTIONS = (
    Option(
        "out",
        Path,
        None,
        "by default experience.npz in the first folder, or beside the file",
    ),
    Option(
        "experience",
        Path,
        None,
        "older file that the drives add to; else all is learned anew",
    ),
    Option(
        "nominal-speed",
        float,
        None,
        "a first guess, m/s; by default 0.5, or --experience's",
    ),
    Option("robot-width", float, None, "metres; by default 0.5, or --experience's"),
    Option(
        "topic",
        str,
        "",
        "bags: of poses or transforms, by default that with most of them",
    ),
    Option("frame", str, "map", "bags: the map's frame"),
    Option("robot-frame", str, "", "bags: by default any that ends in base_link"),
)


class LearnOptions(Namespace):
    """The command's options, as `run` adds them to its parser."""

    drives: list[Path]
    map: str
    out: Path | None
    experience: Path | None
    nominal_speed: float | None
    robot_width: float | None
    topic: str
    frame: str
    robot_frame: str


def run(parser: ArgumentParser, arguments: Sequence[str]) -> int:
    """Learn from all drives of the recordings, and write the experience.

    `parser` gets the command's options, which `arguments` give. Returns the exit code
    0.
    """
    parser.add_argument(
        "drives",
        type=file_of,
        nargs="+",
        help="trainers' folders, bags of ROS 1 or 2, or CSV files with the columns "
        "seconds, x, y",
    )
    parser.add_argument(
        "--map", required=True, help="ROS map YAML, or name of a shipped map"
    )
    add_options(parser, *OPTIONS)
    options = parser.parse_args(arguments, namespace=LearnOptions())
    first = options.drives[0]
    out = options.out or (first if first.is_dir() else first.parent) / EXPERIENCE
    check_writable(out, "--out")
    map_file = read_map_file(find_map(options.map))
    recordings = {f"the recording {path}": path for path in options.drives}
    check_distinct({"--out": out}, {**recordings, **files_of(map_file)})
    grid = map_file.grid()
    experience = _experience_to_teach(options, out)
    with ExitStack() as locked_folders:
        drives = _read_drives(options, grid, locked_folders)
        _teach(experience, drives, grid, out)
        # Not `save`, which adds to an older file.
        write_atomically(out, experience.to_bytes())
    metres = sum(drive.metres for drive in drives)
    minutes = sum(drive.seconds[-1] - drive.seconds[0] for drive in drives) / 60
    print(f"{len(drives)} drives, {metres:.0f} m, {minutes:.1f} min")
    print(f"speed in the open: {experience.learned_speed:.2f} m/s")
    print(f"saved {out}")
    return 0


def _experience_to_teach(options: LearnOptions, out: Path) -> Experience:
    """Return the experience to which the drives are added, to be written to `out`.

    The option ``--experience`` names a file with older experience; without this option
    the experience is new. A ValueError if another option contradicts the file.
    """
    robot = {}
    for name in ("nominal_speed", "robot_width"):
        value = getattr(options, name)
        if value is not None:
            robot[name] = value
    if not options.experience:
        return Experience(**{"nominal_speed": 0.5, **robot})
    experience = Experience.load(options.experience)
    changed = differences(experience.options, robot)
    if changed:
        raise ValueError(f"{options.experience} has {changed}; leave those options out")
    is_replaced = out.exists() and out.samefile(options.experience)
    # The older file may be continued elsewhere, too.
    return experience if is_replaced else experience.for_robot(experience.robot)


def _read_drives(
    options: LearnOptions, grid: GridMap, locked_folders: ExitStack
) -> list[Drive]:
    """Return the drives of all recordings, which were driven on the map `grid`.

    Recordings that are folders of a trainer node are locked, so that no node records
    there meanwhile. The locks are put into `locked_folders`, which the caller closes.
    """
    drives: list[Drive] = []
    for path in options.drives:
        if (path / RECORD).is_file():
            folder = WorkFolder(path, [LOCK, RECORD], "drives", "records")
            locked_folders.enter_context(folder)
        recording = read_recording(
            path,
            grid,
            topic=options.topic,
            frame=options.frame,
            robot_frame=options.robot_frame,
            on_damage=print,
        )
        print(f"{path}: {recording.source}")
        drives += recording.drives
    return drives


def _teach(
    experience: Experience, drives: Sequence[Drive], grid: GridMap, out: Path
) -> None:
    """Let an experience learn from drives on a map.

    A ValueError if no drive taught anything: its text says that the file `out`, which
    the caller writes later, is unchanged.
    """
    reasons = []
    for number, drive in enumerate(drives, 1):
        learned = drive.teach(experience, grid)
        if not learned:  # of no place
            reasons.append(learned.reason)
            print(f"drive {number} taught nothing: {learned.reason}")
    if len(reasons) == len(drives):
        raise ValueError(
            f"no drive taught anything, and {out} is as before; {reasons[0]}"
        )
