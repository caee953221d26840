"""A training run: a trainer with a folder for its curves, its checkpoint and its model."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path

from ddqn_planner.files import write_csv
from ddqn_planner.grid import Cell, MoveRule, path_length
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import CheckpointError, Episode, Trainer

try:
    from torch.utils.tensorboard import SummaryWriter as TensorBoard
except ImportError:  # an extra: the curves are in the CSV file all the same
    TensorBoard = None  # type: ignore[assignment, misc]

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


class TrainingRun:
    """Trains into a folder, and goes on there when the folder holds a checkpoint.

    The folder gets ``model.safetensors``, ``checkpoint.safetensors``, ``episodes.csv`` (one row an
    episode, its cells as ``x:y``), and TensorBoard's curves where ``tensorboard`` is installed.

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
        self.folder.mkdir(parents=True, exist_ok=True)
        if self.checkpoint_path.exists():
            self.trainer = Trainer.load_checkpoint(self.checkpoint_path, scenarios)
            _check_same_training(self.trainer, move_rule, parameters, seed, self.folder)
            self.trainer.parameters = parameters
        else:
            self.trainer = Trainer(scenarios, move_rule, parameters, seed)
        self.saved_at = self.trainer.steps
        self.save_error = ""
        _cut_rows(self.curves_path, self.trainer.episodes)
        # Line-buffered: who reads the curves meanwhile, or after a crash, sees whole rows.
        self._curves = self.curves_path.open("a", buffering=1, newline="", encoding="utf-8")
        steps = self.trainer.steps
        self._board = None
        if TensorBoard is not None:
            self._board = TensorBoard(str(folder), purge_step=steps)

    @property
    def model_path(self) -> Path:
        """Where `save` writes the model."""
        return self.folder / "model.safetensors"

    @property
    def checkpoint_path(self) -> Path:
        """Where `save` writes the checkpoint."""
        return self.folder / "checkpoint.safetensors"

    @property
    def curves_path(self) -> Path:
        """Where the rows of the episodes are."""
        return self.folder / "episodes.csv"

    def steps(self) -> Iterator[list[Episode]]:
        """Train until ``parameters.steps``, and save every `SAVE_INTERVAL` steps and at the end.

        Where that fails the training goes on, and `save_error` says why.

        Yields
        ------
        list of Episode
            Those that ended with this step, often none; they are noted in the curves.
        """
        for finished in self.trainer.run(self.trainer.parameters.steps):
            for episode in finished:
                self._note(episode)
            if self.trainer.steps // SAVE_INTERVAL != self.saved_at // SAVE_INTERVAL:
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
            self.save_error = (
                f"cannot save to {self.folder} ({error}); make room or set its mode: the training "
                f"goes on and tries again every {SAVE_INTERVAL} steps"
            )

    def _note(self, episode: Episode) -> None:
        csv.writer(self._curves).writerow(_row(episode))
        if self._board is not None:
            self._board.add_scalar("average_reward", episode.average_reward, episode.step)
            self._board.add_scalar("episode_moves", episode.moves, episode.step)

    def save(self) -> None:
        """Write the model and the checkpoint.

        Raises
        ------
        OSError
            If one cannot be written; the last good ones are then still there.
        """
        self.trainer.save_model(self.model_path)
        self.trainer.save_checkpoint(self.checkpoint_path)
        self.saved_at = self.trainer.steps

    def close(self) -> None:
        """Close the curves. `save` first."""
        self._curves.close()
        if self._board is not None:
            self._board.close()


def read_cells(curves_path: str | Path, every: int) -> Iterator[tuple[Cell, ...]]:
    """Yield the cells of each `every`-th episode of a run's ``episodes.csv``.

    Raises
    ------
    OSError
        If the file cannot be read.
    """
    with Path(curves_path).open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            if int(row["episode"]) % every == 0:
                x_y = (cell.split(":") for cell in row["cells"].split())
                yield tuple((int(x), int(y)) for x, y in x_y)


def _row(episode: Episode) -> tuple[object, ...]:
    return (
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


def _cut_rows(path: Path, episodes: int) -> None:
    """Keep the header and the rows of the first episodes: those that the checkpoint knows."""
    rows = []
    if path.exists():
        with path.open(newline="", encoding="utf-8") as file:
            rows = [r for r in list(csv.reader(file))[1:] if len(r) == len(COLUMNS)]
    write_csv(path, COLUMNS, rows[:episodes])


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
