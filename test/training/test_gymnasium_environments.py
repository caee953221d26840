import copy
import math
import pickle
import re
import subprocess
import sys
import warnings
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from ddqn_planner.grid import Cell, MapNotFoundError
from ddqn_planner.gymnasium_registration import ENVIRONMENT
from ddqn_planner.training import GridVectorEnvironment, Scenario
from ddqn_planner.training.episodes import EpisodeEnd
from ddqn_planner.training.gymnasium_environments import (
    BatchedGridEnvironment,
    GridEnvironment,
)
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.rendering import (
    FREE_COLOUR,
    GOAL_COLOUR,
    OBSTACLE_COLOUR,
    ROBOT_COLOUR,
    TRAIL_COLOUR,
)

PARAMETERS = HyperParameters(max_episode_steps=12)
EAST, NORTH = 0, 2


def moved_goalwards(
    cell: Cell, action: int, next_cell: Cell, outcome: EpisodeEnd | None
) -> float:
    """A reward that tells all its arguments."""
    ends = [None, *EpisodeEnd].index(outcome)
    return 1000.0 * ends + 100 * action + 10 * (next_cell[0] - cell[0]) + cell[1]


@pytest.fixture(autouse=True)
def warnings_are_errors() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def test_the_scalar_environment_is_a_batch_of_one(paper: Scenario) -> None:
    batch = GridVectorEnvironment([paper], PARAMETERS)
    # How many environments a batch has does not matter here.
    scalar = GridEnvironment(paper, replace(PARAMETERS, environments=7))
    actions = np.random.default_rng(0)
    outcomes = set()
    for seed in range(30):
        observation, info = scalar.reset(seed=seed)
        batch.random = np_random(seed)[0]
        batch.reset()
        ended = False
        while not ended:
            assert (batch.observe(batch.scenario, batch.cell)[0] == observation).all()
            y, x = divmod(int(batch.cell[0]), 20)
            assert (info["cell"], info["goal"]) == ((x, y), paper.goal)
            assert [type(number) for number in info["cell"]] == [int, int]
            assert info["action_mask"].dtype == bool
            mask = paper.grid.legal_moves(paper.move_rule)[:, y, x]
            assert info["action_mask"].tolist() == mask.tolist()
            assert info["outcome"] is None
            action = actions.integers(8)
            expected = batch.move(np.array([action]))
            observation, *results, info = scalar.step(action)
            assert results == [values[0] for values in expected]
            assert [type(value) for value in results] == [float, bool, bool]
            _, terminated, truncated = results
            ended = terminated or truncated
        assert (info["outcome"] == "out_of_steps") == truncated
        assert (info["outcome"] == "collided") == (not truncated and not mask[action])
        outcomes.add(info["outcome"])
    assert {"collided", "out_of_steps"} <= outcomes


@pytest.mark.parametrize("render_mode", [None, "rgb_array", "ansi"])
def test_gymnasium_accepts_the_environment(render_mode: str | None) -> None:
    environment = gymnasium.make(ENVIRONMENT, render_mode=render_mode)
    check_env(environment.unwrapped)


