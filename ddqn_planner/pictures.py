"""Plans to look at: as text, in a terminal's colours, and as a picture file. No ROS is needed."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.files import as_path, write_atomically
from ddqn_planner.grid import LENGTHS, MOVES, Cell, GridMap
from ddqn_planner.robot.footprint import placed

Array = NDArray[np.float64]

OBSTACLE_COLOUR, PATH_COLOUR, DIRECTION_COLOUR = "#22223b", "#d1495b", "#6c757d"

VALUE_COLOURS = ("#f4f1de", "#cfe8dc", "#93cfc8", "#4fa3b5")
"""From the worst value to the best: light to dark, so that the order shows without colours too."""

SIGNS = ".>^<v#*SG"  # of a map as text: where one has to stand for several, it is the last of them
MAX_TEXT_WIDTH = 64  # signs in a row, two characters for each
# Cells of the longest side of a map with lines between its cells.
MAX_SIDE_WITH_LINES = 64
MAX_ARROWS = 48  # arrows of one-way zones along the longest side of a map
OUTLINES = 30  # of a body along its path
ONE_WAY = 1e-9  # the mean direction of a cell that is not one-way is shorter


def draw_text(grid: GridMap, cells: Sequence[Cell]) -> str:
    """Return the map as text, y upwards: # occupied, . or an arrow free, * path, S and G ends."""
    shown = np.where(grid.occupancy, SIGNS.index("#"), 0)
    if grid.forbidden is not None:
        x, y = _mean_directions(grid.forbidden)
        quarter = np.rint(np.arctan2(y, x) / (np.pi / 2)).astype(np.int64) % 4
        in_zone = ~grid.occupancy & (np.hypot(x, y) > ONE_WAY)
        shown[in_zone] = quarter[in_zone] + 1
    for sign, places in (("*", cells), ("S", cells[:1]), ("G", cells[-1:])):
        for x, y in places:
            shown[y, x] = SIGNS.index(sign)
    side = -(-grid.width // MAX_TEXT_WIDTH)  # cells
    for axis, size in enumerate(shown.shape):
        shown = np.maximum.reduceat(shown, range(0, size, side), axis)
    return "\n".join(" ".join(SIGNS[sign] for sign in row) for row in shown[::-1])


def save_picture(
    path: str | Path,
    grid: GridMap,
    cells: Sequence[Cell],
    value: NDArray[np.float32] | None = None,
    title: str = "",
    value_label: str = "value: max Q(s, a)",
    body: tuple[Array, Array, Array] | None = None,  # see `draw_body`
) -> None:
    """Draw the map, the value where it is finite, and the path or the body along it into a file.

    The ending of its name says in which format. A ValueError lists the formats.
    """
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure
    from matplotlib.patheffects import withStroke
    from matplotlib.ticker import MaxNLocator

    file = as_path(path)
    picture_format(file)  # before the work
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
        image = axes.imshow(
            finite, origin="lower", cmap=colours, interpolation="nearest"
        )
        bar = axes.inset_axes((1.02, 0, 0.035, 1))  # as high as the map
        figure.colorbar(image, bar, label=value_label)
    draw_obstacles(axes, grid)
    if body is not None:
        draw_body(axes, *body)
    elif cells:
        x, y = np.transpose(cells)
        outline = [withStroke(linewidth=5.5, foreground="white")]
        axes.plot(
            x, y, color=PATH_COLOUR, linewidth=3, path_effects=outline, label="path"
        )
        style: Any = {
            "color": PATH_COLOUR,
            "edgecolors": "white",
            "linewidths": 1.5,
            "zorder": 3,
        }
        for label, end, marker, size in (
            ("start", 0, "o", 110),
            ("goal", -1, "*", 300),
        ):
            axes.scatter(x[end], y[end], size, label=label, marker=marker, **style)
    if cells or body is not None:
        figure.legend(loc="outside lower center", ncols=4, frameon=False)
    # In memory first, so that an old file stays complete, and no pipe is waited for.
    content = io.BytesIO()
    figure.savefig(content, format=picture_format(file))
    write_atomically(file, content.getvalue())


def picture_format(path: Path, option: str = "the picture") -> str:
    """Return the format of a picture by its file's name; a ValueError lists those there are."""
    from matplotlib.figure import Figure

    formats = sorted(Figure().canvas.get_supported_filetypes())
    ending = path.suffix.lower().removeprefix(".")
    if ending not in formats:
        problem = f"ends in {path.suffix!r}" if ending else "has no ending"
        raise ValueError(
            f"{option} is {path}, which {problem}; give one of .{', .'.join(formats)}"
        )
    return ending


def draw_body(axes: Any, footprint: Array, poses: Array, ends: Array) -> None:
    """Draw what a body sweeps along poses (N, 3), in cells, and where it starts and ends."""
    from matplotlib.collections import PolyCollection

    if len(poses):
        swept: Any = placed(footprint, poses)
        axes.add_collection(
            PolyCollection(swept, facecolor=VALUE_COLOURS[1], label="swept")
        )
        style: Any = {
            "facecolor": VALUE_COLOURS[2],
            "edgecolor": VALUE_COLOURS[3],
            "alpha": 0.3,
        }
        axes.add_collection(
            PolyCollection(swept[:: len(swept) // OUTLINES + 1], **style)
        )
        axes.plot(*poses.T[:2], color=PATH_COLOUR, linewidth=2, label="path")
    (back, _), (front, left) = footprint.min(axis=0), footprint.max(axis=0)
    behind = max(0.0, back)  # of an origin that the body lies ahead of
    if front <= 0:  # or behind
        behind = (front + back) / 2
    nose = np.array([[front, 0], [behind, left / 2], [behind, -left / 2]])
    for pose, label, colour in zip(
        ends, ("start", "goal"), ("white", PATH_COLOUR), strict=True
    ):
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
        axes.quiver(
            x * step, y * step, *along, color=DIRECTION_COLOUR, width=0.002, **style
        )


def _mean_directions(forbidden: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return (2, H, W) float64: the sum of the legal directions of each cell, x and y."""
    legal = (forbidden >> np.arange(len(MOVES))[:, None, None] & 1) == 0
    directions: NDArray[np.float64] = np.tensordot(
        (MOVES / LENGTHS[:, None]).T, legal, 1
    )
    return directions
