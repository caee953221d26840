from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ddqn_planner.grid import GridMap
from ddqn_planner.pictures import TERMINAL, draw_blocks, draw_text, save_picture


def test_a_map_as_text_has_its_first_row_below() -> None:
    grid = GridMap(np.array([[0, 0, 1], [0, 1, 0]]))
    assert draw_text(grid, []) == ". # .\n. . #"
    assert draw_text(grid, [(1, 0), (0, 0), (0, 1)]) == "G # .\n* S #"
    assert draw_text(grid, [(2, 1)]) == ". # G\n. . #"


def test_one_way_zones_are_arrows() -> None:
    # All moves to the east, north, west and south, and no zone.
    forbidden = [[0b10000011, 0b00111000, 0], [0b00001110, 0b11100000, 255]]
    grid = GridMap(np.array([[0, 0, 0], [0, 0, 1]]), forbidden=np.array(forbidden))
    assert draw_text(grid, []) == "v ^ #\n< > ."


def test_a_wide_map_fits_into_its_terminal() -> None:
    occupancy = np.zeros((9, 20))
    occupancy[8, 19] = 1
    grid, cells = GridMap(occupancy), [(0, 0), (1, 1), (2, 2), (3, 3)]
    drawn = draw_blocks(grid, cells, columns=10, lines=24).splitlines()  # 2x2 cells per square
    pairs = [re.findall("\x1b\\[3([^m]+);4([^m]+)m▀", line) for line in drawn]
    outside, free, occupied, path, end = TERMINAL
    assert [[*map(len, pairs)], pairs[0][-1]] == [[10] * 3, (outside, occupied)]
    assert (pairs[-1][0], pairs[-1][1]) == ((free, end), (end, free))
    tall = draw_blocks(grid, cells, columns=10, lines=2).splitlines()  # 3x3 cells
    assert [line.count("▀") for line in tall] == [7, 7]
    assert f"3{path};" not in tall[0]


def test_a_picture_shows_one_way_zones(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    for name, forbidden in (("plain", None), ("one_way", np.full((60, 50), 56))):
        grid = GridMap(np.zeros((60, 50)), forbidden=forbidden)
        save_picture(tmp_path / f"{name}.png", grid, [], None, "a title")
    plain, one_way = (
        np.asarray(Image.open(tmp_path / f"{name}.png").convert("L"))
        for name in ("plain", "one_way")
    )
    assert (plain != one_way).mean() > 0.01


@pytest.mark.parametrize("cells", [[], [(0, 0), (1, 1)]])
def test_a_picture_is_drawn(tmp_path: Path, cells: list[tuple[int, int]]) -> None:
    pytest.importorskip("matplotlib")
    value = np.array([[1, 2, -np.inf], [3, 4, 5]], dtype=np.float32)
    save_picture(tmp_path / "map.png", GridMap(np.zeros((2, 3))), cells, value, "a title")
    with Image.open(tmp_path / "map.png") as picture:
        assert len(set(np.asarray(picture.convert("L")).ravel().tolist())) > 2
