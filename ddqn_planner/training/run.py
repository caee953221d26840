"""A training run: a trainer with a folder for its episodes, its checkpoint and its model."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ddqn_planner.files import WorkFolder, write_atomically
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.episodes import Episode, open_record, record
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import Trainer

SAVE_INTERVAL = 5_000  # environment steps between two checkpoints
# A folder with one of these files belongs to a training.
MARKS = LOCK, CHECKPOINT = "training.lock", "checkpoint.safetensors"


class TrainingRun(WorkFolder):
    """Trains into a folder, or continues there; an error says why it cannot, or what differs."""

    def __init__(
        self,
        folder: str | Path,
        scenarios: Sequence[Scenario],
        parameters: HyperParameters,
        seed: int,
        trainer_class: type[Trainer] = Trainer,
    ) -> None:
        after = f"the training continues and tries again every {SAVE_INTERVAL} steps"
        super().__init__(folder, MARKS, "training", "trains", after)
        self.model_path = self.folder / "model.safetensors"
        self.checkpoint_path = self.folder / CHECKPOINT
        with self.opening(), _memory_with_remedy():
            self.trainer = trainer_class(scenarios, parameters, seed)
            if self.checkpoint_path.exists():
                self.trainer.restore(self.checkpoint_path)
            self._record = open_record(
                self.folder / "episodes.csv", self.trainer.episodes
            )
            self.callback(self._record.close)
        self.asked: set[str] = set()  # to save after the step under way, to stop
        first = self.saved_at = self.trainer.steps
        self.description = (
            f"training in {self.folder} from step {first} to {parameters.steps}"
        )

    def steps(self, every: int = SAVE_INTERVAL) -> Iterator[list[Episode]]:
        """Train until the end or "stop" is asked for, and save; yield as `Trainer.run` does."""
        until = self.trainer.parameters.steps
        with _memory_with_remedy():
            for finished in self.trainer.run(until, every):
                for episode in finished:
                    self._record.append(record(episode))
                due = (
                    self.trainer.steps // SAVE_INTERVAL
                    != self.saved_at // SAVE_INTERVAL
                )
                if (due or "save" in self.asked) and self.trainer.steps < until:
                    self.asked.discard("save")
                    self.try_to_save()
                yield finished
                if "stop" in self.asked:
                    break
            self.try_to_save()

    def try_to_save(self) -> None:
        """Write the model, the checkpoint and the episodes; if that fails, old files stay."""
        self.saved_at, self.model = self.trainer.steps, self.trainer.model_bytes()
        with self.saving():
            # A kill between the two leaves a model that is newer than the checkpoint: no harm.
            write_atomically(self.model_path, self.model)
            self.trainer.save_checkpoint(self.checkpoint_path)
            self._record.flush()


@contextmanager
def _memory_with_remedy() -> Iterator[None]:
    """Say what to do where the memory is too small."""
    try:
        yield
    except MemoryError as error:
        raise MemoryError(
            "the training does not fit into the memory; take a smaller map, or smaller filters, "
            "hidden_units, batch_size, environments, max_episode_steps or replay_capacity"
        ) from error
