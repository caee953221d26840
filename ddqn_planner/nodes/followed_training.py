"""What lets people follow a training: its pace, and its episodes as markers."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

import numpy as np
from geometry_msgs.msg import Point
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from ddqn_planner.training.episodes import Episode, EpisodeEnd

# Blue, orange and grey also differ for people who see few colours.
COLOURS: Final = {
    EpisodeEnd.REACHED_GOAL: (0.0, 0.45, 0.7),
    EpisodeEnd.COLLIDED: (0.9, 0.6, 0.0),
    EpisodeEnd.OUT_OF_STEPS: (0.6, 0.6, 0.6),
}
SHOWN_EPISODES = 20  # a later episode replaces the one of 20 before it
LINE_WIDTH = 0.3  # cells
HEIGHT = 0.02  # metres above the map
LONGEST_SLEEP = 0.1  # seconds, so that a request is seen soon
# How often a paced training pauses in a second, so that its steps come evenly.
PAUSES_PER_SECOND = 10


def steps_between_pauses(pace: float) -> int | None:
    """Return after how many steps a training of a pace pauses, at least 1.

    `pace` is in steps per second; 0 is for no limit: None then.
    """
    return max(1, round(pace / PAUSES_PER_SECOND)) if pace > 0 else None


class Pacer:
    """Lets a training make no more steps in a second than people can follow."""

    def __init__(self, step: int) -> None:
        """Begin at a step of the training."""
        self._step = step
        self._due = time.monotonic()  # when that step should have been made

    def wait(self, step: int, pace: float, is_interrupted: Callable[[], bool]) -> None:
        """Sleep until a step is due.

        Parameters
        ----------
        step : int
            The number of steps that the training has made.
        pace : float
            Steps per second since the last call; 0: the step is due at once.
        is_interrupted : callable
            Ends the sleep when it returns True.
        """
        seconds = (step - self._step) / pace if pace > 0 else 0.0
        self._step = step
        # A training that is slower than its pace does not hurry later.
        self._due = max(self._due + seconds, time.monotonic())
        while not is_interrupted():
            remaining = self._due - time.monotonic()
            if remaining <= 0:
                return
            time.sleep(min(remaining, LONGEST_SLEEP))
        self._due = time.monotonic()


def episode_markers(
    episode: Episode, positions: NDArray[np.float64], cell_size: float, header: Header
) -> MarkerArray:
    """Return an episode as a line in the colour of its end.

    Parameters
    ----------
    episode : Episode
    positions : (N, 2) float64
        Its cells' centres x, y, in metres in the frame of the header.
    cell_size : float
        Metres.
    header : Header
    """
    marker = Marker(header=header, ns="episodes", type=Marker.LINE_STRIP)
    marker.id = episode.number % SHOWN_EPISODES
    marker.action = Marker.ADD
    marker.pose.position.z = HEIGHT
    marker.pose.orientation.w = 1.0
    marker.scale.x = LINE_WIDTH * cell_size
    red, green, blue = COLOURS[episode.outcome]
    marker.color = ColorRGBA(r=red, g=green, b=blue, a=0.8)
    if len(positions) == 1:  # a line has two points: the robot hit an obstacle at once
        positions = np.repeat(positions, 2, axis=0)
    marker.points = [Point(x=x, y=y) for x, y in positions.tolist()]
    return MarkerArray(markers=[marker])
