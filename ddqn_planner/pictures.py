"""Plans to look at: as text, and as a picture. No ROS is needed."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.files import as_path, write_atomically
from ddqn_planner.grid import LENGTHS, MOVES, Cell, GridMap
from ddqn_planner.robot.directions import cusps_before, directions_of_travel
from ddqn_planner.robot.footprint import placed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from PIL.Image import Image as PillowImage

Array = NDArray[np.float64]

OBSTACLE_COLOUR = "#22223b"
PATH_COLOUR = "#d1495b"
REVERSE_COLOUR = "#1e88e5"
GOAL_COLOUR = "#f3c6cc"  # of a body at the goal: pale, so that the path shows on it
DIRECTION_COLOUR = "#6c757d"
# From the worst value to the best: light to dark, so that the order shows without
# colours, too.
VALUE_COLOURS = ("#f4f1de", "#cfe8dc", "#93cfc8", "#4fa3b5")

# Of films, by the endings of their files, as Pillow names them.
FILM_FORMATS = {".gif": "GIF", ".webp": "WEBP", ".png": "PNG"}
# The signs of cells in a text. One for several cells is the last of their signs here.
SIGNS = ".>^<v#*SG"
MAX_TEXT_WIDTH = 64  # signs in a row, two characters for each
# Cells of the longest side of a map with lines between its cells.
MAX_SIDE_WITH_LINES = 64
MAX_ARROWS = 48  # arrows of one-way zones along the longest side of a map
OUTLINES = 30  # of a body along its path
# A picture shows a part of the map that has less than this share of the map's area.
LARGEST_PART = 0.5
MARGIN_IN_BODIES = 2  # around that part, in lengths of the body
NARROWEST_PART = 0.5  # its shorter side, as a share of its longer side
# The mean direction of a cell that is not one-way is shorter: 0, except for rounding.
SHORTEST_DIRECTION = 1e-9


class BodyPicture(NamedTuple):
    """A body that moves along poses; all lengths are in cells, all yaws in radians."""

    footprint: Array  # (K, 2): its corners (x, y), for a robot at (0, 0) that faces +x
    poses: Array  # (N, 3): (x, y, yaw) along the path; none without a path
    ends: Array  # (2, 3): where it starts, and where it has to arrive


class View(NamedTuple):
    """The part of a map that a picture shows; in cells, from the first one's centre."""

    x: tuple[float, float]  # the least and the greatest
    y: tuple[float, float]

    @property
    def width(self) -> float:
        """The number of cells from left to right."""
        return self.x[1] - self.x[0]

    @property
    def height(self) -> float:
        """The number of cells from bottom to top."""
        return self.y[1] - self.y[0]


def draw_text(grid: GridMap, cells: Sequence[Cell]) -> str:
    """Return a map and a path on it as text: lines of signs, the highest y first.

    # is occupied, . free, and an arrow a one-way zone; * is the path of cells (x, y),
    from S to G. On a wide map a sign stands for a square of cells, and shows the sign
    that comes last in SIGNS among those of its cells.
    """
    # (H, W): the sign of each cell, as an index in SIGNS.
    signs = np.full(grid.occupancy.shape, SIGNS.index("."))
    if grid.forbidden is not None:
        signs = _with_arrows(signs, grid.forbidden)
    signs[grid.occupancy] = SIGNS.index("#")
    for sign, marked_cells in (("*", cells), ("S", cells[:1]), ("G", cells[-1:])):
        for x, y in marked_cells:
            signs[y, x] = SIGNS.index(sign)
    # The greatest index in each square of cells: first over its rows, then its columns.
    side = _ceil_divide(grid.width, MAX_TEXT_WIDTH)  # of a square, in cells
    signs = np.maximum.reduceat(signs, range(0, grid.height, side), axis=0)
    signs = np.maximum.reduceat(signs, range(0, grid.width, side), axis=1)
    upwards = signs[::-1]
    return "\n".join(" ".join(SIGNS[sign] for sign in row) for row in upwards)


def _with_arrows(
    signs: NDArray[np.int64], forbidden: NDArray[np.uint8]
) -> NDArray[np.int64]:
    """Return signs (H, W), indices in SIGNS, with an arrow in each one-way cell.

    `forbidden` (H, W) has bit a set where move a is forbidden.
    """
    x, y = _mean_directions(forbidden)  # (H, W) each
    is_one_way = np.hypot(x, y) > SHORTEST_DIRECTION
    # 0 to 3: the quarter turns from +x to the direction, as the arrows > ^ < v.
    quarters = np.rint(np.arctan2(y, x) / (np.pi / 2)).astype(np.int64) % 4
    return np.where(is_one_way, SIGNS.index(">") + quarters, signs)


