"""The grid environment with Gymnasium's interfaces: of one robot, and of N robots."""

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from numbers import Integral
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeAlias

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from ddqn_planner.grid import MOVES, Cell
from ddqn_planner.grid.arguments import cell_inside, is_flag, real, shortened
from ddqn_planner.model.networks import GOAL, OBSTACLE, ROBOT
from ddqn_planner.training.environment import GridVectorEnvironment, Observations
from ddqn_planner.training.episodes import EpisodeEnd
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.rendering import draw_pixels, draw_signs
from ddqn_planner.training.scenario import Scenario, map_scenario, paper_scenario

RENDER_MODES = ("rgb_array", "ansi")
Frame: TypeAlias = NDArray[np.uint8] | str


class RewardFunction(Protocol):
    """The reward of a move, as a user wants it."""

    def __call__(
        self, cell: Cell, action: int, next_cell: Cell, outcome: EpisodeEnd | None
    ) -> float:
        """Return the reward of an action, 0 to 7, in a cell (x, y).

        `next_cell` is the cell after the move, the same one after a collision.
        `outcome` is how the episode ended with this move, or None if it continues.
        """


def _as_scenario(scenario: Scenario | str | Path | None) -> Scenario:
    """Return a scenario, that of a map by its name or file, or the paper's."""
    if scenario is None:
        return paper_scenario()
    if isinstance(scenario, (str, Path)):
        return map_scenario(scenario)
    if not isinstance(scenario, Scenario):
        raise ValueError(
            f"the scenario is {scenario!r}; give a Scenario or the name of a map"
        )
    return scenario


def _as_parameters(
    parameters: HyperParameters | None,
    reward: RewardFunction | str | None,
    robots: int,
    max_episode_steps: int | None = None,
) -> HyperParameters:
    """Return the hyper-parameters, by default the paper's, of a number of robots.

    A `reward` that is text and `max_episode_steps` replace theirs.
    """
    if parameters is None:
        parameters = HyperParameters()
    if not isinstance(parameters, HyperParameters):
        raise ValueError(f"the parameters are {parameters!r}; give HyperParameters")
    if isinstance(reward, str):
        parameters = replace(parameters, reward=reward)
    elif reward is not None:
        _check_reward_function(reward)
    if max_episode_steps is not None:
        parameters = replace(parameters, max_episode_steps=max_episode_steps)
    return replace(parameters, environments=robots)


def _check_reward_function(function: object) -> None:
    """Raise a ValueError unless a function can be called with a `RewardFunction`'s."""
    remedy = "give a function (cell, action, next_cell, outcome)"
    if not callable(function):
        raise ValueError(
            f"the reward is {function!r}; {remedy}, or the name of a reward"
        )
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # some functions written in C have none
        _check_by_call(function)
        return
    try:
        signature.bind((0, 0), 0, (0, 0), None)
    except TypeError as error:
        raise ValueError(
            f"the reward function takes {signature} ({error}); {remedy}"
        ) from None


def _check_by_call(function: Callable[..., object]) -> None:
    """Raise a ValueError unless a function returns a reward for a collision."""
    try:
        reward = function((0, 0), 0, (0, 0), EpisodeEnd.COLLIDED)
    except TypeError as error:
        raise ValueError(
            f"the reward function is {function!r} ({error}); give a function (cell, "
            "action, next_cell, outcome)"
        ) from None
    _as_reward(reward)


def _as_reward(value: object) -> float:
    """Return what a reward function returned as a float, True and False as 1 and 0."""
    reward = float(bool(value)) if is_flag(value) else real(value)
    if not math.isfinite(reward):
        raise ValueError(
            f"the reward function returned {shortened(value)}; give a finite number"
        )
    return reward


