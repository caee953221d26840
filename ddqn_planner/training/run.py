"""A training run: a trainer, and a folder for its episodes, checkpoint and model."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ddqn_planner.files import WorkFolder, write_atomically
from ddqn_planner.training.checkpoint import CHECKPOINT
from ddqn_planner.training.episodes import Progress, open_record, record
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.scenario import Scenario
from ddqn_planner.training.trainer import Trainer

SAVE_INTERVAL = 5_000  # environment steps between two checkpoints
LOCK = "training.lock"


class TrainingRun(WorkFolder):
    """Trains into a folder, or continues a training there.

    A ValueError says why the folder is not of this training.

    Attributes
    ----------
    requests : set of str
        "save": save after the present step. "stop": save then, and end.
    saved_at : int
        The step at which the run saved last, or began.
    model : bytes
        The model's file of the last save.
    stop_signal : int or None
        The number of the signal that requested the stop, if one did.
    """

    def __init__(
        self,
        folder: str | Path,
        scenarios: Sequence[Scenario],
        parameters: HyperParameters,
        seed: int,
        trainer_class: type[Trainer] = Trainer,
    ) -> None:
        """Lock a folder, and begin or continue a training there.

        Parameters
        ----------
        folder : path
            Made if it is missing. If it holds a checkpoint, that training continues.
        scenarios, parameters, seed
            The maps to train on, the hyper-parameters, and the seed of all random
            draws.
        trainer_class
            Makes the trainer.
        """
        after = f"the training continues and tries again every {SAVE_INTERVAL} steps"
        # A folder with one of the two files belongs to a training.
        super().__init__(folder, (LOCK, CHECKPOINT), "training", "trains", after)
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
        self.requests: set[str] = set()
        self.stop_signal: int | None = None
        self.saved_at = self.trainer.steps
        self.description = (
            f"training in {self.folder} from step {self.saved_at} to {parameters.steps}"
        )

    @property
    def is_complete(self) -> bool:
        """Whether the training has reached its last step."""
        return self.trainer.steps >= self.trainer.parameters.steps

    def stop_by_signal(self, number: int) -> None:
        """Request the run to stop, as the signal `number` has come."""
        self.requests.add("stop")
        self.stop_signal = number

    def steps(self, every: int | None = None) -> Iterator[Progress]:
        """Train to the last step or until `requests` has "stop"; save at intervals.

        A generator: it yields the progress as `Trainer.run` does, and also at each
        multiple of SAVE_INTERVAL steps. The caller may add to `requests` meanwhile.
        """
        last_step = self.trainer.parameters.steps
        with _memory_with_remedy():
            for progress in self._progress(every):
                for episode in progress.episodes:
                    self._record.append(record(episode))
                intervals = progress.step // SAVE_INTERVAL
                is_due = intervals != self.saved_at // SAVE_INTERVAL
                is_last = progress.step >= last_step  # saved below
                if (is_due or "save" in self.requests) and not is_last:
                    self.requests.discard("save")
                    self.try_to_save()
                yield progress
                if "stop" in self.requests:
                    break
            self._after = "then start it again: it continues from the last save"
            self.try_to_save()

    def _progress(self, every: int | None) -> Iterator[Progress]:
        """Yield the progress as `Trainer.run` does, and at each save interval."""
        trainer = self.trainer
        last_step = trainer.parameters.steps
        while trainer.steps < last_step:
            next_save = (trainer.steps // SAVE_INTERVAL + 1) * SAVE_INTERVAL
            yield from trainer.run(min(next_save, last_step), every)

    def try_to_save(self) -> None:
        """Write the model, the checkpoint and the episodes.

        After an OSError the old files stay, and `save_error` says why.
        """
        self.saved_at = self.trainer.steps
        self.model = self.trainer.model_bytes()
        with self.saving():
            # A kill between the two leaves a model that is newer than the checkpoint,
            # which does no harm.
            write_atomically(self.model_path, self.model)
            self.trainer.save_checkpoint(self.checkpoint_path)
            self._record.flush()


@contextmanager
def _memory_with_remedy() -> Iterator[None]:
    """Run a block; a MemoryError in it says what to make smaller."""
    try:
        yield
    except MemoryError as error:
        raise MemoryError(
            "the training does not fit into the memory; take a smaller map, or smaller "
            "filters, hidden_units, batch_size, environments, max_episode_steps or "
            "replay_capacity"
        ) from error
