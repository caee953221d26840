from dataclasses import replace
from pathlib import Path
from typing import Any

import driving_kinds as kinds
import driving_laws_one
import driving_laws_two
import driving_worlds as worlds
import numpy as np
import pytest
from driving import main
from driving_laws import Door, Law, Stand
from driving_laws_old import HOUR
from driving_learners import LEARNERS, MarkovField
from driving_missions import Job, run, with_faults

from ddqn_planner.grid import GridMap, MoveRule
from ddqn_planner.planning import Planner

SOME_KINDS = (*kinds.FORMER, *kinds.FOR_CHOOSING, *kinds.FOR_FIGURES[:10])


@pytest.mark.parametrize("kind", [*SOME_KINDS, *kinds.STANDING[:4]])
def test_a_world_is_always_the_same_and_its_best_time_is_exact(kind: str) -> None:
    world, again = worlds.generated_world(kind, 3), worlds.generated_world(kind, 3)
    for clock in (0, HOUR):
        np.testing.assert_array_equal(world.slowness(clock), again.slowness(clock))
    assert world.stations == again.stations
    assert all(world.grid.is_free(station) for station in world.stations)
    assert world.slowness(0).min() >= 0.5
    start, goal = world.stations[:2]
    path = Planner.load("any_map").plan(
        world.known(0), start, goal, MoveRule.ROBOT_SAFE
    )
    best = world.best_seconds(start, goal, 0)
    assert best <= worlds.path_seconds(path.cells, world, 0) * (1 + 1e-6)
    # A copy knows nothing of the times that were asked for before.
    world.best_seconds(start, goal, HOUR)
    expected = world.best_seconds(start, goal, 2 * HOUR)
    assert expected == again.best_seconds(start, goal, 2 * HOUR)


def test_the_halves_of_the_laws_are_disjoint_and_complete() -> None:
    halves = [*kinds.LAWS_FOR_CHOOSING, *kinds.LAWS_FOR_FIGURES]
    assert len({*halves}) == 20
    assert {*halves} == {*driving_laws_one.LAWS, *driving_laws_two.LAWS}
    assert {*worlds.LAWS} == {*kinds.CLASSES}


def test_a_drive_takes_the_time_of_its_path() -> None:
    world, random = (
        worlds.generated_world("office-mixture", 0),
        np.random.default_rng(0),
    )
    path = Planner.load("any_map").plan(
        world.known(0), world.stations[0], world.stations[1], MoveRule.ROBOT_SAFE
    )
    expected = worlds.path_seconds(path.cells, world, 0)
    assert path.cost == pytest.approx(expected)
    assert world.best_seconds(*world.stations[:2], 0) == pytest.approx(expected)
    drives = [worlds.drive(path.cells, world, 100.0, random) for _ in range(200)]
    assert np.mean([measured.duration for measured in drives]) == pytest.approx(
        expected, rel=0.03
    )
    seconds, positions = drives[0].seconds, drives[0].positions
    assert seconds[0] == 100
    assert seconds[-1] == pytest.approx(100 + drives[0].duration, abs=0.2)
    for place, cell in ((positions[0], path.cells[0]), (positions[-1], path.cells[-1])):
        np.testing.assert_allclose(place, world.grid.cell_to_world(cell), atol=0.2)


def corridor(**law: Any) -> worlds.World:
    """Make a corridor of 20 m by 0.25 m between two stations."""
    level = np.ones((1, 81))
    grid = GridMap(np.zeros((1, 81), dtype=bool), 0.25)
    made = Law(lambda clock: level, **law)
    return worlds.World(grid, made, [(0, 0), (80, 0)])


LEVEL = 20 / worlds.SPEED
CORRIDOR = [(x, 0) for x in range(81)]
DOOR = np.arange(81)[None] // 2 == 20  # two cells deep
UPHILL = np.zeros((1, 81, 2))
UPHILL[..., 0] = 2


@pytest.mark.parametrize(
    ("law", "seconds", "back"),
    [
        ({"doors": [Door(DOOR, Stand(0.5, 10, 30))]}, LEVEL + 10, LEVEL + 10),
        ({"stop": Stand(0.1, 0, 10)}, LEVEL + 10, LEVEL + 10),
        ({"at_start": Stand(1, 5, 7)}, LEVEL + 6, LEVEL + 6),
        ({"at_goal": Stand(0.5, 10, 10)}, LEVEL + 5, LEVEL + 5),
        ({"uphill": UPHILL}, 3 * LEVEL, LEVEL),
        ({"whole_drive": lambda clock: 1.5}, 1.5 * LEVEL, 1.5 * LEVEL),
        (
            {"uphill": UPHILL, "whole_drive": lambda clock: 2.0},
            6 * LEVEL,
            2 * LEVEL,
        ),
    ],
)
def test_all_that_a_law_says_takes_its_time(
    law: dict[str, Any], seconds: float, back: float
) -> None:
    world = corridor(**law)
    for cells, expected in ((CORRIDOR, seconds), (CORRIDOR[::-1], back)):
        assert worlds.path_seconds(cells, world, 0) == pytest.approx(expected)
        best = world.best_seconds(cells[0], cells[-1], 0)
        assert best == pytest.approx(expected)
        random = np.random.default_rng(0)
        drives = [worlds.drive(cells, world, 0, random) for _ in range(400)]
        durations = [measured.duration for measured in drives]
        error = np.std(durations) / 20
        assert abs(np.mean(durations) - expected) < 4 * error


