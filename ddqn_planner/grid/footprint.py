"""A robot's footprint, and the cells that it sweeps."""

import ast
import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.arguments import as_number, numbers
from ddqn_planner.grid.motions import Motions, closer

CORNERS: Final = 24  # of the polygon around a circle
MARGIN: Final = 0.1  # cells by which the swept cells are those of a larger body
MAX_REACH: Final = 120  # cells that a primitive may sweep to each side


def read_footprint(text: Any, padding: float = 0.0) -> NDArray[np.float64]:
    """Return a polygon's corners, (K, 2) metres, given as in Nav2: a string of points or a radius.

    The padding moves each corner away from both axes, as Nav2's footprint_padding does. A
    ValueError names what is wrong: fewer than three points, sides that cross, a centre of rotation
    outside.
    """
    padding = as_number("padding", padding, 0, 10, "0 to 10 metres")
    remedy = "give a radius, or a string of points '[[x, y], ...]', metres from the robot's origin"
    try:
        value = ast.literal_eval(text.strip()) if isinstance(text, str) else text
        if isinstance(value, (int, float)):
            radius = as_number("the radius", value, 1e-3, 100, "metres")
            turn = 2 * math.pi * (np.arange(CORNERS) + 0.5) / CORNERS
            around = np.column_stack([np.cos(turn), np.sin(turn)])
            corners = around * (radius / math.cos(math.pi / CORNERS))
        else:
            corners = numbers("the footprint", value).astype(np.float64)
    except (ValueError, SyntaxError, MemoryError, RecursionError) as error:
        raise ValueError(f"the footprint is {text!r} ({error}); {remedy}") from None
    corners += padding * np.sign(corners)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
        raise ValueError(f"the footprint {text!r} is no list of three or more points; {remedy}")
    if not np.isfinite(corners).all() or _crosses_itself(corners):
        raise ValueError(f"the sides of the footprint {text!r} cross or are no numbers; {remedy}")
    if not inside(np.zeros((1, 2)), corners)[0]:
        problem = f"the footprint {text!r} does not contain the robot's origin (0, 0)"
        raise ValueError(f"{problem}; give points relative to it")
    return corners


def _crosses_itself(corners: NDArray[np.float64]) -> bool:
    """Return whether two sides touch that do not meet in a corner, or one has no length."""
    begin, count = corners @ (1, 1j), len(corners)
    end = np.roll(begin, -1)
    a, b, c, d = begin[:, None], end[:, None], begin, end

    def side_of(p: Any, q: Any, r: Any) -> Any:
        return ((q - p).conj() * (r - p)).imag

    touch = (side_of(a, b, c) * side_of(a, b, d) <= 0) & (side_of(c, d, a) * side_of(c, d, b) <= 0)
    between = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    return bool((begin == end).any() or (touch & (between > 1) & (between < count - 1)).any())


def inside(points: NDArray[np.float64], corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which points (N, 2) lie inside a polygon: those from which a ray crosses it oddly."""
    found = np.zeros(len(points), dtype=np.bool_)
    x, y = points.T
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 != y1:
            found ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) / (y1 - y0) * (x1 - x0))
    return found


def outline(corners: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Return points along the sides of a polygon, (M, 2)."""
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    counted = ((a, b, math.ceil(math.dist(a, b) / spacing)) for a, b in sides)
    return np.concatenate([np.linspace(a, b, count, endpoint=False) for a, b, count in counted])


def swept_cells(corners: NDArray[np.float64], motions: Motions) -> NDArray[np.bool_]:
    """Return (P, S, S) bool: the cells that the body touches on each primitive, S // 2 the first's.

    All that lies within `MARGIN` of the body counts, so that what lies between two poses does.
    """
    body = corners / motions.resolution
    far = float(np.hypot(*body.T).max())
    ways = [float(np.hypot(*poses[:, :2].T).max()) for poses in motions.poses]
    reach = math.ceil(far + max(ways)) + 1
    if reach > MAX_REACH:
        problem = f"the body sweeps {reach} cells to a side; at most {MAX_REACH} can be learned"
        raise ValueError(f"{problem}: give a coarser resolution than {motions.resolution} m")
    edge = outline(body, MARGIN)
    square = MARGIN * np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)])
    cells = np.arange(-reach, reach + 1.0)
    centres = np.stack(np.meshgrid(cells, cells), axis=-1).reshape(-1, 2)
    swept = np.zeros((len(motions.poses), len(cells), len(cells)), dtype=np.bool_)
    for mask, poses in zip(swept, motions.poses, strict=True):
        for x, y, yaw in closer(poses, MARGIN, far):
            turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
            around = (edge @ turn + (x, y))[:, None] + square
            column, row = np.rint(around).astype(np.int64).reshape(-1, 2).T + reach
            mask[row, column] = True
        for x, y, yaw in poses:
            turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
            mask |= inside((centres - (x, y)) @ turn, body).reshape(mask.shape)
    return swept


def placed(corners: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the corners (K, 2) of a body at poses (N, 3), in metres: (N, K, 2)."""
    x, y, yaw = poses.T[..., None]
    u, v = corners.T
    turned = np.cos(yaw) * u - np.sin(yaw) * v, np.sin(yaw) * u + np.cos(yaw) * v
    return np.stack([turned[0] + x, turned[1] + y], axis=-1)
