"""A robot's footprint, and the cells that it sweeps."""

import math
import re
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.arguments import as_number, numbers
from ddqn_planner.robot.motions import Motions, Poses, dense_poses

Corners = NDArray[np.float64]  # (K, 2), metres from the robot's origin
Points = NDArray[np.float64]  # (N, 2)

CIRCLE_CORNERS: Final = 24  # of the polygon around a circle
MAX_CORNERS: Final = 1000
MOST_LETTERS: Final = 500  # of a footprint in words
MAX_DISTANCE: Final = 100.0  # metres from the robot's origin to a corner
SAME_CORNER: Final = 1e-6  # metres: corners at this distance are the same
MIN_THICKNESS: Final = 1e-4  # metres: a thinner body has no area
# Cosine of half the angle by which the outline turns in a corner: where the body is
# padded, corners that turn more are cut.
MIN_COSINE: Final = 2 / 3
SMALLEST_COSINE: Final = 1e-3  # of a concave corner, so that it can be divided by
MAX_DEPTH: Final = 4  # of open brackets, and the text around them
MARGIN: Final = 0.1  # cells by which the swept cells are those of a larger body
POINTS_AT_ONCE: Final = 2**14  # of a body at several poses: more leave the cache
MAX_REACH: Final = 180  # cells that a primitive may sweep to each side
# By which a reach is longer, at most, as motions end in the centres of cells.
ROUNDED_CELLS: Final = 10

REMEDY: Final = (
    "give a radius, or points '[[x, y], ...]', metres from the robot's origin"
)
NUMBER: Final = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
TOKEN: Final = re.compile(rf"\s*(?:([\[(])|([\])])|(,)|({NUMBER.pattern})(?![\w.]))")


# From a radius or points to a polygon


def read_footprint(footprint: Any, padding: float = 0.0) -> Corners:
    """Return a polygon's corners, (K, 2) metres, of a radius or of points.

    The forms are those that Nav2 takes. The polygon may be concave, the origin may lie
    outside of it, and parts of its outline may touch, but no two sides may cross.
    Corners that repeat the one before are left out.

    Parameters
    ----------
    footprint : str, number, or sequence of points
        A radius, at least three points (x, y), or a string of either:
        ``"[[0.3, 0.2], ...]"``.
    padding : float
        Metres by which each side moves outward. A rectangle around the origin becomes
        the same as by Nav2's footprint_padding.

    Raises
    ------
    ValueError
        If it is neither, has fewer than three different corners or no area, or if sides
        cross.
    """
    padding = as_number("padding", padding, 0, 10, "0 to 10 metres")
    try:
        value = _parsed(footprint) if isinstance(footprint, str) else footprint
        corners = _around_circle(value) if _is_scalar(value) else _points(value)
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(
            f"the footprint is {_short(footprint)} ({error}); {REMEDY}"
        ) from None
    _check_polygon(corners, _short(footprint))
    if padding == 0:
        return corners
    padded = _without_repeats(_padded(corners, padding))
    if not _is_padded(padded, corners, padding):
        problem = f"a padding of {padding:g} m closes a gap in the footprint"
        raise ValueError(
            f"{problem} {_short(footprint)}; give less, or points with that room"
        )
    return padded


def in_words(footprint: Corners) -> str:
    """Return a footprint (K, 2) as Nav2 writes it, to the millimetre, cut if long."""
    text = str(footprint.round(3).tolist())
    return text if len(text) <= MOST_LETTERS else f"{text[:MOST_LETTERS]}..."


def _check_polygon(corners: Corners, text: str) -> None:
    """Raise a ValueError, with a footprint's text, if its corners form no polygon."""
    if len(corners) < 3:
        problem = f"the footprint {text} has fewer than three points that differ"
        raise ValueError(f"{problem}; {REMEDY}")
    centred = corners - corners.mean(axis=0)
    thickness = np.linalg.svd(centred, compute_uv=False)[1]
    if thickness < MIN_THICKNESS:
        problem = f"the corners of the footprint {text} lie on one line"
        raise ValueError(f"{problem}; give points around an area")
    if _sides_cross(corners):
        problem = f"sides of the footprint {text} cross"
        raise ValueError(f"{problem}; give the points in their order around the body")


def _short(footprint: Any) -> str:
    """Return the text of a footprint in an error, cut if it is long."""
    if isinstance(footprint, np.ndarray):
        footprint = footprint.tolist()
    text = repr(footprint)
    return text if len(text) <= 200 else f"{text[:197]}..."


