"""From a robot's poses to its drives: where one begins, which samples it keeps, when it ends."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.experience.drive_log import FARTHEST, DriveEnd

Float64 = NDArray[np.float64]

SAMPLE_DISTANCE, SAMPLE_PERIOD = 0.05, 0.5
"""A pose is kept if it is so many metres away from the last one that was kept, or so many seconds
later."""

STAND_DISTANCE = 0.1
"""A robot that stays within so many metres stands: localisation is not exact."""

STAND_PERIOD = 2.0
"""Seconds after which a robot that stands at its goal has arrived."""

ARRIVAL_DISTANCE = 0.5
"""Metres from the goal."""

PAUSE = 120.0
"""Seconds: a robot that stands for longer does not wait for a door or a crowd."""

SHORTEST = 0.5
"""Metres: a robot that went no farther away than that from where it began has not driven."""

MOST_SAMPLES = 2000
"""A drive that has so many is cut, so that the robot learns while it drives for hours."""


JUMP = 1.0
"""Seconds: a clock that goes back by more begins anew, as when a bag loops or a simulator is reset.
The robot may be elsewhere."""


class DriveRecorder:
    """Divides poses into drives.

    A drive begins when the robot drives off. It ends when the robot stands at its goal, stands for
    a long time, gets another goal, or gave up, and when the clock jumps back.

    Parameters
    ----------
    on_drive : callable
        Called with the outcome, the seconds (N,) and the positions (N, 2) of each drive that ends.

    Attributes
    ----------
    goal : (x, y) or None
        The last goal, metres.
    """

    def __init__(self, on_drive: Callable[[DriveEnd, Float64, Float64], None]) -> None:
        self._on_drive = on_drive
        self.goal: tuple[float, float] | None = None
        self.forget()

    def forget(self) -> None:
        """Forget the drive that is under way, and where the robot is."""
        self._samples: list[tuple[float, float, float]] = []
        self._last: tuple[float, float, float] | None = None
        self._stands: tuple[float, float, float] | None = None

    @property
    def position(self) -> tuple[float, float] | None:
        """Where the robot is, metres."""
        return self._last[1:] if self._last is not None else None

    def add(self, seconds: float, x: float, y: float) -> None:
        """Take a pose of the robot, in order.

        Raises
        ------
        ValueError
            If a number is not finite, or too great for a place of the world.
        """
        sample = seconds, x, y
        if not all(abs(value) <= FARTHEST for value in sample):  # NaN fails too
            raise ValueError(
                f"the robot is at {(x, y)} at {seconds} s; give finite numbers up to {FARTHEST:g}"
            )
        if self._last is not None and seconds < self._last[0] - JUMP:
            self.end(DriveEnd.STOPPED)
            self.forget()
        stands = self._stands
        if stands is None or math.dist(stands[1:], sample[1:]) > STAND_DISTANCE:
            if stands is not None and self._last is not None and not self._samples:
                self._samples.append(self._last)
            stands = self._stands = sample
        self._last = sample
        if not self._samples:
            return
        before = self._samples[-1]
        moved = math.dist(before[1:], sample[1:]) >= SAMPLE_DISTANCE
        if moved or abs(seconds - before[0]) >= SAMPLE_PERIOD:
            self._samples.append(sample)
        stood = abs(seconds - stands[0])
        if stood >= STAND_PERIOD and self._is_at_goal:
            self.end(DriveEnd.ARRIVED)
        elif stood >= PAUSE:
            self.end(DriveEnd.PAUSED)
        elif len(self._samples) >= MOST_SAMPLES:
            self.end(DriveEnd.CUT)
            self._samples.append(sample)

    @property
    def _is_at_goal(self) -> bool:
        if self.goal is None or self.position is None:
            return False
        return math.dist(self.goal, self.position) <= ARRIVAL_DISTANCE

    def set_goal(self, x: float, y: float) -> None:
        """Take a new goal; the same one again changes nothing."""
        if (x, y) != self.goal:
            self.end(DriveEnd.ARRIVED if self._is_at_goal else DriveEnd.NEW_GOAL)
            self.goal = x, y

    def abort(self) -> None:
        """End the drive because the robot gave up, also where it could not even begin."""
        if not self._samples and self._last is not None:
            self._samples.append(self._last)
        self.end(DriveEnd.ABORTED)

    def end(self, outcome: DriveEnd) -> None:
        """End the drive, if there is one."""
        samples, self._samples = np.array(self._samples), []
        # The robot has to drive off again.
        self._stands = self._last
        if len(samples) == 0:
            return
        extent = np.hypot(*(samples[:, 1:] - samples[0, 1:]).T).max()
        if extent >= SHORTEST or outcome is DriveEnd.ABORTED:
            self._on_drive(outcome, samples[:, 0], samples[:, 1:])
