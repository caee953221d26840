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
from ddqn_planner.model.propagation import features, neighbours, propagate, surroundings
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
        parameters = environment.parameters
        self.sizes = {
            "height": height,
            "width": width,
            "filters": parameters.filters,
            "hidden_units": parameters.hidden_units,
        }
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
        self._seen_SCF = np.stack(self._see())
        self._neighbours_AC = neighbours(environment.shape)
        self._beyond_SCA = np.zeros((*self._seen_SCF.shape[:2], 8), dtype=np.float32)

    def _see(self) -> list[NDArray[np.float32]]:
        maps = [scenario.grid.occupancy for scenario in self._environment.scenarios]
        return [(surroundings(map_, None) == OCCUPIED).astype(np.float32) for map_ in maps]

    def states(self, scenario: NDArray[np.int64], cell: NDArray[np.int64]) -> Tensor:
        """Return what is seen of the cells, and what lies beyond each action: (B, F + 8)."""
        at = (scenario, cell)
        return torch.from_numpy(np.concatenate([self._seen_SCF[at], self._beyond_SCA[at]], axis=1))

    def q(self, network: nn.Module, state_B: Tensor) -> Tensor:
        """Return Q(s, a) = p (r + γ V(s')) + (1 - p) r_o: (B, 8)."""
        seen_BF, return_BA = state_B[:, :-8], state_B[:, -8:]
        p_BA: Tensor = network(seen_BF)
        collision = self._environment.parameters.obstacle_reward
        return collision + p_BA * (return_BA - collision)

    def copy_target(self, target: nn.Module) -> None:
        """Settle V on every map under the new target network."""
        with torch.inference_mode():
            p_SCA = target(torch.from_numpy(self._seen_SCF)).numpy()
        self._settle(p_SCA, self._environment.free_reward)

    def _settle(self, p_SCA: NDArray[np.float32], reward_SAC: NDArray[np.float32]) -> None:
        """Let r + γ V(s') lie beyond."""
        return_SAC = propagate(
            p_SCA.transpose(0, 2, 1),
            reward_SAC,
            self._environment.goal,
            self._neighbours_AC,
            self._environment.parameters.gamma,
            self._environment.parameters.obstacle_reward,
        )
        self._beyond_SCA = np.ascontiguousarray(return_SAC.transpose(0, 2, 1))


class AnyMapLearner(PropagationLearner):
    """The network for any map answers with the reward of each move as well.

    So what lies beyond is γ V(s') alone.
    """

    _lengths = torch.from_numpy(LENGTHS.astype(np.float32))

    def _see(self) -> list[NDArray[np.float32]]:
        environment = self._environment
        return [
            features(surroundings(scenario.grid.occupancy, scenario.grid.cost), rule)
            for scenario, rule in zip(environment.scenarios, environment.move_rules, strict=True)
        ]

    def q(self, network: nn.Module, state_B: Tensor) -> Tensor:
        """Return Q(s, a) = p (r + γ V(s')) + (1 - p) r_o with r = -length * multiplier: (B, 8)."""
        p_BA, multiplier_BA = network(state_B[:, :-8])
        collision = self._environment.parameters.obstacle_reward
        q_BA: Tensor = collision + p_BA * (
            state_B[:, -8:] - self._lengths * multiplier_BA - collision
        )
        return q_BA

    def copy_target(self, target: nn.Module) -> None:
        """Settle V on every map under the new target network."""
        with torch.inference_mode():
            p_SCA, multiplier_SCA = target(torch.from_numpy(self._seen_SCF))
            reward_SCA = -(self._lengths * multiplier_SCA).numpy()
        self._settle(p_SCA.numpy(), reward_SCA.transpose(0, 2, 1))
        self._beyond_SCA -= reward_SCA


LEARNERS: Final[dict[str, type[PaperLearner] | type[PropagationLearner]]] = {
    "paper": PaperLearner,
    "propagation": PropagationLearner,
    "any_map": AnyMapLearner,
}
"""By the hyper-parameter ``network``."""
