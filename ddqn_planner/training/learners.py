"""What each Q-network sees of a robot's cell in training, and what it answers there."""

from __future__ import annotations

from typing import Final, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ddqn_planner.grid import LENGTHS, OCCUPIED
from ddqn_planner.model import PaperQNetwork
from ddqn_planner.model.observation import observe
from ddqn_planner.model.propagation import (
    FEATURES,
    features,
    neighbours,
    propagate,
    surroundings,
)
from ddqn_planner.training.environment import GridVectorEnvironment


class Learner(Protocol):
    """What the trainer asks of a kind of network.

    A state is what the network sees of a robot in a cell, a tensor (B, ...).
    """

    sizes: dict[str, int]
    """The arguments of the network's class."""

    def states(self, scenario: NDArray[np.int64], cell: NDArray[np.int64]) -> Tensor:
        """Return the states of robots in `cell` (B,), y * W + x, on the maps `scenario` (B,)."""
        ...

    def q(self, network: nn.Module, state_B: Tensor) -> Tensor:
        """Return Q(s, a): (B, 8)."""
        ...

    def copy_target(self, target: nn.Module) -> None:
        """Take note of a new target network θ⁻."""
        ...


class PaperLearner:
    """The paper's network sees the whole map with the robot in it, as patches of 3x3 cells.

    Parameters
    ----------
    environment : GridVectorEnvironment
    """

    def __init__(self, environment: GridVectorEnvironment) -> None:
        height, width = environment.shape
        filters = environment.parameters.filters
        self.sizes = {"height": height, "width": width, "filters": filters}
        self._environment = environment

    def states(self, scenario: NDArray[np.int64], cell: NDArray[np.int64]) -> Tensor:
        """Return the patches of the observations: (B, 9, L)."""
        environment = self._environment
        observations = observe(environment.background[scenario], cell, environment.shape)
        return PaperQNetwork.patches(torch.from_numpy(observations))

    def q(self, network: nn.Module, state_B: Tensor) -> Tensor:
        """Return Q(s, a): (B, 8)."""
        assert isinstance(network, PaperQNetwork)
        return network.q_of_patches(state_B)

    def copy_target(self, target: nn.Module) -> None:
        """Do nothing: the observation does not depend on the target network."""


class PropagationLearner:
    """The propagation network sees the 3x3 cells around the robot, and what lies beyond them.

    What lies beyond is r + γ V(s') of each move, V settled under the target network θ⁻. It stays
    the same between two target copies, and no gradient goes through it: back-propagation through
    the repetition diverges.

    Parameters
    ----------
    environment : GridVectorEnvironment
    """

    def __init__(self, environment: GridVectorEnvironment) -> None:
        self.sizes = {"filters": environment.parameters.filters}
        self._environment = environment
        seen_SC9 = [
            surroundings(scenario.grid.occupancy, None) for scenario in environment.scenarios
        ]
        self._surroundings_SC9 = (np.stack(seen_SC9) == OCCUPIED).astype(np.float32)
        self._neighbours_AC = neighbours(environment.shape)
        self._return_SCA = np.zeros((*self._surroundings_SC9.shape[:2], 8), dtype=np.float32)

    def states(self, scenario: NDArray[np.int64], cell: NDArray[np.int64]) -> Tensor:
        """Return the surroundings and r + γ V(s') of each action: (B, 9 + 8)."""
        at = (scenario, cell)
        seen_BF = np.concatenate([self._surroundings_SC9[at], self._return_SCA[at]], axis=1)
        return torch.from_numpy(seen_BF)

    def q(self, network: nn.Module, state_B: Tensor) -> Tensor:
        """Return Q(s, a) = p (r + γ V(s')) + (1 - p) r_o: (B, 8)."""
        p_BA: Tensor = network(state_B[:, :9])
        collision = self._environment.parameters.obstacle_reward
        return collision + p_BA * (state_B[:, 9:] - collision)

    def copy_target(self, target: nn.Module) -> None:
        """Settle V on every map under the new target network."""
        with torch.inference_mode():
            success_SCA = target(torch.from_numpy(self._surroundings_SC9)).numpy()
        environment = self._environment
        return_SAC = propagate(
            success_SCA.transpose(0, 2, 1),
            environment.free_reward,
            environment.goal,
            self._neighbours_AC,
            environment.parameters.gamma,
            environment.parameters.obstacle_reward,
        )
        self._return_SCA = np.ascontiguousarray(return_SAC.transpose(0, 2, 1))


class AnyMapLearner:
    """The network for any map sees its features of the robot's cell, and the values beyond it.

    As for `PropagationLearner`, but the network answers with the reward of each move as well. What
    lies beyond is γ V(s').

    Parameters
    ----------
    environment : GridVectorEnvironment
    """

    def __init__(self, environment: GridVectorEnvironment) -> None:
        self.sizes = {"filters": environment.parameters.filters}
        self._environment = environment
        self._features_SCF = np.stack(
            [
                features(surroundings(s.grid.occupancy, s.grid.cost), rule)
                for s, rule in zip(environment.scenarios, environment.move_rules, strict=True)
            ]
        )
        self._lengths = torch.from_numpy(LENGTHS.astype(np.float32))
        self._neighbours_AC = neighbours(environment.shape)
        self._beyond_SCA = np.zeros((*self._features_SCF.shape[:2], 8), dtype=np.float32)

    def states(self, scenario: NDArray[np.int64], cell: NDArray[np.int64]) -> Tensor:
        """Return the features and γ V(s') of each action: (B, 28 + 8)."""
        at = (scenario, cell)
        seen_BF = np.concatenate([self._features_SCF[at], self._beyond_SCA[at]], axis=1)
        return torch.from_numpy(seen_BF)

    def q(self, network: nn.Module, state_B: Tensor) -> Tensor:
        """Return Q(s, a) = p (r + γ V(s')) + (1 - p) r_o with r = -length times price: (B, 8)."""
        p_BA, price_BA = network(state_B[:, :FEATURES])
        collision = self._environment.parameters.obstacle_reward
        q_BA: Tensor = collision + p_BA * (
            state_B[:, FEATURES:] - self._lengths * price_BA - collision
        )
        return q_BA

    def copy_target(self, target: nn.Module) -> None:
        """Settle V on every map under the new target network."""
        with torch.inference_mode():
            p_SCA, price_SCA = target(torch.from_numpy(self._features_SCF))
        parameters = self._environment.parameters
        reward_SAC = -(self._lengths * price_SCA).numpy().transpose(0, 2, 1)
        return_SAC = propagate(
            p_SCA.numpy().transpose(0, 2, 1),
            reward_SAC,
            self._environment.goal,
            self._neighbours_AC,
            parameters.gamma,
            parameters.obstacle_reward,
        )
        self._beyond_SCA = np.ascontiguousarray((return_SAC - reward_SAC).transpose(0, 2, 1))


Learners = type[PaperLearner] | type[PropagationLearner] | type[AnyMapLearner]

LEARNERS: Final[dict[str, Learners]] = {
    "paper": PaperLearner,
    "propagation": PropagationLearner,
    "any_map": AnyMapLearner,
}
"""By the hyper-parameter ``network``."""
