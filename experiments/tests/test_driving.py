from pathlib import Path

import driving_worlds as worlds
import numpy as np
import pytest
from driving import main
from driving_learners import LEARNERS, LastTime, MeanTime
from driving_missions import Job, run, with_faults

from ddqn_planner.grid import GridMap, MoveRule
from ddqn_planner.planning import Planner


@pytest.mark.parametrize("kind", [*worlds.TUNING, *worlds.HELD_OUT])
def test_a_world_is_always_the_same_and_something_is_slow(kind: str) -> None:
    world, again = worlds.generated_world(kind, 3), worlds.generated_world(kind, 3)
    for clock in (0, worlds.HOUR):
        np.testing.assert_array_equal(world.slowness(clock), again.slowness(clock))
    assert world.stations == again.stations
    assert all(world.grid.is_free(station) for station in world.stations)
    assert world.slowness(0).min() >= 1
    is_slow = max(world.slowness(0).max(), world.slowness(worlds.HOUR).max()) > 1.3
    assert is_slow or world.waits is not None or world.ramps is not None
    np.testing.assert_array_equal(world.slowness(0), world.slowness(2 * worlds.HOUR))
    if world.crowds:
        trip = world.stations[:2]
        world.best_seconds(*trip, 0)
        assert world.best_seconds(*trip, worlds.HOUR) == again.best_seconds(
            *trip, worlds.HOUR
        )


def test_held_out_worlds_are_no_worlds_for_tuning() -> None:
    assert not set(worlds.TUNING) & set(worlds.HELD_OUT)


def test_a_drive_takes_the_time_of_its_path_and_stands_where_it_waits() -> None:
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
    world.waits = np.zeros(world.grid.occupancy.shape)
    for x, y in path.cells[len(path.cells) // 2 :][:2]:  # one door, two cells deep
        world.waits[y, x] = 50
    assert worlds.path_seconds(path.cells, world, 0) == pytest.approx(expected + 50)
    waiting = worlds.drive(path.cells, world, 0, random, pose_noise=0)
    standing = (np.abs(np.diff(waiting.positions, axis=0)).max(axis=1) == 0).sum()
    assert standing == pytest.approx(50 * worlds.RATE, abs=2)
    before = world.grid.cell_to_world(path.cells[len(path.cells) // 2 - 1])
    at = np.abs(waiting.positions - before).max(axis=1) < 1e-9
    assert at.sum() >= standing


def test_a_ramp_is_slow_in_one_direction() -> None:
    grid = GridMap(np.zeros((1, 9), dtype=bool), 0.25)
    ramps = np.zeros((1, 9, 2))
    ramps[..., 0] = 2
    cells = [(x, 0) for x in range(9)]
    world = worlds.World(grid, np.ones((1, 9)), [], [cells[0], cells[-1]], ramps=ramps)
    level = 8 * 0.25 / worlds.SPEED
    assert worlds.path_seconds(cells, world, 0) == pytest.approx(3 * level)
    assert worlds.path_seconds(cells[::-1], world, 0) == pytest.approx(level)
    assert world.best_seconds(cells[0], cells[-1], 0) == pytest.approx(3 * level)
    assert world.best_seconds(cells[-1], cells[0], 0) == pytest.approx(level)


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


def test_the_baselines_remember_the_last_and_the_mean_time() -> None:
    grid = GridMap(np.zeros((1, 12), dtype=bool), 0.25)
    for make, expected in ((LastTime, 4.0), (MeanTime, 3.0)):
        learner = make(grid)
        for times in (2.0, 4.0):
            seconds = np.arange(0, 3 / worlds.SPEED * times, 0.1)
            x = seconds * worlds.SPEED / times
            learner.record(seconds, np.column_stack([x, np.full_like(x, 0.1)]))
        slowness = learner.apply(grid).slowness
        assert slowness is not None
        np.testing.assert_allclose(slowness[0, 1:-1], expected, rtol=0.02)


@pytest.mark.parametrize("learner", LEARNERS)
def test_no_learner_is_faster_than_the_one_that_knows(learner: str) -> None:
    result = run(Job("rooms-waits", 0, learner, 12))
    for seconds in (result.seconds, result.shortest):
        assert (seconds >= result.best * (1 - 1e-6)).all()
    assert len(result.forecast) == (12 if learner == "experience" else 0)


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
