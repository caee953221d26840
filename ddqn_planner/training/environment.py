"""The grid environment: N robots in NumPy, and one robot with Gymnasium's interface."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Integral
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from ddqn_planner.grid import MOVES, Cell, GridMap, MoveRule, neighbours, read_map_file
from ddqn_planner.grid.arguments import as_cell, numbers
from ddqn_planner.grid.grid_map import check_grid
from ddqn_planner.model.networks import (
    FREE,
    GOAL,
    OBSTACLE,
    ROBOT,
    observation_background,
)
from ddqn_planner.resources import find_resource
from ddqn_planner.training.exploring_starts import initial_cells
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.reward import move_reward

Observations = NDArray[np.float32]


@dataclass(frozen=True)
class Scenario:
    """One path planning problem; a ValueError unless a path leads from its start to its goal."""

    grid: GridMap
    start: Cell
    goal: Cell
    move_rule: MoveRule = MoveRule.CORNER_CUTTING  # the paper's, likely

    def __post_init__(self) -> None:
        check_grid(self.grid)
        start, goal = as_cell(self.start, "the start"), as_cell(self.goal, "the goal")
        vars(self).update(
            start=start, goal=goal, move_rule=MoveRule(self.move_rule)
        )  # it is frozen
        for name, cell in (("start", start), ("goal", goal)):
            if not self.grid.is_free(cell):
                raise ValueError(
                    f"the {name} {cell} is not a free cell of the map; give another"
                )
        if start == goal:
            raise ValueError(
                f"start and goal are both {start}; give two different cells"
            )
        if not self._leads_to_goal(self.move_rule):
            others = [rule.value for rule in MoveRule if self._leads_to_goal(rule)]
            remedy = f"give the move rule {others[0]}" if others else "open the map"
            problem = f"no path leads from the start {start} to the goal {goal}"
            rule = f"under the move rule {self.move_rule.value}"
            raise ValueError(f"{problem} {rule}; give other cells, or {remedy}")

    def _leads_to_goal(self, move_rule: MoveRule) -> bool:
        reached = self.grid.reachable([self.start], move_rule)
        return bool(reached[self.goal[1], self.goal[0]])


def paper_scenario() -> Scenario:
    """Return the paper's map with its start and goal."""
    map_file = read_map_file(find_resource("maps", "dilemma.yaml"))
    if map_file.start is None or map_file.goal is None:
        raise ValueError(
            "maps/dilemma.yaml names no start and goal; restore the shipped file"
        )
    return Scenario(map_file.grid(), map_file.start, map_file.goal)


