"""A plan being made: the value field spreads from the goal, then the greedy rollout follows it."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from ddqn_planner.files import write_atomically
from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.pictures.colours import (
    MAX_SIDE_WITH_LINES,
    OBSTACLE_COLOUR,
    PATH_COLOUR,
    mixed_colours,
    value_ramp,
)

FRAMES = 40
"""At most so many frames show the field, and so many the path."""

FRAME_MS, FIELD_MS, LAST_FRAME_MS = 60, 600, 2500
"""How long a frame is shown, the complete field, and the complete path."""

MIN_SIDE = 600
"""The longer side has at least so many pixels, and at most twice as many."""

FINE = 2
"""Frames are drawn so many times as large and then reduced, which makes edges smooth."""

LEVELS = 64
FREE, OBSTACLE = LEVELS, LEVELS + 1
COLOURS = np.concatenate(
    [
        value_ramp(LEVELS),
        mixed_colours(("white", OBSTACLE_COLOUR), 2),
        mixed_colours((PATH_COLOUR, "white"), 10),  # for the smooth edges of the path
    ]
)
PALETTE = Image.new("P", (1, 1))
PALETTE.putpalette(COLOURS.ravel().tolist())

Pixel = tuple[float, float]


def save_animation(
    path: str | Path,
    grid: GridMap,
    start: Cell,
    goal: Cell,
    value: NDArray[np.float32] | None,
    cells: Sequence[Cell],
) -> None:
    """Draw the value field spreading over the map, and then the path growing, into a GIF.

    Parameters
    ----------
    path : str or Path
        The GIF file; missing folders are made.
    grid : GridMap
    start, goal : (x, y)
        Drawn if they lie inside the map.
    value : (H, W) float32, optional
        The value field; its cells appear from the best to the worst, where it is finite.
    cells : sequence of (x, y)
        The path; empty if there is none.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    longest = max(grid.width, grid.height)
    # A whole number of pixels per cell, except for maps with more cells than pixels.
    scale = math.ceil(MIN_SIDE / longest) if longest < 2 * MIN_SIDE else 2 * MIN_SIDE / longest
    scale *= FINE
    # Pixels count from the top, cells from the bottom.
    start_pixel, goal_pixel, *line = (
        ((x + 0.5) * scale, (grid.height - y - 0.5) * scale) for x, y in (start, goal, *cells)
    )
    frames = []
    for colours in _spreading(grid, value):
        field = _field_image(colours, scale)
        frames.append(_frame(field, [], start_pixel, goal_pixel))
    durations = [FRAME_MS] * (len(frames) - 1) + [FIELD_MS]
    for count in np.unique(np.linspace(1, len(line), FRAMES, dtype=int)) if line else ():
        frames.append(_frame(field, line[:count], start_pixel, goal_pixel))
        durations.append(FRAME_MS)
    durations[-1] = LAST_FRAME_MS
    file, first, *others = io.BytesIO(), *frames
    first.save(file, "GIF", save_all=True, append_images=others, duration=durations, loop=0)
    write_atomically(Path(path), file.getvalue())


def _spreading(grid: GridMap, value: NDArray[np.float32] | None) -> Iterator[NDArray[np.uint8]]:
    """Yield (H, W) numbers of `COLOURS`: the map alone, then more and more of its field."""
    colours = np.where(grid.occupancy, OBSTACLE, FREE).astype(np.uint8)
    yield colours
    if value is None:
        return
    known = np.flatnonzero(np.isfinite(value) & ~grid.occupancy)
    known = known[np.argsort(-value.flat[known], kind="stable")]
    finite = value.flat[known]
    span = finite.min(initial=np.inf), finite.max(initial=-np.inf)
    levels = np.rint(np.interp(finite, span, (0, LEVELS - 1)))
    for indices in np.array_split(np.arange(known.size), min(FRAMES, known.size) or 1):
        colours.flat[known[indices]] = levels[indices]
        yield colours


def _field_image(colours: NDArray[np.uint8], scale: float) -> Image.Image:
    height, width = (max(FINE, int(size * scale)) for size in colours.shape)
    image = Image.fromarray(COLOURS[colours[::-1]]).resize((width, height), Image.Resampling.BOX)
    if max(colours.shape) <= MAX_SIDE_WITH_LINES:
        draw, step = ImageDraw.Draw(image), int(scale)
        for place in range(0, max(width, height), step):
            draw.rectangle((place, 0, place + FINE - 1, height), "white")
            draw.rectangle((0, place, width, place + FINE - 1), "white")
    return image


def _frame(field: Image.Image, line: Sequence[Pixel], start: Pixel, goal: Pixel) -> Image.Image:
    """Return the field with the path so far, and with start and goal."""
    image = field.copy()
    draw = ImageDraw.Draw(image)
    if line:
        draw.line(line, fill="white", width=9 * FINE, joint="curve")
        draw.line(line, fill=PATH_COLOUR, width=5 * FINE, joint="curve")
    radius = 10 * FINE
    for x, y in (*line[-1:], start):
        box = (x - radius, y - radius, x + radius, y + radius)
        draw.ellipse(box, PATH_COLOUR, outline="white", width=2 * FINE)
    for radius, colour in ((18 * FINE, "white"), (14 * FINE, PATH_COLOUR)):
        draw.polygon(_star(goal, radius), fill=colour)
    return image.reduce(FINE).quantize(palette=PALETTE, dither=Image.Dither.NONE)


def _star(centre: Pixel, radius: float) -> list[Pixel]:
    turns = np.exp(1j * math.pi * (np.arange(10) / 5 - 0.5)) * np.tile((radius, 0.45 * radius), 5)
    return [(centre[0] + turn.real, centre[1] + turn.imag) for turn in turns.tolist()]