def save_picture(
    path: str | Path,
    grid: GridMap,
    cells: Sequence[Cell],
    value: NDArray[np.float32] | None = None,
    title: str = "",
    value_label: str = "value: max Q(s, a)",
    body: BodyPicture | None = None,
) -> None:
    """Save a picture of a map with a path of cells, or with a body along its poses.

    Parameters
    ----------
    path
        The file. Its ending says in which format; a ValueError lists the formats.
    grid
        The map, of H x W cells.
    cells
        The cells (x, y) of a path, which a line joins; not drawn if there is a body.
    value
        (H, W): a colour per cell, where the value is finite.
    title
        Stands above the map.
    value_label
        What the colours show.
    body
        A body, drawn along its poses. If the map is much larger than the path, the
        picture shows the part of the map around the path.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    file = as_path(path)
    ending = picture_format(file)  # an error comes before the work
    view = whole_map(grid) if body is None else view_of_body(grid, body)
    aspect = min(max(view.height / view.width, 0.4), 1.0)
    inches = (7.2, 1.5 + 5.1 * aspect)  # with room for the title and the legend
    figure = Figure(figsize=inches, dpi=120, layout="constrained")
    axes = figure.subplots()
    axes.set(facecolor="white", xlabel="x [cells]", ylabel="y [cells]", aspect="equal")
    axes.set_title(title, loc="left", fontsize=12)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(integer=True))
    if value is not None:
        _draw_value(axes, value, value_label)
    draw_obstacles(axes, grid)
    if body is not None:
        draw_body(axes, *body)
    elif cells:
        _draw_path(axes, cells)
    axes.set(xlim=view.x, ylim=view.y)
    if cells or body is not None:
        figure.legend(
            loc="outside lower center", ncols=6, frameon=False, columnspacing=1.4
        )
    # Into memory first: after an error an old file is still complete.
    content = io.BytesIO()
    figure.savefig(content, format=ending)
    write_atomically(file, content.getvalue())


def whole_map(grid: GridMap) -> View:
    """Return the view of a map from its first cell to its last."""
    return View((-0.5, grid.width - 0.5), (-0.5, grid.height - 0.5))


def view_of_body(grid: GridMap, body: BodyPicture) -> View:
    """Return the part of a map around a body's path, or else the complete map.

    The map is shown completely if the part has more than half of its area.
    """
    footprint, poses, ends = body
    outlines = placed(footprint, np.concatenate([poses, ends])).reshape(-1, 2)
    lowest = outlines.min(axis=0)  # (2,): x and y
    highest = outlines.max(axis=0)
    side = np.ptp(footprint, axis=0).max()
    size = highest - lowest + 2 * MARGIN_IN_BODIES * side
    size = np.maximum(size, NARROWEST_PART * size.max())
    centre = (lowest + highest) / 2
    everything = whole_map(grid)
    part = View(
        _clipped(centre[0], size[0], everything.x),
        _clipped(centre[1], size[1], everything.y),
    )
    largest_area = LARGEST_PART * grid.width * grid.height
    return part if part.width * part.height < largest_area else everything


def _clipped(
    centre: float, size: float, limits: tuple[float, float]
) -> tuple[float, float]:
    """Return an interval of a size about a centre, as far as it lies in the limits."""
    low, high = limits
    return max(low, float(centre - size / 2)), min(high, float(centre + size / 2))


def picture_format(path: Path, option: str = "the picture") -> str:
    """Return the format of a picture, which is the ending of its file's name.

    A ValueError lists the endings that matplotlib can write; it names the file by
    `option`.
    """
    from matplotlib.figure import Figure

    formats = sorted(Figure().canvas.get_supported_filetypes())
    ending = path.suffix.lower().removeprefix(".")
    if ending not in formats:
        problem = f"ends in {path.suffix!r}" if ending else "has no ending"
        raise ValueError(
            f"{option} is {path}, which {problem}; give one of .{', .'.join(formats)}"
        )
    return ending


def film_format(path: Path, option: str = "the film") -> str:
    """Return the format in which Pillow writes a film, by the ending of its file.

    A ValueError lists the endings; it names the file by `option`.
    """
    from PIL import Image

    Image.init()
    formats = {
        ending: name for ending, name in FILM_FORMATS.items() if name in Image.SAVE_ALL
    }
    ending = path.suffix.lower()
    if ending not in formats:
        problem = f"ends in {path.suffix!r}" if ending else "has no ending"
        raise ValueError(
            f"{option} is {path}, which {problem}; give one of {', '.join(formats)}"
        )
    return formats[ending]


def save_film(
    path: str | Path,
    frames: Iterable[PillowImage],
    milliseconds: int,
    last_milliseconds: int | None = None,
) -> None:
    """Save a film that repeats, as its ending says: .gif, .webp or animated .png.

    Parameters
    ----------
    path
        The file. An old one stays complete after an error.
    frames
        At least one, all of one size.
    milliseconds, last_milliseconds
        For how long each frame is shown, and the last one; by default as the others.
    """
    file = as_path(path)
    name = film_format(file)
    # A GIF has 256 colours. With its own palette of 64, each frame is small.
    images = [frame.quantize(64) if name == "GIF" else frame for frame in frames]
    durations = [milliseconds] * len(images)
    durations[-1] = last_milliseconds or milliseconds
    content = io.BytesIO()
    images[0].save(
        content,
        name,
        save_all=True,
        append_images=images[1:],
        duration=durations,
        loop=0,
    )
    write_atomically(file, content.getvalue())


def _draw_value(axes: Axes, value: NDArray[np.float32], label: str) -> None:
    """Colour the cells that have a finite value (H, W), and add a labelled scale."""
    from matplotlib.colors import LinearSegmentedColormap

    finite = np.where(np.isfinite(value), value, np.nan)
    colours = LinearSegmentedColormap.from_list("value", VALUE_COLOURS)
    image = axes.imshow(finite, origin="lower", cmap=colours, interpolation="nearest")
    scale = axes.inset_axes((1.02, 0, 0.035, 1))  # as high as the map
    axes.get_figure().colorbar(image, scale, label=label)  # type: ignore[union-attr]


def _draw_path(axes: Axes, cells: Sequence[Cell]) -> None:
    """Draw a line through cells (x, y), and a marker at the first and the last cell."""
    from matplotlib.patheffects import withStroke

    x: NDArray[np.int64]
    y: NDArray[np.int64]
    x, y = np.transpose(cells)
    outline = [withStroke(linewidth=5.5, foreground="white")]
    axes.plot(x, y, color=PATH_COLOUR, linewidth=3, path_effects=outline, label="path")
    style: Any = {
        "color": PATH_COLOUR,
        "edgecolors": "white",
        "linewidths": 1.5,
        "zorder": 3,
    }
    axes.scatter(x[0], y[0], 110, label="start", marker="o", **style)
    axes.scatter(x[-1], y[-1], 300, label="goal", marker="*", **style)


def draw_body(axes: Axes, footprint: Array, poses: Array, ends: Array) -> None:
    """Draw what a body sweeps along a path, and the body at the path's two ends.

    All lengths are in the unit of the axes. `footprint` (K, 2) holds the corners of a
    body at (0, 0) that faces +x, `poses` (N, 3) x, y and yaw along the path, and `ends`
    (2, 3) the start and the goal.
    """
    if len(poses):
        _draw_swept(axes, placed(footprint, poses))
        draw_driven(axes, poses)
    colours = {"start": "white", "goal": GOAL_COLOUR}
    nose = _nose(footprint)
    pose: Array
    for pose, (label, colour) in zip(ends, colours.items(), strict=True):
        outline = placed(footprint, pose)
        axes.fill(
            *outline.T, label=label, facecolor=colour, edgecolor=PATH_COLOUR, zorder=3
        )
        axes.fill(*placed(nose, pose).T, facecolor=OBSTACLE_COLOUR, zorder=3)


def _draw_swept(axes: Axes, outlines: Array) -> None:
    """Draw a body's outlines (N, K, 2) along its path, some of them with their edge."""
    from matplotlib.collections import PolyCollection

    polygons: Any = outlines
    axes.add_collection(
        PolyCollection(polygons, facecolor=VALUE_COLOURS[1], label="swept")
    )
    step = len(outlines) // OUTLINES + 1
    some = PolyCollection(
        polygons[::step],
        facecolor=VALUE_COLOURS[2],
        edgecolor=VALUE_COLOURS[3],
        alpha=0.3,
    )
    axes.add_collection(some)


