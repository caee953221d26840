"""Plans to look at: as text, in a terminal's colours, and as a picture file. No ROS is needed."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import LENGTHS, MOVES, Cell, GridMap
from ddqn_planner.grid.footprint import placed

Array = NDArray[np.float64]

OBSTACLE_COLOUR, PATH_COLOUR, DIRECTION_COLOUR = "#22223b", "#d1495b", "#6c757d"

VALUE_COLOURS = ("#f4f1de", "#cfe8dc", "#93cfc8", "#4fa3b5")
"""From the worst value to the best: light to dark, so that the order shows without colours too."""

# Codes of colours: outside the map, free, occupied, the path, its ends.
TERMINAL = ("9", "8;5;255", "8;5;236", "8;5;167", "8;5;33")

MAX_TEXT_WIDTH = 64  # cells of the widest map that is worth printing: two characters for each
MAX_SIDE_WITH_LINES = 64  # cells of the longest side of a map with lines between its cells
MAX_ARROWS = 48  # arrows of one-way zones along the longest side of a map
OUTLINES = 30  # of a body along its path
ONE_WAY = 1e-9  # the mean direction of a cell that is not one-way is shorter


def draw_text(grid: GridMap, cells: Sequence[Cell]) -> str:
    """Return the map as text, y upwards: # occupied, . or an arrow free, * path, S and G ends."""
    letters = np.full(grid.occupancy.shape, ".")
    if grid.forbidden is not None:
        x, y = _mean_directions(grid.forbidden)
        quarter = np.rint(np.arctan2(y, x) / (np.pi / 2)).astype(np.int64)
        letters = np.where(np.hypot(x, y) > ONE_WAY, np.array(list(">^<v"))[quarter], letters)
    letters[grid.occupancy] = "#"
    for x, y in cells:
        letters[y, x] = "*"
    for letter, (x, y) in zip("SG", (*cells[:1], *cells[-1:]), strict=False):
        letters[y, x] = letter
    return "\n".join(" ".join(row) for row in letters[::-1])


