"""Films a long robot in a narrow door, and a car that turns in three points.

python examples/body_film.py robots.gif
"""

import argparse
import math
import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.typing import NDArray
from PIL import Image

from ddqn_planner import GridMap, Planner
from ddqn_planner.files import as_path
from ddqn_planner.model import RobotNetwork
from ddqn_planner.pictures import (
    GOAL_COLOUR,
    PATH_COLOUR,
    VALUE_COLOURS,
    draw_driven,
    draw_obstacles,
    save_film,
)
from ddqn_planner.planning.pose_paths import in_cells
from ddqn_planner.robot.footprint import placed

FRAME_MS = 50
LAST_FRAME_MS = 1500  # the robots stand at their goals
TRACE = 6  # poses from one outline that stays to the next

Pose = tuple[float, float, float]


class Drive(NamedTuple):
    """A robot's outlines along its path, and where they are drawn."""

    outlines: NDArray[Any]  # (poses, corners, 2): in cells
    axes: Any
    body: Any  # the drawn polygon


def door() -> tuple[GridMap, Pose, Pose]:
    """Return a wall with a door 10 cm wider than the robot.

    The robot starts and ends across the door.
    """
    occupancy = np.zeros((70, 110), np.bool_)
    occupancy[[0, -1]] = True
    occupancy[:, [0, -1]] = True
    occupancy[:, 53:57] = True
    occupancy[28:42, 53:57] = False
    return GridMap(occupancy, 0.05), (1.0, 0.9, math.pi / 2), (4.5, 2.6, math.pi / 2)


def lane() -> tuple[GridMap, Pose, Pose]:
    """Return a lane in which a car has to turn round.

    The lane is narrower than the car's turning circle.
    """
    occupancy = np.zeros((70, 110), np.bool_)
    occupancy[:12] = True
    occupancy[58:] = True
    occupancy[:, [0, -1]] = True
    return GridMap(occupancy, 0.05), (1.5, 1.2, 0.0), (1.5, 2.4, math.pi)


def main(arguments: Sequence[str]) -> int:
    """Save the film; return 1 if there is no path."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "file",
        nargs="?",
        default="robots.gif",
        help="where to save the film, by default %(default)s",
    )
    name = parser.parse_args(arguments).file
    try:
        file = as_path(name, "the film")
    except ValueError as error:
        parser.error(str(error))
    if file.suffix.lower() != ".gif":
        parser.error(f"the film is {name!r}; give a name that ends in .gif")
    if not file.parent.is_dir():
        parser.error(f"there is no folder {str(file.parent)!r}; make it")
    scenes = {"differential_robot": door(), "car": lane()}
    figure, panels = plt.subplots(2, 1, figsize=(4.4, 5.8), layout="constrained")
    drives: list[Drive] = []
    for axes, (model, (grid, start, goal)) in zip(panels, scenes.items(), strict=True):
        planner = Planner.load(model)
        assert isinstance(planner.network, RobotNetwork)
        plan = planner.plan_poses(grid, start, goal, bound=1.0)
        if not plan.poses.size:
            print(f"no path: {plan.status.value}")
            return 1
        metres = plan.length * grid.resolution
        print(f"{model}: {metres:.2f} m in {plan.field_ms:.0f} ms")
        axes.axis("off")
        draw_obstacles(axes, grid)
        poses = in_cells(plan.poses, grid)
        outlines = placed(planner.network.footprint / grid.resolution, poses)
        draw_driven(axes, poses)
        (body,) = axes.fill([], [], facecolor=GOAL_COLOUR, edgecolor=PATH_COLOUR)
        drives.append(Drive(outlines, axes, body))

    longest = max(len(drive.outlines) for drive in drives)
    canvas: Any = FigureCanvasAgg(figure)
    frames = []
    for pose in [*range(0, longest, 2), longest]:
        for drive in drives:
            draw_body_at(drive, pose)
        canvas.draw()
        image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        # These colours cover all that are drawn, also those of a short stretch.
        few_colours = image.quantize(64, Image.Quantize.MAXCOVERAGE)
        frames.append(few_colours.convert("RGB"))
    save_film(file, frames, FRAME_MS, LAST_FRAME_MS)
    return 0


def draw_body_at(drive: Drive, pose: int) -> None:
    """Move the body to a pose of its path, or to the last one, and draw its trace."""
    number = min(pose, len(drive.outlines) - 1)
    outline = drive.outlines[number]
    drive.body.set_xy(outline)
    if pose == number and pose % TRACE == 0:
        colour = VALUE_COLOURS[2]
        drive.axes.fill(*outline.T, color=colour, alpha=0.25, zorder=0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