def draw_driven(axes: Axes, poses: Array) -> None:
    """Draw a line along poses (N, 3), above the body at both ends.

    Stretches in reverse have another colour, and a diamond marks each cusp.
    """
    from matplotlib.collections import LineCollection

    directions = directions_of_travel(poses)  # (N - 1,)
    is_reverse = directions < 0
    changes = np.flatnonzero(np.diff(is_reverse)) + 1  # the first poses of stretches
    first = np.concatenate([[0], changes])
    last = np.append(changes, len(poses) - 1)
    stretches: dict[bool, list[Array]] = {False: [], True: []}
    for begin, end in zip(first.tolist(), last.tolist(), strict=True):
        is_driven_back = bool(is_reverse[begin : begin + 1].any())
        stretches[is_driven_back].append(poses[begin : end + 1, :2])
    colours = {False: PATH_COLOUR, True: REVERSE_COLOUR}
    labels = {False: "path", True: "in reverse"}
    for is_driven_back, lines in stretches.items():
        if lines:
            collection = LineCollection(
                lines,
                colors=colours[is_driven_back],
                linewidths=2,
                label=labels[is_driven_back],
                zorder=4,
            )
            axes.add_collection(collection)
    cusps = np.flatnonzero(np.diff(cusps_before(directions)))
    if len(cusps):
        x, y, _ = poses[cusps].T
        axes.scatter(
            x,
            y,
            18,
            color="white",
            edgecolors=OBSTACLE_COLOUR,
            marker="D",
            label="cusp",
            zorder=5,
        )


