"""The training of a robot's model: it bumps into obstacles until its body is proved."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ddqn_planner.grid import GridMap, MoveRule
from ddqn_planner.grid.arguments import as_seed, as_whole
from ddqn_planner.model import ModelMetadata, RobotNetwork
from ddqn_planner.planning import Planner
from ddqn_planner.robot.body_certificate import BodyCertificate
from ddqn_planner.robot.driving_costs import (
    CUSP_METRES,
    SPIN_METRES,
    DrivingCosts,
    with_costs,
)
from ddqn_planner.robot.footprint import read_footprint
from ddqn_planner.robot.motions import (
    BEHIND,
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
from ddqn_planner.training.value_iteration import value_iteration
from ddqn_planner.version import __version__

Floats: TypeAlias = NDArray[np.float32]
Integers: TypeAlias = NDArray[np.int64]
# A radius, points (x, y), or the text of either, see `read_footprint`.
Footprint: TypeAlias = str | float | ArrayLike

# Dimensions: B = a batch, U units, V cells of a unit's view and a last place for all
# cells outside it, N headings, K primitives of each heading (a heading with fewer has
# some twice), M maps, C poses.
# A map is a square of W * W cells that repeats in all directions, with one obstacle and
# a goal. A pose is the number (y * W + x) * N + heading. In `Transitions`, `scenario`
# is the number of a map, and `cell` and `next_cell` are poses.

# Every episode is one random primitive from any pose. The batch and the environments
# are per unit. A collision costs much more than a primitive, so that all successes
# teach about as much.
ROBOT: Final = HyperParameters(
    learning_rate=4.5e-5,
    learning_rate_decay=1.0,
    batch_size=24,
    gamma=0.2,
    obstacle_reward=-1000.0,
    p_r=1.0,
    steps=200_000_000,
    replay_capacity=200_000,
    learning_starts=250,
    target_interval=2000,
    environments=12,
)
PER_UNIT: Final = ("batch_size", "learning_starts", "environments")
LARGEST_COUNT: Final = 4096  # of each of the three, for all units
# On a map of more cells, a place of the view is met less often: so the three are larger
# by the same factor. Else weights would lose more between two collisions than these
# teach.
SMALL_MAP: Final = 10_000  # cells
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


def _parameters_for(units: int, cells: int) -> HyperParameters:
    """Return the hyper-parameters for so many units and cells of a map."""
    factor = max(1.0, cells / SMALL_MAP)
    counts = {
        name: min(LARGEST_COUNT, round(factor * units * getattr(ROBOT, name)))
        for name in PER_UNIT
    }
    # A batch's gradient is a mean: each transition teaches as much as on a small map.
    small_batch = min(LARGEST_COUNT, units * ROBOT.batch_size)
    learning_rate = ROBOT.learning_rate * counts["batch_size"] / small_batch
    return replace(ROBOT, learning_rate=learning_rate, **counts)


class RobotTrainer:
    """Trains a `RobotNetwork` by Double DQN.

    The same arguments give the same network.
    """

    def __init__(
        self,
        footprint: Footprint | None,
        motions: Motions,
        seed: int,
        padding: float = 0.0,
    ) -> None:
        """Make maps, tables and first weights.

        Parameters
        ----------
        footprint, padding
            The body, see `read_footprint`.
        motions : Motions
            Those of the robot, see `read_motions`.
        seed : int
            Of all random draws.
        """
        self.network = RobotNetwork.untrained(
            read_footprint(footprint, padding), motions
        )
        self.seed = as_seed(seed)
        units = self.network.sizes["units"]
        side = self.network.swept_by_unit.shape[1]  # of a unit's view, cells
        self.width = side + FREE_BORDER  # of a square map, cells
        self.headings = motions.headings
        self.parameters = _parameters_for(units, self.width**2)
        seeds = np.random.SeedSequence(self.seed).spawn(4)
        map_generator, *generators = [np.random.default_rng(item) for item in seeds]
        # They draw first poses, actions, and batches.
        self._initial, self._exploration, self._sampling = generators
        self._draw_maps(map_generator)
        self._tabulate_moves(motions)
        self._list_starts()
        self._tabulate_places(side)
        self.replay = ReplayBuffer(self.parameters.replay_capacity)
        self.steps = 0
        self.updates = 0
        tensors = self.network.tensors
        tensors["weight"][:] = FIRST_WEIGHT
        tensors["threshold"][:] = FIRST_THRESHOLD
        # (U, V): the weight of each place in a unit's view, and whether the body sweeps
        # it. An obstacle outside the view has the weight 0.
        outside = ((0, 0), (0, 1))
        self._weight_UV = np.pad(tensors["weight"].reshape(units, -1), outside)
        self._swept_UV = np.pad(self.network.swept_by_unit.reshape(units, -1), outside)
        self._threshold_U = tensors["threshold"]  # the network's own memory

    def _draw_maps(self, random: np.random.Generator) -> None:
        """Draw the goal and the obstacle of each of M maps.

        Sets `goal_M`, a pose, and `obstacle_x_M` and `obstacle_y_M`, in cells. With one
        obstacle per map, a collision tells which place the body swept.
        """
        cells = self.width**2  # of a map
        maps = max(1, min(16, 60_000 // cells))  # fewer, if they are large
        # The first of three cells is not used. Without it, a seed would draw others.
        drawn_M3 = [random.choice(cells, 3, replace=False) for _ in range(maps)]
        _, goal_cell_M, obstacle_M = np.transpose(drawn_M3)
        self.goal_M = goal_cell_M * self.headings  # the pose with heading 0
        self.obstacle_y_M, self.obstacle_x_M = np.divmod(obstacle_M, self.width)

    def _tabulate_moves(self, motions: Motions) -> None:
        """Tabulate where each primitive leads from each pose, and its reward.

        With K primitives for each of N headings, and C poses of a map, it sets
        `primitive_KN`, the numbers of the primitives that start with each heading, and
        `next_KC` and `reward_KC`, by the action 0 to K - 1 and the pose.
        """
        primitives = [
            np.flatnonzero(motions.start == heading) for heading in range(self.headings)
        ]
        count = max(map(len, primitives))  # K
        # `resize` repeats the primitives of a heading that has fewer than K.
        self.primitive_KN = np.transpose(
            [np.resize(numbers, count) for numbers in primitives]
        )
        # A pose is (y * width + x) * headings + heading.
        pose_C = np.arange(self.width**2 * self.headings)
        cell_C, heading_C = np.divmod(pose_C, self.headings)
        y_C, x_C = np.divmod(cell_C, self.width)
        primitive_KC = self.primitive_KN[:, heading_C]
        dx_KC, dy_KC = np.moveaxis(motions.offset[primitive_KC], 2, 0)  # cells
        next_x_KC = (x_C + dx_KC) % self.width  # the map repeats in all directions
        next_y_KC = (y_C + dy_KC) % self.width
        next_cell_KC = next_y_KC * self.width + next_x_KC
        self.next_KC = next_cell_KC * self.headings + motions.end[primitive_KC]
        self.reward_KC = -motions.cost[primitive_KC]

    def _list_starts(self) -> None:
        """Set `_starts`, the poses in which episodes start: all but the goal.

        They are first the poses of map 0, then those of map 1, and so on. Each map has
        the same number of them.
        """
        poses = self.width**2 * self.headings
        is_start_MC = np.arange(poses) != self.goal_M[:, None]
        _, self._starts = np.nonzero(is_start_MC)

    def _tabulate_places(self, side: int) -> None:
        """Tabulate in which place of the robot's view the map's obstacle lies.

        The view is a square of `side` x `side` cells around the robot, whose places are
        numbered row by row; place side * side stands for all cells outside. Sets
        `_place`, (4, width, width): the place by the quarter turns of the robot, and by
        the rows and columns from the robot to the obstacle, modulo the map's width.
        """
        view = np.arange(side * side).reshape(side, side)
        # Rows and columns from the robot; negative ones count from the table's end.
        offsets = np.arange(side) - side // 2
        self._place = np.full((4, self.width, self.width), side * side)
        for quarter in range(4):
            turned = np.rot90(view, -quarter)
            self._place[quarter][np.ix_(offsets, offsets)] = turned

    def run(self, until: int) -> Iterator[BodyCertificate]:
        """Train until the body is proved with a margin, or until step `until`.

        A generator: it yields the certificate of the network, before the training and
        after each UPDATES_PER_PROOF updates. A step is one transition of one robot.
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
            weight[:] = self._weight_UV[:, :-1].reshape(weight.shape)
            certificate = self.network.certificate()
            yield certificate

    def metadata(self) -> ModelMetadata:
        """Return what the model file says of the network in its present state.

        Its map's fingerprint is that of the training's first map.
        """
        occupancy = np.zeros((self.width, self.width), dtype=np.bool_)
        occupancy[self.obstacle_y_M[0], self.obstacle_x_M[0]] = True
        return ModelMetadata(
            network=self.network.name,
            sizes=self.network.sizes,
            move_rule=MoveRule.ROBOT_SAFE,
            gamma=self.parameters.gamma,
            map_fingerprint=GridMap(occupancy).fingerprint,
            steps=self.steps,
            seed=self.seed,
            package_version=__version__,
        )

    def _step(self, robots: int) -> None:
        """Let robots try one random primitive each, and remember the transitions.

        `robots` is the number B of robots. Each robot starts in a random pose of a
        random map.
        """
        p = self.parameters
        maps = len(self.goal_M)
        starts_per_map = len(self._starts) // maps
        scenario = self._initial.integers(maps, size=robots)
        pose = initial_cells(
            start_N=self.goal_M[scenario],  # unused, as p_r is 1
            free_cells=self._starts,
            first_N=scenario * starts_per_map,
            count_N=np.full(robots, starts_per_map),
            p_r=p.p_r,
            random=self._initial,
        )
        action = self._exploration.integers(len(self.primitive_KN), size=robots)
        unit_BK, place_B = self._view(scenario, pose)
        unit_B = unit_BK[np.arange(robots), action]
        # A primitive is legal where its unit does not sweep the obstacle's place.
        legal = ~self._swept_UV[unit_B, place_B]
        next_pose = np.where(legal, self.next_KC[action, pose], pose)
        collision = np.float32(p.obstacle_reward)
        reward = np.where(legal, self.reward_KC[action, pose], collision)
        continues = legal & (next_pose != self.goal_M[scenario])
        discount = np.where(continues, p.gamma, 0.0).astype(np.float32)
        self.replay.add(
            Transitions(scenario, pose, action, reward, next_pose, discount)
        )
        self.steps += robots

    def _update(self) -> None:
        """Draw a batch of B transitions, and descend along its Double DQN gradient.

        After each `target_interval` updates, Q and V are computed anew.
        """
        p = self.parameters
        batch = self.replay.sample(p.batch_size, self._sampling)
        # The B states and after them the B next states, in one evaluation.
        scenario_2B = np.tile(batch.scenario, 2)
        pose_2B = np.concatenate([batch.cell, batch.next_cell])
        unit_2BK, place_2B = self._view(scenario_2B, pose_2B)
        success_2BK = self._success(unit_2BK, place_2B)
        # Q(s, a) = r_o + p(s, a) gain, where the gain is r + γ V(s') - r_o.
        collision = np.float32(p.obstacle_reward)  # r_o
        gain_2BK = self._return_SCK[scenario_2B, pose_2B] - collision
        q_BK, online_next_BK = np.split(collision + success_2BK * gain_2BK, 2)
        target_next_BK = self._q_SCK[batch.scenario, batch.next_cell]
        q_of_target = next_q(p.target, online_next_BK, target_next_BK)
        by_q_BK = double_dqn_gradient(batch, q_BK, q_of_target)
        # By the chain rule: the gradient by the success of each action that was taken,
        # then by the logit of the success. The first B rows are those of the states.
        taken_actions = np.arange(p.batch_size), batch.action
        success_B = success_2BK[taken_actions]
        by_success_B = by_q_BK[taken_actions] * gain_2BK[taken_actions]
        by_logit_B = by_success_B * (success_B * (1 - success_B))
        self._descend(unit_2BK[taken_actions], place_2B[: p.batch_size], by_logit_B)
        self.updates += 1
        if self.updates % p.target_interval == 0:
            self._settle()

    def _descend(self, unit_B: Integers, place_B: Integers, by_logit_B: Floats) -> None:
        """Change weights and thresholds against the gradient of B logits.

        A logit is the threshold of unit `unit_B` minus this unit's weight of the place
        `place_B`; `by_logit_B` is the gradient of the loss by each logit.
        """
        step_B = self.parameters.learning_rate * len(self._weight_UV) * by_logit_B
        # All transitions of a unit move its threshold, and few move a weight: the
        # threshold must not jump.
        np.subtract.at(self._threshold_U, unit_B, THRESHOLD_RATE * step_B)
        np.add.at(self._weight_UV, (unit_B, place_B), step_B)
        self._weight_UV -= np.float32(DECAY)
        np.maximum(self._weight_UV, 0, out=self._weight_UV)
        self._weight_UV[:, -1] = 0  # of obstacles outside the view

    def _view(self, scenario: Integers, pose: Integers) -> tuple[Integers, Integers]:
        """Return what decides on the success of B robots in poses on maps.

        A unit of the network learns one primitive, and all that are this one turned by
        quarter turns. So the robot's view is turned back by its quarter turns, too.

        Parameters
        ----------
        scenario, pose : (B,) int64
            The number of each robot's map and of its pose, cell * N + heading.

        Returns
        -------
        (B, K) int64
            The number, 0 to U - 1, of the unit of each of the K actions in this pose.
        (B,) int64
            The place in the robot's view where the map's obstacle lies: 0 to V - 1.
        """
        cell, heading = np.divmod(pose, self.headings)
        y, x = np.divmod(cell, self.width)
        quarter = heading // (self.headings // 4)
        # From the robot to the obstacle; the map repeats in all directions.
        rows = (self.obstacle_y_M[scenario] - y) % self.width
        columns = (self.obstacle_x_M[scenario] - x) % self.width
        unit_BK = self.network.unit[self.primitive_KN[:, heading]].T
        return unit_BK, self._place[quarter, rows, columns]

    def _success(self, unit_BK: Integers, place_B: Integers) -> Floats:
        """Return p(s, a), (B, K): the probability that an action passes the obstacle.

        `unit_BK` is the unit of each action, and `place_B` the obstacle's place in the
        robot's view.
        """
        weight_BK = self._weight_UV[unit_BK, place_B[:, None]]
        logit_BK = self._threshold_U[unit_BK] - weight_BK
        success_BK: Floats = 0.5 + 0.5 * np.tanh(0.5 * logit_BK)
        return success_BK

    def _settle(self) -> None:
        """Compute Q and r + γ V(s') on all maps, by the present weights.

        Sets `_q_SCK` and `_return_SCK`, by map, pose and action. They stay the same
        until the next call, as a target network's do.
        """
        p = self.parameters
        actions, poses = self.next_KC.shape
        maps = len(self.goal_M)
        self._return_SCK = np.empty((maps, poses, actions), np.float32)
        self._q_SCK = np.empty((maps, poses, actions), np.float32)
        for number in range(maps):  # one after another, as all need much memory
            scenario = np.full(poses, number)
            unit_CK, place_C = self._view(scenario, np.arange(poses))
            success_CK = self._success(unit_CK, place_C)
            # `value_iteration` takes arrays of several maps: here, of one.
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


