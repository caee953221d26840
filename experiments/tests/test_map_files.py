from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as numpy_st
from map_files import save_map
from strategies import Data, Place, grids_with_directions, shapes

from ddqn_planner import GridMap, load_map
from ddqn_planner.grid import UNKNOWN, MapFile, MapFileError, read_map_file

# The examples can share a folder: each writes the same files again.
same_folder = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
percent = st.sampled_from(
    [st.integers(-1, 100), st.sampled_from([-1, 0, 100])]
).flatmap(lambda elements: numpy_st.arrays(np.int8, shapes, elements=elements))
origins = st.tuples(*3 * [st.floats(-100, 100)])


@same_folder
@given(percent, st.floats(0.01, 10), origins, st.data())
def test_a_saved_file_comes_back(
    tmp_path: Path, values: np.ndarray, resolution: float, origin: Any, data: Data
) -> None:
    cells = [st.integers(0, side - 1) for side in values.shape[::-1]]
    start, goal = (data.draw(st.none() | st.tuples(*cells)) for _ in range(2))
    saved = MapFile(
        values, np.float64(resolution), origin, start, goal and np.array(goal)
    )
    save_map(saved, tmp_path / "saved.yaml")
    read = read_map_file(tmp_path / "saved.yaml")
    np.testing.assert_array_equal(read.values, values)
    assert repr((read.start, read.goal)) == repr((start, goal))
    assert (read.resolution, read.origin) == (resolution, origin)


@same_folder
@given(grids_with_directions())
def test_a_saved_grid_comes_back_with_directions_and_costs(
    tmp_path: Path, place: Place
) -> None:
    grid, path = place[0], tmp_path / "saved.yaml"
    save_map(grid, path)
    options = {"occupied_threshold": 100, "allow_unknown": True}
    read = load_map(path, use_map_costs=grid.cost is not None, **options)
    assert read.fingerprint == grid.fingerprint
    closed = grid.occupancy
    if grid.cost is not None:
        closed = closed | (grid.cost >= 65) | (grid.cost == UNKNOWN)
    np.testing.assert_array_equal(load_map(path).occupancy, closed)


def test_no_file_that_is_no_yaml_is_saved(tmp_path: Path) -> None:
    for name in ("saved.pgm", "saved.map", "saved"):
        with pytest.raises(MapFileError, match=r"\.yaml"):
            save_map(GridMap(np.zeros((2, 2))), tmp_path / name)
    assert not list(tmp_path.iterdir())
