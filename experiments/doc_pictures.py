"""Draws pictures of the docs that no other program makes: all, or those named.

``python experiments/doc_pictures.py training`` writes docs/images/training.png.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.ndimage
from figures import draw_map, draw_path, plt
from numpy.typing import NDArray
from PIL import Image

from ddqn_planner import GridMap, MoveRule, Planner, inflate, load_map
from ddqn_planner.grid import Cell, read_map_file
from ddqn_planner.grid.inflation import INSCRIBED, grid_from_costmap
from ddqn_planner.pictures import draw_obstacles
from ddqn_planner.resources import find_map
from ddqn_planner.training.environment import paper_scenario
from ddqn_planner.training.evaluation import length_ratios
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import Trainer

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
DPI = 100
PALETTE = 64  # colours of a file, which keep it small
RULE = MoveRule.ROBOT_SAFE

TRAINING_STEPS = (1_000, 15_000, 50_000)

OFFICE_DETAIL = (0, 240, 0, 160)  # cells: x from and to, y from and to
ROBOT_RADIUS = 0.15  # metres

RESOLUTION = 0.05  # metres per cell of the costmap
COSTMAP_SHAPE = (80, 120)
COSTMAP_ENDS: tuple[Cell, Cell] = ((12, 40), (108, 40))
# Of an inflation layer like that in Nav2's nav2_params.yaml.
INSCRIBED_RADIUS = 0.22  # metres
INFLATION_RADIUS = 0.7  # metres
COST_SCALING = 3.0  # per metre
LETHAL = 100


def draw_ends(axes: Any, start: Cell, goal: Cell) -> None:
    """Draw a start as a disc and a goal as a star."""
    style: Any = {"color": "black", "edgecolors": "white", "zorder": 5}
    axes.scatter(*start, 60, marker="o", **style)
    axes.scatter(*goal, 150, marker="*", **style)


def training() -> Any:
    """Draw which starts reach the end after three numbers of steps."""
    scenario = paper_scenario()
    parameters = HyperParameters(learning_rate=0.001, steps=TRAINING_STEPS[-1])
    trainer = Trainer([scenario], parameters, seed=0)
    figure, panels = plt.subplots(1, 3, figsize=(9.6, 3.5), layout="constrained")
    for axes, steps in zip(panels, TRAINING_STEPS, strict=True):
        for _ in trainer.run(steps, every=500):
            pass
        field = trainer.planner().q_field(scenario.grid, scenario.goal)
        ratios = length_ratios(field, scenario.grid, scenario.move_rule)
        solved = np.where(np.isnan(ratios), np.nan, np.isfinite(ratios))
        axes.imshow(
            solved, origin="lower", cmap="RdYlGn", vmin=-0.6, vmax=1.6, alpha=0.6
        )
        share = float(np.nanmean(solved))
        draw_map(axes, scenario, f"step {steps:,}: {share:.0%} of the starts")
        path = field.rollout(scenario.start).cells
        draw_path(axes, path, 0, "path from the start")
    return figure


def tuning() -> Any:
    """Draw a path through the office without and with a weight of clearance."""
    grid, planner = load_map("office"), Planner.load("any_map")
    map_file = read_map_file(find_map("office"))
    assert map_file.start is not None
    left, right, bottom, top = OFFICE_DETAIL
    goal = (right - 10, top - 62)
    figure, panels = plt.subplots(1, 2, figsize=(9.6, 3.5), layout="constrained")
    for number, (axes, weight) in enumerate(zip(panels, (0.0, 1.0), strict=True)):
        body = inflate(grid, ROBOT_RADIUS, weight)
        plan = planner.plan(body, map_file.start, goal, RULE)
        draw_obstacles(axes, grid)
        draw_path(axes, plan.cells, number, "path")
        draw_ends(axes, map_file.start, goal)
        axes.set(xlim=(left, right), ylim=(bottom, top), xticks=[], yticks=[])
        title = f"clearance_weight {weight:g}: {plan.length:.0f} cells"
        axes.set_title(title, loc="left", fontsize=10)
    return figure


def warehouse() -> Any:
    """Draw the way there and back through one-way aisles."""
    grid, planner = load_map("warehouse"), Planner.load("any_map")
    map_file = read_map_file(find_map("warehouse"))
    assert map_file.start is not None
    assert map_file.goal is not None
    ends = {
        "there": (map_file.start, map_file.goal),
        "back": (map_file.goal, map_file.start),
    }
    figure, axes = plt.subplots(figsize=(7.2, 5.4), layout="constrained")
    draw_obstacles(axes, grid)
    for number, (name, (start, goal)) in enumerate(ends.items()):
        draw_path(axes, planner.plan(grid, start, goal, RULE).cells, number, name)
    draw_ends(axes, map_file.start, map_file.goal)
    axes.set(xlabel="x [cells]", ylabel="y [cells]")
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return figure


def costmap_values() -> NDArray[np.int8]:
    """Return (H, W) int8: a costmap of two rooms with a wide and a narrow opening."""
    middle = COSTMAP_SHAPE[1] // 2
    wall = slice(middle - 2, middle + 2)
    obstacles = np.zeros(COSTMAP_SHAPE, np.bool_)
    obstacles[[0, -1], :] = obstacles[:, [0, -1]] = True
    obstacles[:, wall] = True
    obstacles[34:46, wall] = False  # narrow: 0.6 m
    obstacles[54:76, wall] = False  # wide: 1.1 m
    distance: NDArray[np.float64] = scipy.ndimage.distance_transform_edt(~obstacles)
    metres = distance * RESOLUTION
    decay = np.exp(-COST_SCALING * (metres - INSCRIBED_RADIUS))
    values = np.floor((INSCRIBED - 1) * decay)
    values[metres > INFLATION_RADIUS] = 0
    values[metres <= INSCRIBED_RADIUS] = INSCRIBED
    values[obstacles] = LETHAL
    written: NDArray[np.int8] = values.astype(np.int8)
    return written


def costmap() -> Any:
    """Draw a costmap and the path that its costs lead away from the walls."""
    planner, values = Planner.load("any_map"), costmap_values()
    start, goal = COSTMAP_ENDS
    with_costs = grid_from_costmap(values, RESOLUTION, (0.0, 0.0, 0.0), False)
    without_costs = GridMap(values >= INSCRIBED, RESOLUTION)
    figure, axes = plt.subplots(figsize=(7.2, 4.6), layout="constrained")
    shown = np.ma.masked_greater_equal(values, INSCRIBED)
    most = INSCRIBED - 1
    image = axes.imshow(shown, origin="lower", cmap="YlOrBr", vmin=0, vmax=most)
    inscribed = np.ma.masked_not_equal(values, INSCRIBED)
    axes.imshow(inscribed, origin="lower", cmap="Greys", vmin=0, vmax=200)
    lethal = np.ma.masked_not_equal(values, LETHAL)
    axes.imshow(lethal, origin="lower", cmap="Greys", vmin=0, vmax=110)
    figure.colorbar(image, ax=axes, label="value of a free cell, 0 to 98", shrink=0.8)
    straight, detour = (
        planner.plan(grid, start, goal, RULE).cells
        for grid in (without_costs, with_costs)
    )
    draw_path(axes, straight, 0, "without costs")
    draw_path(axes, detour, 2, "with costs")
    draw_ends(axes, start, goal)
    axes.set(xticks=[], yticks=[])
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return figure


def draw_box(axes: Any, centre: tuple[float, float], text: str, colour: str) -> None:
    """Draw a box with a node's name and what the node does."""
    box = {"boxstyle": "round,pad=0.6", "facecolor": colour, "edgecolor": "#333333"}
    axes.text(*centre, text, ha="center", va="center", fontsize=10, bbox=box)


