"""A plan in motion: the Q field spreads from the goal, then the greedy path is walked in it."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw

from ddqn_planner.files import write_atomically
from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.planning.picture import (
    MAX_RULED_SIDE,
    OBSTACLE_COLOUR,
    PATH_COLOUR,
    value_ramp,
)

FRAMES = 40
"""Of the field, and again of the path, at most."""

FRAME_MS = 60
LAST_FRAME_MS = 2500

MIN_SIDE = 600
"""Pixels of the longer side, at least; at most twice as many."""

LEVELS = 64
"""Shades of the value field; they come first in the palette."""

TINY = np.finfo(np.float64).tiny

FREE, OBSTACLE, PATH = LEVELS, LEVELS + 1, LEVELS + 2

PALETTE: list[int] = [
    *value_ramp(LEVELS).ravel().tolist(),
    *np.ravel([ImageColor.getrgb(c) for c in ("white", OBSTACLE_COLOUR, PATH_COLOUR)]).tolist(),
]

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
    value : (H, W) float32, or None
        The value field; its cells appear from the best to the worst, where it is finite.
    cells : sequence of (x, y)
        The path; none if there is no path to walk.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    longest = max(grid.width, grid.height)
    # Whole pixels a cell, but for maps of more cells than pixels.
    scale = math.ceil(MIN_SIDE / longest) if longest < 2 * MIN_SIDE else 2 * MIN_SIDE / longest
    fields = [_field_image(grid, shades, scale) for shades in _spreading(grid, value)]
    # Pixels count from the top, cells from the bottom.
    start_pixel, goal_pixel, *walk = (
        ((x + 0.5) * scale, (grid.height - y - 0.5) * scale) for x, y in (start, goal, *cells)
    )
    counts = np.unique(np.linspace(1, len(walk), FRAMES, dtype=int)).tolist() if walk else []
    frames = [(field, walk[:0]) for field in fields] + [(fields[-1], walk[:n]) for n in counts]
    first, *others = (_frame(field, walked, start_pixel, goal_pixel) for field, walked in frames)
    content = io.BytesIO()
    first.save(
        content,
        format="GIF",
        save_all=True,
        append_images=others,
        duration=[*[FRAME_MS] * len(others), LAST_FRAME_MS],
        loop=0,
    )
    write_atomically(Path(path), content.getvalue())


def _spreading(grid: GridMap, value: NDArray[np.float32] | None) -> Iterator[NDArray[np.uint8]]:
    """Yield (H, W) colours of the cells: the map alone, then ever more of its field."""
    colours = np.where(grid.occupancy, OBSTACLE, FREE).astype(np.uint8)
    yield colours
    if value is None:
        return
    known = np.flatnonzero(np.isfinite(value) & ~grid.occupancy)
    known = known[np.argsort(-value.flat[known], kind="stable")]
    # In float64: the span of two float32 may overflow.
    finite = value.flat[known].astype(np.float64)
    above_worst = finite - finite.min(initial=np.inf)
    levels = np.rint((LEVELS - 1) * above_worst / max(above_worst.max(initial=0), TINY))
    for indices in np.array_split(np.arange(known.size), min(FRAMES, known.size) or 1):
        colours.flat[known[indices]] = levels[indices]
        yield colours


def _field_image(grid: GridMap, colours: NDArray[np.uint8], scale: float) -> Image.Image:
    rows, columns = (
        (np.arange(max(1, int(size * scale))) / scale).astype(int)
        for size in (grid.height, grid.width)
    )
    pixels = colours[::-1][np.ix_(rows, columns)]
    if max(grid.width, grid.height) <= MAX_RULED_SIDE:
        pixels[:: int(scale)] = pixels[:, :: int(scale)] = FREE
    image = Image.fromarray(pixels)
    image.putpalette(PALETTE)
    return image


def _frame(field: Image.Image, walked: Sequence[Pixel], start: Pixel, goal: Pixel) -> Image.Image:
    """Return the field with the path so far, and with start and goal."""
    image = field.copy()
    draw = ImageDraw.Draw(image)
    if walked:
        draw.line(walked, fill=FREE, width=8, joint="curve")
        draw.line(walked, fill=PATH, width=4, joint="curve")
        draw.ellipse(_box(walked[-1], 6), fill=PATH, outline=FREE, width=2)
    draw.ellipse(_box(start, 9), fill=PATH, outline=FREE, width=2)
    for radius, colour in ((17, FREE), (13, PATH)):
        draw.polygon(_star(goal, radius), fill=colour)
    return image


def _box(centre: Pixel, radius: float) -> list[float]:
    x, y = centre
    return [x - radius, y - radius, x + radius, y + radius]


def _star(centre: Pixel, radius: float) -> list[Pixel]:
    angles = (math.pi * (k / 5 - 0.5) for k in range(10))
    radii = (radius, 0.45 * radius) * 5
    return [
        (centre[0] + r * math.cos(angle), centre[1] + r * math.sin(angle))
        for r, angle in zip(radii, angles, strict=True)
    ]