class _Robots:
    """N robots on one map, and what Gymnasium's interfaces tell of them.

    Attributes
    ----------
    scenario : Scenario
        The map of all robots.
    batch : GridVectorEnvironment
        Their states.
    reward : function, optional
        In place of the batch's own rewards.
    render_mode : str, optional
        How `frame` draws.
    """

    def __init__(
        self,
        scenario: Scenario,
        parameters: HyperParameters,
        reward: RewardFunction | str | None,
        render_mode: str | None,
    ) -> None:
        """Make robots, as many as the parameters have environments."""
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(
                f"render_mode is {render_mode!r}; give None or one of "
                f"{', '.join(RENDER_MODES)}"
            )
        self.scenario = scenario
        self.batch = GridVectorEnvironment([scenario], parameters)
        self.reward = None if isinstance(reward, str) else reward
        self.render_mode = render_mode
        self.is_begun = False
        self.observation_space = gymnasium.spaces.Box(
            OBSTACLE, max(GOAL, ROBOT), self.batch.shape, np.float32
        )

    def reset(
        self, random: np.random.Generator, options: Mapping[str, Any] | None
    ) -> None:
        """Start an episode of each robot; `options` may have their `start`."""
        if options is None:
            options = {}
        if not isinstance(options, Mapping):
            raise ValueError(
                f"the options are {shortened(options)}; give a dict with the start"
            )
        unknown = set(options) - {"start"}
        if unknown:
            raise ValueError(f"the options have {sorted(unknown)}; give only start")
        self.batch.random = random
        if "start" in options:
            first_cell = self._first_cells(options["start"])
            self.batch.reset()
            self.batch.begin(first_cell)
        else:
            self.batch.reset()
        self.is_begun = True

    def _first_cells(self, start: ArrayLike) -> NDArray[np.int64]:
        """Return y * W + x, (N,), of cells (x, y) to start in: (2,) or (N, 2).

        A ValueError if no episode can begin in one of them.
        """
        count = len(self.batch.cell)
        try:
            starts = np.asarray(start)
        except ValueError:  # rows of different lengths
            starts = np.empty(0)
        if starts.shape not in ((2,), (count, 2)):
            for_each = f", or one for each of the {count} robots" if count > 1 else ""
            raise ValueError(
                f"the start is {shortened(start)}; give one cell (x, y){for_each}"
            )
        cells = []
        for cell in starts.reshape(-1, 2).tolist():
            x, y = cell_inside(cell, self.batch.shape, "the start")
            if not self.scenario.grid.is_free((x, y)) or (x, y) == self.scenario.goal:
                raise ValueError(
                    f"the start {(x, y)} is no free cell other than the goal; "
                    "give another"
                )
            cells.append(y * self.batch.shape[1] + x)
        return np.broadcast_to(np.array(cells), count)

    def step(
        self, actions: NDArray[np.int64], moving: NDArray[np.intp]
    ) -> NDArray[np.float64]:
        """Move the robots by actions (N,); return their rewards (N,).

        `moving` are the numbers of the robots whose rewards are asked for.
        """
        cell = self.batch.cell.copy()
        rewards = self.batch.move(actions).reward.astype(np.float64)
        if self.reward is not None:
            outcomes = self.outcomes()
            for robot in moving.tolist():
                outcome = outcomes[robot]
                reward = self.reward(
                    self.xy(cell[robot]),
                    int(actions[robot]),
                    self.xy(self.batch.cell[robot]),
                    None if outcome is None else EpisodeEnd(outcome),
                )
                rewards[robot] = _as_reward(reward)
        return rewards

    def xy(self, cell: np.int64) -> Cell:
        """Return the cell (x, y) that has the number y * W + x."""
        y, x = divmod(int(cell), self.batch.shape[1])
        return x, y

    def outcomes(self) -> NDArray[np.object_]:
        """Return how each episode ended, the value of an `EpisodeEnd` or None: (N,)."""
        batch = self.batch
        is_at_goal = batch.cell == batch.goal[batch.scenario]
        outcomes = np.full(len(batch.cell), None, np.object_)
        outcomes[batch.terminated & is_at_goal] = EpisodeEnd.REACHED_GOAL.value
        outcomes[batch.terminated & ~is_at_goal] = EpisodeEnd.COLLIDED.value
        outcomes[batch.truncated] = EpisodeEnd.OUT_OF_STEPS.value
        return outcomes

    def observations(self) -> Observations:
        """Return what the robots observe, (N, H, W)."""
        return self.batch.observe(self.batch.scenario, self.batch.cell)

    def legal_moves(self) -> NDArray[np.bool_]:
        """Return which actions are legal in the robots' cells, (N, 8)."""
        return self.batch.legal[self.batch.scenario, :, self.batch.cell]

    def frame(self, robot: int) -> Frame | None:
        """Return a picture or a text of a robot's episode, by the render mode."""
        if not self.is_begun:
            raise ResetNeeded("no episode has begun; call reset before render")
        visited = self.batch.visited[robot, : self.batch.steps[robot] + 1]
        cells = [self.xy(cell) for cell in visited]
        if self.render_mode == "rgb_array":
            return draw_pixels(self.scenario, cells)
        if self.render_mode == "ansi":
            return draw_signs(self.scenario, cells)
        gymnasium.logger.warn(
            "render was called without a render mode; give the environment a "
            f"render_mode, one of {', '.join(RENDER_MODES)}"
        )
        return None


