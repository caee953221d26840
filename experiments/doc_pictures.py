"""Draws pictures of the docs that no other program makes: all, or those named.

``python experiments/doc_pictures.py training`` writes docs/images/training.png.
"""

import sys
from argparse import ArgumentParser
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import page_pictures
import scipy.ndimage
import training_pictures
from figures import draw_path, plt
from numpy.typing import NDArray
from PIL import Image

from ddqn_planner import GridMap, MoveRule, Planner, inflate, load_map
from ddqn_planner.grid import MOVES, Cell, MapFile, read_map_file
from ddqn_planner.grid.inflation import INSCRIBED, grid_from_costmap
from ddqn_planner.gymnasium_registration import ENVIRONMENT
from ddqn_planner.pictures import draw_obstacles
from ddqn_planner.resources import find_map
from ddqn_planner.training.environment import paper_scenario

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
DPI = 130
PALETTE = 256  # colours of a file, which keep it small
RULE = MoveRule.ROBOT_SAFE

OFFICE_DETAIL = (240, 160)  # width and height of its lower left corner, in cells
OFFICE_GOAL: Cell = (230, 98)
CLEARANCE_WEIGHTS = (0.0, 1.0)
ROBOT_RADIUS = 0.15  # metres

RESOLUTION = 0.05  # metres per cell of the costmap
COSTMAP_SHAPE = (80, 120)
COSTMAP_ENDS: tuple[Cell, Cell] = ((12, 40), (108, 40))
# Of an inflation layer like that in Nav2's nav2_params.yaml.
INSCRIBED_RADIUS = 0.22  # metres
INFLATION_RADIUS = 0.7  # metres
COST_SCALING = 3.0  # per metre
LETHAL = 100
WALL = 4  # cells
NARROW_OPENING = slice(34, 46)  # rows of the wall: 0.6 m
WIDE_OPENING = slice(54, 76)  # 1.1 m


def draw_ends(axes: Any, start: Cell, goal: Cell) -> None:
    """Draw a start as a disc and a goal as a star."""
    style: Any = {"color": "black", "edgecolors": "white", "zorder": 5}
    axes.scatter(*start, 60, marker="o", **style)
    axes.scatter(*goal, 150, marker="*", **style)


def start_of(map_file: MapFile) -> Cell:
    """Return the start that the file of a map names."""
    assert map_file.start is not None
    return map_file.start


def tuning() -> Any:
    """Draw a path through the office without and with a weight of clearance."""
    planner = Planner.load("any_map")
    grid = load_map("office")
    start = start_of(read_map_file(find_map("office")))
    width, height = OFFICE_DETAIL
    figure, panels = plt.subplots(1, 2, figsize=(9.6, 3.5), layout="constrained")
    panels_and_weights = zip(panels, CLEARANCE_WEIGHTS, strict=True)
    for number, (axes, weight) in enumerate(panels_and_weights):
        inflated = inflate(grid, ROBOT_RADIUS, weight)
        plan = planner.plan(inflated, start, OFFICE_GOAL, RULE)
        draw_obstacles(axes, grid)
        draw_path(axes, plan.cells, number, "path")
        draw_ends(axes, start, OFFICE_GOAL)
        axes.set(xlim=(0, width), ylim=(0, height), xticks=[], yticks=[])
        title = f"clearance_weight {weight:g}: {plan.length:.0f} cells"
        axes.set_title(title, loc="left", fontsize=10)
    return figure


def warehouse() -> Any:
    """Draw the paths there and back through one-way aisles."""
    planner = Planner.load("any_map")
    grid = load_map("warehouse")
    map_file = read_map_file(find_map("warehouse"))
    start = start_of(map_file)
    goal = map_file.goal
    assert goal is not None
    figure, axes = plt.subplots(figsize=(7.2, 5.4), layout="constrained")
    draw_obstacles(axes, grid)
    draw_path(axes, planner.plan(grid, start, goal, RULE).cells, 0, "there")
    draw_path(axes, planner.plan(grid, goal, start, RULE).cells, 1, "back")
    draw_ends(axes, start, goal)
    axes.set(xlabel="x [cells]", ylabel="y [cells]")
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return figure


