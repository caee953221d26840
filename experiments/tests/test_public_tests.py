import argparse
import math
from pathlib import Path

import numpy as np
import pytest
import shapely
from bodies import Oracle
from public_data import (
    BARN_CELL,
    BARN_RADIUS,
    MPD_SUFFIX,
    Patch,
    Query,
    barn_map,
    read_barn,
    read_gppc,
    read_mpd,
)
from public_tests import JACKAL, gppc, mpd

FREE = np.array([[1, 1, 1], [1, 0, 1], [1, 0, 1]], np.float32)
GOAL = (2, 2)
MOVES = [[3, 2, 2], [3, 99, 1], [4, 99, 0]]  # to the goal; corners may be cut

SCENARIO = """version 2
height 3
width 4
cost 1 octile
patch small.patch
commands
Q 0 0 0 3 2 3.8284271247462
P 1 0 1 0
Q 1 0 0 3 0 6.4142135623731
Q 1 0 0 2 0 6
P 2 1 1 0
Q 2 0 0 3 0 -1
"""
PATCHES = """type patch
patches 2
patch 0
height 2
width 1
map
@
T
patch 1
height 3
width 1
map
@
@
@
"""
WORLD = """<sdf><world name='default'>
<model name='ground_plane'><static>1</static></model>
<model name='unit_cylinder_0'>
  <static>1</static>
  <pose frame=''>-2.325000 7.075000 0.000000 0.000000 0.000000 0.000000</pose>
</model>
<state><model name='unit_cylinder_0'>
  <pose frame=''>-2.325000 7.075000 0.000000 0.000000 0.000000 0.000000</pose>
</model></state></world></sdf>
"""


def options(folder: Path) -> argparse.Namespace:
    return argparse.Namespace(folder=folder, model=None, maps=None)


def cells_of(row: str) -> list[str]:
    return [cell.strip() for cell in row.strip("|").split("|")]


@pytest.fixture
def mpd_file(tmp_path: Path) -> Path:
    goals = np.zeros((1, 1, 3, 3))
    goals[0, 0, GOAL[1], GOAL[0]] = 1
    moves = -np.array(MOVES, dtype=np.float64).reshape(1, 1, 3, 3)
    path = tmp_path / f"corner{MPD_SUFFIX}"
    np.savez(path, arr_8=FREE[None], arr_9=goals, arr_11=moves)
    return path


def test_an_mpd_file_has_maps_goals_and_numbers_of_moves(mpd_file: Path) -> None:
    (test,) = read_mpd(mpd_file)
    assert test.goal == GOAL
    assert np.array_equal(test.occupancy, FREE == 0)
    assert test.moves[0, 0] == 3
    assert math.isinf(test.moves[1, 1])


def test_all_starts_of_mpd_are_solved_at_the_optimum(mpd_file: Path) -> None:
    row = mpd(options(mpd_file.parent)).splitlines()[-1]
    expected = ["corner", "1", "6", "6", "6", "1.0000", "100.0%", "1.0000"]
    assert cells_of(row) == expected


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    (tmp_path / "small.patch").write_text(PATCHES, encoding="ascii")
    path = tmp_path / "small.scen"
    path.write_text(SCENARIO, encoding="ascii")
    return path


def test_a_gppc_scenario_has_patches_and_queries_in_order(scenario: Path) -> None:
    shape, commands = read_gppc(scenario)
    assert shape == (3, 4)
    first, patch, *_, last = commands
    assert first == Query((0, 0), (3, 2), 3.8284271247462)
    assert isinstance(patch, Patch)
    assert (patch.x, patch.y, patch.occupancy.tolist()) == (1, 0, [[True], [True]])
    assert isinstance(last, Query)
    assert math.isinf(last.length)


def test_gppc_queries_are_answered_on_the_changed_map(scenario: Path) -> None:
    name, size, changes, queries, right, *_ = cells_of(
        gppc(options(scenario.parent)).splitlines()[-1]
    )
    assert (name, size, changes) == ("small", "4 x 3", "2")
    assert (queries, right) == ("4", "4")


def test_a_barn_world_lists_each_cylinder_once(tmp_path: Path) -> None:
    path = tmp_path / "world_0.world"
    path.write_text(WORLD, encoding="ascii")
    centres = read_barn(path)
    assert centres.tolist() == [[-2.325, 7.075]]
    grid = barn_map(centres)
    y, x = np.nonzero(grid.occupancy)
    assert (len(x), np.ptp(x), np.ptp(y)) == (9, 2, 2)
    assert grid.cell_to_world((x[4], y[4])) == pytest.approx((-2.325, 7.075))
    assert grid.resolution == BARN_CELL


def test_the_oracle_finds_a_body_that_touches_a_disc() -> None:
    disc = shapely.buffer(shapely.points([[0.0, 0.0]]), BARN_RADIUS)
    oracle = Oracle(disc, JACKAL)
    touching = 0.215 + BARN_RADIUS
    assert oracle.collisions(np.array([[0.0, touching - 0.001, 0.0]])) == 1
    assert oracle.collisions(np.array([[0.0, touching + 0.001, 0.0]])) == 0


def test_files_of_another_kind_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "world_0.world"
    path.write_text("<sdf/>", encoding="ascii")
    with pytest.raises(ValueError, match="no cylinders"):
        read_barn(path)
    path = tmp_path / "old.scen"
    path.write_text("version 1\n", encoding="ascii")
    with pytest.raises(ValueError, match="version 2"):
        read_gppc(path)
