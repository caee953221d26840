"""Measures how much wider than a car corridors must be, with more or fewer headings.

A corridor of 5 m joins two open places, at 14 angles from 0 to 45 degrees to the cells.
Starts and goals lie up to half a metre beside its axis and up to half a radian off its
direction. A cell is occupied if its centre lies in a wall: so a body that drives
exactly along the axis needs up to 7 cm more than its width, too. The last columns tell
what requests of 50 to 60 m need on a map of 2000 x 2000 cells, as bodies.py measures
them. Bends and cusps cost nothing: they do not change where a car passes.
"""

import argparse
import math
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any, Final

import numpy as np
from bodies import (
    CELL,
    FOOTPRINTS,
    LONGEST_REQUEST,
    SHORTEST_REQUEST,
    Pose,
    blocks,
    drive,
    requests,
    robot,
)
from tables import table

from ddqn_planner import GridMap, Planner
from ddqn_planner.robot.driving_costs import DrivingCosts
from ddqn_planner.robot.motions import OCTANTS, Motion
from ddqn_planner.warm_up import warm_up

CELLS: Final = 240  # along a side of the map of a corridor
LENGTH: Final = 5.0  # metres, of a corridor
WIDTH: Final = 0.6  # metres, of the car
WIDEST: Final = 60  # centimetres more than the car is wide: all corridors are tried
END: Final = 4.0  # metres from the middle of a corridor to starts and goals
ANGLES: Final = np.radians(np.linspace(0, 45, 14))
LENGTHS_ALONE: Final = DrivingCosts(bend=1.0, cusp=0.0)
BORDER: Final = 0.55  # metres of free space around long requests


class Corridor:
    """A corridor, whose width can be chosen, with a request through it.

    Parameters
    ----------
    angle : float
        Radians to the rows of cells.
    random : Generator
        Draws where the axis, the start and the goal lie.
    """

    def __init__(self, angle: float, random: np.random.Generator) -> None:
        self.angle = angle
        # Metres from the corner of the map to the middle of the corridor.
        self.middle = CELLS * CELL / 2 + random.uniform(-0.5, 0.5, 2) * CELL
        self.start = self._pose(-END, *random.uniform(-0.5, 0.5, 2))
        self.goal = self._pose(END, *random.uniform(-0.5, 0.5, 2))

    def _pose(self, along: float, across: float, turn: float) -> Pose:
        """Return the pose at some metres and radians from the middle and the axis."""
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        x = self.middle[0] + along * cos - across * sin
        y = self.middle[1] + along * sin + across * cos
        return x, y, self.angle + turn

    def grid(self, width: float) -> GridMap:
        """Return the map where the corridor has a width, in metres."""
        rows, columns = np.indices((CELLS, CELLS))
        x = (columns + 0.5) * CELL - self.middle[0]
        y = (rows + 0.5) * CELL - self.middle[1]
        along = x * math.cos(self.angle) + y * math.sin(self.angle)
        across = y * math.cos(self.angle) - x * math.sin(self.angle)
        is_wall = (np.abs(along) <= LENGTH / 2) & (np.abs(across) > width / 2)
        return GridMap(is_wall, CELL)

    def least_extra(self, planner: Planner) -> int:
        """Return the centimetres more than the car's width from which on it passes."""

        def passes(extra: int) -> bool:
            """Return whether the car passes with so many centimetres more."""
            grid = self.grid(WIDTH + extra / 100)
            plan = planner.plan_poses(grid, self.start, self.goal, bound=2.0)
            return plan.poses.size > 0

        # A wider corridor has the free cells of a narrower one, and more.
        too_narrow, wide = -1, WIDEST
        while wide - too_narrow > 1:
            extra = (too_narrow + wide) // 2
            if passes(extra):
                wide = extra
            else:
                too_narrow = extra
        return wide


def rows(options: argparse.Namespace) -> Iterator[list[Any]]:
    """Yield a row for each number of headings."""
    grid = blocks(0.1, options.seed)
    for headings in options.headings:
        planner = robot(FOOTPRINTS["car"], Motion.ACKERMANN, headings, LENGTHS_ALONE)
        for _ in warm_up(planner):  # what is compiled first takes long
            pass
        random = np.random.default_rng(options.seed)
        extras = [
            [Corridor(angle, random).least_extra(planner) for angle in ANGLES]
            for _ in range(options.corridors)
        ]
        most = np.max(extras, axis=0)  # (14,): by angle
        milliseconds, megabytes = long_requests(planner, grid, options)
        yield [
            headings,
            int(most.max()),
            f"{np.mean(extras):.0f}",
            f"{np.degrees(ANGLES[most.argmax()]):.0f}",
            f"{milliseconds:.1f}",
            f"{megabytes:.1f}",
            planner.network.sizes["units"],
        ]


def long_requests(
    planner: Planner, grid: GridMap, options: argparse.Namespace
) -> tuple[float, float]:
    """Return the mean milliseconds of CPU time and the most megabytes of requests."""
    random = np.random.default_rng(options.seed)
    drawn = (
        pair
        for pair in requests(grid, BORDER, random)
        if SHORTEST_REQUEST < math.dist(pair[0][:2], pair[1][:2]) < LONGEST_REQUEST
    )
    speeds = [
        drive(planner, grid, start, goal, 1.2)
        for start, goal in islice(drawn, options.requests)
    ]
    times = [speed.first for speed in speeds]
    return float(np.mean(times)), max(speed.megabytes for speed in speeds)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--headings", type=int, nargs="+", choices=OCTANTS, default=[*OCTANTS]
    )
    parser.add_argument(
        "--corridors", type=int, default=3, metavar="N", help="at each angle"
    )
    parser.add_argument("--requests", type=int, default=10, metavar="N", help="long")
    parser.add_argument("--seed", type=int, default=0)
    header = (
        "headings | cm more than the width: most | mean | at degrees "
        "| long request: ms | MB | units"
    )
    print(table(header, list(rows(parser.parse_args(arguments)))))


if __name__ == "__main__":
    main()
