"""A training run: a trainer with a folder for its episodes, its checkpoint and its model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, replace
from pathlib import Path

from ddqn_planner.files import WorkFolder
from ddqn_planner.grid import MoveRule
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.episodes import Episode, open_record, record
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import CheckpointError, Trainer

SAVE_INTERVAL = 5_000
"""Environment steps between two checkpoints."""

MARKS = LOCK, CHECKPOINT = "training.lock", "checkpoint.safetensors"
"""A folder with one of these files belongs to a training."""


class TrainingRun(WorkFolder):
    """Trains into a folder, or continues there when the folder holds a checkpoint.

    The run writes ``model.safetensors``, ``checkpoint.safetensors``, ``episodes.csv``, and
    ``training.lock``, which keeps other processes out until `close` or the end of the process. The
    folder must be new or empty, or belong to a training.

    A FolderError if it does not, or if another process trains there. A CheckpointError if the
    checkpoint cannot be read, or is one of another move rule or seed, or of other scenarios or
    parameters, except ``steps``. An OSError if the folder cannot be written. A MemoryError if the
    training does not fit into the memory, also from `steps`.
    """

    def __init__(
        self,
        folder: str | Path,
        scenarios: Sequence[Scenario],
        move_rule: MoveRule,
        parameters: HyperParameters,
        seed: int,
    ) -> None:
        after = f"the training continues and tries again every {SAVE_INTERVAL} steps"
        super().__init__(Path(folder), MARKS, "training", "trains", after)
        self.model_path = self.folder / "model.safetensors"
        self.checkpoint_path = self.folder / CHECKPOINT
        self.curves_path = self.folder / "episodes.csv"
        with self.opening() as files:
            with _memory_with_remedy():
                if self.checkpoint_path.exists():
                    self.trainer = Trainer.load_checkpoint(self.checkpoint_path, scenarios)
                    _check_same_training(self.trainer, move_rule, parameters, seed, self.folder)
                    self.trainer.parameters = parameters
                else:
                    self.trainer = Trainer(scenarios, move_rule, parameters, seed)
            self._record = open_record(self.curves_path, self.trainer.episodes)
            files.enter_context(closing(self._record))
        self.saved_at = self.trainer.steps
        self.description = (
            f"training in {self.folder} from step {self.trainer.steps} to {parameters.steps}"
        )

    def steps(self) -> Iterator[list[Episode]]:
        """Train until ``parameters.steps``; save every `SAVE_INTERVAL` steps and at the end.

        Yield the episodes that ended with each step. If a save fails, the training continues, and
        `save_error` says why until a save succeeds.
        """
        rules, until = self.trainer.environment.move_rules, self.trainer.parameters.steps
        with _memory_with_remedy():
            for finished in self.trainer.run(until):
                for episode in finished:
                    self._record.append(record(episode, rules[episode.scenario]))
                due = self.trainer.steps // SAVE_INTERVAL != self.saved_at // SAVE_INTERVAL
                if due and self.trainer.steps < until:
                    self.try_to_save()
                yield finished
            self.try_to_save()

    def try_to_save(self) -> None:
        """Write the model, the checkpoint and the episodes; if that fails, old files stay."""
        self.saved_at = self.trainer.steps
        with self.saving():
            # A kill between the two leaves a model that is newer than the checkpoint. Both are
            # complete, and nothing needs them to be of the same step.
            self.trainer.save_model(self.model_path)
            self.trainer.save_checkpoint(self.checkpoint_path)
            self._record.flush()


@contextmanager
def _memory_with_remedy() -> Iterator[None]:
    """Say what to do where the memory is too small, for torch too, which has no error for it."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "can't allocate memory" not in str(error):
            raise
        raise MemoryError(
            "the training does not fit into the memory; take a smaller map, or smaller filters, "
            "hidden_units, batch_size, environments or replay_capacity"
        ) from error


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
