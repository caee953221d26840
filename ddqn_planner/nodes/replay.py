"""The replay of recorded episodes: each is drawn step by step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rclpy.timer import Timer

from ddqn_planner.nodes.runtime import STEADY, BaseNode


class Replay:
    """Replays episodes, one at a time; `fail` is called with the reason if one ends early."""

    def __init__(self, node: BaseNode, fail: Callable[[str], None]) -> None:
        self._node, self._fail = node, fail
        self._timer: Timer | None = None

    @property
    def is_running(self) -> bool:
        """Whether episodes are being replayed."""
        return self._timer is not None

    def start(
        self, file: Path, episodes: Iterator[Any], draw: Callable[[Any], None], remedy: str
    ) -> tuple[bool, str]:
        """Replay a file's episodes from now on; return whether it succeeds, and a message.

        `draw` is called with the first place of an episode, its first two, and so on. The remedy is
        for a file without episodes.
        """
        frames = (places[: n + 1] for places in episodes for n in range(len(places)))
        try:
            first = next(frames, None)
        except OSError as error:
            return False, f"no recorded episodes ({error}); call ~/start first"
        if first is None:
            return False, f"{file} holds no episode to replay yet; {remedy}"
        self.stop()
        draw(first)

        def step() -> None:
            try:
                frame = next(frames, None)
            except OSError as error:
                self._fail(f"the replay ends: {file.name} can no longer be read ({error})")
                frame = None
            if frame is None:
                self.stop()
            else:
                draw(frame)

        period = self._node.value("replay_period")
        self._timer = self._node.create_timer(period, step, clock=STEADY)
        return True, "replaying the recorded episodes on ~/episode"

    def stop(self) -> bool:
        """Stop a replay; return whether there was one."""
        timer, self._timer = self._timer, None
        if timer is not None:
            self._node.destroy_timer(timer)
        return timer is not None
