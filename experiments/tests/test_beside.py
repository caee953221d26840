"""Paths of bodies beside another planner's: what is read and measured."""

from pathlib import Path

import numpy as np
import pytest
from beside import Request, figures_of, inflated_as_nav2, measured, read_paths
from bodies import Oracle, occupied_cells

from ddqn_planner import GridMap

SQUARE = "[[0.25, 0.25], [-0.25, 0.25], [-0.25, -0.25], [0.25, -0.25]]"


def test_another_planners_path_is_read_and_measured(tmp_path: Path) -> None:
    file = tmp_path / "paths.csv"
    poses = "".join(f"hall,0,7.5,{x},1,0\n" for x in (1, 2, 3))
    file.write_text(f"map,request,ms,x,y,yaw\n{poses}hall,1,2,1,1,0\n")
    oracle = Oracle(occupied_cells(GridMap(np.zeros((80, 80), np.bool_), 0.05)), SQUARE)
    request = Request("hall", "0", (1.0, 1.0, 0.0), (3.0, 1.1, 0.0))
    paths = read_paths(file)
    (result,) = measured(paths, [request], {"hall": oracle}).values()

    assert set(paths) == {("hall", "0"), ("hall", "1")}
    assert result.length == pytest.approx(2)
    assert result.clearance == pytest.approx(75, abs=0.01)  # the border is 1 m away
    assert result.ms == 7.5
    assert (result.shape.turning, result.shape.cusps) == (0, 0)
    assert result.shape.off == pytest.approx(10)
    assert "1.000" in figures_of([result], [result.length])


def test_costs_fall_as_in_the_inflation_layer() -> None:
    occupancy = np.zeros((1, 60), np.bool_)
    occupancy[0, 0] = True
    grid = inflated_as_nav2(GridMap(occupancy, 0.05), inscribed_radius=0.2)

    assert grid.uninflated.sum() == 1
    assert grid.occupancy[0].tolist() == [True] * 5 + [False] * 55  # up to 0.2 m
    costs = grid.cost_multiplier[0, 5:]
    assert np.all(np.diff(costs) <= 0)
    assert costs[0] > costs[15] > 1  # 0.25 m and 1 m
    assert np.all(costs[16:] == 1)
