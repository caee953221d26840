"""The grid environment: N robots in NumPy, and one robot with Gymnasium's interface.

Action space
    ``Discrete(8)``: the moves of `ddqn_planner.grid.MOVES`.
Observation space
    ``Box(H, W) float32``: the matrix of `ddqn_planner.model.observation`.
Rewards
    ``obstacle_reward`` for an illegal move, after which the robot stays in its cell. For a legal
    move with the parameter ``reward = "paper"``: ``goal_reward`` for reaching the goal, else
    `free_cell_reward`. With ``reward = "path_cost"``: `path_cost_reward`.
End of an episode
    Terminated at the goal or at an illegal move, truncated after ``max_episode_steps``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from ddqn_planner.grid import MOVES, Cell, GridMap, MoveRule, legal_moves, neighbours, read_map_file
from ddqn_planner.model.observation import GOAL, OBSTACLE, ROBOT, observation_background, observe
from ddqn_planner.resources import find_resource
from ddqn_planner.training.exploring_starts import initial_cells
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.reward import free_cell_reward, path_cost_reward

Observations = NDArray[np.float32]


@dataclass(frozen=True)
class Scenario:
    """One path planning problem.

    Parameters
    ----------
    grid : GridMap
    start, goal : (x, y)
        Two different free cells.
    move_rule : MoveRule, optional
        By default the rule of its environment.

    Raises
    ------
    ValueError
        If the start or the goal is occupied or outside the map, or both are the same cell.
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


def paper_scenario() -> Scenario:
    """Return the paper's map with its start and goal."""
    map_file = read_map_file(find_resource("maps", "dilemma.yaml"))
    if map_file.start is None or map_file.goal is None:
        raise ValueError("maps/dilemma.yaml names no start and goal; restore the shipped file")
    return Scenario(map_file.grid(), map_file.start, map_file.goal)


def move_reward(
    scenario: Scenario, move_rule: MoveRule, parameters: HyperParameters
) -> NDArray[np.float32]:
    """Return the reward of each legal move: (8, H, W) float32."""
    grid = scenario.grid
    if parameters.reward == "path_cost":
        return path_cost_reward(grid, move_rule)
    shape = (grid.height, grid.width)
    reward = free_cell_reward(shape, scenario.start, scenario.goal, parameters)
    to_goal = neighbours(shape) == scenario.goal[1] * grid.width + scenario.goal[0]
    reward[to_goal.reshape(reward.shape)] = parameters.goal_reward
    return reward


class StepResult(NamedTuple):
    """The result of one step of N robots."""

    cell: NDArray[np.int64]
    """(N,) the cell after the step, y * W + x."""
    reward: NDArray[np.float32]
    """(N,)"""
    terminated: NDArray[np.bool_]
    """(N,) whether the robot reached the goal or collided."""
    truncated: NDArray[np.bool_]
    """(N,) whether the episode is out of steps."""


class GridVectorEnvironment(VectorEnv[Observations, NDArray[np.int64], Any]):
    """N robots on grid maps, all moved in one step.

    The results of all moves are looked up in tables, (S scenarios, 8 actions, H * W). An ended
    episode keeps its last observation until `reset` is called with
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
        self.parameters = parameters
        self.move_rules = tuple(s.move_rule or move_rule for s in scenarios)
        self.num_envs = parameters.environments
        self.single_action_space = gymnasium.spaces.Discrete(len(MOVES))
        self.single_observation_space: gymnasium.spaces.Space[Any] = gymnasium.spaces.Box(
            OBSTACLE, max(GOAL, ROBOT), self.shape, np.float32
        )
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

        width = self.shape[1]
        with_rules = list(zip(scenarios, self.move_rules, strict=True))
        tables = (len(scenarios), len(MOVES), -1)
        self._offset = MOVES[:, 1] * width + MOVES[:, 0]
        self.start = np.array([s.start[1] * width + s.start[0] for s in scenarios])
        self.goal = np.array([s.goal[1] * width + s.goal[0] for s in scenarios])
        self.background = np.stack(
            [observation_background(s.grid.occupancy, s.goal) for s in scenarios]
        )
        self._legal = np.stack(
            [legal_moves(s.grid.occupancy, rule) for s, rule in with_rules]
        ).reshape(tables)
        self.free_reward = np.stack(
            [move_reward(s, rule, parameters) for s, rule in with_rules]
        ).reshape(tables)
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
        """Start new episodes: all, or those where ``options["reset_mask"]`` (N,) bool is True."""
        super().reset(seed=seed)
        self.reset_where((options or {}).get("reset_mask", np.ones(self.num_envs, dtype=np.bool_)))
        return self.observations(), {}

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Observations, NDArray[Any], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Move each robot once: (N,) actions."""
        result = self.move(actions)
        return self.observations(), result.reward, result.terminated, result.truncated, {}

    def reset_where(self, mask: NDArray[np.bool_]) -> None:
        """Start a new episode in each environment where `mask` (N,) is True."""
        scenario = self.np_random.integers(len(self.start), size=int(mask.sum()))
        self.scenario[mask] = scenario
        self.cell[mask] = initial_cells(
            self.start[scenario],
            self._free[scenario],
            self._free_count[scenario],
            self.parameters.p_r,
            self.np_random,
        )
        self.steps[mask] = 0

    def move(self, actions: NDArray[np.int64]) -> StepResult:
        """Move each robot once, as `step` does, without making the observations."""
        lookup = (self.scenario, actions, self.cell)
        legal, reward = self._legal[lookup], self._reward[lookup]
        self.cell = np.where(legal, self.cell + self._offset[actions], self.cell)
        reached = self.cell == self.goal[self.scenario]
        self.steps += 1
        terminated = reached | ~legal
        truncated = (self.steps >= self.parameters.max_episode_steps) & ~terminated
        return StepResult(self.cell, reward, terminated, truncated)

    def observations(self) -> Observations:
        """Return what the robots observe: (N, H, W) float32."""
        return observe(self.background[self.scenario], self.cell, self.shape)


class GridEnvironment(gymnasium.Env[Observations, np.int64]):
    """One robot on one grid map: a `GridVectorEnvironment` with N = 1.

    ``gymnasium.make("ddqn_planner.training:ddqn_planner/Grid-v0")`` gives the paper's map.

    Parameters
    ----------
    scenario : Scenario, optional
        By default the paper's map, start and goal.
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
        parameters = replace(parameters or HyperParameters(), environments=1)
        self.vector = GridVectorEnvironment([scenario or paper_scenario()], move_rule, parameters)
        self.action_space = self.vector.single_action_space
        self.observation_space = self.vector.single_observation_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode at the start or, with probability p_r, at a random free cell."""
        super().reset(seed=seed)
        self.vector.np_random = self.np_random
        observations, info = self.vector.reset()
        return observations[0], info

    def step(self, action: np.int64) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Move the robot once."""
        observations, reward, terminated, truncated, info = self.vector.step(np.array([action]))
        return observations[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), info
