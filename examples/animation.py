"""Films how values spread from the goal and the path follows them; it needs matplotlib.

python examples/animation.py office plan.gif --robot-radius 0.15 --clearance-weight 1
"""

import argparse
from collections.abc import Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from ddqn_planner import GridMap, Plan, Planner, inflate
from ddqn_planner.files import as_path
from ddqn_planner.grid import read_map_file
from ddqn_planner.pictures import PATH_COLOUR, VALUE_COLOURS, draw_obstacles
from ddqn_planner.resources import find_map

FRAMES_PER_SECOND = 16
LAST_FRAMES = 40  # for which the complete path is shown


def save_film(
    path: str, grid: GridMap, plan: Plan, value: NDArray[Any], steps: int = 40
) -> None:
    """Save a GIF: cells appear from the best value to the worst, then the path."""
    height, width = np.array(value.shape) / max(value.shape) * 6
    figure = plt.figure(figsize=(width, height))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.axis("off")
    finite = np.where(np.isfinite(value), value, np.nan)
    colours = LinearSegmentedColormap.from_list("value", VALUE_COLOURS)
    field = axes.imshow(finite, colours, origin="lower")
    draw_obstacles(axes, grid)
    outline = [withStroke(linewidth=9, foreground="white")]
    (line,) = axes.plot([], [], color=PATH_COLOUR, linewidth=5, path_effects=outline)
    for cell, marker, size in ((plan.cells[0], "o", 14), (plan.cells[-1], "*", 28)):
        axes.plot(
            *cell, marker, color=PATH_COLOUR, markersize=size, markeredgecolor="white"
        )
    # The least value that a frame shows, and how many cells of the path.
    frames = [
        (np.nanquantile(finite, 1 - share), 0) for share in np.linspace(0, 1, steps)
    ]
    frames += [
        (-np.inf, int(count)) for count in np.linspace(1, len(plan.cells), steps)
    ]
    frames += frames[-1:] * LAST_FRAMES

    def draw(frame: tuple[float, int]) -> Sequence[Any]:
        field.set_data(np.where(finite >= frame[0], finite, np.nan))
        line.set_data(*np.reshape(plan.cells[: frame[1]], (-1, 2)).T)
        return field, line

    FuncAnimation(figure, draw, frames).save(
        as_path(path), PillowWriter(FRAMES_PER_SECOND)
    )
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> int:
    """Plan on a map, and save the film; return 1 if there is no path."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("map", help="name or file")
    parser.add_argument("file", help="where to save the film, a .gif")
    parser.add_argument("--model", default="any_map", help="name or file")
    for end in ("start", "goal"):
        parser.add_argument(
            f"--{end}", type=int, nargs=2, metavar=("X", "Y"), help="cell"
        )
    for name in ("robot-radius", "clearance-weight"):
        parser.add_argument(f"--{name}", type=float, default=0.0, metavar="X")
    options = parser.parse_args(arguments)
    map_file = read_map_file(find_map(options.map))
    start, goal = options.start or map_file.start, options.goal or map_file.goal
    if not start or not goal:
        parser.error(
            f"{options.map} names no start and goal; give --start X Y --goal X Y"
        )
    grid = inflate(map_file.grid(), options.robot_radius, options.clearance_weight)
    planner = Planner.load(options.model)
    plan = planner.plan(grid, tuple(start), tuple(goal))
    if not plan.cells:
        print(f"no path: {plan.status.value}")
        return 1
    save_film(
        options.file,
        grid,
        plan,
        planner.q_field(grid, plan.cells[-1], plan.move_rule).value,
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
