"""Measures the bytes of experience, and whether merging counts drives twice."""

import time
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from processes import run_script
from tables import report

from ddqn_planner import Experience, GridMap

SIDE = 100.0  # metres of the floor
SPEED = 0.5  # metres per second
PASSAGES = 4  # of each place
WINDING = 0.15  # metres to each side
DRIVES = 20  # of each robot that merges
MERGES = 3  # after each drive

Float64 = NDArray[np.float64]


def line(y: float, random: np.random.Generator, metres: float = SIDE) -> list[Float64]:
    """Return the times and the positions of a winding drive, with uneven speed.

    It leads along x near `y`, in metres.
    """
    x = np.arange(0.05, metres, 0.05)
    winding = WINDING * np.sin(x / random.uniform(0.3, 0.6))
    seconds = np.cumsum(0.05 / SPEED * random.uniform(0.5, 3, len(x)))
    return [seconds, np.column_stack([x, y + winding])]


def measure_floor() -> Iterator[bool]:
    """Measure experience of a floor where each place was driven several times."""
    random = np.random.default_rng(0)
    experience = Experience(SPEED)
    side = experience.robot_width / 2  # of a place
    for _ in range(PASSAGES):
        for y in np.arange(side / 2, SIDE, side):
            experience.record(*line(y, random))
    experience.apply(GridMap(np.zeros((400, 400), np.bool_), 0.25))
    state = experience.state
    began = time.process_time()
    experience.record(*line(50.1, random))
    seconds = time.process_time() - began
    changes = experience.changes_since(state)
    assert changes is not None
    began = time.process_time()
    content = experience.to_bytes()
    seconds_of_file = time.process_time() - began
    places = len(experience.evidence.places)
    floor = f"floor of {SIDE:.0f} x {SIDE:.0f} m, {places} places"
    yield report(f"{floor}: the file", len(content) / 1e6, "MB", 4)
    yield report(f"{floor}: a drive of 100 m", len(changes) / 1e3, "kB", 20)
    yield report(f"{floor}: to learn from this drive", 1e3 * seconds, "ms", 200)
    yield report(f"{floor}: to make the file", 1e3 * seconds_of_file, "ms", 1000)


def measure_merges() -> Iterator[bool]:
    """Let two robots merge each other after each drive, and count their seconds."""
    random = np.random.default_rng(0)
    robots = Experience(SPEED, robot="one"), Experience(SPEED, robot="two")
    driven = 0.0
    for number in range(DRIVES):
        for experience in robots:
            drive = line(1.1 + number / 2, random, metres=10)
            driven += experience.record(*drive).seconds
        for _ in range(MERGES):
            robots[0].merge(robots[1])
            robots[1].merge(robots[0])
    for experience in robots:
        ratio = experience.evidence.driven / driven
        words = f"robot {experience.robot}, {DRIVES} drives, {MERGES * DRIVES} merges"
        yield report(f"{words}: seconds over those driven", ratio, "", 1 + 1e-9)


def main(_: Sequence[str]) -> int:
    """Print each figure beside its bound; return 1 if one is missed."""
    missed = [*measure_merges(), *measure_floor()]
    return int(any(missed))


if __name__ == "__main__":
    run_script(main, {})