def draw_arrow(
    axes: Any, ends: tuple[tuple[float, float], tuple[float, float]], text: str
) -> None:
    """Draw an arrow between two places, with the name of a topic or an action."""
    (x0, y0), (x1, y1) = ends
    style = {"arrowstyle": "-|>", "color": "#333333", "linewidth": 1.5}
    axes.annotate("", (x1, y1), (x0, y0), arrowprops=style)
    label = {"facecolor": "white", "edgecolor": "none", "pad": 1.5}
    middle = (x0 + x1) / 2, (y0 + y1) / 2
    axes.text(*middle, text, ha="center", va="center", fontsize=9, bbox=label)


def nav2() -> Any:
    """Draw which node asks which, with this package's planner in Nav2."""
    figure, axes = plt.subplots(figsize=(9.6, 3.0), layout="constrained")
    axes.set(xlim=(0, 96), ylim=(0, 36))
    axes.axis("off")
    draw_box(axes, (13, 28), "bt_navigator\nruns the behavior tree", "white")
    draw_box(axes, (13, 8), "controller_server\nfollows the path", "white")
    draw_box(axes, (52, 28), "ddqn_planner\nthis package's planner", "#dbe9f6")
    draw_box(axes, (52, 8), "planner_server\nglobal costmap, NavFn", "white")
    draw_box(axes, (86, 28), "localisation", "white")
    draw_arrow(axes, ((23, 28), (41.5, 28)), "compute_path_to_pose")
    draw_arrow(axes, ((13, 24.5), (13, 11.5)), "follow_path")
    draw_arrow(axes, ((45, 11.5), (45, 24.5)), "global_costmap/\ncostmap")
    draw_arrow(axes, ((60, 24.5), (60, 11.5)), "goals for\nNavFn")
    draw_arrow(axes, ((80, 28), (62, 28)), "tf")
    return figure


PICTURES: Mapping[str, Callable[[], Any]] = {
    "training": training,
    "tuning": tuning,
    "warehouse": warehouse,
    "costmap": costmap,
    "nav2": nav2,
}


def main(names: Sequence[str]) -> int:
    """Draw pictures into docs/images, in few colours."""
    for name in names or PICTURES:
        figure, path = PICTURES[name](), IMAGES / f"{name}.png"
        figure.canvas.draw()
        figure.savefig(path, dpi=DPI)
        plt.close(figure)
        with Image.open(path) as image:
            image.convert("RGB").quantize(PALETTE).save(path, optimize=True)
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
