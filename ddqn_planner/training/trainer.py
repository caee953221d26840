"""The training loop: episodes in, a Q-network out. Logging and checkpoints consume the loop."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from numpy.typing import NDArray
from safetensors import safe_open
from torch import Tensor

from ddqn_planner.files import write_atomically
from ddqn_planner.grid import MOVES, Cell, MoveRule
from ddqn_planner.model import ModelMetadata, package_version, save_model
from ddqn_planner.planning import Planner
from ddqn_planner.training import ranks
from ddqn_planner.training.double_dqn import double_dqn_loss
from ddqn_planner.training.encoders import ENCODERS
from ddqn_planner.training.environment import GridVectorEnvironment, Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.memory import MemoryShortageError, check_memory
from ddqn_planner.training.networks import TrainableNetwork
from ddqn_planner.training.replay_buffer import ReplayBuffer, Transitions

CHECKPOINT_KEY = "ddqn_planner_checkpoint"
DIGEST_KEY = "sha256"

DTYPES = {torch.float32: "F32", torch.float64: "F64", torch.int64: "I64"}
"""As safetensors names them."""

FUSED = tuple(map(int, torch.__version__.split(".")[:2])) >= (2, 4)
"""Adam in one call, which older versions have on GPUs alone."""


class CheckpointError(ValueError):
    """A checkpoint cannot be resumed; the message says why and what to do."""


class Outcome(str, Enum):
    """How an episode ended."""

    REACHED_GOAL = "reached_goal"
    COLLIDED = "collided"
    OUT_OF_STEPS = "out_of_steps"


@dataclass(frozen=True)
class Episode:
    """An episode as it was walked (the paper's round)."""

    number: int
    """1 for the first."""
    step: int
    """Environment steps of the training when it ended."""
    scenario: int
    """Number of its scenario."""
    outcome: Outcome
    cells: tuple[Cell, ...]
    """The cells entered, the initial one included."""
    moves: int
    """Moves made, an illegal one included."""
    total_reward: float

    @property
    def average_reward(self) -> float:
        """Reward a step, the paper's curve (Fig. 6)."""
        return self.total_reward / self.moves


class Trainer:
    """Trains a Q-network by Double DQN.

    The same scenarios, parameters and seed give the same network, bit for bit, also when the
    training was interrupted by `save_checkpoint` and `load_checkpoint`.

    Parameters
    ----------
    scenarios : sequence of Scenario
        Maps of one size; each episode draws one of them.
    move_rule : MoveRule
    parameters : HyperParameters
    seed : int
        At least 0.
    """

    def __init__(
        self,
        scenarios: Sequence[Scenario],
        move_rule: MoveRule,
        parameters: HyperParameters,
        seed: int,
    ) -> None:
        self.scenarios = tuple(scenarios)
        self.move_rule = move_rule
        self.parameters = parameters
        self.seed = seed
        self.steps = 0
        self.updates = 0
        self.episodes = 0

        # The processes of a training share their first weights, and draw all else by themselves.
        seeds = np.random.SeedSequence(seed).spawn(1 + 3 * ranks.world_size())
        weights, (environment, exploration, replay) = seeds[0], seeds[1 + 3 * ranks.rank() :][:3]
        self.environment = GridVectorEnvironment(self.scenarios, move_rule, parameters)
        self.environment.np_random = np.random.default_rng(environment)
        self._exploration = np.random.default_rng(exploration)
        self._sampling = np.random.default_rng(replay)
        self._encoder = ENCODERS[parameters.network](self.environment)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(weights.generate_state(1)[0]))
            sizes = parameters.network_sizes(self.environment.shape)
            self.network = self._encoder.module_class(**sizes)
        self._target = copy.deepcopy(self.network).requires_grad_(False)
        self._encoder.update_target(self._target)
        self._weights = tuple(self.network.parameters())
        self._optimiser = torch.optim.Adam(self._weights, parameters.learning_rate, fused=FUSED)
        self._replay = ReplayBuffer(parameters.replay_capacity)

        self.environment.begin(np.ones(parameters.environments, dtype=np.bool_))
        self._walked: list[list[int]] = [[int(cell)] for cell in self.environment.cell]
        self._total_reward = np.zeros(parameters.environments)

    @property
    def epsilon(self) -> float:
        """Probability of a random action now: it falls linearly, then stays."""
        p = self.parameters
        fraction = min(self.steps / p.epsilon_steps, 1.0)
        return p.epsilon_start + fraction * (p.epsilon_end - p.epsilon_start)

    def run(self, until: int) -> Iterator[list[Episode]]:
        """Train until `until` environment steps are made in all.

        Yields
        ------
        list of Episode
            Those that ended with this step, often none. Between two steps the trainer is whole:
            it can be saved there, and the loop be left.
        """
        p = self.parameters
        while self.steps < until:
            scenario, cell = self.environment.scenario.copy(), self.environment.cell
            actions = self._choose_actions()
            moved = self.environment.move(actions)
            discount = np.where(moved.terminated, 0.0, p.gamma).astype(np.float32)
            self._replay.add(
                Transitions(scenario, cell, actions, moved.reward, moved.cell, discount)
            )
            before, self.steps = self.steps, self.steps + p.environments
            if self.steps > p.learning_starts:
                for _ in range(self.steps // p.update_interval - before // p.update_interval):
                    self._update()
            self._total_reward += moved.reward
            for walked, entered in zip(self._walked, moved.cell.tolist(), strict=True):
                walked.append(entered)
            ended = moved.terminated | moved.truncated
            yield self._begin_again(ended, moved.terminated) if ended.any() else []

    def _choose_actions(self) -> NDArray[np.int64]:
        """Draw ε-greedy actions, ε for each environment by itself."""
        environment = self.environment
        count = self.parameters.environments
        actions = self._exploration.integers(len(MOVES), size=count)
        greedy = self._exploration.random(count) >= self.epsilon
        if greedy.any():
            with torch.inference_mode():
                q_NA = self._q(self.network)(
                    self._encoder.states(environment.scenario, environment.cell)
                )
            actions[greedy] = q_NA.argmax(dim=1).numpy()[greedy]
        return actions

    def _update(self) -> None:
        """Make one Double DQN update on a batch from the replay buffer."""
        p = self.parameters
        batch = self._replay.sample(p.batch_size, self._sampling)
        states = self._encoder.states(
            np.tile(batch.scenario, 2), np.concatenate([batch.cell, batch.next_cell])
        )
        state, next_state = states.chunk(2)
        online, target = self._q(self.network), self._q(self._target)
        selection, evaluation = {
            "double_dqn": (online, target),
            "dqn": (target, target),
            "printed": (online, online),
        }[p.target]
        loss = double_dqn_loss(
            online,
            selection,
            evaluation,
            state,
            torch.from_numpy(batch.action),
            torch.from_numpy(batch.reward),
            next_state,
            torch.from_numpy(batch.discount),
        )
        # Not backward(): nothing is accumulated, and so nothing must be zeroed.
        gradients = ranks.average(torch.autograd.grad(loss, self._weights))
        for weight, gradient in zip(self._weights, gradients, strict=True):
            weight.grad = gradient
        self._optimiser.step()
        self.updates += 1
        if self.updates % p.target_interval == 0:
            self._target.load_state_dict(self.network.state_dict())
            self._encoder.update_target(self._target)

    def _q(self, network: TrainableNetwork) -> Callable[[Tensor], Tensor]:
        return partial(self._encoder.q, network)

    def _begin_again(
        self, ended: NDArray[np.bool_], terminated: NDArray[np.bool_]
    ) -> list[Episode]:
        """Begin new episodes where they ended, and return those that did."""
        environment, finished = self.environment, []
        for index in np.flatnonzero(ended):
            self.episodes += 1
            finished.append(self._episode(int(index), terminated[index]))
        environment.begin(ended)
        for index in np.flatnonzero(ended):
            self._walked[index] = [int(environment.cell[index])]
            self._total_reward[index] = 0.0
        return finished

    def _episode(self, index: int, terminated: np.bool_) -> Episode:
        environment, walked = self.environment, self._walked[index]
        width = environment.shape[1]
        scenario = int(environment.scenario[index])
        if not terminated:
            outcome = Outcome.OUT_OF_STEPS
        elif walked[-1] == environment.goal[scenario]:
            outcome = Outcome.REACHED_GOAL
        else:
            outcome = Outcome.COLLIDED
        entered = walked[:-1] if outcome is Outcome.COLLIDED else walked
        return Episode(
            number=self.episodes,
            step=self.steps,
            scenario=scenario,
            outcome=outcome,
            cells=tuple((cell % width, cell // width) for cell in entered),
            moves=len(walked) - 1,
            total_reward=float(self._total_reward[index]),
        )

    def planner(self) -> Planner:
        """Return a planner with a copy of the network as it is now."""
        return Planner(self.network.to_numpy(), self.metadata())

    def metadata(self) -> ModelMetadata:
        """Return what a model file says of the network as it is now."""
        return ModelMetadata(
            network=self.parameters.network,
            sizes=self.network.sizes,
            move_rule=self.move_rule,
            gamma=self.parameters.gamma,
            map_fingerprint=self.scenarios[0].grid.fingerprint,
            steps=self.steps,
            seed=self.seed,
            package_version=package_version(),
        )

    def save_model(self, path: str | Path) -> None:
        """Write the network as it is now to a model file; see `save_model` for errors."""
        save_model(path, self.network.to_numpy(), self.metadata())

    def save_checkpoint(self, path: str | Path) -> None:
        """Write all that `load_checkpoint` needs to go on as if nothing had happened.

        Raises
        ------
        OSError
            If the file cannot be written; the one before it is then untouched.
        """
        tensors = self._tensors(self._optimiser.state_dict()["state"])
        description = {
            "seed": self.seed,
            "move_rule": self.move_rule,
            "parameters": asdict(self.parameters),
            "scenarios": _fingerprints(self.scenarios),
            "counters": [self.steps, self.updates, self.episodes, self._replay.added],
            "walked": self._walked,
            "generators": [generator.bit_generator.state for generator in self._generators()],
        }
        text = json.dumps(description)
        metadata = {CHECKPOINT_KEY: text, DIGEST_KEY: _digest(text, tensors)}
        content = safetensors.torch.save(tensors, metadata)
        write_atomically(Path(path), content)

    def _tensors(self, optimiser: dict[int, dict[str, Tensor]]) -> dict[str, Tensor]:
        """Return all that a checkpoint holds, with a given state of the optimiser."""
        environment = self.environment
        tensors = _prefixed("network", self.network.state_dict())
        tensors |= _prefixed("target", self._target.state_dict())
        for index, state in optimiser.items():
            tensors |= _prefixed(f"optimiser.{index}", state)
        stored = Transitions._make(
            values[: len(self._replay)] for values in self._replay.transitions
        )
        arrays = {f"replay.{name}": values for name, values in stored._asdict().items()}
        arrays |= {
            "environment.scenario": environment.scenario,
            "environment.cell": environment.cell,
            "environment.steps": environment.steps,
            "total_reward": self._total_reward,
        }
        tensors |= {name: torch.from_numpy(values) for name, values in arrays.items()}
        return {name: tensor.contiguous() for name, tensor in tensors.items()}

    def _layout(self) -> dict[str, tuple[str, list[int]]]:
        """Return the type and shape of each tensor of a checkpoint with the counters as now."""
        state = {
            index: {"step": torch.zeros(()), "exp_avg": weight, "exp_avg_sq": weight}
            for index, weight in enumerate(self._weights if self.updates else ())
        }
        tensors = self._tensors(state)
        return {name: (DTYPES[t.dtype], [*t.shape]) for name, t in tensors.items()}

    @classmethod
    def load_checkpoint(cls, path: str | Path, scenarios: Sequence[Scenario]) -> Trainer:
        """Return the trainer that `save_checkpoint` wrote.

        Parameters
        ----------
        path : str or Path
        scenarios : sequence of Scenario
            The same as those of the saved trainer; a checkpoint holds no maps.

        Raises
        ------
        CheckpointError
            If the file is missing, broken or no checkpoint, or was made with other scenarios.
        MemoryShortageError
            If its training cannot fit into the memory.
        """
        try:
            with safe_open(path, framework="pt") as file:
                metadata = file.metadata() or {}
                text = metadata[CHECKPOINT_KEY]
                description = json.loads(text)
                if description["scenarios"] != _fingerprints(scenarios):
                    raise CheckpointError(
                        f"{path}: was made with another map, start or goal; give that one, or "
                        "train into another folder"
                    )
                parameters = HyperParameters(**description["parameters"])
                check_memory(scenarios, parameters)
                rule = MoveRule(description["move_rule"])
                trainer = cls(scenarios, rule, parameters, description["seed"])
                trainer._count(description)
                slices = {key: file.get_slice(key) for key in file.keys()}  # noqa: SIM118
                found = {key: (part.get_dtype(), part.get_shape()) for key, part in slices.items()}
                # Before one is read: a small file may claim, and hold as holes, any size.
                if found != trainer._layout():
                    raise ValueError("its tensors have other names, types or shapes")
                tensors = {key: file.get_tensor(key) for key in found}
            if metadata[DIGEST_KEY] != _digest(text, tensors):
                raise ValueError("its digest is another")
            trainer._restore(description, tensors)
        except (CheckpointError, MemoryShortageError):
            raise
        except Exception as error:  # whatever a broken file does to those who read it
            raise CheckpointError(
                f"{path}: is no whole checkpoint ({error!r}); remove it to train anew, or train "
                "into another folder"
            ) from error
        return trainer

    def _count(self, description: dict[str, Any]) -> None:
        self.steps, self.updates, self.episodes, self._replay.added = description["counters"]

    def _restore(self, description: dict[str, Any], tensors: dict[str, Tensor]) -> None:
        self.network.load_state_dict(_unprefixed("network", tensors))
        self._target.load_state_dict(_unprefixed("target", tensors))
        self._encoder.update_target(self._target)
        optimiser = self._optimiser.state_dict()
        count = len(optimiser["param_groups"][0]["params"]) if self.updates else 0
        optimiser["state"] = {
            index: _unprefixed(f"optimiser.{index}", tensors) for index in range(count)
        }
        self._optimiser.load_state_dict(optimiser)
        for name, values in self._replay.transitions._asdict().items():
            values[: len(self._replay)] = tensors[f"replay.{name}"].numpy()
        self.environment.scenario = tensors["environment.scenario"].numpy().copy()
        self.environment.cell = tensors["environment.cell"].numpy().copy()
        self.environment.steps = tensors["environment.steps"].numpy().copy()
        self._total_reward = tensors["total_reward"].numpy().copy()
        self._walked = description["walked"]
        for generator, state in zip(self._generators(), description["generators"], strict=True):
            generator.bit_generator.state = state

    def _generators(self) -> tuple[np.random.Generator, ...]:
        return self.environment.np_random, self._exploration, self._sampling


def _fingerprints(scenarios: Sequence[Scenario]) -> list[list[object]]:
    return [[s.grid.fingerprint, list(s.start), list(s.goal)] for s in scenarios]


def _digest(text: str, tensors: dict[str, Tensor]) -> str:
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        digest.update(name.encode())
        digest.update(tensors[name].numpy().ravel().data)
    return digest.hexdigest()


def _prefixed(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {f"{prefix}.{name}": tensor for name, tensor in tensors.items()}


def _unprefixed(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    start = f"{prefix}."
    return {name[len(start) :]: t for name, t in tensors.items() if name.startswith(start)}
