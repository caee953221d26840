"""What each Q-network observes of a robot's cell in training, and its Q values there.

Dimensions: S maps, A = 8 actions, B = a batch, C = H * W cells (cell y * W + x), I = inputs.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ddqn_planner.grid import LENGTHS, MOVES, neighbours
from ddqn_planner.model.observation import observe, patches
from ddqn_planner.training.environment import GridVectorEnvironment
from ddqn_planner.training.networks import (
    AnyMapModule,
    PaperModule,
    PropagationModule,
    TrainableNetwork,
)
from ddqn_planner.training.value_iteration import value_iteration


class Encoder(ABC):
    """What the trainer asks about a network: it encodes the environment's cells as states.

    Parameters
    ----------
    environment : GridVectorEnvironment
    """

    module_class: ClassVar[type[TrainableNetwork]]

    def __init__(self, environment: GridVectorEnvironment) -> None:
        self._environment = environment

    @abstractmethod
    def states(self, scenario: NDArray[np.int64], cell: NDArray[np.int64]) -> Tensor:
        """Return the states (B, ...) of robots in `cell` (B,) on the maps `scenario` (B,)."""

    @abstractmethod
    def q(self, module: TrainableNetwork, state_B: Tensor) -> Tensor:
        """Return Q(s, a): (B, 8)."""

    def update_target(self, target: TrainableNetwork) -> None:  # noqa: B027 (optional)
        """Use a new target network θ⁻, if the states depend on it."""


class PaperEncoder(Encoder):
    """The paper's network observes the whole map with the robot in it, as windows of 3x3 cells."""

    module_class = PaperModule

    def states(self, scenario: NDArray[np.int64], cell: NDArray[np.int64]) -> Tensor:
        """Return the windows of the observations: (B, 9, L)."""
        environment = self._environment
        observations = observe(environment.background[scenario], cell, environment.shape)
        return PaperModule.windows(torch.from_numpy(observations))

    def q(self, module: TrainableNetwork, state_B: Tensor) -> Tensor:
        """Return Q(s, a): (B, 8)."""
        assert isinstance(module, PaperModule)
        return module.q_of_windows(state_B)


class PropagationEncoder(Encoder):
    """The propagation network observes the 3x3 patch around the robot, and the return beyond it.

    This return is r + γ V(s') of each move, where V is settled under the target network θ⁻. It
    stays the same until the next target copy. No gradient flows through it: back-propagation
    through the iteration diverges.
    """

    module_class: ClassVar[type[PropagationModule]] = PropagationModule

    def __init__(self, environment: GridVectorEnvironment) -> None:
        super().__init__(environment)
        network = self.module_class.numpy_class
        grids = (scenario.grid for scenario in environment.scenarios)
        self._feature_SCI = np.stack(
            [
                network.features(patches(grid.occupancy, grid.cost), rule)
                for grid, rule in zip(grids, environment.move_rules, strict=True)
            ]
        )
        self._return_SCA = np.zeros((*self._feature_SCI.shape[:2], len(MOVES)), dtype=np.float32)
        self._neighbours_AC = neighbours(environment.shape)

    def states(self, scenario: NDArray[np.int64], cell: NDArray[np.int64]) -> Tensor:
        """Return the features of the cells' patches, and the return of each move: (B, I + 8)."""
        at = (scenario, cell)
        state_B = np.concatenate([self._feature_SCI[at], self._return_SCA[at]], axis=1)
        return torch.from_numpy(state_B)

    def q(self, module: TrainableNetwork, state_B: Tensor) -> Tensor:
        """Return Q(s, a) = p (r + γ V(s')) + (1 - p) r_o: (B, 8)."""
        assert isinstance(module, PropagationModule)
        feature_BI, return_BA = state_B[:, : -len(MOVES)], state_B[:, -len(MOVES) :]
        return self._expected(module.success(feature_BI), return_BA)

    def _expected(self, p_BA: Tensor, return_BA: Tensor) -> Tensor:
        collision = self._environment.parameters.obstacle_reward
        return collision + p_BA * (return_BA - collision)

    def update_target(self, target: TrainableNetwork) -> None:
        """Settle V on every map under the new target network."""
        assert isinstance(target, PropagationModule)
        with torch.inference_mode():
            p_SCA = target.success(torch.from_numpy(self._feature_SCI)).numpy()
        self._settle(p_SCA, self._environment.free_reward)

    def _settle(self, p_SCA: NDArray[np.float32], reward_SAC: NDArray[np.float32]) -> None:
        """Cache r + γ V(s') of each move."""
        return_SAC = value_iteration(
            p_SCA.transpose(0, 2, 1),
            reward_SAC,
            self._environment.goal,
            self._neighbours_AC,
            self._environment.parameters.gamma,
            self._environment.parameters.obstacle_reward,
        )
        self._return_SCA = np.ascontiguousarray(return_SAC.transpose(0, 2, 1))


class AnyMapEncoder(PropagationEncoder):
    """The network for any map predicts the reward of each move too.

    So the return beyond the patch is γ V(s') alone.
    """

    module_class = AnyMapModule
    _lengths = torch.from_numpy(LENGTHS.astype(np.float32))

    def q(self, module: TrainableNetwork, state_B: Tensor) -> Tensor:
        """Return Q(s, a) = p (r + γ V(s')) + (1 - p) r_o with r = -length * multiplier: (B, 8)."""
        assert isinstance(module, AnyMapModule)
        feature_BI, return_BA = state_B[:, : -len(MOVES)], state_B[:, -len(MOVES) :]
        cost_BA = self._lengths * module.multiplier(feature_BI)
        return self._expected(module.success(feature_BI), return_BA - cost_BA)

    def update_target(self, target: TrainableNetwork) -> None:
        """Settle V on every map under the new target network."""
        assert isinstance(target, AnyMapModule)
        with torch.inference_mode():
            feature_SCI = torch.from_numpy(self._feature_SCI)
            p_SCA = target.success(feature_SCI).numpy()
            reward_SCA = -(self._lengths * target.multiplier(feature_SCI)).numpy()
        self._settle(p_SCA, reward_SCA.transpose(0, 2, 1))
        self._return_SCA -= reward_SCA


ENCODERS: Final[dict[str, type[Encoder]]] = {
    encoder.module_class.numpy_class.name: encoder
    for encoder in (PaperEncoder, PropagationEncoder, AnyMapEncoder)
}
"""By the hyper-parameter ``network``."""
