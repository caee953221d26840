"""What the figures have in common."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from PIL import Image

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.pictures import draw_obstacles

if TYPE_CHECKING:
    from ddqn_planner.training.environment import Scenario

Array = NDArray[Any]
COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")  # Okabe and Ito's palette
STYLES: Final = ("-", "--", "-.", ":")
ROUTE_STYLES: Final[dict[str, dict[str, str]]] = {
    "shortest": {"color": "#555555", "linestyle": ":"},
    "learned": {"color": COLOURS[0], "linestyle": "-"},
    "best possible": {"color": COLOURS[3], "linestyle": "--"},
}
LINE: Final = {
    "linewidth": 2.2,
    "path_effects": [withStroke(linewidth=4, foreground="white")],
}


def save_figure(figure: Any, path: Path, caption: str) -> str:
    """Write a figure to a file, close it, and return the Markdown that shows it."""
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return f"![{caption}]({path.name})"


def frame_of(figure: Any) -> Image.Image:
    """Draw a figure as a frame of a film, and close it."""
    figure.canvas.draw()
    image = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")
    plt.close(figure)
    return image


def draw_curves(
    axes: Any, x: Array, curves: Mapping[str, Sequence[Array]], xlabel: str, ylabel: str
) -> None:
    """Draw each curve's median over the seeds in a band from least to greatest."""
    lines = zip(curves.items(), COLOURS, STYLES, strict=False)
    for (label, seeds), colour, style in lines:
        if np.isfinite(seeds).any():
            axes.plot(x, np.nanmedian(seeds, axis=0), style, color=colour, label=label)
            low, high = np.nanmin(seeds, axis=0), np.nanmax(seeds, axis=0)
            axes.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0)
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.grid(alpha=0.3)


def draw_slowness(
    grid: GridMap,
    stations: Sequence[Cell],
    panels: Mapping[str, tuple[Array, Mapping[str, Sequence[Cell]]]],
    size: tuple[float, float],
) -> Any:
    """Return a picture of slowness (H, W) for each title, with its routes.

    The names of the routes are those of `ROUTE_STYLES`.
    """
    figure, both = plt.subplots(1, len(panels), figsize=size, layout="constrained")
    for axes, (title, (slowness, routes)) in zip(both, panels.items(), strict=True):
        axes.set_facecolor("#e6e6e6")
        values = np.where(grid.occupancy, np.nan, slowness)
        image = axes.imshow(values, origin="lower", cmap="YlOrRd", norm=LogNorm(1, 8))
        draw_obstacles(axes, grid)
        for name, cells in routes.items():
            axes.plot(*np.transpose(cells), label=name, **LINE, **ROUTE_STYLES[name])
        axes.scatter(*np.transpose(stations), 35, color="black", zorder=4)
        axes.set(xticks=[], yticks=[])
        axes.set_title(title, loc="left", fontsize=10)
    bar = figure.colorbar(
        image, ax=both, label="seconds over seconds at nominal speed", shrink=0.8
    )
    bar.set_ticks([1, 2, 4, 8], labels=["1", "2", "4", "8"])
    bar.minorticks_off()
    figure.legend(
        *both[0].get_legend_handles_labels(), loc="outside lower center", ncols=3
    )
    return figure


def draw_times(
    seconds: Mapping[str, Sequence[Array]],
    best: Sequence[Array],
    width: int,
    banded: str,
) -> tuple[Any, Any]:
    """Draw times over the best, means of `width` missions.

    `seconds` has by a learner's name, as `best`, an array (missions,) of each world.
    The curve of the learner `banded` gets a band, the others are medians.
    """
    window = np.ones(width)
    best_sums = [np.convolve(world, window, "valid") for world in best]
    curves = dict[str, Sequence[Array]]()
    for name, worlds in seconds.items():
        ratios = []
        for world, best_sum in zip(worlds, best_sums, strict=True):
            ratios.append(np.convolve(world, window, "valid") / best_sum)
        curves[name] = ratios if name == banded else [np.median(ratios, axis=0)]
    figure, axes = plt.subplots(figsize=(7.2, 3.6), layout="constrained")
    missions = np.arange(len(curves[banded][0])) + width
    xlabel = f"mission; each point is of the {width} missions up to it"
    draw_curves(axes, missions, curves, xlabel, "time over the best possible")
    axes.axhline(1, color="black", linewidth=0.8)
    axes.legend(frameon=False)
    return figure, axes


def draw_map(axes: Any, scenario: "Scenario", title: str) -> None:
    """Draw a map, its start and its goal."""
    draw_obstacles(axes, scenario.grid)
    axes.set(aspect="equal", xticks=[], yticks=[])
    axes.set_title(title, loc="left", fontsize=10)
    style = {"color": "black", "edgecolors": "white", "linewidths": 1.2, "zorder": 4}
    axes.scatter(*scenario.start, 70, marker="o", **style)
    axes.scatter(*scenario.goal, 190, marker="*", **style)


def draw_path(axes: Any, cells: Sequence[Cell], number: int, label: str) -> None:
    """Draw the path of the n-th planner of a figure."""
    if cells:
        style = {
            "color": COLOURS[number],
            "linestyle": STYLES[number],
            "zorder": 2 + number,
        }
        axes.plot(*np.transpose(cells), label=label, **LINE, **style)
