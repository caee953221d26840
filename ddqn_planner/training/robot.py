"""The training of a robot's model: it bumps into obstacles until its body is proved."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import GridMap, MoveRule
from ddqn_planner.grid.arguments import as_seed, as_whole
from ddqn_planner.model import ModelMetadata, RobotNetwork, package_version
from ddqn_planner.robot.body_certificate import BodyCertificate
from ddqn_planner.robot.footprint import read_footprint
from ddqn_planner.robot.motions import HEADINGS, Motion, make_motions, read_lattice
from ddqn_planner.training.double_dqn import (
    ReplayBuffer,
    Transitions,
    double_dqn_gradient,
    next_q,
)
from ddqn_planner.training.exploring_starts import initial_cells
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.propagation import value_iteration

# Shapes: B = a batch, U units, K = primitives of each of N headings (those with few have some
# twice), M maps, which repeat in all directions, C poses, numbers (y * W + x) * 16 + heading.

# Every episode is one random primitive from any pose. The batch and the environments are per unit.
# A collision costs much more than a primitive, so that all successes teach about as much.
ROBOT: Final = HyperParameters(
    learning_rate=4.5e-5,
    batch_size=24,
    gamma=0.2,
    obstacle_reward=-1000.0,
    p_r=1.0,
    steps=40_000_000,
    replay_capacity=200_000,
    learning_starts=250,
    target_interval=2000,
    environments=12,
)
FIRST: Final = (
    0.3,
    1.0,
)  # the weights and the thresholds of a network that knows nothing
PER_UNIT: Final = ("batch_size", "learning_starts", "environments")
SHRINKS: Final = (
    3e-5  # what each weight loses per update: an obstacle is harmless unless seen
)
CAREFUL: Final = 0.1  # of a step is what a threshold moves
CHECKED: Final = 100  # updates between two proofs
MOST_STEPS: Final = 10**12
MARGIN: Final = 0.02  # of the proof, with which the training ends


class RobotTrainer:
    """Trains a `RobotNetwork` by Double DQN; the same arguments give the same network."""

    def __init__(
        self,
        footprint: str | None,
        motion: str | None,
        turning_radius: float,
        resolution: float,
        lattice: str | Path | None,
        seed: int,
        padding: float = 0.0,
    ) -> None:
        if motion is not None and lattice is None:
            motions = make_motions(motion, turning_radius, resolution)
        elif lattice is not None and motion is None:
            motions = read_lattice(lattice)
        else:
            count = (
                "neither motion nor lattice is"
                if motion is None
                else "motion and lattice are"
            )
            remedy = f"give one of the two: motion {', '.join(Motion)}, or lattice FILE"
            raise ValueError(f"{count} given; {remedy}")
        self.network = RobotNetwork.untrained(
            read_footprint(footprint, padding), motions
        )
        self.seed = seed = as_seed(seed)
        tensors, units = self.network.tensors, self.network.sizes["units"]
        counts = {name: min(4096, units * getattr(ROBOT, name)) for name in PER_UNIT}
        self.parameters = replace(ROBOT, **counts)
        draws = np.random.SeedSequence(seed).spawn(4)
        maps, *generators = map(np.random.default_rng, draws)
        self._initial, self._exploration, self._sampling = generators
        swept = self.network.swept_by_unit

        # Maps with one obstacle, so it is known what was hit. Three cells are drawn, and two used:
        # the draws belong to what one seed gives.
        self.width = width = swept.shape[1] + 5  # more than what the robot sees
        count = max(4, min(16, 60_000 // width**2))  # fewer, if they are large
        drawn = np.array(
            [maps.choice(width**2, 3, replace=False) for _ in range(count)]
        )
        self.goal_M = drawn[:, 1] * HEADINGS
        self.obstacle_M2 = np.column_stack(np.divmod(drawn[:, 2], width))

        of_heading = [
            np.flatnonzero(motions.start == heading) for heading in range(HEADINGS)
        ]
        most = max(map(len, of_heading))
        self.primitive_KN = np.array(
            [np.resize(numbers, most) for numbers in of_heading]
        ).T
        y, x = np.mgrid[: self.width, : self.width].reshape(2, -1, 1)
        dx, dy = motions.offset[self.primitive_KN].T[..., None, :].swapaxes(1, 3)
        cell_KCN = (y + dy) % self.width * self.width + (x + dx) % self.width
        next_KCN = cell_KCN * HEADINGS + motions.end[self.primitive_KN][:, None]
        self.next_KC = next_KCN.reshape(most, -1)
        self.reward_KC = np.tile(-motions.cost[self.primitive_KN], self.width**2)
        is_first_MC = np.arange(self.next_KC.shape[1]) != self.goal_M[:, None]
        _, self._first = np.nonzero(
            is_first_MC
        )  # where episodes start: on obstacles, too
        self._replay = ReplayBuffer(self.parameters.replay_capacity)
        self.steps = self.updates = 0

        tensors["weight"][:], tensors["threshold"][:] = FIRST
        # A unit's cells in a row, and one more of 0 for what it does not see.
        one_more = (0, 0), (0, 1)
        self._weight = np.pad(tensors["weight"].reshape(units, -1), one_more)
        self._swept = np.pad(swept.reshape(units, -1), one_more)
        self._threshold = tensors["threshold"]
        # Where a robot that has turned by quarters sees an obstacle, so many rows and columns away.
        side = swept.shape[1]
        near, seen = (
            np.arange(side) - side // 2,
            np.arange(side * side).reshape(side, side),
        )
        self._place = np.full((4, self.width, self.width), side * side)
        for quarter in range(4):
            self._place[quarter][np.ix_(near, near)] = np.rot90(seen, -quarter)

    def run(self, until: int) -> Iterator[BodyCertificate]:
        """Train until all is proved, or so many steps are done; yield what is proved so far.

        A step is one transition of one robot.
        """
        until = as_whole("the number of steps", until, 1, MOST_STEPS)
        self._settle()
        certificate = self.network.certificate()
        yield certificate
        while certificate.margin < MARGIN and self.steps < until:
            for _ in range(CHECKED):
                if self.steps >= until:
                    break
                self._step(min(self.parameters.environments, until - self.steps))
                if self.steps >= self.parameters.learning_starts:
                    self._update()
            weight = self.network.tensors["weight"]
            weight[:] = self._weight[:, :-1].reshape(weight.shape)
            certificate = self.network.certificate()
            yield certificate

    def metadata(self) -> ModelMetadata:
        """Return what the model file says of the network as it is now."""
        occupancy = np.zeros((self.width, self.width), dtype=np.bool_)
        occupancy[tuple(self.obstacle_M2[0])] = True
        p, sizes = self.parameters, self.network.sizes
        of_training = (
            GridMap(occupancy).fingerprint,
            self.steps,
            self.seed,
            package_version(),
        )
        return ModelMetadata(
            self.network.name, sizes, MoveRule.ROBOT_SAFE, p.gamma, *of_training
        )

    def _step(self, robots: int) -> None:
        """Let so many robots try a random primitive, and remember what came of it."""
        p, maps = self.parameters, len(self.goal_M)
        scenario = self._initial.integers(maps, size=robots)
        count = np.full(robots, len(self._first) // maps)
        places = self._first, scenario * count, count
        cell = initial_cells(self.goal_M[scenario], *places, p.p_r, self._initial)
        actions = self._exploration.integers(len(self.primitive_KN), size=robots)
        unit_BK, place_B = self._observed(scenario, cell)
        legal = ~self._swept[unit_BK[np.arange(len(cell)), actions], place_B]
        next_cell = np.where(legal, self.next_KC[actions, cell], cell)
        collision = np.float32(p.obstacle_reward)
        reward = np.where(legal, self.reward_KC[actions, cell], collision)
        goes_on = legal & (next_cell != self.goal_M[scenario])
        discount = np.where(goes_on, p.gamma, 0.0).astype(np.float32)
        self._replay.add(
            Transitions(scenario, cell, actions, reward, next_cell, discount)
        )
        self.steps += robots

    def _update(self) -> None:
        """Make one Double DQN update with a batch from the replay buffer."""
        p, units = self.parameters, len(self._weight)
        batch = self._replay.sample(p.batch_size, self._sampling)
        states = (
            np.tile(batch.scenario, 2),
            np.concatenate([batch.cell, batch.next_cell]),
        )
        unit_2BK, place_2B = self._observed(*states)
        p_2BK = self._success(unit_2BK, place_2B)
        collision = np.float32(p.obstacle_reward)
        gain_2BK = self._return_SCK[states] - collision
        q_BK, online_next_BK = np.split(collision + p_2BK * gain_2BK, 2)
        target_next_BK = self._q_SCK[batch.scenario, batch.next_cell]
        q_gradient = double_dqn_gradient(
            batch, q_BK, next_q(p.target, online_next_BK, target_next_BK)
        )
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
        heading, cell, width = cell % HEADINGS, cell // HEADINGS, self.width
        y, x = self.obstacle_M2[scenario].T
        seen = (
            heading // (HEADINGS // 4),
            (y - cell // width) % width,
            (x - cell % width) % width,
        )
        return self.network.unit[self.primitive_KN[:, heading]].T, self._place[seen]

    def _success(
        self, unit_BK: NDArray[np.int64], place_B: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """Return p(s, a) of what `_observed` returns: (B, K)."""
        logit_BK = self._threshold[unit_BK] - self._weight[unit_BK, place_B[:, None]]
        p_BK: NDArray[np.float32] = 0.5 + 0.5 * np.tanh(0.5 * logit_BK)
        return p_BK

    def _settle(self) -> None:
        """As the target network, settle V on every map."""
        p, cells = self.parameters, np.arange(self.next_KC.shape[1])
        self._return_SCK = np.empty(
            (len(self.goal_M), *self.next_KC.T.shape), np.float32
        )
        self._q_SCK = np.empty_like(self._return_SCK)
        for number in range(len(self.goal_M)):
            p_1CK = self._success(*self._observed(np.full_like(cells, number), cells))[
                None
            ]
            given = self.reward_KC.T[None], self.goal_M[[number]], self.next_KC, p.gamma
            (returns,), (q,) = value_iteration(p_1CK, *given, p.obstacle_reward)
            self._return_SCK[number], self._q_SCK[number] = returns, q
