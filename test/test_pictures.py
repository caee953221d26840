import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageColor

from ddqn_planner.grid import GridMap
from ddqn_planner.pictures import (
    GOAL_COLOUR,
    OBSTACLE_COLOUR,
    REVERSE_COLOUR,
    BodyPicture,
    draw_body,
    draw_text,
    save_picture,
    view_of_body,
    whole_map,
)

CAR = np.array([[10.0, 5.0], [-4.0, 5.0], [-4.0, -5.0], [10.0, -5.0]])


def test_a_map_as_text_has_its_first_row_below() -> None:
    grid = GridMap(np.array([[0, 0, 1], [0, 1, 0]]))
    assert draw_text(grid, []) == ". # .\n. . #"
    assert draw_text(grid, [(1, 0), (0, 0), (0, 1)]) == "G # .\n* S #"
    assert draw_text(grid, [(2, 1)]) == ". # G\n. . #"
    # All moves to the east, north, west and south are arrows; no zone is none.
    forbidden = [[0b10000011, 0b00111000, 0], [0b00001110, 0b11100000, 255]]
    assert (
        draw_text(GridMap([[0, 0, 0], [0, 0, 1]], forbidden=forbidden), [])
        == "v ^ #\n< > ."
    )


def test_a_wide_map_shows_of_each_square_what_matters_most() -> None:
    occupancy = np.zeros((5, 130))  # 3 cells a side
    occupancy[4, 129] = occupancy[4, 128] = occupancy[0, 8] = 1
    drawn = draw_text(
        GridMap(occupancy), [(0, 0), (1, 1), (3, 0), (6, 0), (6, 1)]
    ).splitlines()
    assert [len(line) for line in drawn] == [2 * 44 - 1] * 2
    assert drawn[0] == ". " * 42 + "# #"
    assert drawn[1] == "S * G " + ". " * 40 + "."


def test_a_picture_shows_the_value_the_path_and_one_way_zones(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    value = np.arange(60 * 50, dtype=np.float32).reshape(60, 50)
    value[0, 0] = -np.inf
    pictures = []
    for cells, forbidden in (
        ([], None),
        ([(0, 0), (9, 9)], None),
        ([], np.full((60, 50), 56)),
    ):
        grid = GridMap(np.zeros((60, 50)), forbidden=forbidden)
        save_picture(tmp_path / "map.png", grid, cells, value, "a title")
        with Image.open(tmp_path / "map.png") as picture:
            pictures.append(np.asarray(picture.convert("L").resize((400, 400))))
    plain, with_path, one_way = pictures
    assert len(np.unique(plain)) > 20
    for other in (with_path, one_way):
        assert (plain != other).mean() > 0.01


def test_a_picture_shows_the_part_of_a_large_map_around_a_body() -> None:
    poses = np.column_stack([np.linspace(200, 260, 61), np.full(61, 40), np.zeros(61)])
    body = BodyPicture(CAR, poses, poses[[0, -1]])
    grid = GridMap(np.zeros((600, 900)))
    part = view_of_body(grid, body)
    # Two lengths of the body, of 14 cells, on both sides; clipped to the map below.
    np.testing.assert_allclose(part.x, (196 - 28, 270 + 28))
    np.testing.assert_allclose(part.y, (40 - 33, 40 + 33))
    lower = body._replace(poses=poses - (0, 20, 0), ends=body.ends - (0, 20, 0))
    assert view_of_body(grid, lower).y == (-0.5, 53.0)
    small_grid = GridMap(np.zeros((80, 300)))
    assert view_of_body(small_grid, body).x == part.x
    smallest_grid = GridMap(np.zeros((80, 280)))
    long_path = np.array([[10.0, 40, 0], [260, 40, 0]])
    long_body = BodyPicture(CAR, long_path, long_path)
    assert view_of_body(smallest_grid, long_body) == whole_map(smallest_grid)


@pytest.mark.parametrize("yaw", [0.0, 0.7, math.pi / 2, 4.0])
def test_a_body_stands_where_it_is_with_its_nose_ahead(yaw: float) -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    canvas = FigureCanvasAgg(Figure(figsize=(4, 4), dpi=100))  # 4 pixels per cell
    axes = canvas.figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    # From the middle ahead to 25 cells, in reverse to -25, and the goal is there.
    along = np.concatenate([np.linspace(0, 25, 50), np.linspace(24, -25, 100)])
    x, y = 50 + math.cos(yaw) * along, 50 + math.sin(yaw) * along
    poses = np.column_stack([x, y, np.full(150, yaw)])
    draw_body(axes, CAR, poses, poses[[49, -1]])
    axes.set(xlim=(0, 100), ylim=(0, 100))
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[::-1]

    def shows(colour: str, ahead: float, left: float) -> bool:
        x = 50 + math.cos(yaw) * ahead - math.sin(yaw) * left
        y = 50 + math.sin(yaw) * ahead + math.cos(yaw) * left
        pixel = pixels[round(4 * y), round(4 * x), :3].astype(int)
        return bool(np.abs(pixel - ImageColor.getrgb(colour)).max() < 25)

    assert shows(OBSTACLE_COLOUR, -25 + 2, 1.5)  # the nose of the goal
    assert shows(GOAL_COLOUR, -25 - 2, 3)
    assert shows(REVERSE_COLOUR, -25 + 3, 0)  # the end, on the body at the goal
    assert shows(REVERSE_COLOUR, 12, 0)  # above the way ahead
    assert shows("white", 25, 0)  # the cusp
    assert shows(OBSTACLE_COLOUR, 25 + 3, 0)  # the nose of the start
    assert shows("white", 25 - 2, 3)
    assert not any(shows("white", *place) for place in ((0, 3), (0, -3), (-12, 3)))
    assert all(shows("white", *place) for place in ((0, 7), (0, -7), (-31, 0), (37, 0)))


def test_a_path_ahead_has_one_colour_and_no_cusp() -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    axes = Figure().add_subplot()
    poses = np.column_stack([np.linspace(0, 25, 50), np.zeros(50), np.zeros(50)])
    draw_body(axes, CAR, poses, poses[[0, -1]])
    assert axes.get_legend_handles_labels()[1] == ["swept", "path", "start", "goal"]
    turned_back = np.concatenate([poses, poses[-2::-1]])
    draw_body(axes, CAR, turned_back, poses[[0, 0]])
    assert {"path", "in reverse", "cusp"} < {*axes.get_legend_handles_labels()[1]}
    draw_body(axes, CAR, poses[:1], poses[[0, 0]])  # it stands
