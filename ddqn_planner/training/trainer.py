"""The training loop: episodes in, a Q-network out. Checkpoints continue it bit for bit."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
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
from ddqn_planner.grid import MOVES, MoveRule
from ddqn_planner.model import ModelMetadata, model_bytes, package_version
from ddqn_planner.planning import Planner
from ddqn_planner.training.double_dqn import ReplayBuffer, Transitions, double_dqn_gradient
from ddqn_planner.training.environment import GridVectorEnvironment, Scenario
from ddqn_planner.training.episodes import Episode, EpisodeEnd
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.networks import MODULES, PaperModule
from ddqn_planner.training.shared_background import player

CHECKPOINT_KEY, DIGEST_KEY = "ddqn_planner_checkpoint", "sha256"
FUSED = tuple(map(int, torch.__version__.split(".")[:2])) >= (2, 4)  # Adam, on the CPU too


class CheckpointError(ValueError):
    """A checkpoint cannot be resumed; the message says why and what to do."""


class Trainer:
    """Trains a Q-network by Double DQN; the same arguments give the same network, bit for bit."""

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
        self.steps = self.updates = self.episodes = 0

        weights, *others = np.random.SeedSequence(seed).spawn(4)
        self._generators = [np.random.default_rng(sequence) for sequence in others]
        initial, self._exploration, self._sampling = self._generators
        self.environment = GridVectorEnvironment(self.scenarios, move_rule, parameters, initial)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(weights.generate_state(1)[0]))
            module, (height, width) = MODULES[parameters.network], self.environment.shape
            known = {**asdict(parameters), "height": height, "width": width}
            self.network = module(**{name: known[name] for name in module.numpy_class.size_names})
        self._target = copy.deepcopy(self.network).requires_grad_(False)
        self._target.settle(self.environment)
        self._weights = tuple(self.network.parameters())
        self._optimiser = torch.optim.Adam(self._weights, parameters.learning_rate, fused=FUSED)
        for weight in self._weights:  # as Adam does at its first step; a checkpoint restores it
            moments = {name: torch.zeros_like(weight) for name in ("exp_avg", "exp_avg_sq")}
            self._optimiser.state[weight] = {"step": torch.zeros(()), **moments}
        self._replay = ReplayBuffer(parameters.replay_capacity)

        self.environment.reset()
        self._visited: list[list[int]] = [[int(cell)] for cell in self.environment.cell]
        self._total_reward = np.zeros(parameters.environments)
        self._player: Any = None  # without it torch trains the paper's network, as it does others
        if isinstance(self.network, PaperModule):
            networks = self.network, self._target, self._optimiser.state
            self._player = player(*networks, self.environment, self._replay, self._total_reward)

    @property
    def epsilon(self) -> float:
        """Probability of a random action now: it falls linearly, then stays the same."""
        p = self.parameters
        fraction = min(self.steps / p.epsilon_steps, 1.0)
        return p.epsilon_start + fraction * (p.epsilon_end - p.epsilon_start)

    def run(self, until: int, every: int = 10**9) -> Iterator[list[Episode]]:
        """Train until step `until`; yield what ended, often and at each multiple of `every`."""
        while self.steps < until:
            pause = min(until, (self.steps // every + 1) * every)
            cells, terminated, truncated = self._play(pause) if self._player else self._step()
            for visited, entered in zip(self._visited, cells.T.tolist(), strict=True):
                visited += entered
            ended = terminated | truncated
            yield self._end_episodes(ended, terminated) if ended.any() else []

    def _play(self, until: int) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_]]:
        """Make some steps in compiled code; return what `_step` returns."""
        (*_, terminated, truncated, trail), play = self._player
        counters = np.array([self.steps, self.updates, self._replay.added])
        made = play((self._exploration, self._sampling), counters, until)
        self.steps, self.updates, self._replay.added = counters.tolist()
        return trail[:made], terminated, truncated

    def _step(self) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_]]:
        """Make a step, with torch; return the entered cells (1, N), and which episodes ended."""
        p = self.parameters
        scenario, cell = self.environment.scenario.copy(), self.environment.cell
        actions = self._choose_actions()
        reward, terminated, truncated = self.environment.move(actions)
        next_cell = self.environment.cell
        discount = np.where(terminated, 0.0, p.gamma).astype(np.float32)
        self._replay.add(Transitions(scenario, cell, actions, reward, next_cell, discount))
        before, self.steps = self.steps, self.steps + p.environments
        if self.steps > p.learning_starts:
            for _ in range(self.steps // p.update_interval - before // p.update_interval):
                self._update()
        self._total_reward += reward
        return next_cell[None], terminated, truncated

    def _choose_actions(self) -> NDArray[np.int64]:
        """Draw ε-greedy actions, independently for each environment."""
        count = self.parameters.environments
        actions = self._exploration.integers(len(MOVES), size=count)
        greedy = self._exploration.random(count) >= self.epsilon
        if greedy.any():
            states = self._target.states(self.environment.scenario, self.environment.cell)
            with torch.inference_mode():
                q_NA = self.network(states)
            actions[greedy] = q_NA.argmax(dim=1).numpy()[greedy]
        return actions

    def _update(self) -> None:
        """Make one Double DQN update with a batch from the replay buffer."""
        p = self.parameters
        batch = self._replay.sample(p.batch_size, self._sampling)
        cells = np.concatenate([batch.cell, batch.next_cell])
        states = self._target.states(np.tile(batch.scenario, 2), cells)
        target_BA = self._target.target_q(batch.scenario, batch.next_cell)
        gradient_of = partial(double_dqn_gradient, p.target, batch, target_BA)
        self.network.differentiate(states, gradient_of)
        self._optimiser.step()
        self.updates += 1
        if self.updates % p.target_interval == 0:
            self._target.load_state_dict(self.network.state_dict())
            self._target.settle(self.environment)

    def _end_episodes(
        self, ended: NDArray[np.bool_], terminated: NDArray[np.bool_]
    ) -> list[Episode]:
        """Return the ended episodes, and start new ones in their environments."""
        episodes: list[Episode] = []
        places, width = np.flatnonzero(ended).tolist(), self.environment.shape[1]
        for index in places:
            cells, scenario = self._visited[index], int(self.environment.scenario[index])
            moves, outcome = len(cells) - 1, EpisodeEnd.OUT_OF_STEPS
            if cells[-1] == self.environment.goal[scenario]:
                outcome = EpisodeEnd.REACHED_GOAL
            elif terminated[index]:
                outcome, cells = EpisodeEnd.COLLIDED, cells[:-1]
            visited = tuple((cell % width, cell // width) for cell in cells)
            total = float(self._total_reward[index])
            self.episodes += 1
            ends = self.episodes, self.steps, scenario, outcome, visited, moves, total
            episodes.append(Episode(*ends))
        self.environment.reset(ended)
        for index in places:
            self._visited[index] = [int(self.environment.cell[index])]
        self._total_reward[ended] = 0.0
        return episodes

    def planner(self) -> Planner:
        """Return a planner with a copy of the network as it is now."""
        metadata = ModelMetadata(
            network=self.parameters.network,
            sizes=self.network.sizes,
            move_rule=self.move_rule,
            gamma=self.parameters.gamma,
            map_fingerprint=self.scenarios[0].grid.fingerprint,
            steps=self.steps,
            seed=self.seed,
            package_version=package_version(),
        )
        return Planner(self.network.to_numpy(), metadata)

    def model_bytes(self) -> bytes:
        """Return what a model file of now holds; a ValueError if the training diverged."""
        if not all(weight.isfinite().all() for weight in self._weights):
            remedy = "train into another folder with a smaller learning_rate"
            raise ValueError(f"the training diverged, and nothing more is saved; {remedy}")
        planner = self.planner()
        return model_bytes(planner.network, planner.metadata)

    def save_model(self, path: str | Path) -> None:
        """Write what `model_bytes` returns to a file."""
        write_atomically(Path(path), self.model_bytes())

    def save_checkpoint(self, path: str | Path) -> None:
        """Write all that `load_checkpoint` needs; after an OSError, an old file is unchanged."""
        description = {  # with the names of 0.1, whose checkpoints load too
            "seed": self.seed,
            "move_rule": self.move_rule,
            "parameters": asdict(self.parameters),
            "scenarios": _fingerprints(self.scenarios),
            "counters": [self.steps, self.updates, self.episodes, self._replay.added],
            "walked": self._visited,
            "generators": [generator.bit_generator.state for generator in self._generators],
        }
        tensors = {name: tensor.contiguous() for name, tensor in self._tensors().items()}
        text = json.dumps(description)
        metadata = {CHECKPOINT_KEY: text, DIGEST_KEY: _digest(text, tensors)}
        write_atomically(Path(path), safetensors.torch.save(tensors, metadata))

    @classmethod
    def load_checkpoint(cls, path: str | Path, scenarios: Sequence[Scenario]) -> Trainer:
        """Return the trainer of a checkpoint, made with these scenarios, or a CheckpointError."""
        try:
            with safe_open(path, framework="pt") as file:
                metadata = file.metadata()
                text = metadata[CHECKPOINT_KEY]
                description = json.loads(text)
                if description["scenarios"] != _fingerprints(scenarios):
                    raise CheckpointError(
                        f"{path}: was made with another map, start or goal; give that one, or "
                        "train into another folder"
                    )
                parameters = HyperParameters(**description["parameters"])
                rule = MoveRule(description["move_rule"])
                trainer = cls(scenarios, rule, parameters, description["seed"])
                trainer._continue(description, file)
                if metadata[DIGEST_KEY] != _digest(text, trainer._tensors()):
                    raise ValueError("its digest is another")
        except (CheckpointError, MemoryError):
            raise
        except Exception as error:  # a broken file can raise any error in the libraries
            raise CheckpointError(
                f"{path}: is no complete checkpoint ({error!r}); remove it to train anew, or train "
                "into another folder"
            ) from error
        return trainer

    def _continue(self, description: Any, file: Any) -> None:
        """Continue where a checkpoint was made; a ValueError if its tensors are not those."""
        self.steps, self.updates, self.episodes, self._replay.added = description["counters"]
        tensors = self._tensors()
        shapes = {name: [*tensor.shape] for name, tensor in tensors.items()}
        # Before any is read: a small sparse file can claim tensors of any size.
        if {name: file.get_slice(name).get_shape() for name in file.keys()} != shapes:  # noqa: SIM118
            raise ValueError("its tensors have other names or shapes")
        for name, tensor in tensors.items():
            tensor.copy_(file.get_tensor(name))
        self._target.settle(self.environment)
        self._visited = description["walked"]
        for generator, state in zip(self._generators, description["generators"], strict=True):
            generator.bit_generator.state = state

    def _tensors(self) -> dict[str, Tensor]:
        """Return the tensors of a checkpoint, which share the trainer's memory."""
        environment, replay = self.environment, self._replay.transitions._asdict()
        names = ("scenario", "cell", "steps")
        groups: dict[str, dict[str, Any]] = {
            "network": self.network.state_dict(),
            "target": self._target.state_dict(),
            "replay": {name: values[: len(self._replay)] for name, values in replay.items()},
            "environment": {name: getattr(environment, name) for name in names},
        }
        for index, weight in enumerate(self._weights if self.updates else ()):
            groups[f"optimiser.{index}"] = self._optimiser.state[weight]
            self._optimiser.state[weight]["step"].fill_(self.updates)
        tensors = {
            f"{group}.{name}": torch.as_tensor(part)
            for group, parts in groups.items()
            for name, part in parts.items()
        }
        return tensors | {"total_reward": torch.from_numpy(self._total_reward)}


def _fingerprints(scenarios: Sequence[Scenario]) -> list[list[object]]:
    return [[s.grid.fingerprint, list(s.start), list(s.goal)] for s in scenarios]


def _digest(text: str, tensors: dict[str, Tensor]) -> str:
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        digest.update(name.encode())
        digest.update(tensors[name].numpy().ravel().data)
    return digest.hexdigest()
