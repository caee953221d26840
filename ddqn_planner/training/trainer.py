"""The training loop: episodes in, a Q-network out. Checkpoints resume it exactly."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
import safetensors.numpy
import torch
from numpy.typing import NDArray
from safetensors import safe_open

from ddqn_planner.files import as_path, differences, write_atomically
from ddqn_planner.grid import MOVES
from ddqn_planner.grid.arguments import as_seed, as_whole, listed
from ddqn_planner.interrupts import interrupts_wait
from ddqn_planner.model import (
    NETWORKS,
    ModelMetadata,
    PropagationQNetwork,
    QNetwork,
    model_bytes,
)
from ddqn_planner.planning import Planner
from ddqn_planner.training.checkpoint import (
    CHECKPOINT_KEY,
    DIGEST_KEY,
    CheckpointError,
    check_checkpoint,
    digest_of,
    reason_of,
)
from ddqn_planner.training.compiled_learner import Counters, play, training_of
from ddqn_planner.training.double_dqn import (
    NextQ,
    Q,
    ReplayBuffer,
    Transitions,
    next_q,
)
from ddqn_planner.training.environment import GridVectorEnvironment
from ddqn_planner.training.episodes import Episode, EpisodeEnd, Progress
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.propagation import PropagationLearner
from ddqn_planner.training.scenario import Scenario
from ddqn_planner.version import __version__

MOST_STEPS = 10**12  # of a training


class Learned(NamedTuple):
    """All that an update changes: tensors by name, of the same names in each."""

    online: dict[str, NDArray[np.float32]]  # θ
    target: dict[str, NDArray[np.float32]]  # θ⁻
    mean: dict[str, NDArray[np.float32]]  # Adam's moments of the gradient
    square: dict[str, NDArray[np.float32]]


class Learner(Protocol):
    """Updates the network of a trainer, and evaluates it."""

    def q_values(
        self, scenario: NDArray[np.int64], cell: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """Return Q(s, a), (B, 8), of robots in cells (B,) of maps `scenario` (B,)."""

    def update(self, batch: Transitions, number: int, learning_rate: float) -> None:
        """Change the weights by a batch; `number` counts the updates, from 1 on."""

    def settle(self) -> None:
        """Take over weights that were changed from outside."""


class Trainer:
    """Trains a Q-network by Double DQN.

    The same arguments give the same network, bit for bit.

    Examples
    --------
    >>> import numpy as np
    >>> from ddqn_planner import GridMap
    >>> from ddqn_planner.training import HyperParameters, Scenario, Trainer
    >>> scenario = Scenario(GridMap(np.zeros((4, 5))), (0, 0), (4, 3))
    >>> trainer = Trainer([scenario], HyperParameters(steps=200), seed=0)
    >>> [progress.step for progress in trainer.run(every=100)]
    [100, 200]
    >>> planner = trainer.planner()
    """

    # What moves the robots, and shows them their maps.
    environment_class: ClassVar[type[GridVectorEnvironment]] = GridVectorEnvironment

    def __init__(
        self,
        scenarios: Sequence[Scenario],
        parameters: HyperParameters | None = None,
        seed: int = 0,
    ) -> None:
        """Make a network of random weights, and put all robots at their first cells.

        Parameters
        ----------
        scenarios : sequence of Scenario
            The maps to train on, all of one size, with their starts and goals.
        parameters : HyperParameters, optional
            By default the paper's.
        seed : int
            Of all random draws: 0 to 2^63 - 1.
        """
        self.scenarios = tuple(
            listed(scenarios, "the scenarios", "give a list of Scenario")
        )
        if parameters is None:
            parameters = HyperParameters()
        self.parameters = parameters
        self.seed = as_seed(seed)
        self.steps = 0
        self.updates = 0
        self.episodes = 0
        self._new_episodes: list[Episode] = []  # that no progress has reported yet
        self.last_progress: Progress | None = None  # that `run` has yielded

        weight_seed, *generator_seeds = np.random.SeedSequence(self.seed).spawn(4)
        # They draw initial cells, actions, and batches.
        self._generators = [np.random.default_rng(seed) for seed in generator_seeds]
        initial, self._exploration, self._sampling = self._generators
        self.environment = self.environment_class(self.scenarios, parameters, initial)
        self.network = self._initial_network(int(weight_seed.generate_state(1)[0]))
        tensors = self.network.tensors
        self.learned = Learned(
            online=tensors,
            target={name: np.copy(tensor) for name, tensor in tensors.items()},
            mean={name: np.zeros_like(tensor) for name, tensor in tensors.items()},
            square={name: np.zeros_like(tensor) for name, tensor in tensors.items()},
        )
        # The average of θ by name; empty without `weight_averaging`.
        self.average: dict[str, NDArray[np.float32]] = {}
        if parameters.weight_averaging > 0:
            self.average = {name: np.copy(tensor) for name, tensor in tensors.items()}
        self.replay = ReplayBuffer(parameters.replay_capacity)
        self.environment.reset()
        # The paper's network learns in compiled code, and has no learner.
        self.learner: Learner | None = None
        if isinstance(self.network, PropagationQNetwork):
            self.learner = PropagationLearner(
                self.network, self.learned, self.environment, self.next_q
            )
        else:
            self._training = training_of(
                self.learned, self.average, self.environment, self.replay, self.next_q
            )

    def __repr__(self) -> str:
        """Return how far the training has come, and of what, in one line."""
        height, width = self.environment.shape
        maps = len(self.scenarios)
        return (
            f"{type(self).__name__}(step {self.steps:,} of {self.parameters.steps:,}, "
            f"{self.episodes:,} episodes, network {self.parameters.network}, "
            f"{maps} {'map' if maps == 1 else 'maps'} of {width} x {height} cells, "
            f"seed {self.seed})"
        )

    def _initial_network(self, seed: int) -> QNetwork:
        """Return the network that the parameters name, with random weights."""
        network_class = NETWORKS[self.parameters.network]
        height, width = self.environment.shape
        values = {**asdict(self.parameters), "height": height, "width": width}
        sizes = {name: values[name] for name in network_class.size_names}
        tensors = _initial_tensors(network_class.shapes(sizes), seed)
        network = network_class(sizes, tensors)
        # A network sets small cost weights to 0, which is right after training alone.
        network.tensors = tensors
        return network

    def next_q(self, online_BA: Q, target_BA: Q) -> NextQ:
        """Return which Q of the next states the target uses, see `next_q`."""
        return next_q(self.parameters.target, online_BA, target_BA)

    @property
    def epsilon(self) -> float:
        """Present probability of a random action: it falls linearly, then stays."""
        p = self.parameters
        fraction = min(self.steps / p.epsilon_steps, 1.0)
        return p.epsilon_start + fraction * (p.epsilon_end - p.epsilon_start)

    @property
    def learning_rate(self) -> float:
        """Present learning rate of the updates."""
        return self.parameters.learning_rate_at(self.steps)

    @property
    def has_diverged(self) -> bool:
        """Whether a weight of the network is not finite."""
        tensors = self.network.tensors.values()
        return not all(np.isfinite(tensor).all() for tensor in tensors)

    def run(
        self, until: int | None = None, every: int | None = None
    ) -> Iterator[Progress]:
        """Train, and yield the progress again and again: a generator.

        A training stops when nobody asks for more progress, and a later call continues
        it. After Ctrl-C in the loop, too, nothing is lost.

        Parameters
        ----------
        until : int, optional
            The last step, counted from the beginning of the training; by default
            `steps` of the hyper-parameters.
        every : int, optional
            Yield at each multiple of so many steps, and at the last step. By default
            yield each time that an episode ends, and within some milliseconds.

        Yields
        ------
        Progress
            With the episodes that have ended since the last progress.
        """
        if until is None:
            until = self.parameters.steps
        last_step = as_whole("until", until, 0, MOST_STEPS)
        if every is not None:
            every = as_whole("every", every, 1, MOST_STEPS)
        return self._run(last_step, every)

    def _run(self, last_step: int, every: int | None) -> Iterator[Progress]:
        """Yield what `run` yields; the arguments are checked."""
        while self.steps < last_step:
            next_stop = last_step
            if every is not None:
                next_multiple = (self.steps // every + 1) * every
                next_stop = min(last_step, next_multiple)
            with interrupts_wait():
                self._advance(next_stop)
            if every is None or self.steps >= next_stop:
                yield self._progress()

    def _advance(self, last_step: int) -> None:
        """Make some steps, up to `last_step`, until an episode ends at the latest."""
        if self.learner is None:
            self._play(last_step)
        else:
            self._step(self.learner)
        self._new_episodes += self._end_episodes()

    def _progress(self) -> Progress:
        """Return the present progress, with the new episodes."""
        episodes = tuple(self._new_episodes)
        self._new_episodes.clear()
        self.last_progress = Progress(
            step=self.steps,
            updates=self.updates,
            episodes=episodes,
            epsilon=self.epsilon,
            learning_rate=self.learning_rate,
        )
        return self.last_progress

    def _play(self, last_step: int) -> None:
        """Make some steps in compiled code, and the updates that fall due.

        They end when an episode ends, or at step `last_step` of the training.
        """
        counters = Counters(self.steps, self.updates, self.replay.added)
        counters = play(
            self._training, self._exploration, self._sampling, counters, last_step
        )
        self.steps, self.updates, self.replay.added = counters

    def _step(self, learner: Learner) -> None:
        """Make a step of each robot, and then the updates that fall due.

        `learner` evaluates the network, and updates it.
        """
        environment = self.environment
        p = self.parameters
        scenario = environment.scenario
        cell = environment.cell.copy()
        action = self._exploration.integers(len(MOVES), size=p.environments)
        is_greedy = self._exploration.random(p.environments) >= self.epsilon
        if is_greedy.any():
            best_action = learner.q_values(scenario, cell).argmax(axis=1)
            action = np.where(is_greedy, best_action, action)
        outcome = environment.move(action)
        transitions = Transitions(
            scenario=scenario,
            cell=cell,
            action=action,
            reward=outcome.reward,
            next_cell=environment.cell,
            discount=np.where(outcome.terminated, 0.0, p.gamma).astype(np.float32),
        )
        self.replay.add(transitions)
        # An update is due for each multiple of the interval that these steps pass.
        multiples_before = self.steps // p.update_interval
        self.steps += p.environments
        updates_due = self.steps // p.update_interval - multiples_before
        if self.steps > p.learning_starts:
            for _ in range(updates_due):
                self.updates += 1
                batch = self.replay.sample(p.batch_size, self._sampling)
                learner.update(batch, self.updates, self.learning_rate)

    def _end_episodes(self) -> list[Episode]:
        """Return the episodes that have ended, and start new ones in their place."""
        has_ended = self.environment.terminated | self.environment.truncated
        episodes = []
        for robot in np.flatnonzero(has_ended).tolist():
            self.episodes += 1
            episodes.append(self._episode(robot))
        if episodes:
            self.environment.reset(has_ended)
        return episodes

    def _episode(self, robot: int) -> Episode:
        """Return the episode of robot number `robot`, which has just ended."""
        environment = self.environment
        _, width = environment.shape
        scenario = int(environment.scenario[robot])
        moves = int(environment.steps[robot])
        numbers = environment.visited[robot, : moves + 1].tolist()  # y * width + x
        if numbers[-1] == environment.goal[scenario]:
            outcome = EpisodeEnd.REACHED_GOAL
        elif environment.terminated[robot]:
            outcome = EpisodeEnd.COLLIDED
            numbers.pop()  # the cell in which the robot stayed
        else:
            outcome = EpisodeEnd.OUT_OF_STEPS
        return Episode(
            number=self.episodes,
            step=self.steps,
            scenario=scenario,
            outcome=outcome,
            cells=tuple((number % width, number // width) for number in numbers),
            moves=moves,
            total_reward=float(environment.total_reward[robot]),
        )

    def planner(self) -> Planner:
        """Return a planner with a copy of the network as it is now."""
        network = self.network
        scenario = self.scenarios[0]
        metadata = ModelMetadata(
            network=self.parameters.network,
            sizes=network.sizes,
            move_rule=scenario.move_rule,
            gamma=self.parameters.gamma,
            map_fingerprint=scenario.grid.fingerprint,
            steps=self.steps,
            seed=self.seed,
            package_version=__version__,
        )
        weights = self.average or network.tensors
        tensors = {name: tensor.copy() for name, tensor in weights.items()}
        return Planner(type(network)(network.sizes, tensors), metadata)

    def model_bytes(self) -> bytes:
        """Return the bytes of a model file with the present network.

        A ValueError if the training diverged: a weight is not finite.
        """
        if self.has_diverged:
            remedy = "train into another folder with a smaller learning_rate"
            raise ValueError(
                f"the training diverged, and nothing more is saved; {remedy}"
            )
        planner = self.planner()
        return model_bytes(planner.network, planner.metadata)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how a copy is made: a new trainer takes over this one's state.

        Compiled code shares memory with the arrays, which copies of them would not.
        """
        arrays = {name: tensor.copy() for name, tensor in self.arrays().items()}
        state = self._description(), arrays
        return type(self), (self.scenarios, self.parameters, self.seed), state

    def __setstate__(
        self, state: tuple[dict[str, Any], dict[str, NDArray[Any]]]
    ) -> None:
        """Take over the description and the arrays of another trainer."""
        description, arrays = state
        self._restore_counters(description)
        for name, tensor in self.arrays().items():
            tensor[...] = arrays[name]
        self._restore_episodes(description)

    def _description(self) -> dict[str, Any]:
        """Return all of a checkpoint but its arrays, see `arrays`, as a JSON object.

        The keys are those of the first version, so that old checkpoints load.
        """
        environment = self.environment
        paths = [
            cells[: moves + 1].tolist()
            for cells, moves in zip(environment.visited, environment.steps, strict=True)
        ]
        scenarios = [
            [scenario.grid.fingerprint, [*scenario.start], [*scenario.goal]]
            for scenario in self.scenarios
        ]
        states = [generator.bit_generator.state for generator in self._generators]
        return {
            "seed": self.seed,
            "move_rule": self.scenarios[0].move_rule.value,
            "parameters": asdict(self.parameters),
            "scenarios": scenarios,
            # In the order in which `_restore_arrays` reads them.
            "counters": [self.steps, self.updates, self.episodes, self.replay.added],
            "walked": paths,  # the cells of each robot's unfinished episode
            "generators": states,
        }

    def save_checkpoint(self, path: str | Path) -> None:
        """Write all that `restore` needs; after an OSError an old file is unchanged."""
        # The file has arrays in the order of C alone.
        tensors = {
            name: np.asarray(tensor, order="C")
            for name, tensor in self.arrays().items()
        }
        text = json.dumps(self._description())
        metadata = {CHECKPOINT_KEY: text, DIGEST_KEY: digest_of(text, tensors)}
        write_atomically(as_path(path), safetensors.numpy.save(tensors, metadata))

    def restore(self, path: str | Path) -> None:
        """Continue from the checkpoint at `path`, which must be of this training.

        The checkpoint's parameters may differ in `steps` alone. A learning rate that
        falls then follows the new number of steps.

        Raises
        ------
        CheckpointError
            If there is no such file, it is not a complete checkpoint, or one of another
            training. Then this trainer may have read a part of it, and must not be used
            any more.
        """
        path = as_path(path, "the checkpoint")
        check_checkpoint(path)
        try:
            with safe_open(path, framework="np") as file:
                metadata = file.metadata()
                description = json.loads(metadata[CHECKPOINT_KEY])
                self._check_training(description)
                self._restore_counters(description)
                self._restore_arrays(file)
            digest = digest_of(metadata[CHECKPOINT_KEY], self.arrays())
            if metadata[DIGEST_KEY] != digest:
                raise ValueError("its digest is another")
            self._restore_episodes(description)
        except CheckpointError as error:
            raise CheckpointError(
                f"{path}: {error}, or train into another folder"
            ) from None
        except MemoryError:
            raise
        except Exception as error:  # a broken file can raise any error in the libraries
            raise CheckpointError(
                f"{path}: is no complete checkpoint ({reason_of(error)}); remove it to "
                "train anew, or train into another folder"
            ) from error

    def _check_training(self, saved: dict[str, Any]) -> None:
        """Raise a CheckpointError unless a saved `_description` is of this training."""
        current = self._description()
        if saved["scenarios"] != current["scenarios"]:
            raise CheckpointError(
                "was made with another map, start or goal; give that one"
            )
        # How long a training takes may change, and old files lack new parameters. The
        # learning rate of trainings before 0.5.0 did not fall.
        defaults = {"learning_rate_decay": 1.0}
        values = defaults | saved["parameters"] | {"steps": self.parameters.steps}
        saved_options = saved | asdict(HyperParameters(**values))
        options = {
            "seed": current["seed"],
            "move_rule": current["move_rule"],
            **current["parameters"],
        }
        changed = differences(saved_options, options)
        if changed:
            raise CheckpointError(f"was made with {changed}; give those values")

    def _restore_counters(self, saved: dict[str, Any]) -> None:
        """Set the counters of a saved `_description`.

        They come first, as they tell which arrays there are, and of which sizes.
        """
        counters = saved["counters"]
        self.steps, self.updates, self.episodes, self.replay.added = counters

    def _restore_arrays(self, file: Any) -> None:
        """Read the arrays of a checkpoint, an open safetensors file.

        The arrays are read into the memory of this trainer.
        """
        tensors = self.arrays()
        shapes = {name: [*tensor.shape] for name, tensor in tensors.items()}
        # Before any is read: a small sparse file can claim tensors of any size.
        saved_shapes = {
            name: file.get_slice(name).get_shape()
            for name in file.keys()  # noqa: SIM118
        }
        if saved_shapes != shapes:
            raise ValueError("its tensors have other names or shapes")
        for name, tensor in tensors.items():
            tensor[...] = file.get_tensor(name)

    def _restore_episodes(self, saved: dict[str, Any]) -> None:
        """Restore the cells of unfinished episodes, and the random generators.

        `saved` is a `_description`. The arrays were restored before.
        """
        paths = zip(self.environment.visited, saved["walked"], strict=True)
        for visited, cells in paths:
            visited[: len(cells)] = cells
        states = zip(self._generators, saved["generators"], strict=True)
        for generator, state in states:
            generator.bit_generator.state = state
        if self.learner is not None:
            self.learner.settle()

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a checkpoint; they share the trainer's memory."""
        learned = self.learned
        environment = self.environment
        tensors: dict[str, NDArray[Any]] = {
            "environment.scenario": environment.scenario,
            "environment.cell": environment.cell,
            "environment.steps": environment.steps,
            "total_reward": environment.total_reward,
        }
        for name in learned.online:
            tensors[f"network.{name}"] = learned.online[name]
            tensors[f"target.{name}"] = learned.target[name]
        for name, tensor in self.average.items():
            tensors[f"average.{name}"] = tensor
        for name, values in self.replay.transitions._asdict().items():
            tensors[f"replay.{name}"] = values[: len(self.replay)]
        if self.parameters.priority > 0:
            tensors["replay.error"] = self.replay.error[: len(self.replay)]
        if self.updates:
            # As torch's optimisers name them.
            for number, name in enumerate(learned.online):
                optimiser = f"optimiser.{number}"
                tensors[f"{optimiser}.step"] = np.array(self.updates, np.float32)
                tensors[f"{optimiser}.exp_avg"] = learned.mean[name]
                tensors[f"{optimiser}.exp_avg_sq"] = learned.square[name]
        return tensors


def _initial_tensors(
    shapes: Mapping[str, tuple[int, ...]], seed: int
) -> dict[str, NDArray[np.float32]]:
    """Return random weights and biases by name, drawn as torch draws them for layers.

    `shapes` are those of all tensors, ``LAYER.weight`` and ``LAYER.bias``. The same
    `seed` gives the same weights.
    """
    generator = torch.Generator().manual_seed(seed)
    tensors = {}
    for name, shape in shapes.items():
        layer, _, _ = name.partition(".")  # of "layer.weight" or "layer.bias"
        inputs = math.prod(shapes[f"{layer}.weight"][1:])
        bound = inputs**-0.5
        tensor = np.empty(shape, np.float32)
        torch.from_numpy(tensor).uniform_(-bound, bound, generator=generator)
        if name == "prices.bias":
            # A cost multiplier below 1 has no gradient: it must begin above.
            tensor[:] = 1
        tensors[name] = tensor
    return tensors
