"""The training of a robot's model: it bumps into obstacles until its body is proved."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import GridMap, MoveRule
from ddqn_planner.grid.arguments import as_seed, as_whole
from ddqn_planner.model import ModelMetadata, RobotNetwork, package_version
from ddqn_planner.robot.body_certificate import BodyCertificate
from ddqn_planner.robot.footprint import read_footprint
from ddqn_planner.robot.motions import (
    HEADINGS,
    Motion,
    Motions,
    make_motions,
    read_lattice,
)
from ddqn_planner.training.double_dqn import (
    ReplayBuffer,
    Transitions,
    double_dqn_gradient,
    next_q,
)
from ddqn_planner.training.exploring_starts import initial_cells
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.propagation import value_iteration

Floats: TypeAlias = NDArray[np.float32]
Integers: TypeAlias = NDArray[np.int64]

# Shapes: B = a batch, U units, K = primitives of each of N headings (headings with few
# have some twice), M maps, which repeat in all directions, C poses, numbers
# (y * W + x) * 16 + heading.

# Every episode is one random primitive from any pose. The batch and the environments
# are per unit. A collision costs much more than a primitive, so that all successes
# teach about as much.
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
PER_UNIT: Final = ("batch_size", "learning_starts", "environments")
LARGEST_COUNT: Final = 4096  # of these for all units
# Of a network that knows nothing.
FIRST_WEIGHT: Final = 0.3
FIRST_THRESHOLD: Final = 1.0
# What each weight loses per update: an obstacle is harmless unless it was hit.
DECAY: Final = 3e-5
THRESHOLD_RATE: Final = 0.1  # of a weight's learning rate
UPDATES_PER_PROOF: Final = 100
MOST_STEPS: Final = 10**12
MARGIN: Final = 0.02  # of the proof, with which the training ends
FREE_BORDER: Final = 5  # cells by which a map is larger than what the robot sees


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
        motions = _read_motions(motion, turning_radius, resolution, lattice)
        self.network = RobotNetwork.untrained(
            read_footprint(footprint, padding), motions
        )
        self.seed = as_seed(seed)
        units = self.network.sizes["units"]
        counts = {
            name: min(LARGEST_COUNT, units * getattr(ROBOT, name)) for name in PER_UNIT
        }
        self.parameters = replace(ROBOT, **counts)
        seeds = np.random.SeedSequence(self.seed).spawn(4)
        map_generator, *generators = [np.random.default_rng(item) for item in seeds]
        self._initial, self._exploration, self._sampling = generators
        side = self.network.swept_by_unit.shape[1]
        self.width = side + FREE_BORDER
        self._draw_maps(map_generator)
        self._tabulate_moves(motions)
        self._tabulate_places(side)
        self._replay = ReplayBuffer(self.parameters.replay_capacity)
        self.steps = 0
        self.updates = 0
        tensors = self.network.tensors
        tensors["weight"][:] = FIRST_WEIGHT
        tensors["threshold"][:] = FIRST_THRESHOLD
        # A unit's cells in a row, and a last one of 0 for what it does not see.
        last_cell = ((0, 0), (0, 1))
        self._weight = np.pad(tensors["weight"].reshape(units, -1), last_cell)
        self._swept = np.pad(self.network.swept_by_unit.reshape(units, -1), last_cell)
        self._threshold = tensors["threshold"]

    def _draw_maps(self, random: np.random.Generator) -> None:
        """Draw maps of one obstacle, so that it is known what was hit."""
        cells = self.width**2
        maps = max(4, min(16, 60_000 // cells))  # fewer, if they are large
        # The first of three cells is not used, but drawn: the draws belong to what one
        # seed gives.
        drawn = [random.choice(cells, 3, replace=False) for _ in range(maps)]
        _, goal, obstacle = np.transpose(drawn)
        self.goal_M = goal * HEADINGS
        self.obstacle_M2 = np.column_stack(np.divmod(obstacle, self.width))  # y, x

    def _tabulate_moves(self, motions: Motions) -> None:
        """Tabulate where primitives lead, what they cost, and where episodes start."""
        primitives = [
            np.flatnonzero(motions.start == heading) for heading in range(HEADINGS)
        ]
        count = max(map(len, primitives))
        self.primitive_KN = np.transpose(
            [np.resize(numbers, count) for numbers in primitives]
        )
        cell = np.arange(self.width**2)[:, None]
        y, x = np.divmod(cell, self.width)
        dx_KN, dy_KN = np.moveaxis(motions.offset[self.primitive_KN], 2, 0)
        # (K, cells, N)
        next_y = (y + dy_KN[:, None]) % self.width
        next_x = (x + dx_KN[:, None]) % self.width
        next_heading = motions.end[self.primitive_KN][:, None]
        next_pose = (next_y * self.width + next_x) * HEADINGS + next_heading
        self.next_KC = next_pose.reshape(count, -1)
        self.reward_KC = np.tile(-motions.cost[self.primitive_KN], self.width**2)
        # Episodes start anywhere but at the goal, on obstacles, too.
        is_start_MC = np.arange(self.next_KC.shape[1]) != self.goal_M[:, None]
        _, self._starts = np.nonzero(is_start_MC)

    def _tabulate_places(self, side: int) -> None:
        """Tabulate which cell of its view an obstacle is in for a robot.

        By the quarters that the robot has turned, and how many rows and columns away
        the obstacle lies; side * side is a place that it does not see.
        """
        view = np.arange(side * side).reshape(side, side)
        offsets = np.arange(side) - side // 2
        self._place = np.full((4, self.width, self.width), side * side)
        for quarter in range(4):
            turned = np.rot90(view, -quarter)
            self._place[quarter][np.ix_(offsets, offsets)] = turned

    def run(self, until: int) -> Iterator[BodyCertificate]:
        """Train until all is proved, or so many steps are done; yield what is proved so far.

        A step is one transition of one robot.
        """
        until = as_whole("the number of steps", until, 1, MOST_STEPS)
        self._settle()
        certificate = self.network.certificate()
        yield certificate
        while certificate.margin < MARGIN and self.steps < until:
            for _ in range(UPDATES_PER_PROOF):
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
        y, x = self.obstacle_M2[0]
        occupancy[y, x] = True
        return ModelMetadata(
            network=self.network.name,
            sizes=self.network.sizes,
            move_rule=MoveRule.ROBOT_SAFE,
            gamma=self.parameters.gamma,
            map_fingerprint=GridMap(occupancy).fingerprint,
            steps=self.steps,
            seed=self.seed,
            package_version=package_version(),
        )

    def _step(self, robots: int) -> None:
        """Let so many robots try a random primitive, and remember what came of it."""
        p = self.parameters
        maps = len(self.goal_M)
        starts = len(self._starts) // maps  # of each map
        scenario = self._initial.integers(maps, size=robots)
        pose = initial_cells(
            self.goal_M[scenario],
            self._starts,
            scenario * starts,
            np.full(robots, starts),
            p.p_r,
            self._initial,
        )
        action = self._exploration.integers(len(self.primitive_KN), size=robots)
        unit_BK, place_B = self._view(scenario, pose)
        unit_B = unit_BK[np.arange(robots), action]
        legal = ~self._swept[unit_B, place_B]
        next_pose = np.where(legal, self.next_KC[action, pose], pose)
        collision = np.float32(p.obstacle_reward)
        reward = np.where(legal, self.reward_KC[action, pose], collision)
        continues = legal & (next_pose != self.goal_M[scenario])
        discount = np.where(continues, p.gamma, 0.0).astype(np.float32)
        self._replay.add(
            Transitions(scenario, pose, action, reward, next_pose, discount)
        )
        self.steps += robots

    def _update(self) -> None:
        """Make one Double DQN update with a batch from the replay buffer."""
        p = self.parameters
        batch = self._replay.sample(p.batch_size, self._sampling)
        # The states, and after them the next states.
        scenario = np.tile(batch.scenario, 2)
        pose = np.concatenate([batch.cell, batch.next_cell])
        unit_2BK, place_2B = self._view(scenario, pose)
        success_2BK = self._success(unit_2BK, place_2B)
        # Q(s, a) = p (r + γ V(s')) + (1 - p) r_o
        collision = np.float32(p.obstacle_reward)
        gain_2BK = self._return_SCK[scenario, pose] - collision
        q_BK, online_next_BK = np.split(collision + success_2BK * gain_2BK, 2)
        target_next_BK = self._q_SCK[batch.scenario, batch.next_cell]
        by_q_BK = double_dqn_gradient(
            batch, q_BK, next_q(p.target, online_next_BK, target_next_BK)
        )
        # The gradient by the logit of the success of each action that was taken.
        rows = np.arange(p.batch_size)
        success_B = success_2BK[rows, batch.action]
        by_success_B = (by_q_BK * gain_2BK[: p.batch_size])[rows, batch.action]
        by_logit_B = by_success_B * (success_B * (1 - success_B))
        units = len(self._weight)
        step_B = p.learning_rate * units * by_logit_B
        unit_B = unit_2BK[rows, batch.action]
        place_B = place_2B[: p.batch_size]
        # All transitions of a unit move its threshold, and few move a weight: the
        # threshold must not jump.
        np.subtract.at(self._threshold, unit_B, THRESHOLD_RATE * step_B)
        np.add.at(self._weight, (unit_B, place_B), step_B)
        self._weight -= np.float32(DECAY)
        np.maximum(self._weight, 0, out=self._weight)
        self._weight[:, -1] = 0
        self.updates += 1
        if self.updates % p.target_interval == 0:
            self._settle()

    def _view(self, scenario: Integers, pose: Integers) -> tuple[Integers, Integers]:
        """Return the unit of each action, (B, K), and the place of the obstacle, (B,)."""
        cell, heading = np.divmod(pose, HEADINGS)
        y, x = np.divmod(cell, self.width)
        obstacle_y, obstacle_x = self.obstacle_M2[scenario].T
        quarter = heading // (HEADINGS // 4)
        rows = (obstacle_y - y) % self.width
        columns = (obstacle_x - x) % self.width
        unit_BK = self.network.unit[self.primitive_KN[:, heading]].T
        return unit_BK, self._place[quarter, rows, columns]

    def _success(self, unit_BK: Integers, place_B: Integers) -> Floats:
        """Return p(s, a) of what `_view` returns: (B, K)."""
        logit_BK = self._threshold[unit_BK] - self._weight[unit_BK, place_B[:, None]]
        success_BK: Floats = 0.5 + 0.5 * np.tanh(0.5 * logit_BK)
        return success_BK

    def _settle(self) -> None:
        """As the target network, settle V on every map."""
        p = self.parameters
        actions, poses = self.next_KC.shape
        maps = len(self.goal_M)
        self._return_SCK = np.empty((maps, poses, actions), np.float32)
        self._q_SCK = np.empty((maps, poses, actions), np.float32)
        for number in range(maps):  # one after another, as all need much memory
            scenario = np.full(poses, number)
            success_CK = self._success(*self._view(scenario, np.arange(poses)))
            return_1CK, q_1CK = value_iteration(
                success_CK[None],
                self.reward_KC.T[None],
                self.goal_M[[number]],
                self.next_KC,
                p.gamma,
                p.obstacle_reward,
            )
            self._return_SCK[number] = return_1CK[0]
            self._q_SCK[number] = q_1CK[0]


def _read_motions(
    motion: str | None,
    turning_radius: float,
    resolution: float,
    lattice: str | Path | None,
) -> Motions:
    """Return the primitives of a kind of motion, or of a lattice file."""
    if motion is not None and lattice is None:
        return make_motions(motion, turning_radius, resolution)
    if lattice is not None and motion is None:
        return read_lattice(lattice)
    is_neither = motion is None
    problem = (
        "neither motion nor lattice is" if is_neither else "motion and lattice are"
    )
    remedy = f"give one of the two: motion {', '.join(Motion)}, or lattice FILE"
    raise ValueError(f"{problem} given; {remedy}")