class GridEnvironment(gymnasium.Env[Observations, np.int64]):
    """One robot on a map: it moves from cell to cell toward a goal.

    `gymnasium.make` knows it as ``ddqn_planner/Grid-v0``. Coordinates are cells (x, y).

    Action Space
        ``Discrete(8)``: the moves E, NE, N, NW, W, SW, S, SE, with +x to the east and
        +y to the north.
    Observation Space
        ``Box(-0.1, 3, (H, W), float32)``: -0.1 in occupied cells, 0 in free ones, 1 in
        the goal and 3 in the robot's cell.
    Rewards
        By default the paper's, see `ddqn_planner.training.reward`.
    Episode Start
        The scenario's start, or with probability p_r (a hyper-parameter, 0.5) a random
        free cell.
    Episode End
        Terminated when the robot reaches the goal, or collides: the move was illegal.
        Truncated after ``max_episode_steps`` of the hyper-parameters, 200.
    Information
        ``cell`` and ``goal``, (x, y); ``action_mask``, (8,) bool: the legal moves;
        ``outcome``: None, or ``reached_goal``, ``collided`` or ``out_of_steps``.

    Examples
    --------
    >>> from ddqn_planner.training import GridEnvironment
    >>> environment = GridEnvironment()  # the paper's map
    >>> observation, info = environment.reset(options={"start": (16, 19)})
    >>> east = 0
    >>> _, reward, terminated, truncated, info = environment.step(east)
    >>> terminated, info["outcome"]
    (True, 'reached_goal')
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": list(RENDER_MODES),
        "render_fps": 10,
    }

    def __init__(
        self,
        scenario: Scenario | str | Path | None = None,
        parameters: HyperParameters | None = None,
        reward: RewardFunction | str | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Make an environment of one robot on a map.

        Parameters
        ----------
        scenario : Scenario, str or Path, optional
            The map, the start and the goal, or the name or the file of a map that names
            a start and a goal; by default the paper's.
        parameters : HyperParameters, optional
            How episodes begin and end, and the weights of the reward; `environments`
            does not count.
        reward : function or str, optional
            A function ``(cell, action, next_cell, outcome) -> float``, or the name of
            a reward, ``"paper"`` or ``"path_cost"``; by default that of `parameters`.
        render_mode : str, optional
            What `render` returns: ``"rgb_array"`` for a picture, ``"ansi"`` for a text.
        """
        self._robots = _Robots(
            _as_scenario(scenario),
            _as_parameters(parameters, reward, robots=1),
            reward,
            render_mode,
        )
        self.render_mode = render_mode
        self.scenario = self._robots.scenario
        self.action_space = gymnasium.spaces.Discrete(len(MOVES))
        self.observation_space = self._robots.observation_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode; `options` may have its first cell, ``{"start": (x, y)}``.

        Returns
        -------
        The observation (H, W), and information, as after `step`.
        """
        super().reset(seed=seed)
        self._robots.reset(self.np_random, options)
        return self._robots.observations()[0], self._information()

    def step(
        self, action: np.int64
    ) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Move the robot once by an action, 0 to 7.

        Returns
        -------
        The observation (H, W) after the move, the reward, whether the episode has ended
        at the goal or by a collision, whether it has ended for lack of steps, and
        information: see the class.

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
        if not self._robots.is_begun:
            raise ResetNeeded("no episode has begun; call reset before the first step")
        batch = self._robots.batch
        if batch.terminated[0] or batch.truncated[0]:
            raise ResetNeeded("the episode has ended; call reset before the next step")
        rewards = self._robots.step(np.array([int(action)]), np.array([0]))
        return (
            self._robots.observations()[0],
            float(rewards[0]),
            bool(batch.terminated[0]),
            bool(batch.truncated[0]),
            self._information(),
        )

    def _information(self) -> dict[str, Any]:
        """Return what `reset` and `step` tell beside the observation."""
        robots = self._robots
        return {
            "cell": robots.xy(robots.batch.cell[0]),
            "goal": self.scenario.goal,
            "action_mask": robots.legal_moves()[0],
            "outcome": robots.outcomes()[0],
        }

    def render(self) -> Frame | None:
        """Return a picture (height, width, 3) uint8, or a text, by the render mode.

        Both show the map with the highest y on top, the goal, the robot and its trail.
        """
        return self._robots.frame(0)


class BatchedGridEnvironment(
    gymnasium.vector.VectorEnv[Observations, NDArray[np.int64], NDArray[Any]]
):
    """N robots on copies of one map, moved at once by NumPy.

    `gymnasium.make_vec` makes it for ``ddqn_planner/Grid-v0``. Spaces, rewards and ends
    of episodes are those of `GridEnvironment`. In the step after the end of an episode
    a robot does not move, but begins a new one, with the reward 0: the autoreset
    mode "next step". Information is in arrays: ``cell`` and ``goal`` (N, 2) int64,
    ``action_mask`` (N, 8) bool and ``outcome`` (N,) object; the mask ``_KEY`` (N,) of
    each is True everywhere.
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        **GridEnvironment.metadata,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        scenario: Scenario | str | Path | None = None,
        parameters: HyperParameters | None = None,
        reward: RewardFunction | str | None = None,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
    ) -> None:
        """Make an environment of `num_envs` robots on copies of a map.

        Parameters
        ----------
        num_envs : int
            How many robots; `environments` of the parameters does not count.
        scenario, parameters, reward, render_mode
            As those of `GridEnvironment`.
        max_episode_steps : int, optional
            After how many steps an episode is truncated, instead of that of the
            parameters.
        """
        self._robots = _Robots(
            _as_scenario(scenario),
            _as_parameters(parameters, reward, num_envs, max_episode_steps),
            reward,
            render_mode,
        )
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.scenario = self._robots.scenario
        self.single_action_space = gymnasium.spaces.Discrete(len(MOVES))
        self.single_observation_space = self._robots.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode of each robot, as `GridEnvironment.reset`.

        One random generator draws for all robots. The ``start`` of the options is one
        cell for all of them, or (N, 2) cells.
        """
        super().reset(seed=seed)
        self._robots.reset(self.np_random, options)
        return self._robots.observations(), self._information()

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[
        Observations,
        NDArray[np.float64],
        NDArray[np.bool_],
        NDArray[np.bool_],
        dict[str, Any],
    ]:
        """Move each robot by its action (N,), or begin its next episode.

        Returns
        -------
        The observations (N, H, W), the rewards, which episodes terminated, which were
        truncated, (N,) each, and information: see the class.

        Raises
        ------
        ValueError
            If an action is no whole number from 0 to 7.
        gymnasium.error.ResetNeeded
            Before the first `reset`.
        """
        if not self._robots.is_begun:
            raise ResetNeeded("no episode has begun; call reset before the first step")
        batch = self._robots.batch
        actions = batch.as_actions(actions)  # a wrong one changes nothing
        is_new = batch.terminated | batch.truncated
        if is_new.any():
            batch.reset(is_new)
        first_cell = batch.cell[is_new]
        rewards = self._robots.step(actions, np.flatnonzero(~is_new))
        # What begins an episode makes no step.
        batch.begin(first_cell, is_new)
        rewards[is_new] = 0.0
        return (
            self._robots.observations(),
            rewards,
            batch.terminated.copy(),
            batch.truncated.copy(),
            self._information(),
        )

    def _information(self) -> dict[str, Any]:
        """Return what `reset` and `step` tell beside the observations."""
        robots = self._robots
        width = robots.batch.shape[1]
        cell_y, cell_x = np.divmod(robots.batch.cell, width)
        information: dict[str, NDArray[Any]] = {
            "cell": np.stack([cell_x, cell_y], axis=1),
            "goal": np.tile(self.scenario.goal, (self.num_envs, 1)),
            "action_mask": robots.legal_moves(),
            "outcome": robots.outcomes(),
        }
        masks = {f"_{key}": np.ones(self.num_envs, np.bool_) for key in information}
        return information | masks

    def render(self) -> tuple[Frame | None, ...]:  # type: ignore[override]
        """Return a picture or a text of each robot, as `GridEnvironment.render`."""
        return tuple(self._robots.frame(robot) for robot in range(self.num_envs))
