"""The training loop: episodes in, a Q-network out. Checkpoints continue it bit for bit."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
import torch
from numpy.typing import NDArray
from safetensors import safe_open

from ddqn_planner.files import as_path, differences, open_regular, write_atomically
from ddqn_planner.grid import MOVES
from ddqn_planner.grid.arguments import as_seed, listed
from ddqn_planner.model import (
    NETWORKS,
    ModelMetadata,
    PropagationQNetwork,
    model_bytes,
    package_version,
)
from ddqn_planner.planning import Planner
from ddqn_planner.training.compiled_learner import arrays_of, play
from ddqn_planner.training.double_dqn import ReplayBuffer, Transitions
from ddqn_planner.training.environment import GridVectorEnvironment, Scenario
from ddqn_planner.training.episodes import Episode, EpisodeEnd
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.propagation import PropagationLearner

CHECKPOINT_KEY, DIGEST_KEY = "ddqn_planner_checkpoint", "sha256"


class CheckpointError(ValueError):
    """A checkpoint cannot be resumed; the message says why and what to do."""


class Trainer:
    """Trains a Q-network by Double DQN; the same arguments give the same network, bit for bit."""

    def __init__(
        self, scenarios: Sequence[Scenario], parameters: HyperParameters, seed: int
    ) -> None:
        self.scenarios = tuple(listed(scenarios, "the scenarios"))
        self.parameters = parameters
        self.seed = seed = as_seed(seed)
        self.steps = self.updates = self.episodes = 0

        weights, *others = np.random.SeedSequence(seed).spawn(4)
        self._generators = [np.random.default_rng(sequence) for sequence in others]
        initial, self._exploration, self._sampling = self._generators
        self.environment = GridVectorEnvironment(self.scenarios, parameters, initial)
        network_class, (height, width) = (
            NETWORKS[parameters.network],
            self.environment.shape,
        )
        known = {**asdict(parameters), "height": height, "width": width}
        sizes = {name: known[name] for name in network_class.size_names}
        first = _initial_tensors(
            network_class.shapes(sizes), int(weights.generate_state(1)[0])
        )
        self.network = network_class(sizes, first)
        self.network.tensors = (
            first  # all of them: what is noise is known once they are trained
        )
        copies = np.copy, np.zeros_like, np.zeros_like
        target, mean, square = (
            {name: copy(t) for name, t in first.items()} for copy in copies
        )
        # The networks θ and θ⁻, and Adam's moments of the gradient: all that an update changes.
        self._parts = self.network.tensors, target, mean, square
        self._replay = ReplayBuffer(parameters.replay_capacity)

        self.environment.reset()
        self._learner: Any = (
            None  # the paper's network needs none: it learns in compiled code
        )
        if isinstance(self.network, PropagationQNetwork):
            self._learner = PropagationLearner(
                self.network, self._parts, self.environment
            )
        else:
            self._arrays = arrays_of(self._parts, self.environment, self._replay)

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
            if self._learner:
                self._step()
            else:
                self._play(pause)
            yield self._end_episodes()

    def _play(self, until: int) -> None:
        """Make some steps in compiled code, until an episode ends."""
        counters = np.array([self.steps, self.updates, self._replay.added])
        play(*self._arrays, (self._exploration, self._sampling), counters, until)
        self.steps, self.updates, self._replay.added = counters.tolist()

    def _step(self) -> None:
        """Make a step, with torch."""
        e, p = self.environment, self.parameters
        scenario, cell = e.scenario, e.cell.copy()
        actions = self._exploration.integers(len(MOVES), size=p.environments)
        is_greedy = self._exploration.random(p.environments) >= self.epsilon
        if is_greedy.any():
            q_NA = self._learner.q_values(scenario, cell)
            actions = np.where(is_greedy, q_NA.argmax(axis=1), actions)
        reward, terminated, _ = e.move(actions)
        discount = np.where(terminated, 0.0, p.gamma).astype(np.float32)
        self._replay.add(Transitions(scenario, cell, actions, reward, e.cell, discount))
        before, self.steps = self.steps, self.steps + p.environments
        if self.steps > p.learning_starts:
            for _ in range(
                self.steps // p.update_interval - before // p.update_interval
            ):
                self.updates += 1
                batch = self._replay.sample(p.batch_size, self._sampling)
                self._learner.update(batch, self.updates)

    def _end_episodes(self) -> list[Episode]:
        """Return the episodes that have ended, and start others in their place."""
        e, episodes = self.environment, list[Episode]()
        ended = e.terminated | e.truncated
        for index in np.flatnonzero(ended).tolist():
            scenario, moves = int(e.scenario[index]), int(e.steps[index])
            cells, outcome = (
                e.visited[index, : moves + 1].tolist(),
                EpisodeEnd.OUT_OF_STEPS,
            )
            if cells[-1] == e.goal[scenario]:
                outcome = EpisodeEnd.REACHED_GOAL
            elif e.terminated[index]:
                outcome, cells = EpisodeEnd.COLLIDED, cells[:-1]
            visited = tuple((cell % e.shape[1], cell // e.shape[1]) for cell in cells)
            self.episodes += 1
            ends = self.episodes, self.steps, scenario, outcome, visited, moves
            episodes.append(Episode(*ends, float(e.total_reward[index])))
        if episodes:
            e.reset(ended)
        return episodes

    def planner(self) -> Planner:
        """Return a planner with a copy of the network as it is now."""
        p, network, first = self.parameters, self.network, self.scenarios[0]
        of_training = first.grid.fingerprint, self.steps, self.seed, package_version()
        metadata = ModelMetadata(
            p.network, network.sizes, first.move_rule, p.gamma, *of_training
        )
        tensors = {name: tensor.copy() for name, tensor in network.tensors.items()}
        return Planner(type(network)(network.sizes, tensors), metadata)

    def model_bytes(self) -> bytes:
        """Return what a model file of now holds; a ValueError if the training diverged."""
        if not all(
            np.isfinite(tensor).all() for tensor in self.network.tensors.values()
        ):
            remedy = "train into another folder with a smaller learning_rate"
            raise ValueError(
                f"the training diverged, and nothing more is saved; {remedy}"
            )
        planner = self.planner()
        return model_bytes(planner.network, planner.metadata)

    def _description(self) -> dict[str, Any]:
        """Return what of a checkpoint is no array, with the names of 0.1: those load too."""
        e = self.environment
        return {
            "seed": self.seed,
            "move_rule": self.scenarios[0].move_rule.value,
            "parameters": asdict(self.parameters),
            "scenarios": [
                [s.grid.fingerprint, [*s.start], [*s.goal]] for s in self.scenarios
            ],
            "counters": [self.steps, self.updates, self.episodes, self._replay.added],
            "walked": [
                cells[: count + 1].tolist()
                for cells, count in zip(e.visited, e.steps, strict=True)
            ],
            "generators": [
                generator.bit_generator.state for generator in self._generators
            ],
        }

    def save_checkpoint(self, path: Path) -> None:
        """Write all that `restore` needs; after an OSError, an old file is unchanged."""
        tensors = {
            name: np.asarray(t, order="C") for name, t in self._tensors().items()
        }
        text = json.dumps(self._description())
        metadata = {CHECKPOINT_KEY: text, DIGEST_KEY: _digest(text, tensors)}
        write_atomically(as_path(path), safetensors.numpy.save(tensors, metadata))

    def restore(self, path: Path) -> None:
        """Take over a checkpoint of this training, whatever its `steps`, or a CheckpointError."""
        try:
            open_regular(as_path(path)).close()  # safe_open would wait for a pipe
            with safe_open(as_path(path), framework="np") as file:
                metadata, now = file.metadata(), self._description()
                saved = json.loads(metadata[CHECKPOINT_KEY])
                if saved["scenarios"] != now["scenarios"]:
                    raise CheckpointError(
                        "was made with another map, start or goal; give that one"
                    )
                others = saved["parameters"] | {"steps": self.parameters.steps}
                before = saved | asdict(HyperParameters(**others))
                given = {name: now[name] for name in ("seed", "move_rule")} | now[
                    "parameters"
                ]
                if changed := differences(before, given):
                    raise CheckpointError(f"was made with {changed}; give those values")
                self.steps, self.updates, self.episodes, self._replay.added = saved[
                    "counters"
                ]
                tensors = self._tensors()
                shapes = {name: [*tensor.shape] for name, tensor in tensors.items()}
                # Before any is read: a small sparse file can claim tensors of any size.
                names = file.keys()
                saved_shapes = {
                    name: file.get_slice(name).get_shape() for name in names
                }
                if saved_shapes != shapes:
                    raise ValueError("its tensors have other names or shapes")
                for name, tensor in tensors.items():
                    tensor[...] = file.get_tensor(name)
                if metadata[DIGEST_KEY] != _digest(metadata[CHECKPOINT_KEY], tensors):
                    raise ValueError("its digest is another")
            for visited, cells in zip(
                self.environment.visited, saved["walked"], strict=True
            ):
                visited[: len(cells)] = cells
            for generator, state in zip(
                self._generators, saved["generators"], strict=True
            ):
                generator.bit_generator.state = state
            if self._learner:
                self._learner.settle()
        except CheckpointError as error:
            raise CheckpointError(
                f"{path}: {error}, or train into another folder"
            ) from None
        except MemoryError:
            raise
        except Exception as error:  # a broken file can raise any error in the libraries
            problem = f"is no complete checkpoint ({error!r}); remove it to train anew"
            raise CheckpointError(
                f"{path}: {problem}, or train into another folder"
            ) from error

    def _tensors(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a checkpoint, which share the trainer's memory."""
        online, target, mean, square = self._parts
        replay = self._replay.transitions._asdict()
        groups: dict[str, dict[str, NDArray[Any]]] = {
            "network": online,
            "target": target,
            "replay": {
                name: values[: len(self._replay)] for name, values in replay.items()
            },
            "environment": {
                n: getattr(self.environment, n) for n in ("scenario", "cell", "steps")
            },
        }
        for index, name in enumerate(online if self.updates else ()):
            moments = {"exp_avg": mean[name], "exp_avg_sq": square[name]}
            groups[f"optimiser.{index}"] = {
                "step": np.array(self.updates, np.float32),
                **moments,
            }
        tensors = {
            f"{g}.{n}": array
            for g, arrays in groups.items()
            for n, array in arrays.items()
        }
        return tensors | {"total_reward": self.environment.total_reward}


def _initial_tensors(
    shapes: Mapping[str, tuple[int, ...]], seed: int
) -> dict[str, Any]:
    """Draw weights and biases as torch does for its layers."""
    generator, tensors = torch.Generator().manual_seed(seed), {}
    for name, shape in shapes.items():
        layer, _, _ = name.partition(".")
        most = math.prod(shapes[f"{layer}.weight"][1:]) ** -0.5
        tensors[name] = np.empty(shape, np.float32)
        torch.from_numpy(tensors[name]).uniform_(-most, most, generator=generator)
        if (
            name == "prices.bias"
        ):  # a cost multiplier below 1 has no gradient: it must begin above
            tensors[name][:] = 1
    return tensors


def _digest(text: str, tensors: dict[str, NDArray[Any]]) -> str:
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        digest.update(name.encode())
        digest.update(tensors[name].ravel().data)
    return digest.hexdigest()
