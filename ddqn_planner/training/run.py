"""A training run: a trainer with a folder for its curves, its checkpoint and its model."""

from __future__ import annotations

import io
import re
import reprlib
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, BinaryIO

from ddqn_planner.files import Appender, lock, remove_temporaries, write_atomically
from ddqn_planner.grid import Cell, MoveRule, path_length
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.memory import check_memory
from ddqn_planner.training.trainer import CheckpointError, Episode, Trainer

# Not torch's SummaryWriter: its thread ends at the first error, for example of a full disk.
try:
    from tensorboard.compat.proto.event_pb2 import (  # type: ignore[import-untyped]
        Event,
        SessionLog,
    )
    from tensorboard.compat.proto.summary_pb2 import Summary  # type: ignore[import-untyped]
    from tensorboard.summary.writer.record_writer import (  # type: ignore[import-untyped]
        RecordWriter,
    )
except ImportError:  # an extra: the CSV file has the curves too
    Event = None

SAVE_INTERVAL = 5_000
"""Environment steps between two checkpoints."""

COLUMNS = (
    "episode",
    "step",
    "scenario",
    "outcome",
    "moves",
    "length",
    "total_reward",
    "average_reward",
    "cells",
)

ROW = re.compile(rb"(\d{1,18})(?:,[^,]*){7},(\d{1,9}:\d{1,9}(?: \d{1,9}:\d{1,9})*)\r\n")
"""A complete row: the number of the episode, and its cells."""

LOCK, CHECKPOINT = "training.lock", "checkpoint.safetensors"
"""A folder with one of these files belongs to a training. The lock file is there from the start, so
that a training that was killed before its first checkpoint can start again in its folder."""


class FolderError(ValueError):
    """A folder contains files but no training, or another process trains in it."""


class TrainingRun:
    """Trains into a folder, or continues there when the folder holds a checkpoint.

    The run writes ``model.safetensors``, ``checkpoint.safetensors``, ``episodes.csv`` (one row per
    episode, its cells as ``x:y``), TensorBoard's curves where ``tensorboard`` is installed, and
    ``training.lock``, which keeps other processes out until `close` or the end of the process. The
    folder must be new or empty, or belong to a training.

    Parameters
    ----------
    folder : str or Path
    scenarios : sequence of Scenario
    move_rule : MoveRule
    parameters : HyperParameters
        Those of the checkpoint, if there is one; only ``steps`` may differ.
    seed : int
        That of the checkpoint, if there is one.

    Raises
    ------
    CheckpointError
        If the folder holds a checkpoint that cannot be read, or of another training.
    FolderError
        If the folder contains files but no training, or another process trains in it.
    MemoryShortageError
        If the training does not fit into the memory; `memory` is its estimate in bytes.
    OSError
        If the folder cannot be written.
    """

    def __init__(
        self,
        folder: str | Path,
        scenarios: Sequence[Scenario],
        move_rule: MoveRule,
        parameters: HyperParameters,
        seed: int,
    ) -> None:
        self.folder = Path(folder)
        self.model_path = self.folder / "model.safetensors"
        self.checkpoint_path = self.folder / CHECKPOINT
        self.curves_path = self.folder / "episodes.csv"
        self.memory = check_memory(scenarios, parameters)
        self.save_error = ""
        with ExitStack() as stack:  # closes what is open, the lock too, if the rest fails
            stack.enter_context(_claim(self.folder))
            if self.checkpoint_path.exists():
                self.trainer = Trainer.load_checkpoint(self.checkpoint_path, scenarios)
                _check_same_training(self.trainer, move_rule, parameters, seed, self.folder)
                self.trainer.parameters = parameters
            else:
                self.trainer = Trainer(scenarios, move_rule, parameters, seed)
            self.saved_at = self.trainer.steps
            for path in (self.model_path, self.checkpoint_path, self.curves_path):
                remove_temporaries(path)
            _cut_rows(self.curves_path, self.trainer.episodes)
            self._curves = stack.enter_context(closing(Appender(self.curves_path)))
            self._board: Appender | None = None
            if Event is not None:
                # TensorBoard reads the files of a folder in the order of their names.
                name = f"events.out.tfevents.{time.time_ns()}.ddqn_planner"
                self._board = stack.enter_context(closing(Appender(self.folder / name)))
                self._board.append(_first_events(self.trainer.steps))
            self._open_files = stack.pop_all()

    def steps(self) -> Iterator[list[Episode]]:
        """Train until ``parameters.steps``; save every `SAVE_INTERVAL` steps and at the end.

        If a save fails, or the curves cannot be written, the training continues, and `save_error`
        says why until a save succeeds. Episodes that end meanwhile may be missing in the curves.

        Yields
        ------
        list of Episode
            The episodes that ended with this step, often none; they are in the curves.
        """
        for finished in self.trainer.run(self.trainer.parameters.steps):
            for episode in finished:
                self._record(episode)
            due = self.trainer.steps // SAVE_INTERVAL != self.saved_at // SAVE_INTERVAL
            if due and self.trainer.steps < self.trainer.parameters.steps:
                self.try_to_save()
            yield finished
        self.try_to_save()

    def try_to_save(self) -> None:
        """Save. If that fails, `save_error` says why, and the last good files stay."""
        try:
            self.save()
            self.save_error = ""
        except OSError as error:
            self.saved_at = self.trainer.steps
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        # Without the error's file name: it is often that of a temporary file.
        self.save_error = (
            f"cannot save to {self.folder} ({error.strerror or error}); make room or allow writing "
            f"there: the training continues and tries again every {SAVE_INTERVAL} steps"
        )

    def _record(self, episode: Episode) -> None:
        try:
            rule = self.trainer.environment.move_rules[episode.scenario]
            self._curves.append(_row(episode, rule))
            if self._board is not None:
                self._board.append(_events(episode))
        except OSError as error:
            self._fail(error)

    def save(self) -> None:
        """Write the model and the checkpoint.

        Raises
        ------
        OSError
            If the curves or one of the two cannot be written; the last good files then stay.
        """
        # A kill between the two leaves a model that is newer than the checkpoint. Both are
        # complete, and nothing needs them to be of the same step: the next save replaces the model.
        self.trainer.save_model(self.model_path)
        self.trainer.save_checkpoint(self.checkpoint_path)
        self._curves.flush()
        if self._board is not None:
            self._board.flush()
        self.saved_at = self.trainer.steps

    def close(self) -> None:
        """Close the curves and unlock the folder. `save` first."""
        self._open_files.close()


