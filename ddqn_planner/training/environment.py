"""The grid environment: N robots in NumPy."""

from collections.abc import Sequence
from types import EllipsisType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ddqn_planner.grid import MOVES, neighbours
from ddqn_planner.grid.arguments import numbers
from ddqn_planner.model.networks import (
    FREE,
    ROBOT,
    observation_background,
)
from ddqn_planner.training.exploring_starts import initial_cells
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.reward import move_reward
from ddqn_planner.training.scenario import Scenario, check_scenarios
from ddqn_planner.training.scenario import paper_scenario as paper_scenario

Observations = NDArray[np.float32]


class Outcome(NamedTuple):
    """The result of a move of N robots; (N,) each."""

    reward: NDArray[np.float32]
    terminated: NDArray[np.bool_]  # the robot arrived at its goal, or collided
    truncated: NDArray[np.bool_]  # the robot has made its last step, elsewhere


class GridVectorEnvironment:
    """N robots on maps of one size, moved in one step.

    Each episode draws one of S scenarios. `reset` begins the first episodes, too. No
    robot moves while the episode of one has ended and is not reset. Cells are numbers
    y * W + x, C in all; the results of moves are looked up in tables.

    Attributes
    ----------
    background : (S, C) float32
        What a network observes of each map without a robot.
    legal : (S, 8, C) bool
        Whether a move is legal.
    free_reward : (S, 8, C) float32
        The reward of a legal move, see `move_reward`.
    rewards : (S, 8, C) float32
        The reward of any move.
    next_cell : (8, C) int64
        The neighbour in the direction of a move; C off the map.
    start, goal : (S,) int64
        The cells of the scenarios.
    scenario, cell, steps : (N,) int64
        Of each robot's episode: its scenario, its cell, and how many steps it has made.
    visited : (N, max_episode_steps + 1) int64
        The cells of each episode in their order.
    total_reward : (N,) float64
        The sum of the rewards of each episode.
    terminated, truncated : (N,) bool
        Whether an episode ended with its last move, or ran out of steps.
    """

    def __init__(
        self,
        scenarios: Sequence[Scenario],
        parameters: HyperParameters,
        random: np.random.Generator | None = None,
    ) -> None:
        """Tabulate all moves on the maps; the caller then calls `reset`.

        Parameters
        ----------
        scenarios : sequence of Scenario
            S maps of one size, with their starts and goals.
        parameters : HyperParameters
            The number of robots, the rewards, and how episodes begin and end.
        random : Generator, optional
            Draws the scenario and the first cell of each episode.
        """
        check_scenarios(scenarios)
        if not isinstance(parameters, HyperParameters):
            raise ValueError(f"the parameters are {parameters!r}; give HyperParameters")
        self.shape = scenarios[0].grid.occupancy.shape
        self.scenarios = tuple(scenarios)
        self.parameters = parameters
        self.random = random or np.random.default_rng()

        self._tabulate_moves()
        self._list_cells()
        robots = parameters.environments  # N
        self.scenario = np.zeros(robots, np.int64)
        self.cell = np.zeros(robots, np.int64)
        self.steps = np.zeros(robots, np.int64)
        self.visited = np.zeros((robots, parameters.max_episode_steps + 1), np.int64)
        self.total_reward = np.zeros(robots)
        self.terminated = np.zeros(robots, np.bool_)
        self.truncated = np.zeros(robots, np.bool_)

    def _tabulate_moves(self) -> None:
        """Set `legal`, `free_reward`, `rewards` (S, 8, C), and `next_cell` (8, C)."""
        legal = []
        rewards = []
        for scenario in self.scenarios:
            grid = scenario.grid
            legal.append(grid.legal_moves(scenario.move_rule))
            rewards.append(
                move_reward(grid, scenario.start, scenario.goal, self.parameters)
            )
        height, width = self.shape
        shape_SAC = (len(self.scenarios), len(MOVES), height * width)
        self.legal = np.stack(legal).reshape(shape_SAC)
        self.free_reward = np.stack(rewards).reshape(shape_SAC)
        collision = np.float32(self.parameters.obstacle_reward)
        self.rewards = np.where(self.legal, self.free_reward, collision)
        self.next_cell = neighbours(self.shape)

    def _list_cells(self) -> None:
        """Set `start`, `goal` and `background`, and list the free cells of all maps.

        Cells are numbers y * W + x.
        """
        _, width = self.shape
        start_xy = np.array([scenario.start for scenario in self.scenarios])  # (S, 2)
        goal_xy = np.array([scenario.goal for scenario in self.scenarios])
        number_of_xy = np.array([1, width])
        self.start = start_xy @ number_of_xy
        self.goal = goal_xy @ number_of_xy
        backgrounds = [
            observation_background(scenario.grid.occupancy, scenario.goal)
            for scenario in self.scenarios
        ]
        self.background = np.stack(backgrounds)
        # The free cells of map 0, then those of map 1, and so on; and for each map, how
        # many it has, and where they begin.
        is_free_SC = self.background == FREE  # goals are not
        _, self._free_cells = np.nonzero(is_free_SC)
        self._free_count = is_free_SC.sum(axis=1)
        self._first_free = np.cumsum(self._free_count) - self._free_count

    def reset(self, mask: NDArray[np.bool_] | EllipsisType = ...) -> None:
        """Start new episodes of robots where `mask` (N,) is True; by default of all.

        Each episode draws a scenario, and begins in a random cell with probability p_r,
        else at the scenario's start.
        """
        # Shapes: (M,) for M robots.
        scenario = self.random.integers(len(self.start), size=len(self.cell[mask]))
        cell = initial_cells(
            self.start[scenario],
            self._free_cells,
            self._first_free[scenario],
            self._free_count[scenario],
            self.parameters.p_r,
            self.random,
        )
        self.scenario[mask] = scenario
        self.begin(cell, mask)

    def begin(
        self, cell: NDArray[np.int64], mask: NDArray[np.bool_] | EllipsisType = ...
    ) -> None:
        """Start new episodes in cells (M,), of the M robots where `mask` (N,) is True.

        Their scenarios stay.
        """
        self.cell[mask] = cell
        self.visited[mask, 0] = cell
        self.steps[mask] = 0
        self.total_reward[mask] = 0.0
        self.terminated[mask] = False
        self.truncated[mask] = False

    def as_actions(self, actions: ArrayLike) -> NDArray[np.int64]:
        """Return the actions of all robots, (N,); a ValueError if one is wrong."""
        highest = len(MOVES) - 1
        array = numbers(
            "the array of actions",
            actions,
            self.cell.shape,
            "iu",
            (0, highest),
            remedy=f"whole numbers, 0 to {highest}",
        )
        return array.astype(np.int64, copy=False)

    def move(self, actions: NDArray[np.int64]) -> Outcome:
        """Move each robot by its action (N,), 0 to 7; a robot that collides stays.

        A RuntimeError if an episode has ended. The next move overwrites
        `terminated` and `truncated` of the result.
        """
        actions = self.as_actions(actions)
        if (self.terminated | self.truncated).any():
            raise RuntimeError("an episode has ended; call reset before the next step")
        # Shapes: (N,).
        legal = self.legal[self.scenario, actions, self.cell]
        reward = self.rewards[self.scenario, actions, self.cell]
        self.cell[:] = np.where(legal, self.next_cell[actions, self.cell], self.cell)
        self.steps += 1
        self.visited[np.arange(len(actions)), self.steps] = self.cell
        self.total_reward += reward
        is_at_goal = self.cell == self.goal[self.scenario]
        is_out_of_steps = self.steps >= self.parameters.max_episode_steps
        self.terminated[:] = ~legal | is_at_goal
        self.truncated[:] = ~self.terminated & is_out_of_steps
        return Outcome(reward, self.terminated, self.truncated)

    def observe(
        self, scenario: NDArray[np.int64], cell: NDArray[np.int64]
    ) -> Observations:
        """Return the observations (B, H, W) of robots in cells (B,) of maps (B,).

        `scenario` has the number of the map of each robot.
        The values are those of `observation_background`, and ROBOT in the robot's cell.
        """
        observations = self.background[scenario]
        observations[np.arange(len(cell)), cell] = ROBOT
        return observations.reshape(-1, *self.shape)
