"""The times at which maps and their updates came, and the period of a costmap."""

import math
import time
from collections import deque
from collections.abc import Callable

import numpy as np

INTERVALS = 8  # between the last messages, whose median is the period


class Arrivals:
    """Counts maps and updates, and measures the time from one to the next."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.number = 0
        # The number of the last message after which a request waited for nothing.
        self.awaited_in_vain = -1
        self._times: deque[float] = deque(maxlen=INTERVALS + 1)

    def note(self) -> float:
        """Count a map or an update that comes now; return the time in seconds."""
        now = self._clock()
        self.number += 1
        self._times.append(now)
        return now

    @property
    def period(self) -> float:
        """Seconds between messages, the median; infinite before the second message."""
        intervals = np.diff(self._times)
        if len(intervals) == 0:
            return math.inf
        if len(intervals) <= 2:
            # Two messages may come together, as a costmap and its first update.
            return float(intervals.max())
        return float(np.median(intervals))
