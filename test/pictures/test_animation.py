from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageColor

from ddqn_planner.grid import GridMap, MoveRule, shortest_distances, shortest_path
from ddqn_planner.pictures.animation import (
    FIELD_MS,
    FRAMES,
    LAST_FRAME_MS,
    MIN_SIDE,
    save_animation,
)
from ddqn_planner.pictures.colours import OBSTACLE_COLOUR, PATH_COLOUR
from ddqn_planner.training.environment import Scenario


def frames_of(path: Path) -> tuple[list[np.ndarray], list[int]]:
    """Return the frames, (height, width, 3) uint8, and how many milliseconds each lasts."""
    frames, durations = [], []
    with Image.open(path) as animation:
        for number in range(animation.n_frames):
            animation.seek(number)
            frames.append(np.array(animation.convert("RGB")))
            durations.append(animation.info["duration"])
    return frames, durations


def is_colour(frame: np.ndarray, colour: str) -> np.ndarray:
    return (frame == ImageColor.getrgb(colour)).all(axis=-1)


def negative_distances(grid: GridMap, goal: tuple[int, int]) -> np.ndarray:
    return -shortest_distances(grid, goal, MoveRule.ROBOT_SAFE).astype(np.float32)


def test_cells_appear_in_the_order_of_their_value_and_then_the_path_grows(
    small: Scenario, tmp_path: Path
) -> None:
    grid, start, goal = small.grid, small.start, small.goal
    value = negative_distances(grid, goal)
    cells = shortest_path(grid, start, goal, MoveRule.ROBOT_SAFE)
    save_animation(tmp_path / "new" / "plan.gif", grid, start, goal, value, cells)
    frames, durations = frames_of(tmp_path / "new" / "plan.gif")
    assert durations[-1] == LAST_FRAME_MS
    assert sum(shown >= FIELD_MS for shown in durations) == 2  # the complete field, the path
    side = frames[0].shape[1] // grid.width
    assert frames[0].shape == (side * grid.height, side * grid.width, 3)
    corners = [frame[::-1][side // 8 :: side, side // 8 :: side] for frame in frames]
    assert (is_colour(corners[0], OBSTACLE_COLOUR) == grid.occupancy).all()
    seen = [~is_colour(corner, "white") & ~grid.occupancy for corner in corners]
    for before, after in pairwise(seen):
        assert (before <= after).all()
        assert value[after].min() >= value[~grid.occupancy & ~before].max(initial=-99)
    assert not seen[0].any()
    assert (seen[-1] == ~grid.occupancy).all()
    red = [is_colour(frame, PATH_COLOUR) for frame in frames]
    assert red[0].sum() < red[-1].sum()
    centres = red[-1][::-1][side // 2 :: side, side // 2 :: side]
    assert {(int(x), int(y)) for y, x in np.argwhere(centres)} == set(cells)


@pytest.mark.parametrize("value", [None, np.full((4, 5), -np.inf, np.float32)])
def test_without_field_and_path_the_map_is_drawn(
    small: Scenario, tmp_path: Path, value: np.ndarray | None
) -> None:
    save_animation(tmp_path / "plan.gif", small.grid, (-3, 99), small.goal, value, ())
    (frame,), _ = frames_of(tmp_path / "plan.gif")
    assert is_colour(frame, OBSTACLE_COLOUR).any()


@pytest.mark.parametrize("shape", [(1, 1), (3, 700), (2500, 1)])
def test_frames_and_pixels_of_any_map_are_bounded(shape: tuple[int, int], tmp_path: Path) -> None:
    grid = GridMap(np.zeros(shape, dtype=bool))
    start, goal = (0, 0), (shape[1] - 1, shape[0] - 1)
    value = negative_distances(grid, goal)
    cells = shortest_path(grid, start, goal, MoveRule.ROBOT_SAFE)
    save_animation(tmp_path / "plan.gif", grid, start, goal, value, cells)
    frames, _ = frames_of(tmp_path / "plan.gif")
    assert len(frames) <= 2 * FRAMES + 1
    assert MIN_SIDE <= max(frames[0].shape) <= 2 * MIN_SIDE
    assert is_colour(frames[-1], PATH_COLOUR).any()