def test_a_robot_stands_in_the_last_cell_before_a_door() -> None:
    world = corridor(doors=[Door(DOOR, Stand(1, 50, 50))])
    random = np.random.default_rng(0)
    waiting = worlds.drive(CORRIDOR, world, 0, random, pose_noise=0)
    standing = np.abs(np.diff(waiting.positions, axis=0)).max(axis=1) == 0
    assert standing.sum() == pytest.approx(50 * worlds.RATE, abs=2)
    x = waiting.positions[1:][standing, 0]
    np.testing.assert_allclose(x, world.grid.cell_to_world((39, 0))[0])


def test_the_one_who_knows_turns_as_little_as_it_pays() -> None:
    grid = GridMap(np.zeros((9, 9), dtype=bool), 0.25)
    level = np.ones((9, 9))
    world = worlds.World(grid, Law(lambda clock: level, turn_seconds=3.0), [])
    world = replace(world, stations=[(0, 0), (8, 2), (2, 0)])
    straight = worlds.path_seconds([(0, 0), (1, 0), (2, 0)], world, 0)
    assert straight == pytest.approx(1.0)  # no turn
    assert worlds.path_seconds([(0, 0), (1, 0), (1, 1)], world, 0) == 1.0 + 6.0
    one_turn = [*((x, 0) for x in range(7)), (7, 1), (8, 2)]
    expected = worlds.path_seconds(one_turn, world, 0)
    assert world.best_seconds((0, 0), (8, 2), 0) == pytest.approx(expected)
    assert world.best_seconds((0, 0), (2, 0), 0) == pytest.approx(straight)
    random = np.random.default_rng(0)
    drives = [worlds.drive(one_turn, world, 0, random) for _ in range(200)]
    mean = np.mean([measured.duration for measured in drives])
    assert mean == pytest.approx(expected, rel=0.03)


def test_every_fault_occurs() -> None:
    seconds = np.arange(0, 60, 0.1)
    positions = np.column_stack([seconds * worlds.SPEED, np.zeros_like(seconds)])
    measured = worlds.Drive(seconds, positions, 60.0)
    seen = set()
    for seed in range(30):
        faulty = with_faults(measured, np.random.default_rng(seed))
        pause = len(faulty.seconds) > len(seconds)
        clock_jumps = bool((np.abs(np.diff(faulty.seconds)) > 1).any())
        jumps = int((np.hypot(*np.diff(faulty.positions, axis=0).T) > 0.5).sum())
        seen.add((pause, clock_jumps, jumps))
        assert len(faulty.seconds) == len(faulty.positions)
    pause, clock, teleport, odometry = (True, False, 0), (False, True, 0), 2, 1
    assert seen >= {pause, clock, (False, False, teleport), (False, False, odometry)}


def test_the_plain_field_learns_the_mean_time_of_places() -> None:
    grid = GridMap(np.zeros((1, 12), dtype=bool), 0.25)
    field = MarkovField(grid)
    for _ in range(30):
        seconds = np.arange(0, 3 / worlds.SPEED * 4, 0.1)
        x = seconds * worlds.SPEED / 4
        field.record(seconds, np.column_stack([x, np.full_like(x, 0.1)]))
    slowness = field.apply(grid).slowness
    assert slowness is not None
    np.testing.assert_allclose(slowness[0, 1:-1], 4.0, rtol=0.05)


def test_no_learner_is_faster_than_the_one_that_knows() -> None:
    results = run(Job("rooms-waits", 0, tuple(LEARNERS), 12))
    assert [result.learner for result in results] == [*LEARNERS]
    for result in results:
        for seconds in (result.seconds, result.shortest):
            assert (seconds >= result.best * (1 - 1e-6)).all()
        is_experience = result.learner == "experience"
        assert len(result.forecast) == (12 if is_experience else 0)
    # All drive the same missions.
    np.testing.assert_array_equal(results[0].best, results[1].best)
    np.testing.assert_array_equal(results[0].shortest, results[1].shortest)


def test_the_experiment_writes_its_report(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    command = [
        "--backend",
        "sequential",
        "--quick",
        "--seeds",
        "1",
        "--out",
        str(tmp_path),
    ]
    assert main(command) == 0
    assert "| experience | " in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "quick").iterdir()} == {
        "report.md",
        "curve.png",
    }


def test_wrong_options_are_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for options, words in (
        (["--seeds", "0"], "--seeds is 0; give at least 1"),
        (["--maps", str(tmp_path)], "found no ROS map (.yaml); check the path"),
    ):
        assert main([*options, "--out", str(tmp_path)]) == 2
        assert words in capsys.readouterr().err
