from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ddqn_planner.grid import GridMap
from ddqn_planner.pictures import draw_text, save_picture
from ddqn_planner.pictures.colours import VALUE_COLOURS, value_ramp


def test_a_map_as_text_has_its_first_row_below() -> None:
    grid = GridMap(np.array([[0, 0, 1], [0, 1, 0]]))
    assert draw_text(grid, []) == ". # .\n. . #"
    assert draw_text(grid, [(1, 0), (0, 0), (0, 1)]) == "G # .\n* S #"
    assert draw_text(grid, [(2, 1)]) == ". # G\n. . #"


def test_the_ramp_leads_from_the_worst_colour_to_the_best() -> None:
    ramp = value_ramp(7)
    assert ["#" + bytes(ramp[level]).hex() for level in (0, 2, 4, 6)] == list(VALUE_COLOURS)
    assert (np.diff(ramp.astype(int).sum(axis=1)) < 0).all()


@pytest.mark.parametrize("cells", [[], [(0, 0), (1, 1)]])
def test_a_picture_is_drawn(tmp_path: Path, cells: list[tuple[int, int]]) -> None:
    pytest.importorskip("matplotlib")
    value = np.array([[1, 2, -np.inf], [3, 4, 5]], dtype=np.float32)
    save_picture(tmp_path / "map.png", GridMap(np.zeros((2, 3))), cells, value, "a title")
    with Image.open(tmp_path / "map.png") as picture:
        assert len(set(np.asarray(picture.convert("L")).ravel().tolist())) > 2
