"""The grid environment: a scalar one with Gymnasium's interface, and a batch of N in NumPy.

Both have the same dynamics (`test/training/test_environment.py` walks them side by side).

Action space
    ``Discrete(8)``: the moves of `ddqn_planner.grid.MOVES`.
Observation space
    ``Box(H, W) float32``: the matrix of `ddqn_planner.model.observation`.
Rewards
    ``obstacle_reward`` for an illegal move, which leaves the robot where it is. For any other move
    the paper's: ``goal_reward`` for reaching the end, else `free_cell_reward`; or, if the parameter
    ``reward`` is ``path_cost``, `path_cost_reward`.
Episode end
    Terminated at the end or at an illegal move, truncated after ``max_episode_steps``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from ddqn_planner.grid import (
    MOVES,
    Cell,
    GridMap,
    MoveRule,
    legal_moves,
    neighbours,
    read_map_file,
)
from ddqn_planner.model.observation import GOAL, OBSTACLE, ROBOT, observation_background, observe
from ddqn_planner.resources import find_resource
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.initialisation import initial_cells
from ddqn_planner.training.reward import free_cell_reward, path_cost_reward


@dataclass(frozen=True)
class Scenario:
    """One path planning problem.

    Parameters
    ----------
    grid : GridMap
    start, goal : (x, y)
        Two different free cells.
    move_rule : MoveRule, optional
        The rule of its environment by default.

    Raises
    ------
    ValueError
        If the start or the goal is occupied or outside the map, or they are one cell.
    """

    grid: GridMap
    start: Cell
    goal: Cell
    move_rule: MoveRule | None = None

    def __post_init__(self) -> None:
        for name, cell in (("start", self.start), ("goal", self.goal)):
            if not self.grid.is_free(cell):
                raise ValueError(f"the {name} {cell} is not a free cell of the map; give another")
        if self.start == self.goal:
            raise ValueError(f"start and goal are both {self.start}; give two different cells")


def move_reward(
    scenario: Scenario, move_rule: MoveRule, parameters: HyperParameters
) -> NDArray[np.float32]:
    """Return the reward of each move that is legal: (8, H, W) float32."""
    grid = scenario.grid
    if parameters.reward == "path_cost":
        return path_cost_reward(grid, move_rule)
    shape = (grid.height, grid.width)
    reward = free_cell_reward(shape, scenario.start, scenario.goal, parameters)
    to_goal = neighbours(shape) == scenario.goal[1] * grid.width + scenario.goal[0]
    reward[to_goal.reshape(reward.shape)] = parameters.goal_reward
    return reward


class Moved(NamedTuple):
    """What one step did to N robots."""

    cell: NDArray[np.int64]
    """(N,) the cell after the step, y * W + x."""
    reward: NDArray[np.float32]
    """(N,)"""
    terminated: NDArray[np.bool_]
    """(N,) at the end, or collided."""
    truncated: NDArray[np.bool_]
    """(N,) out of steps."""


Observations = NDArray[np.float32]


def observation_space(shape: tuple[int, int]) -> gymnasium.spaces.Space[Observations]:
    """Return the space of the observations of maps of shape (H, W)."""
    space: gymnasium.spaces.Space[Any] = gymnasium.spaces.Box(
        OBSTACLE, max(GOAL, ROBOT), shape, np.float32
    )
    return space


class GridVectorEnvironment(VectorEnv[Observations, NDArray[np.int64], Any]):
    """N robots on grid maps, stepped at once.

    What a move does is looked up in tables made at the start, (S scenarios, 8 actions, H * W). An
    ended episode stays as it ended, its last observation with it, until `reset` is called with
    ``options={"reset_mask": mask}`` (Gymnasium's autoreset mode "disabled").

    Parameters
    ----------
    scenarios : sequence of Scenario
        Maps of one size; each episode draws one of them.
    move_rule : MoveRule
    parameters : HyperParameters
        For N (``environments``), the rewards, p_r and ``max_episode_steps``.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.DISABLED}  # noqa: RUF012

    def __init__(
        self, scenarios: Sequence[Scenario], move_rule: MoveRule, parameters: HyperParameters
    ) -> None:
        shapes = {scenario.grid.occupancy.shape for scenario in scenarios}
        if len(shapes) != 1:
            raise ValueError(f"the maps have the sizes {sorted(shapes)}; give maps of one size")
        (self.shape,) = shapes
        self.scenarios = tuple(scenarios)
        self.num_envs = parameters.environments
        self.single_action_space = gymnasium.spaces.Discrete(len(MOVES))
        self.single_observation_space = observation_space(self.shape)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.parameters = parameters

        width = self.shape[1]
        self._offset = MOVES[:, 1] * width + MOVES[:, 0]
        self.start = np.array([s.start[1] * width + s.start[0] for s in scenarios])
        self.goal = np.array([s.goal[1] * width + s.goal[0] for s in scenarios])
        self.background = np.stack(
            [observation_background(s.grid.occupancy, s.goal) for s in scenarios]
        )
        self.move_rules = tuple(s.move_rule or move_rule for s in scenarios)
        self._legal = np.stack(
            [
                legal_moves(s.grid.occupancy, rule).reshape(len(MOVES), -1)
                for s, rule in zip(scenarios, self.move_rules, strict=True)
            ]
        )
        self.free_reward = np.stack(
            [
                move_reward(s, rule, parameters).reshape(len(MOVES), -1)
                for s, rule in zip(scenarios, self.move_rules, strict=True)
            ]
        )
        self._reward = np.where(
            self._legal, self.free_reward, np.float32(parameters.obstacle_reward)
        )
        free = [np.flatnonzero(~s.grid.occupancy) for s in scenarios]
        free = [cells[cells != goal] for cells, goal in zip(free, self.goal, strict=True)]
        self._free_count = np.array([len(cells) for cells in free])
        self._free = np.stack([np.resize(cells, self._free_count.max()) for cells in free])

        self.scenario = np.zeros(self.num_envs, dtype=np.int64)
        self.cell = self.start[self.scenario]
        self.steps = np.zeros(self.num_envs, dtype=np.int64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Begin new episodes: all, or those where ``options["reset_mask"]`` (N,) bool is True."""
        super().reset(seed=seed)
        self.begin((options or {}).get("reset_mask", np.ones(self.num_envs, dtype=np.bool_)))
        return self.observations(), {}

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Observations, NDArray[Any], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Make one move each: (N,) actions; see the module for rewards and ends."""
        moved = self.move(actions)
        return self.observations(), moved.reward, moved.terminated, moved.truncated, {}

    def begin(self, reset_mask: NDArray[np.bool_]) -> None:
        """Begin a new episode in each environment where `reset_mask` (N,) is True."""
        scenario = self.np_random.integers(len(self.start), size=int(reset_mask.sum()))
        self.scenario[reset_mask] = scenario
        self.cell[reset_mask] = initial_cells(
            self.start[scenario],
            self._free[scenario],
            self._free_count[scenario],
            self.parameters.p_r,
            self.np_random,
        )
        self.steps[reset_mask] = 0

    def move(self, actions: NDArray[np.int64]) -> Moved:
        """Make one move each, without drawing observations."""
        lookup = (self.scenario, actions, self.cell)
        legal, reward = self._legal[lookup], self._reward[lookup]
        self.cell = np.where(legal, self.cell + self._offset[actions], self.cell)
        reached = self.cell == self.goal[self.scenario]
        self.steps += 1
        terminated = reached | ~legal
        truncated = (self.steps >= self.parameters.max_episode_steps) & ~terminated
        return Moved(self.cell, reward, terminated, truncated)

    def observations(self) -> Observations:
        """Return what the robots see: (N, H, W) float32."""
        return observe(self.background[self.scenario], self.cell, self.shape)


class GridEnvironment(gymnasium.Env[Observations, np.int64]):
    """One robot on one grid map: the same as `GridVectorEnvironment`, spelled out.

    ``gymnasium.make("ddqn_planner.training:ddqn_planner/Grid-v0")`` gives the paper's map.

    Parameters
    ----------
    scenario : Scenario, optional
        The paper's map, start and end by default.
    move_rule : MoveRule
    parameters : HyperParameters
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        scenario: Scenario | None = None,
        move_rule: MoveRule = MoveRule.CORNER_CUTTING,
        parameters: HyperParameters | None = None,
    ) -> None:
        self.scenario = scenario or paper_scenario()
        self.parameters = parameters or HyperParameters()
        grid = self.scenario.grid
        self.shape = (grid.height, grid.width)
        self.action_space = gymnasium.spaces.Discrete(len(MOVES))
        self.observation_space = observation_space(self.shape)
        self._background = observation_background(grid.occupancy, self.scenario.goal)
        rule = self.scenario.move_rule or move_rule
        self._legal = legal_moves(grid.occupancy, rule)
        self._reward = move_reward(self.scenario, rule, self.parameters)
        self.cell: Cell = self.scenario.start
        self.steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Begin an episode at the start or, with probability p_r, at a random free cell."""
        super().reset(seed=seed)
        cells = [cell for cell in self.scenario.grid.free_cells() if cell != self.scenario.goal]
        width = self.shape[1]
        numbers = np.array([y * width + x for x, y in cells])
        start = np.array([self.scenario.start[1] * width + self.scenario.start[0]])
        count = np.array([len(cells)])
        (number,) = initial_cells(start, numbers[None], count, self.parameters.p_r, self.np_random)
        self.cell = (int(number) % width, int(number) // width)
        self.steps = 0
        return self._observation(), {}

    def step(self, action: np.int64) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Make one move."""
        x, y = self.cell
        self.steps += 1
        out_of_steps = self.steps >= self.parameters.max_episode_steps
        if not self._legal[action, y, x]:
            return self._observation(), self.parameters.obstacle_reward, True, False, {}
        self.cell = (x + int(MOVES[action, 0]), y + int(MOVES[action, 1]))
        reached = self.cell == self.scenario.goal
        reward = float(self._reward[action, y, x])
        return self._observation(), reward, reached, out_of_steps and not reached, {}

    def _observation(self) -> Observations:
        number = np.array([self.cell[1] * self.shape[1] + self.cell[0]])
        observation: Observations = observe(self._background, number, self.shape)[0]
        return observation


def paper_scenario() -> Scenario:
    """Return the paper's map with its start and end."""
    map_file = read_map_file(find_resource("maps", "dilemma.yaml"))
    if map_file.start is None or map_file.goal is None:
        raise ValueError("maps/dilemma.yaml names no start and goal; restore the shipped file")
    return Scenario(map_file.grid(), map_file.start, map_file.goal)