# Gymnasium loads no plugins: a program imports both, or names the package.
@pytest.mark.parametrize(
    ("imports", "name"),
    [
        ("gymnasium", f"ddqn_planner:{ENVIRONMENT}"),
        ("ddqn_planner, gymnasium", ENVIRONMENT),
    ],
)
def test_the_environment_has_a_name_and_costs_nothing(imports: str, name: str) -> None:
    code = f"""
import sys, warnings
from importlib import util
warnings.simplefilter("error")
import {imports.partition(",")[0]}
# To ask whether there is a Gymnasium does not load it.
assert util.find_spec("gymnasium").name == "gymnasium"
import {imports}
assert gymnasium.__loader__ is gymnasium.__spec__.loader
assert "ddqn_planner" not in type(gymnasium.__loader__).__module__
from gymnasium.envs.registration import _find_spec
assert _find_spec({name!r}).id == {ENVIRONMENT!r}
assert not {{"torch", "numba", "ddqn_planner.training"}} & sys.modules.keys()
assert not any("ddqn_planner" in type(item).__module__ for item in sys.meta_path)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    "action", [-1, 8, 2.5, 2.0, math.nan, None, "2", True, [2], np.array([2])]
)
def test_what_is_no_action_is_refused_and_changes_nothing(
    paper: Scenario, action: Any
) -> None:
    environment, other = (GridEnvironment(paper, PARAMETERS) for _ in range(2))
    for item in (environment, other):
        item.reset(seed=0)
    with pytest.raises(
        ValueError, match=r"the action is .*; give a whole number, 0 to 7"
    ):
        environment.step(action)
    assert data_equivalence(environment.step(np.int64(2)), other.step(np.int64(2)))


@pytest.mark.parametrize("kind", [int, np.int64, np.uint8, np.array])
def test_each_integer_type_is_an_action(paper: Scenario, kind: Any) -> None:
    results = []
    for action in (3, kind(3)):
        environment = GridEnvironment(paper, PARAMETERS)
        environment.reset(seed=1)
        results.append(environment.step(action))
    assert data_equivalence(*results)


def test_no_step_is_made_before_a_reset_or_after_the_end(paper: Scenario) -> None:
    parameters = replace(PARAMETERS, max_episode_steps=1)
    environment = GridEnvironment(paper, parameters, render_mode="ansi")
    action = np.int64(0)
    with pytest.raises(ResetNeeded, match="call reset before the first step"):
        environment.step(action)
    with pytest.raises(ResetNeeded, match="call reset before render"):
        environment.render()
    for _ in range(2):
        environment.reset(seed=0)
        *_, terminated, truncated, _ = environment.step(action)
        assert terminated or truncated
        with pytest.raises(ResetNeeded, match="ended; call reset"):
            environment.step(action)
    batch = BatchedGridEnvironment(2, paper)
    with pytest.raises(ResetNeeded, match="call reset before the first step"):
        batch.step(np.zeros(2, np.int64))
    batch.reset()
    with pytest.raises(ValueError, match="the array of actions"):
        batch.step(np.array([0, 8]))


def test_a_seed_gives_the_same_episode_also_after_pickling_and_copying() -> None:
    made = gymnasium.make(ENVIRONMENT, reward=moved_goalwards)
    made.reset(seed=5)
    copies = [made, pickle.loads(pickle.dumps(made)), copy.deepcopy(made)]
    episodes = []
    for environment in copies:
        # The generator goes with the copy.
        episode: list[Any] = [environment.reset()]
        while not (len(episode) > 1 and (episode[-1][2] or episode[-1][3])):
            episode.append(environment.step(len(episode) % 8))
        episode.append(environment.reset(seed=5))
        episodes.append(episode)
    assert all(data_equivalence(episodes[0], episode) for episode in episodes)


@pytest.mark.parametrize("start", [(0, 1), [0, 1], np.array([0, 1])])
def test_an_episode_starts_where_the_options_say(small: Scenario, start: Any) -> None:
    environment = GridEnvironment(small, replace(PARAMETERS, p_r=1.0))
    for _ in range(5):
        observation, info = environment.reset(options={"start": start})
        assert info["cell"] == (0, 1)
        assert observation[1, 0] == 3
    batch = BatchedGridEnvironment(2, small)
    _, infos = batch.reset(options={"start": start})
    assert infos["cell"].tolist() == [[0, 1]] * 2
    _, infos = batch.reset(options={"start": [start, (3, 3)]})
    assert infos["cell"].tolist() == [[0, 1], [3, 3]]


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"start": (2, 0)}, r"the start \(2, 0\) is no free cell"),
        ({"start": (4, 0)}, r"the start \(4, 0\) is no free cell other than the goal"),
        ({"start": (5, 0)}, r"the start \(5, 0\) lies outside"),
        ({"start": None}, "the start is None"),
        ({"start": (0.5, 0)}, "the start"),
        ({"begin": (0, 0)}, r"the options have \['begin'\]; give only start"),
    ],
)
def test_a_start_that_is_none_is_refused_and_changes_nothing(
    small: Scenario, options: dict[str, Any], reason: str
) -> None:
    environment = GridEnvironment(small)
    environment.reset(options={"start": (0, 1)})
    with pytest.raises(ValueError, match=reason):
        environment.reset(options=options)
    assert environment.step(np.int64(NORTH))[4]["cell"] == (0, 2)


def test_a_function_gives_the_reward(small: Scenario) -> None:
    parameters = replace(PARAMETERS, max_episode_steps=2)
    environment = GridEnvironment(small, parameters, moved_goalwards)
    rewards = []
    for start, actions in (
        ((0, 0), [EAST, EAST]),
        ((3, 0), [EAST]),
        ((0, 1), [NORTH, EAST]),
    ):
        environment.reset(options={"start": start})
        rewards += [environment.step(np.int64(action))[1] for action in actions]
    goal, collision, steps = (1000.0 * end for end in (1, 2, 3))
    assert rewards == [10, collision, goal + 10, 201, steps + 12]
    # Of N robots, the one that begins an episode gets none.
    moves = []

    def recorded(*move: Any) -> float:
        moves.append(move)
        return moved_goalwards(*move)

    batch = BatchedGridEnvironment(2, small, parameters, recorded)
    batch.reset(options={"start": [(1, 0), (0, 3)]})
    assert batch.step(np.array([EAST, EAST]))[1].tolist() == [collision, 13]
    assert batch.step(np.array([EAST, EAST]))[1].tolist() == [0, steps + 13]
    assert [move[0] for move in moves] == [(1, 0), (0, 3), (1, 3)]


def test_a_reward_has_a_name(small: Scenario) -> None:
    environment = GridEnvironment(small, reward="path_cost")
    environment.reset(options={"start": (3, 0)})
    assert environment.step(np.int64(EAST))[1] == -1
    with pytest.raises(ValueError, match="reward is 'short'; give one of paper"):
        GridEnvironment(small, reward="short")
    with pytest.raises(ValueError, match="the reward is 5; give a function"):
        GridEnvironment(small, reward=5)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "value",
    [None, math.nan, math.inf, "1", np.ones(2), [1], 1j, 10**400, Fraction(10**400)],
)
def test_a_reward_that_is_no_number_is_refused(small: Scenario, value: Any) -> None:
    reason = "the reward function returned .*; give a finite number"
    function: Any = lambda *_: value  # noqa: E731
    environment = GridEnvironment(small, reward=function)
    environment.reset()
    with pytest.raises(ValueError, match=reason):
        environment.step(np.int64(EAST))
    batch = BatchedGridEnvironment(2, small, reward=function)
    batch.reset()
    with pytest.raises(ValueError, match=reason):
        batch.step(np.array([EAST, EAST]))


@pytest.mark.parametrize(
    "value", [1, True, np.True_, np.float32(1), np.int8(1), Fraction(1)]
)
def test_each_type_of_number_is_a_reward(small: Scenario, value: Any) -> None:
    environment = GridEnvironment(small, reward=lambda *_: value)
    environment.reset()
    reward = environment.step(np.int64(EAST))[1]
    assert (type(reward), reward) == (float, 1)


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
@pytest.mark.parametrize(
    "function",
    [lambda: 1.0, lambda cell, action: 1.0, lambda *_, size: 1.0, len],
)
def test_a_reward_function_takes_four_arguments(make: Any, function: Any) -> None:
    reason = r"the reward function takes \(.*; give a function \(cell, action, "
    with pytest.raises(ValueError, match=reason):
        make(ENVIRONMENT, reward=function)


@pytest.mark.parametrize("function", [max, iter, zip, dict, getattr])
def test_a_function_of_c_that_is_no_reward_is_refused(
    small: Scenario, function: Any
) -> None:
    with pytest.raises(ValueError, match=r"the reward function .*; give a "):
        GridEnvironment(small, reward=function)


@pytest.mark.parametrize(
    "scenario", ["nope", "no/such.yaml", Path("nope.yaml"), "~x/y"]
)
def test_a_map_that_is_missing_is_named(scenario: str | Path) -> None:
    for make in (gymnasium.make, gymnasium.make_vec):
        with pytest.raises(MapNotFoundError, match="; give"):
            make(ENVIRONMENT, scenario=scenario)  # type: ignore[operator]


@pytest.mark.parametrize(
    "actions",
    [
        [0.0, 1.0],
        [0, math.nan],
        np.array([0, None]),
        np.array([0, 1], object),
        ["0", "1"],
        [0, True],
        [0, 8],
        [0, -1],
    ],
)
def test_wrong_actions_are_refused_and_change_nothing(
    small: Scenario, actions: Any
) -> None:
    parameters = replace(PARAMETERS, max_episode_steps=1)
    batch, reference = (BatchedGridEnvironment(2, small, parameters) for _ in range(2))
    for environment in (batch, reference):
        environment.reset(seed=0)
        environment.step(np.array([EAST, EAST]))
    with pytest.raises(
        ValueError, match=r"the array of actions.*; give whole numbers, 0 to 7"
    ):
        batch.step(actions)
    steps = [item.step(np.array([EAST, EAST])) for item in (batch, reference)]
    assert data_equivalence(*steps)


@pytest.mark.parametrize(
    "start", [[(0, 1), (3,)], [(0, 1)] * 3, [[(0, 1)], 2], 5, "east", {"x": 1}, []]
)
def test_starts_of_a_wrong_shape_are_refused(small: Scenario, start: Any) -> None:
    reason = r"the start is .*; give one cell \(x, y\)"
    with pytest.raises(ValueError, match=reason + "$"):
        GridEnvironment(small).reset(options={"start": start})
    batch = BatchedGridEnvironment(2, small)
    with pytest.raises(ValueError, match=reason + ", or one for each of the 2 robots$"):
        batch.reset(options={"start": start})
    with pytest.raises(ValueError, match="the options are 5; give a dict"):
        batch.reset(options=5)  # type: ignore[arg-type]


def test_only_scenarios_maps_and_parameters_make_an_environment(
    small: Scenario, tmp_path: Any
) -> None:
    assert GridEnvironment("warehouse").observation_space.shape == (36, 48)
    (tmp_path / "map.pgm").write_bytes(b"P5 2 1 255 \xfe\xfe")
    (tmp_path / "map.yaml").write_text(
        "{image: map.pgm, resolution: 1, origin: [0, 0, 0], negate: 0, "
        "occupied_thresh: 0.65, free_thresh: 0.196}"
    )
    with pytest.raises(ValueError, match="names no start and goal; give Scenario"):
        GridEnvironment(tmp_path / "map.yaml")
    with pytest.raises(ValueError, match="the scenario is 5; give a Scenario or the"):
        GridEnvironment(5)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="give HyperParameters"):
        GridEnvironment(small, 5)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="render_mode is 'human'; give None or one of"):
        GridEnvironment(small, render_mode="human")
    with pytest.raises(ValueError, match="environments is 0"):
        BatchedGridEnvironment(0, small)


def test_an_episode_is_drawn_as_text(small: Scenario) -> None:
    environment = gymnasium.make(ENVIRONMENT, scenario=small, render_mode="ansi")
    environment.reset(options={"start": (0, 0)})
    environment.step(EAST)
    assert environment.render() == ". . . . .\n. . # . .\n. . # . .\n* R # . G"


def test_an_episode_is_drawn_in_colours(small: Scenario) -> None:
    environment = gymnasium.make(ENVIRONMENT, scenario=small, render_mode="rgb_array")
    environment.reset(options={"start": (0, 0)})
    environment.step(EAST)
    picture: Any = environment.render()
    assert (picture.dtype, picture.shape) == (np.uint8, (4 * 96, 5 * 96, 3))
    colours = picture[48::96, 48::96][::-1]  # in the middle of each cell
    assert tuple(colours[0, 0]) == TRAIL_COLOUR
    assert tuple(colours[0, 1]) == ROBOT_COLOUR
    assert tuple(colours[0, 2]) == OBSTACLE_COLOUR
    assert tuple(colours[0, 4]) == GOAL_COLOUR
    assert tuple(colours[3, 2]) == FREE_COLOUR
    # On a large map more than a pixel shows the robot.
    large: Any = GridEnvironment("office", render_mode="rgb_array")
    large.reset()
    picture = large.render()
    assert (picture == ROBOT_COLOUR).all(axis=2).sum() == 11**2


def stepped(
    environment: VectorEnv[Any, Any, Any], steps: int, **options: Any
) -> list[Any]:
    """Return what a vector environment gives, its information as text."""
    results = [environment.reset(**options)]
    actions = np.random.default_rng(3)
    for _ in range(steps):
        results.append(environment.step(actions.integers(8, size=environment.num_envs)))
    for *_, information in results:
        for key, values in information.items():
            information[key] = str(np.array(values.tolist()).tolist())
    return results


@pytest.mark.parametrize("reward", [None, moved_goalwards])
@pytest.mark.parametrize(("count", "p_r"), [(1, 0.5), (5, 0.0)])
def test_a_vector_environment_is_as_that_of_gymnasium(
    small: Scenario, reward: Any, count: int, p_r: float
) -> None:
    parameters = HyperParameters(max_episode_steps=4, p_r=p_r)
    options = {"scenario": small, "parameters": parameters, "reward": reward}
    ours = gymnasium.make_vec(ENVIRONMENT, count, **options)
    theirs = gymnasium.make_vec(ENVIRONMENT, count, "sync", **options)
    assert isinstance(ours, BatchedGridEnvironment)
    assert isinstance(theirs, SyncVectorEnv)
    assert ours.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert ours.metadata == theirs.metadata
    for space in ("observation_space", "action_space"):
        assert getattr(ours, space) == getattr(theirs, space)
        single = f"single_{space}"
        assert getattr(ours, single) == getattr(theirs, single)
    results = stepped(ours, 100, seed=7)
    assert data_equivalence(results, stepped(theirs, 100, seed=7))
    outcomes = str([information["outcome"] for *_, information in results])
    assert "collided" in outcomes
    assert "out_of_steps" in outcomes
    # The same seed, the same episodes.
    assert data_equivalence(results, stepped(ours, 100, seed=7))


def test_information_of_a_vector_environment_is_in_arrays(small: Scenario) -> None:
    environment = gymnasium.make_vec(
        ENVIRONMENT, 3, scenario=small, max_episode_steps=1, render_mode="ansi"
    )
    environment.reset(options={"start": (0, 0)})
    *_, truncated, infos = environment.step(np.array([EAST, EAST, NORTH]))
    assert infos["cell"].tolist() == [[1, 0], [1, 0], [0, 1]]
    assert infos["goal"].tolist() == [[4, 0]] * 3
    assert infos["action_mask"].shape == (3, 8)
    assert infos["outcome"].tolist() == ["out_of_steps"] * 3
    assert truncated.all()
    for key in ("cell", "goal", "action_mask", "outcome"):
        assert infos[f"_{key}"].tolist() == [True] * 3
    frames: Any = environment.render()
    assert re.findall(r"R . #", frames[2]) == ["R . #"]
    assert frames[0].endswith("* R # . G")


def test_the_programs_of_the_page_run() -> None:
    page = Path(__file__).parents[2] / "docs" / "gymnasium.md"
    names: dict[str, Any] = {}
    for program in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL):
        exec(program, names)
    assert names["picture"].shape == (480, 480, 3)
    assert names["infos"]["cell"].shape == (64, 2)
    assert names["env"].reset()[0].shape == (20, 20)
