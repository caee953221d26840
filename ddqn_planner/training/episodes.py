"""The episodes of a training, and their record, ``episodes.csv``."""

import re
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import NamedTuple

from ddqn_planner.files import Appender, as_path, read_rows, write_atomically
from ddqn_planner.grid import Cell, path_length

HEADER = (
    b"episode,step,scenario,outcome,moves,length,total_reward,average_reward,cells\r\n"
)
# A complete row. Its groups are the number of the episode, and its cells as "x:y x:y".
ROW = re.compile(rb"(\d{1,18})(?:,[^,]*){7},(\d{1,9}:\d{1,9}(?: \d{1,9}:\d{1,9})*)\r\n")


class EpisodeEnd(str, Enum):
    """How an episode ended."""

    REACHED_GOAL = "reached_goal"
    COLLIDED = "collided"
    OUT_OF_STEPS = "out_of_steps"


class Episode(NamedTuple):
    """An episode that has ended (the paper's round), the first one with number 1."""

    number: int
    step: int  # environment steps of the training when it ended
    scenario: int  # index of the map in the trainer's `scenarios`
    outcome: EpisodeEnd
    cells: tuple[Cell, ...]  # in order, from the initial one on
    moves: int  # with the last one, if that was a collision
    total_reward: float

    @property
    def average_reward(self) -> float:
        """Reward per step, the paper's curve (Fig. 6)."""
        return self.total_reward / self.moves


class Progress(NamedTuple):
    """The state of a training between two steps."""

    step: int  # environment steps since the training began
    updates: int  # of the network
    episodes: tuple[Episode, ...]  # that have ended since the last progress
    epsilon: float  # ε, the probability of a random action
    learning_rate: float

    def __repr__(self) -> str:
        """Return all but the episodes, of which there may be hundreds."""
        return (
            f"Progress(step={self.step}, updates={self.updates}, "
            f"{len(self.episodes)} episodes, epsilon={self.epsilon:.3g}, "
            f"learning_rate={self.learning_rate:.3g})"
        )


def open_record(path: Path, episodes: int) -> Appender:
    """Open the ``episodes.csv`` at `path` to append to it; a missing file is made.

    Only the rows of the episodes 1 to `episodes` stay. Later rows are newer than the
    checkpoint from which the training continues.
    """
    lines = [HEADER]
    if path.exists():
        rows = map(ROW.fullmatch, read_rows(path))
        lines += [row[0] for row in rows if row and int(row[1]) <= episodes]
    write_atomically(path, b"".join(lines))
    return Appender(path)


def record(episode: Episode) -> bytes:
    """Return the row of an episode, its cells as ``x:y``."""
    row = (
        episode.number,
        episode.step,
        episode.scenario,
        episode.outcome.value,
        episode.moves,
        round(path_length(episode.cells), 4),
        round(episode.total_reward, 6),
        round(episode.average_reward, 6),
        " ".join(f"{x}:{y}" for x, y in episode.cells),
    )
    return f"{','.join(map(str, row))}\r\n".encode()


def read_cells(path: str | Path, every: int) -> Iterator[tuple[Cell, ...]]:
    """Yield the cells of the episodes `every`, 2 * `every`, ... of an ``episodes.csv``.

    `path` is that of the file; cells are (x, y), in the order of the episode. Rows that
    are not complete are left out. An OSError without a file.
    """
    for line in read_rows(as_path(path)):
        row = ROW.fullmatch(line)
        if row is None or int(row[1]) % every != 0:
            continue
        cells = []
        for cell in row[2].split():
            x, y = cell.split(b":")
            cells.append((int(x), int(y)))
        yield tuple(cells)
