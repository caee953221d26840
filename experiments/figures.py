"""What the figures have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from ddqn_planner.grid import Cell
from ddqn_planner.pictures import draw_obstacles
from ddqn_planner.training.environment import Scenario

COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
"""Of Okabe and Ito's palette, which colour-blind readers can tell apart."""
STYLES: Final = ("-", "--", "-.", ":")


def save_figure(figure: Any, path: Path, caption: str) -> str:
    """Write a figure to a file, close it, and return the Markdown that shows it."""
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return f"![{caption}]({path.name})"


def draw_curves(
    axes: Any,
    x: NDArray[Any],
    curves: Mapping[str, Sequence[NDArray[Any]]],
    xlabel: str,
    ylabel: str,
) -> None:
    """Draw the median over the seeds of each curve, and a band from the least to the greatest."""
    lines = zip(curves.items(), COLOURS, STYLES, strict=False)
    for (label, seeds), colour, style in lines:
        if np.isfinite(seeds).any():
            axes.plot(x, np.nanmedian(seeds, axis=0), style, color=colour, label=label)
            low, high = np.nanmin(seeds, axis=0), np.nanmax(seeds, axis=0)
            axes.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0)
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.grid(alpha=0.3)


def draw_map(axes: Any, scenario: Scenario, title: str) -> None:
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
        axes.plot(
            *np.transpose(cells),
            STYLES[number],
            color=COLOURS[number],
            linewidth=2.2,
            path_effects=[withStroke(linewidth=4, foreground="white")],
            label=label,
            zorder=2 + number,
        )