def two_rooms() -> NDArray[np.bool_]:
    """Return (H, W) bool: two rooms with a narrow and a wide opening between them."""
    occupancy = np.zeros(COSTMAP_SHAPE, np.bool_)
    occupancy[[0, -1], :] = True
    occupancy[:, [0, -1]] = True
    left_side = (COSTMAP_SHAPE[1] - WALL) // 2
    wall = slice(left_side, left_side + WALL)
    occupancy[:, wall] = True
    occupancy[NARROW_OPENING, wall] = False
    occupancy[WIDE_OPENING, wall] = False
    return occupancy


def costmap_values() -> NDArray[np.int8]:
    """Return (H, W) int8: the costmap of two rooms, as Nav2's inflation layer does."""
    occupancy = two_rooms()
    cells: NDArray[np.float64] = scipy.ndimage.distance_transform_edt(~occupancy)
    metres = cells * RESOLUTION  # from each cell to the nearest obstacle
    decay = np.exp(-COST_SCALING * (metres - INSCRIBED_RADIUS))
    values = np.floor((INSCRIBED - 1) * decay)
    values[metres > INFLATION_RADIUS] = 0
    values[metres <= INSCRIBED_RADIUS] = INSCRIBED
    values[occupancy] = LETHAL
    integers: NDArray[np.int8] = values.astype(np.int8)
    return integers


def costmap() -> Any:
    """Draw a costmap and the path that its costs lead away from the walls."""
    planner = Planner.load("any_map")
    values = costmap_values()
    start, goal = COSTMAP_ENDS
    map_with_costs = grid_from_costmap(values, RESOLUTION, (0.0, 0.0, 0.0), False)
    map_without_costs = GridMap(values >= INSCRIBED, RESOLUTION)
    figure, axes = plt.subplots(figsize=(7.2, 4.6), layout="constrained")
    draw_costmap(figure, axes, values)
    short_path = planner.plan(map_without_costs, start, goal, RULE).cells
    detour = planner.plan(map_with_costs, start, goal, RULE).cells
    draw_path(axes, short_path, 0, "without costs")
    draw_path(axes, detour, 2, "with costs")
    draw_ends(axes, start, goal)
    axes.set(xticks=[], yticks=[])
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return figure


def draw_costmap(figure: Any, axes: Any, values: NDArray[np.int8]) -> None:
    """Draw the costs of free cells in colour, and the other cells in grey."""
    free = np.ma.masked_greater_equal(values, INSCRIBED)
    inscribed = np.ma.masked_not_equal(values, INSCRIBED)
    lethal = np.ma.masked_not_equal(values, LETHAL)
    costs = axes.imshow(free, origin="lower", cmap="YlOrBr", vmin=0, vmax=INSCRIBED - 1)
    axes.imshow(inscribed, origin="lower", cmap="Greys", vmin=0, vmax=200)
    axes.imshow(lethal, origin="lower", cmap="Greys", vmin=0, vmax=110)
    figure.colorbar(costs, ax=axes, label="value of a free cell, 0 to 98", shrink=0.8)


def draw_box(
    axes: Any, centre: tuple[float, float], text: str, colour: str = "white"
) -> None:
    """Draw a box with a node's name and what the node does."""
    box = {"boxstyle": "round,pad=0.6", "facecolor": colour, "edgecolor": "#333333"}
    x, y = centre
    axes.text(x, y, text, ha="center", va="center", fontsize=10, bbox=box)


def draw_arrow(
    axes: Any, tail: tuple[float, float], head: tuple[float, float], text: str
) -> None:
    """Draw an arrow between two places, with the name of a topic or an action."""
    arrow = {"arrowstyle": "-|>", "color": "#333333", "linewidth": 1.5}
    axes.annotate("", head, tail, arrowprops=arrow)
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1.5}
    x, y = np.mean([tail, head], axis=0)
    axes.text(x, y, text, ha="center", va="center", fontsize=9, bbox=box)