def read_cells(curves_path: str | Path, every: int) -> Iterator[tuple[Cell, ...]]:
    """Yield the cells of each `every`-th episode of a run's ``episodes.csv``.

    Rows that are not complete are skipped.

    Raises
    ------
    OSError
        If the file cannot be read.
    """
    with Path(curves_path).open("rb") as file:
        for row in map(ROW.fullmatch, file):
            if row and int(row[1]) % every == 0:
                x_y = (cell.split(b":") for cell in row[2].split())
                yield tuple((int(x), int(y)) for x, y in x_y)


def _claim(folder: Path) -> BinaryIO:
    """Lock a folder for a training until the returned file is closed."""
    folder.mkdir(parents=True, exist_ok=True)
    names = sorted(path.name for path in folder.iterdir())
    if names and not any((folder / name).is_file() for name in (LOCK, CHECKPOINT)):
        raise FolderError(
            f"{folder} holds {reprlib.repr(names)} but no training; give a new or empty folder"
        )
    try:
        return lock(folder / LOCK)
    except BlockingIOError:
        raise FolderError(
            f"another process trains in {folder}; wait for its end, stop it, or give another folder"
        ) from None


def _row(episode: Episode, move_rule: MoveRule) -> bytes:
    values = (
        episode.number,
        episode.step,
        episode.scenario,
        episode.outcome.value,
        episode.moves,
        round(path_length(episode.cells, move_rule), 4),
        round(episode.total_reward, 6),
        round(episode.average_reward, 6),
        " ".join(f"{x}:{y}" for x, y in episode.cells),
    )
    return _line(values)


def _line(values: Sequence[object]) -> bytes:
    return (",".join(map(str, values)) + "\r\n").encode()


def _cut_rows(path: Path, episodes: int) -> None:
    """Keep the header and the rows of the first `episodes`, which the checkpoint includes."""
    lines = [_line(COLUMNS)]
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


def _events(episode: Episode) -> bytes:
    values = {"average_reward": episode.average_reward, "episode_moves": episode.moves}
    summary = Summary(value=[Summary.Value(tag=t, simple_value=v) for t, v in values.items()])
    return _records(Event(wall_time=time.time(), step=episode.step, summary=summary))


def _records(*events: Any) -> bytes:
    content = io.BytesIO()
    writer = RecordWriter(content)
    for event in events:
        writer.write(event.SerializeToString())
    return content.getvalue()


def _check_same_training(
    trainer: Trainer, move_rule: MoveRule, parameters: HyperParameters, seed: int, folder: Path
) -> None:
    now = {**asdict(parameters), "seed": seed, "move_rule": move_rule.value}
    saved = asdict(replace(trainer.parameters, steps=parameters.steps))
    saved |= {"seed": trainer.seed, "move_rule": trainer.move_rule.value}
    differences = [
        f"{name} {value} (now {now[name]})" for name, value in saved.items() if value != now[name]
    ]
    if differences:
        raise CheckpointError(
            f"{folder} holds a training with {', '.join(differences)}; give those values to "
            "continue it, or another folder"
        )
