"""What a law may say of a world: where, when and for how long a robot is slow."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import Cell, GridMap

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Stand:
    """A robot stands, with a chance of 0 to 1, for seconds that are drawn evenly."""

    chance: float
    shortest: float  # seconds
    longest: float  # seconds

    @property
    def mean(self) -> float:
        """The seconds that are expected of it."""
        return self.chance * (self.shortest + self.longest) / 2

    def draw(self, random: np.random.Generator) -> float:
        """Draw for how many seconds the robot stands, mostly 0 if the chance is low."""
        if random.random() >= self.chance:
            return 0.0
        return float(random.uniform(self.shortest, self.longest))


@dataclass(frozen=True)
class Door:
    """Cells at which a robot may have to stand, each time that it comes to them."""

    cells: NDArray[np.bool_]  # (H, W); the robot stands in the last cell before them
    stand: Stand


@dataclass(frozen=True)
class Law:
    """What makes robots slow in one world. Nobody tells it to the robot.

    The times are those of a robot that drives `slowness` times as long as at nominal
    speed, and stands besides.
    """

    # Of the world's clock, seconds, to the slowness of each cell: (H, W), 0.5 or more.
    slowness: Callable[[float], Float64]
    # (H, W, 2): a vector (x, y) in each cell; driving in its direction adds its length
    # to the slowness, and driving against it adds nothing.
    uphill: Float64 | None = None
    doors: Sequence[Door] = field(default_factory=list)
    turn_seconds: float = 0.0  # of each turn by 45 degrees
    at_start: Stand | None = None  # within the first metre of a drive
    at_goal: Stand | None = None  # within the last metre of a drive
    stop: Stand | None = None  # anywhere; its chance is that of each metre
    # Of the world's clock to a factor of all driving times: weather, a battery.
    whole_drive: Callable[[float], float] | None = None


def always(slowness: Float64) -> Law:
    """Return the law of a world whose slowness (H, W) is always the same."""
    return Law(lambda clock: slowness)


MakeLaw: TypeAlias = Callable[[GridMap, Sequence[Cell], np.random.Generator], Law]
"""Draws the law of a world from its map, the cells of its stations, and chance."""