def nav2() -> Any:
    """Draw which node asks which, with this package's planner in Nav2."""
    figure, axes = plt.subplots(figsize=(9.6, 3.0), layout="constrained")
    axes.set(xlim=(0, 96), ylim=(0, 36))
    axes.axis("off")
    draw_box(axes, (13, 28), "bt_navigator\nruns the behavior tree")
    draw_box(axes, (13, 8), "controller_server\nfollows the path")
    draw_box(axes, (52, 28), "ddqn_planner\nthis package's planner", "#dbe9f6")
    draw_box(axes, (52, 8), "planner_server\nglobal costmap, NavFn")
    draw_box(axes, (86, 28), "localisation")
    draw_arrow(axes, (23, 28), (41.5, 28), "compute_path_to_pose")
    draw_arrow(axes, (13, 24.5), (13, 11.5), "follow_path")
    draw_arrow(axes, (45, 11.5), (45, 24.5), "global_costmap/\ncostmap")
    draw_arrow(axes, (60, 24.5), (60, 11.5), "goals for\nNavFn")
    draw_arrow(axes, (80, 28), (62, 28), "tf")
    return figure


def gymnasium_frames() -> Any:
    """Draw what the environment renders: at the start, on the way, and at the goal."""
    scenario = paper_scenario()
    plan = Planner.load("dilemma").plan(scenario.grid, scenario.start, scenario.goal)
    moves = np.diff(plan.cells, axis=0)  # (M, 2)
    actions = (moves[:, None] == MOVES).all(axis=2).argmax(axis=1)
    environment = gymnasium.make(
        ENVIRONMENT, scenario=scenario, render_mode="rgb_array"
    )
    environment.reset(options={"start": scenario.start})
    frames: list[Any] = [environment.render()]
    for action in actions:
        environment.step(action)
        frames.append(environment.render())
    figure, all_axes = plt.subplots(1, 3, figsize=(9, 3.1), layout="constrained")
    steps = (0, len(actions) // 2, len(actions))
    for axes, step in zip(all_axes, steps, strict=True):
        axes.imshow(frames[step], interpolation="nearest")
        axes.set_title(f"after {step} steps", fontsize=10)
        axes.axis("off")
    return figure


PICTURES: Mapping[str, Callable[[], Any]] = {
    "task": training_pictures.task,
    "dead_end": training_pictures.dead_end,
    "improvements": training_pictures.improvements,
    "training": training_pictures.training,
    "learning_curves": training_pictures.learning_curves,
    "tuning": tuning,
    "warehouse": warehouse,
    "costmap": costmap,
    "nav2": nav2,
    "gymnasium": gymnasium_frames,
    "network": page_pictures.network,
    "kinds": page_pictures.kinds,
    "decisions": page_pictures.decisions,
    "speed": page_pictures.speed,
    "bends": page_pictures.bends,
    "python_api": page_pictures.python_api,
}


# What these save is complete: a film, or a picture that a user's command draws.
FILES: Mapping[str, Callable[[Path], None]] = {
    "own_map.png": training_pictures.save_own_map,
    "training.gif": training_pictures.save_film,
    "beside_smac.gif": page_pictures.save_beside_smac,
    "command_line.png": page_pictures.save_command_line,
}


def main() -> int:
    """Draw pictures into docs/images, in few colours."""
    names = [*PICTURES, *FILES]
    parser = ArgumentParser(description=main.__doc__)
    parser.add_argument("names", nargs="*", help=f"all by default: {', '.join(names)}")
    chosen = parser.parse_args().names
    if unknown := [name for name in chosen if name not in names]:
        parser.error(f"there is no picture {unknown[0]!r}; give {', '.join(names)}")
    for name in chosen or names:
        if name in FILES:
            path = IMAGES / name
            FILES[name](path)
        else:
            path = IMAGES / f"{name}.png"
            save_picture(PICTURES[name](), path)
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")
    return 0


def save_picture(figure: Any, path: Path) -> None:
    """Save a figure in few colours, and close it."""
    figure.canvas.draw()
    figure.savefig(path, dpi=DPI)
    plt.close(figure)
    with Image.open(path) as image:
        image.convert("RGB").quantize(PALETTE).save(path, optimize=True)


if __name__ == "__main__":
    sys.exit(main())
