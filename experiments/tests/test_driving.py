from pathlib import Path

import driving_worlds as worlds
import numpy as np
import pytest
from driving import BEST, LAST, LEARNED, MEAN, PLANNERS, CellTimes, Job, main, run

from ddqn_planner.grid import GridMap, MoveRule
from ddqn_planner.planning import Planner


@pytest.mark.parametrize("kind", worlds.KINDS)
def test_a_world_is_always_the_same_and_its_crowds_come_and_go(kind: str) -> None:
    world, again = worlds.generated_world(kind, 3), worlds.generated_world(kind, 3)
    np.testing.assert_array_equal(world.slowness(0), again.slowness(0))
    assert world.stations == again.stations
    assert all(world.grid.is_free(station) for station in world.stations)
    assert (world.slowness(0) != world.slowness(worlds.HOUR)).any()
    np.testing.assert_array_equal(world.slowness(0), world.slowness(2 * worlds.HOUR))
    assert world.slowness(0).min() == 1


def test_a_drive_takes_the_time_of_its_path() -> None:
    world, random = worlds.generated_world("office", 0), np.random.default_rng(0)
    path = Planner.load("any_map").plan(
        world.known(0), world.stations[0], world.stations[1], MoveRule.ROBOT_SAFE
    )
    expected = worlds.path_seconds(path.cells, world.slowness(0), world.grid)
    assert path.cost == pytest.approx(expected)
    drives = [worlds.drive(path.cells, world, 100.0, random) for _ in range(200)]
    assert np.mean([measured.duration for measured in drives]) == pytest.approx(expected, rel=0.03)
    noise = np.std([np.log(measured.slowness) for measured in drives], axis=0)
    assert noise.mean() == pytest.approx(worlds.NOISE, rel=0.1)
    seconds, positions = drives[0].seconds, drives[0].positions
    assert seconds[0] == 100
    assert seconds[-1] == pytest.approx(100 + drives[0].duration, abs=0.2)
    for place, cell in ((positions[0], path.cells[0]), (positions[-1], path.cells[-1])):
        np.testing.assert_allclose(place, world.grid.cell_to_world(cell), atol=0.2)


def test_every_fault_occurs() -> None:
    seconds = np.arange(0, 60, 0.1)
    positions = np.column_stack([seconds * worlds.SPEED, np.zeros_like(seconds)])
    measured = worlds.Drive(seconds, positions, np.ones(1), 60.0)
    seen = set()
    for seed in range(30):
        faulty = worlds.with_faults(measured, np.random.default_rng(seed))
        pause = len(faulty.seconds) > len(seconds)
        clock_jumps = bool((np.abs(np.diff(faulty.seconds)) > 1).any())
        jumps = int((np.hypot(*np.diff(faulty.positions, axis=0).T) > 0.5).sum())
        seen.add((pause, clock_jumps, jumps))
        assert len(faulty.seconds) == len(faulty.positions)
    pause, clock, teleport, odometry = (True, False, 0), (False, True, 0), 2, 1
    assert seen >= {pause, clock, (False, False, teleport), (False, False, odometry)}


def test_the_baselines_remember_the_last_and_the_mean_time() -> None:
    grid = GridMap(np.zeros((1, 3), dtype=bool))
    for is_mean, expected in ((False, [4, 1, 1]), (True, [3, 1, 1])):
        memory = CellTimes(grid, is_mean)
        memory.record([(0, 0), (1, 0)], np.array([2.0, 0.5]))
        memory.record([(0, 0)], np.array([4.0]))
        slowness = memory.apply().slowness
        assert slowness is not None
        np.testing.assert_array_equal(slowness, [expected])


def test_no_planner_is_faster_than_the_one_that_knows() -> None:
    result = run(Job("office", 0, 12))
    assert set(result.seconds) == {BEST, *PLANNERS} >= {LEARNED, LAST, MEAN}
    for name in PLANNERS:
        assert (result.seconds[name] >= result.seconds[BEST] * (1 - 1e-6)).all()
    assert result.forecast.shape == (12, 4)


def test_the_experiment_writes_its_report(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    command = ["--backend", "sequential", "--quick", "--seeds", "1", "--out", str(tmp_path)]
    assert main(command) == 0
    assert "| learned | 1." in capsys.readouterr().out
    written = {path.name for path in (tmp_path / "quick").iterdir()}
    assert written == {"report.md", "curve.png", "map.png"}


def test_wrong_options_are_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for options, words in (
        (["--seeds", "0"], "--seeds is 0; give at least 1"),
        (["--maps", str(tmp_path)], "found no ROS map (.yaml); check the path"),
    ):
        assert main([*options, "--out", str(tmp_path)]) == 2
        assert words in capsys.readouterr().err