def draw_blocks(grid: GridMap, cells: Sequence[Cell], columns: int, lines: int) -> str:
    """Return the map for a terminal of so many characters, each of them two coloured squares."""
    side = max(-(-grid.width // columns), -(-grid.height // (2 * lines)))  # cells
    shown = np.where(grid.occupancy, 2, 1)
    shown[tuple(np.transpose(cells)[::-1])] = 3
    for x, y in (cells[0], cells[-1]):
        shown[y, x] = 4
    shown = np.pad(shown, [(0, -grid.height % (2 * side)), (0, -grid.width % side)])
    rows, width = shown.shape[0] // side, shown.shape[1] // side
    squares = shown.reshape(rows, side, width, side).max(axis=(1, 3))[::-1]
    return "\n".join(
        "".join(f"\x1b[3{TERMINAL[a]};4{TERMINAL[b]}m▀" for a, b in zip(*pair, strict=True))
        + "\x1b[0m"
        for pair in zip(squares[::2], squares[1::2], strict=True)
    )


def save_picture(
    path: str | Path,
    grid: GridMap,
    cells: Sequence[Cell],
    value: NDArray[np.float32] | None,
    title: str,
    value_label: str = "value: max Q(s, a)",
    body: tuple[Array, Array, Array] | None = None,  # see `draw_body`
) -> None:
    """Draw the map, the value where it is finite, and the path or the body along it into a file."""
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure
    from matplotlib.patheffects import withStroke
    from matplotlib.ticker import MaxNLocator

    tall = min(max(grid.height / grid.width, 0.4), 1.0)
    figure = Figure(figsize=(7.2, 1.5 + 5.1 * tall), dpi=120, layout="constrained")
    axes = figure.subplots()
    axes.set(facecolor="white", xlabel="x [cells]", ylabel="y [cells]", aspect="equal")
    axes.set_title(title, loc="left", fontsize=12)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(integer=True))
    if value is not None:
        finite = np.where(np.isfinite(value), value, np.nan)
        colours = LinearSegmentedColormap.from_list("value", VALUE_COLOURS)
        image = axes.imshow(finite, origin="lower", cmap=colours, interpolation="nearest")
        bar = axes.inset_axes((1.02, 0, 0.035, 1))  # as high as the map
        figure.colorbar(image, bar, label=value_label)
    draw_obstacles(axes, grid)
    if body is not None:
        draw_body(axes, *body)
    elif cells:
        x, y = np.transpose(cells)
        outline = [withStroke(linewidth=5.5, foreground="white")]
        axes.plot(x, y, color=PATH_COLOUR, linewidth=3, path_effects=outline, label="path")
        style: Any = {"color": PATH_COLOUR, "edgecolors": "white", "linewidths": 1.5, "zorder": 3}
        for label, end, marker, size in (("start", 0, "o", 110), ("goal", -1, "*", 300)):
            axes.scatter(x[end], y[end], size, label=label, marker=marker, **style)
    if cells or body is not None:
        figure.legend(loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(path)


def draw_body(axes: Any, footprint: Array, poses: Array, ends: Array) -> None:
    """Draw what a body sweeps along poses (N, 3), in cells, and where it starts and ends."""
    from matplotlib.collections import PolyCollection

    if len(poses):
        swept: Any = placed(footprint, poses)
        axes.add_collection(PolyCollection(swept, facecolor=VALUE_COLOURS[1], label="swept"))
        style: Any = {"facecolor": VALUE_COLOURS[2], "edgecolor": VALUE_COLOURS[3], "alpha": 0.3}
        axes.add_collection(PolyCollection(swept[:: len(swept) // OUTLINES + 1], **style))
        axes.plot(*poses.T[:2], color=PATH_COLOUR, linewidth=2, label="path")
    nose = np.array([[1, 0], [0, 0.5], [0, -0.5]]) * footprint.max(axis=0)
    for pose, label, colour in zip(ends, ("start", "goal"), ("white", PATH_COLOUR), strict=True):
        style = {"edgecolor": PATH_COLOUR, "zorder": 3}
        axes.fill(*placed(footprint, pose).T, label=label, facecolor=colour, **style)
        axes.fill(*placed(nose, pose).T, facecolor=OBSTACLE_COLOUR, zorder=3)


def draw_obstacles(axes: Any, grid: GridMap) -> None:
    """Draw a map's occupied cells and one-way zones into matplotlib axes, and lines of cells."""
    from matplotlib.colors import ListedColormap

    occupied = np.where(grid.occupancy, 1.0, np.nan)
    colours = ListedColormap([OBSTACLE_COLOUR])
    axes.imshow(occupied, origin="lower", cmap=colours, interpolation="nearest")
    if max(grid.width, grid.height) <= MAX_SIDE_WITH_LINES:
        axes.set_xticks(np.arange(-0.5, grid.width), minor=True)
        axes.set_yticks(np.arange(-0.5, grid.height), minor=True)
        axes.grid(which="minor", color="white", linewidth=0.8)
        axes.tick_params(which="minor", length=0)
    if grid.forbidden is not None:
        step = -(-max(grid.width, grid.height) // MAX_ARROWS)
        directions = _mean_directions(grid.forbidden)
        shown = (np.hypot(*directions) > ONE_WAY) & ~grid.occupancy
        y, x = np.nonzero(shown[::step, ::step])
        along = directions[:, y * step, x * step]
        along *= 0.8 * step / np.hypot(*along)
        style = {"pivot": "middle", "angles": "xy", "scale_units": "xy", "scale": 1}
        axes.quiver(x * step, y * step, *along, color=DIRECTION_COLOUR, width=0.002, **style)


def _mean_directions(forbidden: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return (2, H, W) float64: the sum of the legal directions of each cell, x and y."""
    legal = (forbidden >> np.arange(len(MOVES))[:, None, None] & 1) == 0
    directions: NDArray[np.float64] = np.tensordot((MOVES / LENGTHS[:, None]).T, legal, 1)
    return directions