def _parsed(text: str) -> Any:
    """Return the number or the nested lists of numbers that a text stands for.

    Commas may be left out, and brackets may be round. A ValueError says what is wrong
    with any other text.
    """
    text = text.strip(" \t\r\n'\"")
    if NUMBER.fullmatch(text):
        return float(text)
    # The lists whose brackets are open, the innermost at the end. The first list holds
    # what stands outside of all brackets: in the end, the list of points alone.
    lists: list[list[Any]] = [[]]
    position = 0  # up to where the text was read
    while position < len(text):
        token = _token_at(text, position)
        # All but one are None: a bracket that opens or closes, a comma or a number.
        opens, closes, _, number = token.groups()
        if opens:
            lists.append([])
            if len(lists) > MAX_DEPTH:
                raise ValueError("its brackets are nested too deeply")
        elif closes:
            inner = lists.pop()
            if not lists:
                raise ValueError("a bracket is closed that was not opened")
            lists[-1].append(inner)
        elif number:
            lists[-1].append(float(number))
        position = token.end()
    if len(lists) > 1:
        raise ValueError("a bracket is not closed")
    if len(lists[0]) != 1:
        raise ValueError("it is no single list of points")
    return lists[0][0]


def _token_at(text: str, position: int) -> re.Match[str]:
    """Return a match of `TOKEN` at a position of a text: a bracket, comma or number.

    A ValueError shows the text there if it is neither.
    """
    token = TOKEN.match(text, position)
    if token is None:
        beginning = text[position : position + 20]
        raise ValueError(f"{beginning!r} is neither bracket nor number")
    return token


def _is_scalar(value: Any) -> bool:
    """Return whether a footprint is a radius, and not a list or array of points."""
    return not isinstance(value, (list, tuple)) and np.ndim(value) == 0


def _around_circle(value: Any) -> Corners:
    """Return the corners (K, 2) of a polygon around the circle of a radius, in metres.

    The circle touches the middle of each side. A ValueError if `value` is no radius.
    """
    if isinstance(value, np.ndarray):  # of no axes: the number in it
        value = value[()]
    remedy = f"0.001 to {MAX_DISTANCE:g} metres"
    radius = as_number("the radius", value, 1e-3, MAX_DISTANCE, remedy)
    angle = 2 * math.pi * (np.arange(CIRCLE_CORNERS) + 0.5) / CIRCLE_CORNERS  # (K,)
    directions = np.column_stack([np.cos(angle), np.sin(angle)])
    distance = radius / math.cos(math.pi / CIRCLE_CORNERS)
    return directions * distance


def _points(value: Any) -> Corners:
    """Return points as an array (K, 2), without those that repeat the point before.

    A ValueError if `value` is no sequence of points (x, y), metres within a range.
    """
    points = numbers("the points", value)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(
            f"it has shape {points.shape}, and not three or more points (x, y)"
        )
    points = points.astype(np.float64)
    if not (np.abs(points) <= MAX_DISTANCE).all():  # or NaN
        limits = f"{-MAX_DISTANCE:g} to {MAX_DISTANCE:g} metres"
        raise ValueError(f"its coordinates are no numbers from {limits}")
    points = _without_repeats(points)
    if len(points) > MAX_CORNERS:
        raise ValueError(
            f"it has {len(points)} corners, and at most {MAX_CORNERS} are possible"
        )
    return points


def _without_repeats(points: Corners) -> Corners:
    """Return a polygon's corners (K, 2): points (N, 2) without repeated ones.

    A point that is the same as the corner before is left out. The corner before the
    first one is the last.
    """
    corners: list[NDArray[np.float64]] = []
    for point in points:
        if not corners or math.dist(point, corners[-1]) > SAME_CORNER:
            corners.append(point)
    while len(corners) > 1 and math.dist(corners[0], corners[-1]) <= SAME_CORNER:
        corners.pop()
    return np.array(corners, dtype=np.float64).reshape(-1, 2)


# Polygons


def _cross(first: Points, second: Points) -> NDArray[np.float64]:
    """Return the cross products of vectors (..., 2): above 0 for a turn to the left."""
    product: NDArray[np.float64] = (
        first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
    )
    return product


