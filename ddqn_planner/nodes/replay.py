"""The replay of recorded episodes: each is drawn step by step."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.timer import Timer

from ddqn_planner.nodes.runtime import STEADY, BaseNode


class Replay:
    """Replays episodes, one at a time.

    Parameters
    ----------
    node : BaseNode
        It has the parameter ``replay_period``.
    refuse : callable
        Called with the reason when a replay has to end early.
    """

    def __init__(self, node: BaseNode, refuse: Callable[[str], None]) -> None:
        self._node, self._refuse = node, refuse
        self._timer: Timer | None = None

    @property
    def is_running(self) -> bool:
        """Whether episodes are being replayed."""
        return self._timer is not None

    def start(
        self, file: Path, episodes: Iterator[Any], draw: Callable[[Any], None], remedy: str
    ) -> tuple[bool, str]:
        """Replay from now on; return whether it succeeds, and a message.

        Parameters
        ----------
        file : Path
            The file of the episodes.
        episodes : iterator of sequences
            The places of each.
        draw : callable
            Called with the first place of an episode, its first two, and so on.
        remedy : str
            What to do if there is none.
        """
        try:
            first = next(episodes, None)
        except OSError as error:
            return False, f"no recorded episodes ({error}); call ~/start first"
        if first is None:
            return False, f"{file} holds no episode to replay yet; {remedy}"
        self.stop()
        frames = (
            places[: count + 1]
            for places in itertools.chain([first], episodes)
            for count in range(len(places))
        )
        period = self._node.value("replay_period")
        self._timer = self._node.create_timer(
            period, partial(self._step, frames, draw), clock=STEADY
        )
        return True, "replaying the recorded episodes on ~/episode"

    def _step(self, frames: Iterator[Any], draw: Callable[[Any], None]) -> None:
        try:
            frame = next(frames, None)
        except OSError as error:
            self._refuse(f"the replay ends: episodes.csv can no longer be read ({error})")
            frame = None
        if frame is None:
            self.stop()
        else:
            draw(frame)

    def stop(self) -> bool:
        """Stop a replay; return whether there was one."""
        timer, self._timer = self._timer, None
        if timer is not None:
            self._node.destroy_timer(timer)
        return timer is not None