class GridVectorEnvironment:
    """N robots on maps of one size, moved in one step; each episode draws one of S scenarios."""

    # Cells are numbers y * W + x. The results of moves are looked up in tables (S, 8, H * W).
    # `reset` begins the first episodes too; one that has ended waits for it, and makes no move.

    def __init__(
        self,
        scenarios: Sequence[Scenario],
        parameters: HyperParameters,
        random: np.random.Generator | None = None,
    ) -> None:
        if not scenarios or not all(isinstance(one, Scenario) for one in scenarios):
            raise ValueError(
                f"the scenarios are {scenarios!r}; give at least one Scenario"
            )
        if not isinstance(parameters, HyperParameters):
            raise ValueError(f"the parameters are {parameters!r}; give HyperParameters")
        shapes = {scenario.grid.occupancy.shape for scenario in scenarios}
        if len(shapes) != 1:
            raise ValueError(
                f"the maps have the sizes {sorted(shapes)}; give maps of one size"
            )
        (self.shape,) = shapes
        self.scenarios = tuple(scenarios)
        self.parameters = parameters
        self.random = random or np.random.default_rng()

        maps = [observation_background(s.grid.occupancy, s.goal) for s in scenarios]
        self.background, self.next_cell = np.stack(maps), neighbours(self.shape)
        tables, to_number = (len(maps), len(MOVES), -1), np.array([1, self.shape[1]])
        legal = [s.grid.legal_moves(s.move_rule) for s in scenarios]
        reward = [move_reward(s.grid, s.start, s.goal, parameters) for s in scenarios]
        self.legal = np.stack(legal).reshape(tables)
        self.free_reward = np.stack(reward).reshape(tables)
        collision = np.float32(parameters.obstacle_reward)
        self.rewards = np.where(self.legal, self.free_reward, collision)
        self.start = np.array([s.start for s in scenarios]) @ to_number
        self.goal = np.array([s.goal for s in scenarios]) @ to_number

        free_SC = self.background == FREE  # goals are not
        _, self._free = np.nonzero(free_SC)
        self._free_count = free_SC.sum(axis=1)
        self._free_first = np.cumsum(self._free_count) - self._free_count

        count, most = parameters.environments, parameters.max_episode_steps
        self.scenario, self.cell, self.steps = np.zeros((3, count), np.int64)
        # Of each robot's episode: the cells in their order, and the sum of the rewards.
        self.visited, self.total_reward = (
            np.zeros((count, most + 1), np.int64),
            np.zeros(count),
        )
        self.terminated, self.truncated = np.zeros((2, count), np.bool_)

    def reset(self, mask: Any = ...) -> None:
        """Start new episodes: all, or those where `mask` (N,) is True."""
        scenario = self.random.integers(len(self.start), size=len(self.cell[mask]))
        self.scenario[mask] = scenario
        free = self._free, self._free_first[scenario], self._free_count[scenario]
        start, p_r = self.start[scenario], self.parameters.p_r
        self.cell[mask] = initial_cells(start, *free, p_r, self.random)
        self.visited[mask, 0] = self.cell[mask]
        self.steps[mask], self.total_reward[mask] = 0, 0.0
        self.terminated[mask] = self.truncated[mask] = False

    def move(self, actions: NDArray[np.int64]) -> tuple[NDArray[Any], ...]:
        """Move each robot once, (N,) actions; return reward, terminated, truncated: (N,) each."""
        actions = numbers(
            "the actions", actions, self.cell.shape, "iu", (0, len(MOVES) - 1)
        )
        if (self.terminated | self.truncated).any():
            raise ResetNeeded("an episode has ended; call reset before the next step")
        lookup = (self.scenario, actions, self.cell)
        legal, reward = self.legal[lookup], self.rewards[lookup]
        self.cell[:] = np.where(legal, self.next_cell[actions, self.cell], self.cell)
        self.steps += 1
        self.visited[np.arange(len(actions)), self.steps] = self.cell
        self.total_reward += reward
        self.terminated[:] = ~legal | (self.cell == self.goal[self.scenario])
        self.truncated[:] = ~self.terminated & (
            self.steps >= self.parameters.max_episode_steps
        )
        return reward, self.terminated, self.truncated

    def observe(
        self, scenario: NDArray[np.int64], cell: NDArray[np.int64]
    ) -> Observations:
        """Return what robots in `cell` (B,) see of the maps `scenario` (B,): (B, H, W) float32."""
        observations = self.background[scenario]
        observations[np.arange(len(cell)), cell] = ROBOT
        return observations.reshape(-1, *self.shape)


class GridEnvironment(gymnasium.Env[Observations, np.int64]):
    """``ddqn_planner.training.environment:ddqn_planner/Grid-v0``: by default, the paper's map."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        scenario: Scenario | None = None,
        parameters: HyperParameters | None = None,
    ) -> None:
        if parameters is None:
            parameters = HyperParameters()
        if isinstance(parameters, HyperParameters):
            parameters = replace(parameters, environments=1)
        scenario = paper_scenario() if scenario is None else scenario
        self.vector = GridVectorEnvironment([scenario], parameters)
        self._is_begun = False
        self.action_space = gymnasium.spaces.Discrete(len(MOVES))
        self.observation_space = gymnasium.spaces.Box(
            OBSTACLE, max(GOAL, ROBOT), self.vector.shape, np.float32
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode at the start or, with probability p_r, at a random free cell."""
        super().reset(seed=seed)
        self.vector.random = self.np_random
        self.vector.reset()
        self._is_begun = True
        return self._observe(), {}

    def step(
        self, action: np.int64
    ) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Move the robot once.

        Raises
        ------
        ValueError
            If the action is no whole number from 0 to 7.
        gymnasium.error.ResetNeeded
            Before the first `reset`, and after an episode has ended.
        """
        is_whole = isinstance(action, Integral) and not isinstance(action, bool)
        is_array = (
            isinstance(action, np.ndarray)
            and action.shape == ()
            and action.dtype.kind in "iu"
        )
        if not (is_whole or is_array) or not 0 <= action < len(MOVES):
            raise ValueError(
                f"the action is {action!r}; give a whole number, 0 to {len(MOVES) - 1}"
            )
        if not self._is_begun:
            raise ResetNeeded("no episode has begun; call reset before the first step")
        (reward,), (terminated,), (truncated,) = self.vector.move(
            np.array([int(action)])
        )
        return self._observe(), float(reward), bool(terminated), bool(truncated), {}

    def _observe(self) -> Observations:
        observation: Observations = self.vector.observe(
            self.vector.scenario, self.vector.cell
        )[0]
        return observation


gymnasium.register("ddqn_planner/Grid-v0", f"{__name__}:GridEnvironment")