def _nose(footprint: Array) -> Array:
    """Return a triangle (3, 2) with its tip at the front of a body, for its heading.

    Its base lies at the robot's origin; at the body's back if the origin is behind the
    body, and in the middle of the body if the origin is ahead of the body.
    """
    back: float
    front: float
    left: float
    back, _ = footprint.min(axis=0)
    front, left = footprint.max(axis=0)
    base = max(0.0, back)
    if front <= 0:
        base = (front + back) / 2
    return np.array([[front, 0], [base, left / 2], [base, -left / 2]])


def draw_obstacles(axes: Axes, grid: GridMap) -> None:
    """Draw a map's occupied cells, and arrows in its one-way zones.

    A map of few cells also has lines between its cells.
    """
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
        _draw_directions(axes, grid, grid.forbidden)


def _draw_directions(axes: Axes, grid: GridMap, forbidden: NDArray[np.uint8]) -> None:
    """Draw arrows in the one-way zones, at most MAX_ARROWS along a side of the map.

    `forbidden` (H, W) has bit a set where move a is forbidden.
    """
    step = _ceil_divide(max(grid.width, grid.height), MAX_ARROWS)  # cells
    directions = _mean_directions(forbidden)  # (2, H, W)
    is_one_way = (np.hypot(*directions) > SHORTEST_DIRECTION) & ~grid.occupancy
    # The rows and columns of the cells with an arrow, in steps.
    row, column = np.nonzero(is_one_way[::step, ::step])
    y = row * step
    x = column * step
    arrows = directions[:, y, x]  # (2, arrows): made 0.8 steps long
    arrows *= 0.8 * step / np.hypot(*arrows)
    axes.quiver(
        x,
        y,
        *arrows,
        color=DIRECTION_COLOUR,
        width=0.002,
        pivot="middle",
        angles="xy",
        scale_units="xy",
        scale=1,
    )


def _mean_directions(forbidden: NDArray[np.uint8]) -> Array:
    """Return the sum of the unit vectors of each cell's legal moves: (2, H, W), x, y.

    `forbidden` (H, W) has bit a set where move a is forbidden. The sum is 0 where all
    moves are legal, or none.
    """
    action = np.arange(len(MOVES))[:, None, None]  # (8, 1, 1)
    is_legal = (forbidden >> action & 1) == 0  # (8, H, W)
    unit_vectors = MOVES / LENGTHS[:, None]  # (8, 2)
    directions: Array = np.tensordot(unit_vectors.T, is_legal, 1)  # summed over moves
    return directions


def _ceil_divide(size: int, parts: int) -> int:
    """Return size / parts, rounded up."""
    return -(-size // parts)
