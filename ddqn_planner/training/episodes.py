"""The episodes of a training, and their record: ``episodes.csv`` and TensorBoard's curves."""

from __future__ import annotations

import io
import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from ddqn_planner.files import Appender, remove_temporaries, write_atomically
from ddqn_planner.grid import Cell, MoveRule, path_length

# Not torch's SummaryWriter: its thread ends at the first error, for example of a full disk.
try:
    from tensorboard.compat.proto.event_pb2 import Event, SessionLog
    from tensorboard.compat.proto.summary_pb2 import Summary
    from tensorboard.summary.writer.record_writer import RecordWriter
except ImportError:  # an extra: the CSV file has the curves too
    Event = None

HEADER = b"episode,step,scenario,outcome,moves,length,total_reward,average_reward,cells\r\n"

ROW = re.compile(rb"(\d{1,18})(?:,[^,]*){7},(\d{1,9}:\d{1,9}(?: \d{1,9}:\d{1,9})*)\r\n")
"""A complete row: the number of the episode, and its cells."""


class EpisodeEnd(str, Enum):
    """How an episode ended."""

    REACHED_GOAL = "reached_goal"
    COLLIDED = "collided"
    OUT_OF_STEPS = "out_of_steps"


@dataclass(frozen=True)
class Episode:
    """An episode that has ended (the paper's round), the first one with number 1."""

    number: int
    step: int
    """Environment steps of the training when it ended."""
    scenario: int
    outcome: EpisodeEnd
    cells: tuple[Cell, ...]
    """The visited cells in order, with the initial one."""
    moves: int
    """Moves made, with an illegal last one."""
    total_reward: float

    @property
    def average_reward(self) -> float:
        """Reward per step, the paper's curve (Fig. 6)."""
        return self.total_reward / self.moves


class EpisodeLog:
    """Appends episodes to ``episodes.csv``, and to TensorBoard's curves where it is installed.

    The CSV file at `path` has one row per episode, its cells as ``x:y``; TensorBoard's file is
    beside it. The training continues from `episodes` and `step`: later rows and events of an
    earlier process are dropped. An OSError if a file cannot be written.
    """

    def __init__(self, path: Path, episodes: int, step: int) -> None:
        remove_temporaries(path)
        _cut_rows(path, episodes)
        with ExitStack() as stack:
            rows = stack.enter_context(closing(Appender(path)))
            self._files: list[tuple[Appender, Callable[[Episode, MoveRule], bytes]]]
            self._files = [(rows, _row)]
            if Event is not None:
                # TensorBoard reads the files of a folder in the order of their names.
                name = f"events.out.tfevents.{time.time_ns()}.ddqn_planner"
                board = stack.enter_context(closing(Appender(path.with_name(name))))
                board.append(_first_events(step))
                self._files.append((board, _events))
            self._open_files = stack.pop_all()

    def append(self, episode: Episode, move_rule: MoveRule) -> None:
        """Append an episode; see `Appender.append` for errors."""
        for file, record in self._files:
            file.append(record(episode, move_rule))

    def flush(self) -> None:
        """Write the rest of the last records; see `Appender.append` for errors."""
        for file, _ in self._files:
            file.flush()

    def close(self) -> None:
        """Close the files."""
        self._open_files.close()


def read_cells(path: str | Path, every: int) -> Iterator[tuple[Cell, ...]]:
    """Yield the cells of each `every`-th episode of an ``episodes.csv`` in its complete rows.

    Raises
    ------
    OSError
        If the file cannot be read.
    """
    with Path(path).open("rb") as file:
        for row in map(ROW.fullmatch, file):
            if row and int(row[1]) % every == 0:
                x_y = (cell.split(b":") for cell in row[2].split())
                yield tuple((int(x), int(y)) for x, y in x_y)


def _row(episode: Episode, move_rule: MoveRule) -> bytes:
    e, length = episode, round(path_length(episode.cells, move_rule), 4)
    rewards = f"{round(e.total_reward, 6)},{round(e.average_reward, 6)}"
    cells = " ".join(f"{x}:{y}" for x, y in e.cells)
    start = f"{e.number},{e.step},{e.scenario},{e.outcome.value},{e.moves},{length}"
    return f"{start},{rewards},{cells}\r\n".encode()


def _cut_rows(path: Path, episodes: int) -> None:
    """Keep the header and the rows of the first `episodes`."""
    lines = [HEADER]
    if path.exists():
        with path.open("rb") as file:
            rows = map(ROW.fullmatch, file)
            lines += [row[0] for row in rows if row and int(row[1]) <= episodes]
    write_atomically(path, b"".join(lines))


def _first_events(step: int) -> bytes:
    """Return the start of a TensorBoard file: it replaces other files' events from `step` on."""
    return _records(
        Event(wall_time=time.time(), step=step, file_version="brain.Event:2"),
        Event(wall_time=time.time(), step=step, session_log=SessionLog(status=SessionLog.START)),
    )


def _events(episode: Episode, _: MoveRule) -> bytes:
    values = {"average_reward": episode.average_reward, "episode_moves": episode.moves}
    summary = Summary(value=[Summary.Value(tag=t, simple_value=v) for t, v in values.items()])
    return _records(Event(wall_time=time.time(), step=episode.step, summary=summary))


def _records(*events: Any) -> bytes:
    content = io.BytesIO()
    writer = RecordWriter(content)
    for event in events:
        writer.write(event.SerializeToString())
    return content.getvalue()