class MotionOptions(NamedTuple):
    """What a robot's motions are made from: a kind of motion, or a lattice file."""

    motion: str | None = None  # one of `Motion`; then there is no lattice
    turning_radius: float = 0.0  # metres, of the tightest bends
    resolution: float = 0.05  # metres per cell
    headings: int = HEADINGS  # 16, 32 or 64
    lattice: str | Path | None = None  # a file, in place of the four
    allow_reverse: bool = False  # the lattice's motions also in reverse
    costs: DrivingCosts = DrivingCosts()


def train_robot(  # noqa: PLR0913
    footprint: Footprint,
    motion: str | None = None,
    *,
    turning_radius: float = 0.0,
    resolution: float = 0.05,
    headings: int = HEADINGS,
    lattice: str | Path | None = None,
    padding: float = 0.0,
    bend_cost: float | None = None,
    reverse_cost: float = BEHIND,
    cusp_cost: float = CUSP_METRES,
    spin_cost: float = SPIN_METRES,
    seed: int = 0,
    steps: int = ROBOT.steps,
) -> Planner:
    """Train the model of a robot with a body and a heading until it is proved.

    This is ``ddqn-planner train-robot`` as a call. The same arguments give the same
    model. `Planner.plan_poses` plans with the result, and `Planner.save` saves it.

    Parameters
    ----------
    footprint : number, sequence of points, or str
        The body in metres around the robot's origin: a radius, at least three points
        (x, y), or a text of either as in Nav2.
    motion : str, optional
        ``"differential"``, ``"ackermann"`` or ``"omnidirectional"``.
    turning_radius : float
        Of the tightest bends, in metres; ackermann needs it.
    resolution : float
        Metres per cell of the maps.
    headings : int
        How many: 16, 32 or 64. With more, the robot finds a way through narrower
        passages that are askew to the map's cells, and plans with more memory.
    lattice : path, optional
        A file of Nav2's lattice generator, in place of these four.
    padding : float
        Metres by which the body counts as larger: room for a controller.
    bend_cost : float, optional
        Of a metre in a bend, in metres driven straight ahead: 1 or more, by default
        1.15. A lattice's bends cost what its file says, unless a number is given.
    reverse_cost : float
        Of a metre in reverse or sideways, likewise.
    cusp_cost : float
        Of a change between ahead and reverse, in metres: as far as the robot drives in
        the time that the change takes. With 0, a request takes less time.
    spin_cost : float
        Of a turn by one radian on the spot, in metres: 0.5 or more.
    seed : int
        Of all random draws: 0 to 2^63 - 1.
    steps : int
        Transitions after which to give up.

    Raises
    ------
    ValueError
        If an argument is wrong, or the model is not proved after the steps.

    Examples
    --------
    >>> import numpy as np
    >>> from ddqn_planner import GridMap, train_robot
    >>> planner = train_robot(0.1, "differential", resolution=0.25)
    >>> grid = GridMap(np.zeros((20, 30)), resolution=0.25)
    >>> planner.plan_poses(grid, start=(1, 1, 0), goal=(5, 3, 0)).status.name
    'SUCCEEDED'
    """
    costs = DrivingCosts(bend_cost, reverse_cost, cusp_cost, spin_cost)
    options = MotionOptions(
        motion, turning_radius, resolution, headings, lattice, costs=costs
    )
    motions = read_motions(options)
    trainer = RobotTrainer(footprint, motions, seed, padding)
    *_, certificate = trainer.run(steps)
    if not certificate.proved:
        raise ValueError(
            f"after {trainer.steps:,} steps the model is {certificate}; give more "
            "steps, or another seed or resolution"
        )
    return Planner(trainer.network, trainer.metadata())


def read_motions(options: MotionOptions) -> Motions:
    """Return the primitives of a kind of motion, or of a lattice file."""
    if options.allow_reverse and options.lattice is None:
        problem = "allow_reverse is given without a lattice"
        raise ValueError(f"{problem}; leave it out: all other motions can reverse")
    if options.motion is not None and options.lattice is None:
        motions = make_motions(
            options.motion,
            options.turning_radius,
            options.resolution,
            options.headings,
        )
        return with_costs(motions, options.costs, is_lattice=False)
    if options.lattice is not None and options.motion is None:
        motions = read_lattice(options.lattice, options.allow_reverse)
        return with_costs(motions, options.costs, is_lattice=True)
    is_neither = options.motion is None
    problem = (
        "neither motion nor lattice is" if is_neither else "motion and lattice are"
    )
    remedy = f"give one of the two: motion {', '.join(Motion)}, or lattice FILE"
    raise ValueError(f"{problem} given; {remedy}")
