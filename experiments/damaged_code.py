"""Damages all files of compiled code, and checks plans and warnings after it."""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from processes import run_script
from tables import table

BLOCK = 4096  # bytes that a disk writes at once
WARNING = "ddqn_planner's compiled code: "
# With a tolerance, a plan needs functions that others do not.
PLAN = """
import numpy as np
from ddqn_planner import GridMap, Planner
from ddqn_planner.warm_up import warm_up

planner = Planner.load("any_map")
for _ in warm_up(planner, learns=True):
    pass
occupancy = np.random.default_rng(0).random((40, 50)) < 0.2
occupancy[30] = True
for start, goal, tolerance in [((2, 2), (40, 4), 0), ((3, 9), (44, 38), 40)]:
    for cost in (None, np.ones((40, 50), np.int8)):
        grid = GridMap(occupancy, cost=cost)
        is_straight = tolerance > 0
        plan = planner.plan(
            grid, start, goal, tolerance=tolerance, simplified=is_straight
        )
        print(plan.status.name, plan.length, plan.cells)
"""
Damage = Callable[[bytes, np.random.Generator], bytes]


def zero_a_block(content: bytes, random: np.random.Generator) -> bytes:
    """Return the content as after a power cut before one block was written."""
    first = int(random.integers(len(content))) // BLOCK * BLOCK
    length = len(content[first : first + BLOCK])
    return content[:first] + bytes(length) + content[first + length :]


def flip_a_bit(content: bytes, random: np.random.Generator) -> bytes:
    """Return the content with one bit changed."""
    damaged = bytearray(content)
    damaged[random.integers(len(content))] ^= 1 << int(random.integers(8))
    return bytes(damaged)


DAMAGES: dict[str, Damage] = {
    "empty": lambda content, random: b"",
    "cut": lambda content, random: content[: random.integers(len(content))],
    "zeros": lambda content, random: bytes(len(content)),
    "a block of zeros": zero_a_block,
    "one bit": flip_a_bit,
    "random": lambda content, random: random.bytes(len(content)),
}


def plan(folder: Path, python: str) -> subprocess.CompletedProcess[str]:
    """Run the program that plans, with its compiled code in a folder."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder)}
    command = [python, "-c", PLAN]
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, check=False
    )


def damage_files(folder: Path, damage: Damage, random: np.random.Generator) -> None:
    """Damage all files of compiled code in a folder."""
    for path in sorted(folder.rglob("*.nbc")):
        path.write_bytes(damage(path.read_bytes(), random))


def main(arguments: Sequence[str]) -> int:
    """Damage the files; return 1 if a plan or a warning was wrong.

    The plans are made by this Python or by another.
    """
    python = arguments[0] if arguments else sys.executable
    random = np.random.default_rng(0)
    rows = []
    is_wrong = False
    with tempfile.TemporaryDirectory() as name:
        intact = Path(name, "intact")
        folder = Path(name, "code")
        first = plan(intact, python)
        if first.returncode or not first.stdout:
            raise RuntimeError(f"no plan with an empty folder: {first.stderr}")
        for damage_name, damage in DAMAGES.items():
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(intact, folder)
            damage_files(folder, damage, random)
            runs = [plan(folder, python) for _ in range(2)]
            are_right = [
                run.returncode == 0 and run.stdout == first.stdout for run in runs
            ]
            warnings = [run.stderr.count(WARNING) for run in runs]
            is_wrong |= not all(are_right) or warnings != [1, 0]
            rows.append([damage_name, *are_right, *warnings])
    words = "plans are right | and with the next start | warnings | with the next start"
    print(table(f"damage | {words}", rows))
    return int(is_wrong)


if __name__ == "__main__":
    run_script(main, {"python": "the Python that plans (this one)"})