def _sides_cross(corners: Corners) -> bool:
    """Return whether two sides of a polygon with corners (K, 2) cross.

    Sides that only meet in a corner, touch, or lie on one line do not cross.
    """
    starts = corners  # of the K sides
    ends = np.roll(corners, -1, axis=0)
    # (K, K): whether the line through a side (column) parts another side (row): one end
    # of that lies to the left of the line, and one to the right.
    is_parted = _side_of(starts, starts, ends) * _side_of(ends, starts, ends) < 0
    # Sides cross if each of them is parted by the line through the other.
    return bool((is_parted & is_parted.T).any())


def _side_of(points: Points, starts: Points, ends: Points) -> NDArray[np.float64]:
    """Return on which side of each of K lines each of N points lies: (N, K).

    The points are (N, 2). A line leads from a start to an end, (K, 2) each. The result
    is 1 for a point to the left, -1 for one to the right, and 0 for one on the line.
    """
    lines = ends - starts  # (K, 2)
    to_points = points[:, None] - starts  # (N, K, 2)
    # (N, K): the distance of a point from a line, times the length of the line.
    product = _cross(lines, to_points)
    tolerance = 1e-9 * np.hypot(lines[:, 0], lines[:, 1])  # (K,)
    return np.where(np.abs(product) <= tolerance, 0, np.sign(product))


def _padded(corners: Corners, padding: float) -> Corners:
    """Return a polygon whose sides lie `padding` metres further out: (L, 2).

    A sharp corner is cut, and becomes two corners: so L may be greater than the number
    of `corners` (K, 2).
    """
    next_corners = np.roll(corners, -1, axis=0)
    sides = next_corners - corners
    # (K, 2): unit vectors along the side after each corner, and the side before it.
    directions = sides / np.hypot(sides[:, 0], sides[:, 1])[:, None]
    directions_before = np.roll(directions, 1, axis=0)
    # The area is positive if the corners are in counter-clockwise order.
    double_area = float(_cross(corners, next_corners).sum())
    orientation = math.copysign(1, double_area)
    padded: list[NDArray[np.float64]] = []
    corner: NDArray[np.float64]  # (2,) each
    direction_in: NDArray[np.float64]
    direction_out: NDArray[np.float64]
    for corner, direction_in, direction_out in zip(
        corners, directions_before, directions, strict=True
    ):
        offsets = _corner_offsets(direction_in, direction_out, orientation)
        padded += [corner + padding * offset for offset in offsets]
    return np.array(padded)


def _corner_offsets(
    direction_in: NDArray[np.float64],
    direction_out: NDArray[np.float64],
    orientation: float,
) -> list[NDArray[np.float64]]:
    """Return by how much a corner moves if the sides of its polygon move outward by 1.

    Parameters
    ----------
    direction_in, direction_out : (2,) float64
        Unit vectors along the sides before and after the corner.
    orientation : float
        1 if the polygon is counter-clockwise, -1 if it is clockwise.

    Returns
    -------
    list of (2,) float64
        One offset, or two where the corner is cut.
    """
    total = direction_in + direction_out
    # The cosine of half the angle by which the outline turns in the corner.
    cosine = math.hypot(total[0], total[1]) / 2
    is_concave = _cross(direction_in, direction_out) * orientation < 0
    if cosine > MIN_COSINE or is_concave:
        # One offset, to where the moved sides meet: at a distance of 1 / cosine from
        # the corner, in the direction of `outward`, whose length is 2 * cosine.
        outward = _turned_outward(total, orientation)
        return [outward / (2 * max(cosine, SMALLEST_COSINE) ** 2)]
    # Two offsets, to the ends of the cut. The middle of the cut is as far from the
    # corner as the sides move, 1, and the cut lies at a right angle to that direction.
    difference = direction_in - direction_out
    length = math.hypot(difference[0], difference[1])
    middle_of_cut: NDArray[np.float64] = difference / length
    along_cut = -_turned_outward(middle_of_cut, orientation)
    half_cut = along_cut * (1 - cosine) / math.sqrt(1 - cosine**2)
    return [middle_of_cut - half_cut, middle_of_cut + half_cut]


def _turned_outward(
    vector: NDArray[np.float64], orientation: float
) -> NDArray[np.float64]:
    """Return a vector (2,) along the outline, turned by 90 degrees to its outside.

    The orientation is 1 for a counter-clockwise outline, -1 for a clockwise one.
    """
    x: float
    y: float
    x, y = vector
    return np.array([orientation * y, -orientation * x])


