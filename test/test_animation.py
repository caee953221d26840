from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageColor

pytest.importorskip("matplotlib")
import animation

from ddqn_planner import GridMap, Planner
from ddqn_planner.pictures import PATH_COLOUR


def test_cells_appear_then_the_path_grows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(animation, "LAST_FRAMES", 2)
    planner, grid = Planner.load("any_map"), GridMap(np.zeros((8, 12), dtype=bool))
    plan = planner.plan(grid, (1, 4), (10, 4))
    value = planner.q_field(grid, (10, 4)).value
    animation.save_film(str(tmp_path / "plan.gif"), grid, plan, value, steps=4)
    shown, red = [], []
    with Image.open(tmp_path / "plan.gif") as film:
        for number in range(film.n_frames):
            film.seek(number)
            pixels = np.asarray(film.convert("RGB"), dtype=int)
            away = np.abs(pixels - ImageColor.getrgb(PATH_COLOUR)).max(axis=2)
            shown.append(int((pixels.min(axis=2) < 250).sum()))
            red.append(int((away < 40).sum()))
    assert len(shown) in (7, 8)
    assert shown[:4] == sorted(set(shown[:4]))
    assert red[4:] == sorted(set(red[4:]))
    assert red[-1] > 2 * red[3]


def test_a_film_of_a_shipped_map(monkeypatch: pytest.MonkeyPatch) -> None:
    saved: list[str] = []
    monkeypatch.setattr(animation, "save_film", lambda path, *_: saved.append(path))
    assert animation.main(["dilemma", "plan.gif"]) == 0
    assert (
        animation.main(["dilemma", "no.gif", "--start", "6", "19", "--goal", "1", "19"])
        == 1
    )
    assert saved == ["plan.gif"]
