"""The training of a robot's model: it bumps into obstacles until its body is proved."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from ddqn_planner.grid import GridMap, MoveRule
from ddqn_planner.grid.footprint import read_footprint
from ddqn_planner.grid.motions import HEADINGS, make_motions, read_lattice
from ddqn_planner.model import ModelMetadata, RobotNetwork, package_version
from ddqn_planner.model.robot import BodyCertificate
from ddqn_planner.training.double_dqn import ReplayBuffer, Transitions, double_dqn_gradient
from ddqn_planner.training.environment import PoseVectorEnvironment, Scenario, around
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.propagation import value_iteration

# Shapes: B = a batch, U units, S x S cells around the robot, K = primitives of a heading, C = cells
# by heading.

# Every episode starts at any pose, and all actions are random. The batch and the environments are
# per unit. A collision costs much more than a primitive, so that all successes teach about as much.
ROBOT: Final = HyperParameters(
    network="propagation",
    reward="path_cost",
    learning_rate=4.5e-5,
    batch_size=24,
    gamma=0.2,
    obstacle_reward=-1000.0,
    goal_reward=0.0,
    p_r=1.0,
    steps=40_000_000,
    replay_capacity=200_000,
    learning_starts=250,
    target_interval=2000,
    epsilon_end=1.0,
    max_episode_steps=1,
    environments=12,
)
FIRST: Final = 0.3, 1.0  # the weights and the thresholds of a network that knows nothing
PER_UNIT: Final = ("batch_size", "learning_starts", "environments")
SHRINKS: Final = 3e-5  # what each weight loses per update: an obstacle is harmless unless seen
CAREFUL: Final = 0.1  # of a step is what a threshold moves
CHECKED: Final = 100  # updates between two proofs
MARGIN: Final = 0.02  # of the proof, with which the training ends


def random_scenarios(side: int, random: np.random.Generator) -> list[Scenario]:
    """Draw maps, wider than what the robot sees, with one obstacle: so it is known what was hit."""
    width, scenarios = side + 5, []
    for _ in range(max(4, min(16, 60_000 // width**2))):  # fewer, if they are large
        start, goal, occupied = random.choice(width**2, 3, replace=False).tolist()
        occupancy = np.zeros((width, width), dtype=np.bool_)
        occupancy.flat[occupied] = True
        ends = (start % width, start // width), (goal % width, goal // width)
        scenarios.append(Scenario(GridMap(occupancy), *ends))
    return scenarios


class RobotTrainer:
    """Trains a `RobotNetwork` by Double DQN; the same arguments give the same network."""

    def __init__(
        self,
        footprint: str | None,
        motion: str | None,
        turning_radius: float,
        resolution: float,
        lattice: str | None,
        seed: int,
        padding: float = 0.0,
    ) -> None:
        if motion is not None and lattice is None:
            motions = make_motions(motion, turning_radius, resolution)
        elif lattice is not None and motion is None:
            motions = read_lattice(lattice)
        else:
            raise ValueError(f"motion is {motion}, lattice is {lattice}; give one of the two")
        self.network = RobotNetwork.untrained(read_footprint(footprint, padding), motions)
        self.seed = seed
        tensors, units = self.network.tensors, self.network.sizes["units"]
        counts = {name: min(4096, units * getattr(ROBOT, name)) for name in PER_UNIT}
        self.parameters = replace(ROBOT, **counts)
        draws = np.random.SeedSequence(seed).spawn(4)
        maps, initial, self._exploration, self._sampling = map(np.random.default_rng, draws)
        swept = self.network.swept_by_unit
        scenarios = random_scenarios(swept.shape[1], maps)
        body = self.network.motions, self.network.of_primitives(swept)
        self.environment = PoseVectorEnvironment(scenarios, *body, self.parameters, initial)
        self._replay = ReplayBuffer(self.parameters.replay_capacity)
        self.steps = self.updates = 0

        tensors["weight"][:], tensors["threshold"][:] = FIRST
        # A unit's weights in a row, and one more of 0 for what it does not see.
        self._weight = np.pad(tensors["weight"].reshape(units, -1), ((0, 0), (0, 1)))
        self._threshold = tensors["threshold"]
        self._obstacle = np.array([np.argwhere(s.grid.occupancy)[0] for s in scenarios])
        # Where a robot that has turned by quarters sees an obstacle, so many rows and columns away.
        side = swept.shape[1]
        near, seen = np.arange(side) - side // 2, np.arange(side * side).reshape(side, side)
        self._place = np.full((4, *self.environment.shape), side * side)
        for quarter in range(4):
            self._place[quarter][np.ix_(near, near)] = np.rot90(seen, -quarter)

    def run(self, until: int) -> Iterator[BodyCertificate]:
        """Train until all is proved, or so many steps are done; yield what is proved so far."""
        self.environment.reset()
        self._settle()
        certificate = self.network.certificate()
        yield certificate
        while certificate.margin < MARGIN and self.steps < until:
            for _ in range(CHECKED):
                self._step()
                if self.steps >= self.parameters.learning_starts:
                    self._update()
            weight = self.network.tensors["weight"]
            weight[:] = self._weight[:, :-1].reshape(weight.shape)
            certificate = self.network.certificate()
            yield certificate

    def metadata(self) -> ModelMetadata:
        """Return what the model file says of the network as it is now."""
        first = self.environment.scenarios[0].grid.fingerprint
        p, sizes = self.parameters, self.network.sizes
        of_training = first, self.steps, self.seed, package_version()
        return ModelMetadata(self.network.name, sizes, MoveRule.ROBOT_SAFE, p.gamma, *of_training)

    def _step(self) -> None:
        """Let each robot try a random primitive, and remember what came of it."""
        e, p = self.environment, self.parameters
        scenario, cell = e.scenario.copy(), e.cell
        actions = self._exploration.integers(len(e.primitive), size=p.environments)
        reward, terminated, truncated = e.move(actions)
        discount = np.where(terminated, 0.0, p.gamma).astype(np.float32)
        self._replay.add(Transitions(scenario, cell, actions, reward, e.cell, discount))
        e.reset(terminated | truncated)
        self.steps += p.environments

    def _update(self) -> None:
        """Make one Double DQN update with a batch from the replay buffer."""
        p, units = self.parameters, len(self._weight)
        batch = self._replay.sample(p.batch_size, self._sampling)
        states = np.tile(batch.scenario, 2), np.concatenate([batch.cell, batch.next_cell])
        unit_2BK, place_2B = self._observed(*states)
        logit_2BK = self._threshold[unit_2BK] - self._weight[unit_2BK, place_2B[:, None]]
        p_2BK = 0.5 + 0.5 * np.tanh(0.5 * logit_2BK)
        collision = np.float32(p.obstacle_reward)
        gain_2BK = self._return_SCK[states] - collision
        q = self._q_SCK[batch.scenario, batch.next_cell], collision + p_2BK * gain_2BK
        q_gradient = double_dqn_gradient(p.target, batch, *map(torch.from_numpy, q)).numpy()
        taken = np.arange(p.batch_size), batch.action
        by_logit_B = (q_gradient * gain_2BK[: p.batch_size])[taken]
        by_logit_B *= p_2BK[taken] * (1 - p_2BK[taken])
        step_B = p.learning_rate * units * by_logit_B
        unit_B, place_B = unit_2BK[taken], place_2B[: p.batch_size]
        # All transitions of a unit move its threshold, and few move a weight: it must not jump.
        np.subtract.at(self._threshold, unit_B, CAREFUL * step_B)
        np.add.at(self._weight, (unit_B, place_B), step_B)
        self._weight -= np.float32(SHRINKS)
        np.maximum(self._weight, 0, out=self._weight)
        self._weight[:, -1] = 0
        self.updates += 1
        if self.updates % p.target_interval == 0:
            self._settle()

    def _observed(
        self, scenario: NDArray[np.int64], cell: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the unit of each action, (B, K), and the place of the obstacle, (B,)."""
        (height, width), heading, cell = self.environment.shape, cell % HEADINGS, cell // HEADINGS
        y, x = self._obstacle[scenario].T
        seen = heading // (HEADINGS // 4), (y - cell // width) % height, (x - cell % width) % width
        return self.network.unit[self.environment.primitive[:, heading]].T, self._place[seen]

    def _settle(self) -> None:
        """As the target network, settle V on every map."""
        e, p, actions = self.environment, self.parameters, len(self.environment.primitive)
        learned = self._weight[:, :-1].reshape(self.network.tensors["weight"].shape)
        weight_PSS = self.network.of_primitives(learned)
        threshold_P1 = self._threshold[self.network.unit][:, None]
        self._return_SCK = np.empty(e.free_reward.swapaxes(1, 2).shape, np.float32)
        self._q_SCK = np.empty_like(self._return_SCK)
        collision = np.float32(p.obstacle_reward)
        for number, scenario in enumerate(e.scenarios):
            blocked_PC = around(scenario.grid.occupancy, weight_PSS).reshape(len(weight_PSS), -1)
            p_KHC = 0.5 + 0.5 * np.tanh(0.5 * (threshold_P1 - blocked_PC)[e.primitive])
            p_1CK = p_KHC.transpose(2, 1, 0).reshape(1, -1, actions)
            given = e.free_reward[[number]].swapaxes(1, 2), e.goal[[number]], e.next_cell, p.gamma
            return_1CK = value_iteration(p_1CK, *given, p.obstacle_reward)
            self._return_SCK[number] = return_1CK[0]
            self._q_SCK[number] = collision + p_1CK[0] * (return_1CK[0] - collision)