def _is_padded(padded: Corners, corners: Corners, padding: float) -> bool:
    """Return whether a padded polygon is `padding` metres away from the unpadded one.

    The padded polygon must lie around the other one, and may not cross itself. `padded`
    (L, 2) and `corners` (K, 2) are the corners of both.
    """
    if _sides_cross(padded):
        return False
    if inside(padded, corners).any() or not inside(corners, padded).all():
        return False
    # The least distance is from a corner of one polygon to a side of the other.
    gap = min(distances(padded, corners).min(), distances(corners, padded).min())
    return bool(gap > padding * (1 - 1e-6))


def distances(points: Points, corners: Corners) -> NDArray[np.float64]:
    """Return how far points (N, 2) are from the outline of a polygon, (N,).

    The polygon has K corners, (K, 2). Distances have the unit of the points.
    """
    nearest = np.full(len(points), np.inf)
    side_ends = np.roll(corners, -1, axis=0)
    for start, end in zip(corners, side_ends, strict=True):
        side = end - start  # (2,)
        from_start = points - start  # (N, 2)
        # The point of the side that is nearest to a point lies at a share of the side:
        # 0 is its begin and 1 its end.
        shares = (from_start @ side / (side @ side)).clip(0, 1)  # (N,)
        from_nearest = from_start - shares[:, None] * side  # (N, 2)
        distance = np.hypot(from_nearest[:, 0], from_nearest[:, 1])
        nearest = np.minimum(nearest, distance)
    return nearest


def inside(points: Points, corners: Corners) -> NDArray[np.bool_]:
    """Return which points (N, 2) lie in a polygon, with corners (K, 2): (N,) bool.

    The outline leads around such a point at least once, in one direction.
    """
    # For each point, a ray leads to the right. The winding number counts the sides that
    # cross the ray upward, minus those that cross it downward.
    winding_number = np.zeros(len(points), dtype=np.int64)
    x = points[:, 0]
    y = points[:, 1]
    ends = np.roll(corners, -1, axis=0)
    start_x: float
    start_y: float
    end_x: float
    end_y: float
    for (start_x, start_y), (end_x, end_y) in zip(corners, ends, strict=True):
        if start_y == end_y:  # a side along the rays crosses none
            continue
        # (N,) each: whether the side crosses the horizontal line through each point,
        # and where; to the right of the point it crosses the ray.
        crosses_line = (start_y > y) != (end_y > y)
        share_of_side = (y - start_y) / (end_y - start_y)
        x_of_crossing = start_x + share_of_side * (end_x - start_x)
        crosses_ray = crosses_line & (x < x_of_crossing)
        if end_y > start_y:
            winding_number += crosses_ray
        else:
            winding_number -= crosses_ray
    is_inside: NDArray[np.bool_] = winding_number != 0
    return is_inside


def outline(corners: Corners, spacing: float) -> Points:
    """Return points along the sides of a polygon, (M, 2), at most `spacing` apart.

    The corners (K, 2) and the spacing have the same unit.
    """
    parts = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        count = math.ceil(math.dist(start, end) / spacing)
        parts.append(np.linspace(start, end, count, endpoint=False))
    return np.concatenate(parts)


def placed(corners: Corners, poses: Poses) -> NDArray[np.float64]:
    """Return where the corners of a body are at each of some poses: (N, K, 2), metres.

    The corners (K, 2) are ahead and to the left of the robot's origin. The poses (N, 3)
    are in metres and radians; the result of one pose, (3,), is (K, 2).
    """
    x = poses[..., :1]  # (N, 1), as y and yaw
    y = poses[..., 1:2]
    yaw = poses[..., 2:]
    ahead = corners[:, 0]  # (K,), in the robot's own frame, as left
    left = corners[:, 1]
    cos = np.cos(yaw)
    sin = np.sin(yaw)
    corner_x = cos * ahead - sin * left + x  # (N, K)
    corner_y = sin * ahead + cos * left + y
    return np.stack([corner_x, corner_y], axis=-1)


# The cells that a body sweeps


def swept_cells(corners: Corners, motions: Motions) -> NDArray[np.bool_]:
    """Return the cells that a body touches on each primitive: (P, S, S) bool.

    The index is (primitive, y, x); the robot starts in the middle, x = y = S // 2. All
    cells within `MARGIN` of the body count, so that cells that the body touches between
    two poses count, too. The body's corners (K, 2) are in metres.

    Raises
    ------
    ValueError
        If a primitive sweeps cells that are too far away.
    """
    body = corners / motions.resolution  # (K, 2), in cells
    radius = float(np.hypot(body[:, 0], body[:, 1]).max())
    reach = _reach(radius, motions)  # cells to each side of the start
    edge = outline(body, MARGIN)  # (M, 2): points in cells
    side = 2 * reach + 1
    swept = np.zeros((len(motions.poses), side, side), dtype=np.bool_)
    for mask, poses in zip(swept, motions.poses, strict=True):
        # A cell that the body comes to cover between two poses is touched by its
        # outline. So the outline needs many poses, and the inside needs few.
        _mark_touched(mask, edge, dense_poses(poses, MARGIN, radius))
        _mark_covered(mask, body, poses)
    return swept


