"""The expected times of a map's moves, by what the trainer has learned of the robot's drives."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import numpy as np
from rclpy.task import Future
from std_msgs.msg import UInt8MultiArray

from ddqn_planner.experience import Experience
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.copies import WHOLE
from ddqn_planner.nodes.conversions import bytes_of, label_of
from ddqn_planner.nodes.lifecycle import ManagedNode
from ddqn_planner.nodes.report import NO_REQUEST, Outcome, Report
from ddqn_planner.nodes.runtime import Worker

CHANGED_SHARE = 0.02  # of cells: with more, experience is spread anew over the map, slowly
NO_MAP = GridMap(np.zeros((1, 1), dtype=np.bool_))


class ExpectedTimes:
    """Puts on maps what the trainer has learned of the robot's drives."""

    def __init__(
        self, node: ManagedNode, report: Report, worker: Worker, on_change: Callable[[], None]
    ) -> None:
        self._node, self._report, self._worker, self._on_change = node, report, worker, on_change
        self._experience: Experience | None = None
        self._spread_on: GridMap | None = None
        self._applied = (NO_MAP, NO_MAP)  # the last map, without times and with them
        self._label = ""  # of the message that was taken last
        # What the worker was asked last, and its answer.
        self._outcome, self._forecast = NO_REQUEST, Future()

    async def on_sent(self, message: UInt8MultiArray | None = None) -> None:
        """Plan by what drives taught, or refuse the trainer's message, or the file that is set."""
        with self._report.taking("experience"):
            await self._worker.call(self.load, message)
            self._on_change()

    def told(self, outcome: Outcome) -> dict[str, str]:
        """Return what `describe` returns, once the worker has computed it."""
        if self._experience is None:
            return {}
        if outcome is not self._outcome:
            self._outcome, self._forecast = outcome, self._worker.call(self.describe, outcome)
        if not self._forecast.done():
            self._report.change()  # to look again soon
        return self._forecast.result() or {}

    def load(self, message: UInt8MultiArray | None = None) -> None:
        """Use a message, if it is new, or the file that is set, or none; errors change nothing."""
        label, newer = label_of(message) if message else "", None
        if message and label == self._label:
            return
        if message:
            newer = Experience.from_bytes(bytes_of("experience", message))
        elif file := self._node.value("experience"):
            newer = Experience.load(file)
        if newer is not None and self._experience is not None:
            newer.take_over(self._experience)
        self._experience, self._label = newer, label

    def apply(self, grid: GridMap) -> GridMap:
        """Return a map whose moves cost expected time, or the same map before a drive."""
        if self._experience is None or not self._experience.evidence.places:
            return grid
        if self._spread_on is None or not is_like(grid, self._spread_on):
            self._spread_on = grid
        (before, timed), share = self._applied, self._node.value("exploration")
        of_places = self._experience.apply(self._spread_on, share)
        boxes = grid.patches_since(before)
        if boxes is None or timed.slowness is not of_places.slowness:
            seconds = of_places.seconds_per_cell
            timed = grid.with_layers(slowness=of_places.slowness, seconds_per_cell=seconds)
        else:
            timed = timed.with_boxes_of(grid, boxes)
        self._applied = grid, timed
        return timed

    def describe(self, outcome: Outcome) -> dict[str, str]:
        """Return how long a plan takes, unless its map is old or untimed, or no memory is left."""
        now, request, path = self._spread_on, outcome.request, outcome.plan.path
        told: dict[str, str] = {}
        is_timed = request is not None and request.grid.slowness is not None and len(path) > 0
        if self._experience and now and request and is_timed and is_like(request.grid, now):
            with suppress(MemoryError):
                seconds, low, high = self._experience.expected_time(now, path)
                told["expected time (s)"] = f"{seconds:.1f}"
                told["expected time, 90 % interval (s)"] = f"{low:.1f} to {high:.1f}"
        return told


def is_like(grid: GridMap, other: GridMap) -> bool:
    """Return whether two maps have the same place, and nearly the same obstacles."""
    mine, its = ((each.occupancy.shape, each.resolution, each.origin) for each in (grid, other))
    if mine != its:
        return False
    boxes = grid.patches_since(other)
    boxes = [WHOLE] if boxes is None else boxes
    changed = sum(np.count_nonzero(grid.occupancy[box] != other.occupancy[box]) for box in boxes)
    return bool(changed <= CHANGED_SHARE * grid.occupancy.size)
