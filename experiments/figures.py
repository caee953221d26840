"""The figures of the reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import Any, Final

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from trainings import TrainingEvaluation

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.pictures import draw_obstacles
from ddqn_planner.training.environment import Scenario

COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
"""Of Okabe and Ito's palette, which colour-blind readers can tell apart."""
STYLES: Final = ("-", "--", "-.", ":")
NEW_OBSTACLE_COLOUR: Final = "#E69F00"

Curve = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Steps (T,), and values (seeds, T)."""


def save_figure(figure: Any, path: Path, caption: str) -> str:
    """Write a figure to a file, close it, and return the Markdown that shows it."""
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return f"![{caption}]({path.name})"


def evaluation_curve(runs: Sequence[Sequence[TrainingEvaluation]], column: str) -> Curve:
    """Return a column of the evaluations of each seed."""
    values = [[getattr(evaluation, column) for evaluation in run] for run in runs]
    return np.array([e.step for e in runs[0]], dtype=np.float64), np.array(values, dtype=np.float64)


def share_curve(runs: Sequence[Sequence[TrainingEvaluation]]) -> Curve:
    """Return the share of the seeds that are solved from the start."""
    steps, solved = evaluation_curve(runs, "solved")
    return steps, solved.mean(axis=0, keepdims=True)


def draw_curves(axes: Any, curves: Mapping[str, Curve], label: str) -> None:
    """Draw the median over the seeds of each curve, and the range from least to greatest."""
    for (name, (steps, values)), colour, style in zip(
        curves.items(), COLOURS, STYLES, strict=False
    ):
        if not np.isfinite(values).any():
            continue
        axes.plot(steps, np.nanmedian(values, axis=0), style, color=colour, label=name)
        low, high = np.nanmin(values, axis=0), np.nanmax(values, axis=0)
        axes.fill_between(steps, low, high, color=colour, alpha=0.18, linewidth=0)
    axes.set(xlabel="environment steps", ylabel=label)
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


def draw_new_obstacles(axes: Any, grid: GridMap, before: GridMap) -> None:
    """Draw the obstacles of a map that an earlier map does not have."""
    for y, x in np.argwhere(grid.occupancy & ~before.occupancy):
        axes.add_patch(
            Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=NEW_OBSTACLE_COLOUR, edgecolor="black")
        )


def draw_share(axes: Any, solved_HW: NDArray[np.float64], seeds: int) -> Any:
    """Colour each cell by the number of seeds that solve it; return the image for a colour bar."""
    colours = ListedColormap(plt.get_cmap("RdYlBu")(np.linspace(0.08, 0.92, seeds + 1)))
    norm = BoundaryNorm(np.arange(seeds + 2) - 0.5, seeds + 1)
    return axes.imshow(solved_HW, cmap=colours, norm=norm, origin="lower", interpolation="nearest")


def draw_border(axes: Any, cells: Set[Cell]) -> None:
    """Draw the border of a set of cells."""
    style = {"color": "black", "linewidth": 2.5, "zorder": 3}
    for x, y in cells:
        for side in (-1, 1):
            if (x + side, y) not in cells:
                axes.vlines(x + side / 2, y - 0.5, y + 0.5, **style)
            if (x, y + side) not in cells:
                axes.hlines(y + side / 2, x - 0.5, x + 0.5, **style)