def _reach(radius: float, motions: Motions) -> int:
    """Return how many cells a body may sweep to each side of its start.

    The body's radius, its greatest distance from the robot's origin, is in cells. A
    ValueError if the cells are too many.
    """
    poses = np.concatenate(motions.poses)  # (N, 3): of all primitives
    distances = np.hypot(poses[:, 0], poses[:, 1])  # cells from the start
    reach = math.ceil(radius + float(distances.max())) + 1
    if reach > MAX_REACH:
        # In whole centimetres. Motions end in the centres of cells, so they are longer
        # by some cells than the coarser resolution alone makes them.
        ratio = reach / (MAX_REACH - ROUNDED_CELLS)
        coarse = math.ceil(100 * motions.resolution * ratio) / 100
        problem = f"the body sweeps {reach} cells to a side; at most {MAX_REACH} can be"
        remedy = f"give a resolution of {coarse:g} m, or a smaller turning radius"
        raise ValueError(f"{problem} learned: {remedy}")
    return reach


def _mark_touched(mask: NDArray[np.bool_], edge: Points, poses: Poses) -> None:
    """Set the cells of a mask within `MARGIN` of a body's outline at one of some poses.

    Parameters
    ----------
    mask : (S, S) bool
        By y and x; the robot starts in the middle.
    edge : (M, 2) float64
        Points of the outline in the robot's own frame, in cells.
    poses : (N, 3) float64
        x and y in cells from the middle of the mask, yaw in radians.
    """
    side = len(mask)
    middle = side // 2 * (side + 1)  # the number of the robot's cell, row by row
    cells = mask.reshape(-1)
    for batch in _batches(poses, len(edge)):
        turned_edge = edge @ _rotations(batch).swapaxes(1, 2)
        points = turned_edge + batch[:, None, :2]  # (B, M, 2)
        # The cells near a point are those that contain a corner of a square around it.
        low = np.rint(points - MARGIN)
        high = np.rint(points + MARGIN)
        for row in (low[..., 1], high[..., 1]):
            for column in (low[..., 0], high[..., 0]):
                number = (row * side + column).astype(np.int64)
                cells[middle + number] = True


def _mark_covered(mask: NDArray[np.bool_], body: Points, poses: Poses) -> None:
    """Set the cells of a mask whose centres lie inside a body at one of some poses.

    Parameters
    ----------
    mask : (S, S) bool
        By y and x; the robot starts in the middle.
    body : (K, 2) float64
        The corners in the robot's own frame, in cells.
    poses : (N, 3) float64
        x and y in cells from the middle of the mask, yaw in radians.
    """
    middle = len(mask) // 2
    coordinates = np.arange(-middle, middle + 1.0)
    # (S * S, 2): the centres of all cells of the mask, from its middle.
    centres = np.stack(np.meshgrid(coordinates, coordinates), axis=-1).reshape(-1, 2)
    for batch in _batches(poses, len(centres)):
        from_robot = centres - batch[:, None, :2]  # (B, S * S, 2)
        in_robot_frame = from_robot @ _rotations(batch)  # turned back
        is_inside = inside(in_robot_frame.reshape(-1, 2), body)
        mask |= is_inside.reshape(-1, *mask.shape).any(axis=0)


def _batches(poses: Poses, points: int) -> Iterator[Poses]:
    """Yield poses (N, 3) in parts for which some points each fit into a cache."""
    size = max(POINTS_AT_ONCE // points, 1)
    for first in range(0, len(poses), size):
        yield poses[first : first + size]


def _rotations(poses: Poses) -> NDArray[np.float64]:
    """Return the matrices (N, 2, 2) that turn a column vector by the yaws of poses."""
    return np.array([_rotation(yaw) for yaw in poses[:, 2].tolist()])


def _rotation(yaw: float) -> NDArray[np.float64]:
    """Return the matrix (2, 2) that turns a column vector by a yaw."""
    cos = math.cos(yaw)
    sin = math.sin(yaw)
    return np.array([[cos, -sin], [sin, cos]])
