"""One moment of an episode, as an array of pixels or as text."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import Cell
from ddqn_planner.training.scenario import Scenario

# Red, green and blue, 0 to 255.
FREE_COLOUR: Final = (255, 255, 255)
LINE_COLOUR: Final = (225, 225, 225)  # between the cells
OBSTACLE_COLOUR: Final = (34, 34, 59)
TRAIL_COLOUR: Final = (240, 185, 192)
GOAL_COLOUR: Final = (42, 157, 143)
ROBOT_COLOUR: Final = (209, 73, 91)

# Cells of a map's longer side, up to which goal and robot are one cell wide.
MAX_SIDE_OF_SMALL_MAPS: Final = 100
PICTURE_SIDE: Final = 480  # pixels, about those of the picture's longer side
MIN_SIDE_WITH_LINES: Final = 5  # pixels of a cell, from which on lines are drawn


def draw_pixels(scenario: Scenario, cells: Sequence[Cell]) -> NDArray[np.uint8]:
    """Return a picture of a map and a robot: (height, width, 3), the highest y on top.

    `cells` are those of the episode so far: the robot's trail, and its cell at last.
    """
    occupancy = scenario.grid.occupancy
    colours = np.full((*occupancy.shape, 3), FREE_COLOUR, np.uint8)
    colours[occupancy] = OBSTACLE_COLOUR
    for x, y in cells:
        colours[y, x] = TRAIL_COLOUR
    # On a large map a cell is too small to be seen.
    reach = max(occupancy.shape) // MAX_SIDE_OF_SMALL_MAPS
    for cell, colour in ((scenario.goal, GOAL_COLOUR), (cells[-1], ROBOT_COLOUR)):
        x, y = cell
        rows = slice(max(0, y - reach), y + reach + 1)
        columns = slice(max(0, x - reach), x + reach + 1)
        colours[rows, columns] = colour
    side = max(1, PICTURE_SIDE // max(occupancy.shape))  # of a cell, in pixels
    picture = colours[::-1].repeat(side, axis=0).repeat(side, axis=1)
    if side >= MIN_SIDE_WITH_LINES:
        picture[::side] = LINE_COLOUR
        picture[:, ::side] = LINE_COLOUR
    return picture


def draw_signs(scenario: Scenario, cells: Sequence[Cell]) -> str:
    """Return a map and a robot as text: a line for each row, the highest y first.

    # is occupied, . free, * the robot's trail, G the goal and R the robot, the last of
    `cells`, which are those of the episode so far.
    """
    occupancy = scenario.grid.occupancy
    signs = np.where(occupancy, "#", ".")
    for x, y in cells:
        signs[y, x] = "*"
    for (x, y), sign in ((scenario.goal, "G"), (cells[-1], "R")):
        signs[y, x] = sign
    return "\n".join(" ".join(row) for row in signs[::-1])
