"""A training run: a trainer with a folder for its curves, its checkpoint and its model."""

from __future__ import annotations

import io
import os
import re
import reprlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, BinaryIO

from ddqn_planner.files import Appender, lock, remove_temporaries, write_atomically
from ddqn_planner.grid import Cell, MoveRule, path_length
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.memory import check_memory
from ddqn_planner.training.trainer import CheckpointError, Episode, Trainer

# Not torch's SummaryWriter: its thread ends for good at the first error, a full disk's too.
try:
    from tensorboard.compat.proto.event_pb2 import (  # type: ignore[import-untyped]
        Event,
        SessionLog,
    )
    from tensorboard.compat.proto.summary_pb2 import Summary  # type: ignore[import-untyped]
    from tensorboard.summary.writer.record_writer import (  # type: ignore[import-untyped]
        RecordWriter,
    )
except ImportError:  # an extra: the curves are in the CSV file all the same
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
"""A whole row: the episode's number, and its cells."""


RANK_FOLDER = re.compile(r"rank_\d+")
"""The folders of the other processes of a training, see `ddqn_planner.training.ranks`."""

LOCK, CHECKPOINT = "training.lock", "checkpoint.safetensors"
"""Either file says that a folder is a training's. The lock is there from the start, so that a
training that was killed before its first checkpoint can begin again."""


class FolderError(ValueError):
    """A folder holds what no training wrote, or another process trains in it."""


class TrainingRun:
    """Trains into a folder, and goes on there when the folder holds a checkpoint.

    The folder gets ``model.safetensors``, ``checkpoint.safetensors``, ``episodes.csv`` (one row per
    episode, its cells as ``x:y``), TensorBoard's curves where ``tensorboard`` is installed, and
    ``training.lock``, which keeps other processes out until `close` or the end of the process. It
    must be new, empty, or a training's.

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
        If the folder holds what no training wrote, or another process trains in it.
    MemoryShortageError
        If the training cannot fit into the memory; see ``memory``, bytes.
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
        self.memory = check_memory(scenarios, parameters)
        self._lock = _claim(self.folder)
        try:
            self._open(scenarios, move_rule, parameters, seed)
        except BaseException:
            self._lock.close()
            raise

    def _open(
        self,
        scenarios: Sequence[Scenario],
        move_rule: MoveRule,
        parameters: HyperParameters,
        seed: int,
    ) -> None:
        if self.checkpoint_path.exists():
            self.trainer = Trainer.load_checkpoint(self.checkpoint_path, scenarios)
            _check_same_training(self.trainer, move_rule, parameters, seed, self.folder)
            self.trainer.parameters = parameters
        else:
            self.trainer = Trainer(scenarios, move_rule, parameters, seed)
        self.saved_at = self.trainer.steps
        self.save_error = ""
        for path in (self.model_path, self.checkpoint_path, self.curves_path):
            remove_temporaries(path)
        _cut_rows(self.curves_path, self.trainer.episodes)
        self._curves = Appender(self.curves_path)
        self._board = Appender(self._board_path()) if Event is not None else None
        if self._board is not None:
            self._board.append(_first_events(self.trainer.steps))

    @property
    def model_path(self) -> Path:
        """Where `save` writes the model."""
        return self.folder / "model.safetensors"

    @property
    def checkpoint_path(self) -> Path:
        """Where `save` writes the checkpoint."""
        return self.folder / CHECKPOINT

    @property
    def curves_path(self) -> Path:
        """Where the rows of the episodes are."""
        return self.folder / "episodes.csv"

    def _board_path(self) -> Path:
        # TensorBoard reads a folder's files in the order of their names: here of their times.
        return self.folder / f"events.out.tfevents.{time.time_ns()}.ddqn_planner"

    def steps(self) -> Iterator[list[Episode]]:
        """Train until ``parameters.steps``, and save every `SAVE_INTERVAL` steps and at the end.

        Where that fails, or the curves cannot be written, the training goes on, and `save_error`
        says why until a save succeeds. Episodes that end meanwhile may lack in the curves.

        Yields
        ------
        list of Episode
            Those that ended with this step, often none; they are noted in the curves.
        """
        for finished in self.trainer.run(self.trainer.parameters.steps):
            for episode in finished:
                self._note(episode)
            due = self.trainer.steps // SAVE_INTERVAL != self.saved_at // SAVE_INTERVAL
            if due and self.trainer.steps < self.trainer.parameters.steps:
                self.try_to_save()
            yield finished
        self.try_to_save()

    def try_to_save(self) -> None:
        """Save, or note in `save_error` why that fails; the last good files then stay."""
        try:
            self.save()
            self.save_error = ""
        except OSError as error:
            self.saved_at = self.trainer.steps
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        # Not its file name: that of a temporary file says nothing.
        self.save_error = (
            f"cannot save to {self.folder} ({error.strerror or error}); make room or set its mode: "
            f"the training goes on and tries again every {SAVE_INTERVAL} steps"
        )

    def _note(self, episode: Episode) -> None:
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
            If one cannot be written; the last good ones are then still there. Or if the curves
            cannot be written.
        """
        # A kill between the two leaves a model that is newer than the checkpoint. Each is whole: a
        # planner takes the model, and a training goes on from the checkpoint and saves its model
        # over that one. Neither reads the other's file.
        self.trainer.save_model(self.model_path)
        self.trainer.save_checkpoint(self.checkpoint_path)
        self._curves.flush()
        if self._board is not None:
            self._board.flush()
        self.saved_at = self.trainer.steps

    def close(self) -> None:
        """Close the curves, and let others into the folder. `save` first."""
        self._curves.close()
        if self._board is not None:
            self._board.close()
        self._lock.close()


def read_cells(curves_path: str | Path, every: int) -> Iterator[tuple[Cell, ...]]:
    """Yield the cells of each `every`-th episode of a run's ``episodes.csv``.

    What is no whole row is passed over.

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
    """Make a folder a training's, and keep others out until what is returned is closed."""
    folder.mkdir(parents=True, exist_ok=True)
    known = any(os.path.isfile(folder / name) for name in (LOCK, CHECKPOINT))
    # The other processes of a training may have made their folders before this one's.
    others = sorted(path.name for path in folder.iterdir() if not RANK_FOLDER.fullmatch(path.name))
    if others and not known:
        raise FolderError(
            f"{folder} holds {reprlib.repr(others)} but no training; give a new or empty folder"
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
    """Keep the header and the rows of the first episodes: those that the checkpoint knows."""
    lines = [_line(COLUMNS)]
    if path.exists():
        with path.open("rb") as file:
            rows = map(ROW.fullmatch, file)
            lines += [row[0] for row in rows if row and int(row[1]) <= episodes]
    write_atomically(path, b"".join(lines))


def _first_events(step: int) -> bytes:
    """Return what a file of TensorBoard begins with: what others hold from this step on is void."""
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
    saved = replace(trainer.parameters, steps=parameters.steps)
    differences = [
        f"{entry.name} {getattr(saved, entry.name)} (now {getattr(parameters, entry.name)})"
        for entry in fields(HyperParameters)
        if getattr(saved, entry.name) != getattr(parameters, entry.name)
    ]
    if trainer.seed != seed:
        differences.append(f"seed {trainer.seed} (now {seed})")
    if trainer.move_rule is not move_rule:
        differences.append(f"move_rule {trainer.move_rule.value} (now {move_rule.value})")
    if differences:
        raise CheckpointError(
            f"{folder} holds a training with {', '.join(differences)}; give those values to go on "
            "with it, or another folder"
        )
