"""A robot's footprint, and the cells that it sweeps."""

import math
import re
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.arguments import as_number, numbers
from ddqn_planner.robot.motions import Motions, closer

Corners = NDArray[np.float64]  # (K, 2), metres from the robot's origin

CORNERS: Final = 24  # of the polygon around a circle
MAX_CORNERS: Final = 1000
FARTHEST: Final = 100.0  # metres from the robot's origin to a corner, at most
SAME: Final = 1e-6  # metres: nearer corners are the same one
THINNEST: Final = (
    1e-4  # metres: a body whose corners lie so near to one line has no area
)
SHARP: Final = (
    2 / 3
)  # cosine of half the angle of a corner that is cut where the body is padded
SHARPEST: Final = 1e-3
MAX_DEPTH: Final = 4  # of open brackets, and the text around them
MARGIN: Final = 0.1  # cells by which the swept cells are those of a larger body
MAX_REACH: Final = 120  # cells that a primitive may sweep to each side

REMEDY: Final = (
    "give a radius, or points '[[x, y], ...]', metres from the robot's origin"
)
NUMBER: Final = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
TOKEN: Final = re.compile(rf"\s*(?:([\[(])|([\])])|(,)|({NUMBER.pattern})(?![\w.]))")


def read_footprint(footprint: Any, padding: float = 0.0) -> Corners:
    """Return a polygon's corners, (K, 2) metres, of a radius or of points, as Nav2 takes them.

    The polygon may be concave, the origin may lie outside of it, and parts of its outline may
    touch, but no two sides may cross. Corners that repeat the one before are left out.

    Parameters
    ----------
    footprint : str, number, or sequence of points
        A radius, at least three points (x, y), or a string of either: ``"[[0.3, 0.2], ...]"``.
    padding : float
        Metres by which each side moves outward. A rectangle around the origin becomes what Nav2's
        footprint_padding makes of it.

    Raises
    ------
    ValueError
        If it is neither, has fewer than three different corners or no area, or sides cross.
    """
    padding = as_number("padding", padding, 0, 10, "0 to 10 metres")
    try:
        value = _parsed(footprint) if isinstance(footprint, str) else footprint
        corners = _around_circle(value) if _is_scalar(value) else _points(value)
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(
            f"the footprint is {_short(footprint)} ({error}); {REMEDY}"
        ) from None
    if len(corners) < 3:
        problem = f"the footprint {_short(footprint)} has fewer than three or more points that"
        raise ValueError(f"{problem} differ; {REMEDY}")
    centred = corners - corners.mean(axis=0)
    if np.linalg.svd(centred, compute_uv=False)[1] < THINNEST:
        problem = f"the corners of the footprint {_short(footprint)} lie on one line"
        raise ValueError(f"{problem}; give points around an area")
    if _sides_cross(corners):
        problem = f"sides of the footprint {_short(footprint)} cross"
        raise ValueError(f"{problem}; give the points in their order around the body")
    if padding > 0:
        padded = _without_repeats(_padded(corners, padding))
        if not _is_padded(padded, corners, padding):
            problem = f"a padding of {padding:g} m closes a gap in the footprint"
            raise ValueError(
                f"{problem} {_short(footprint)}; give less, or points with that room"
            )
        corners = padded
    return corners


def _short(footprint: Any) -> str:
    text = repr(footprint.tolist() if isinstance(footprint, np.ndarray) else footprint)
    return text if len(text) <= 200 else f"{text[:197]}..."


def _parsed(text: str) -> Any:
    """Return the number or the nested lists of a text in which commas may be left out."""
    text = text.strip(" \t\r\n'\"")
    if NUMBER.fullmatch(text):
        return float(text)
    lists: list[list[Any]] = [[]]  # those that are open, the innermost at the end
    position = 0
    while position < len(text):
        token = TOKEN.match(text, position)
        if token is None:
            raise ValueError(
                f"{text[position : position + 20]!r} is neither bracket nor number"
            )
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


def _is_scalar(value: Any) -> bool:
    return not isinstance(value, (list, tuple)) and np.ndim(value) == 0


def _around_circle(value: Any) -> Corners:
    """Return the polygon around a circle."""
    value = value[()] if isinstance(value, np.ndarray) else value
    radius = as_number(
        "the radius", value, 1e-3, FARTHEST, f"0.001 to {FARTHEST:g} metres"
    )
    turn = 2 * math.pi * (np.arange(CORNERS) + 0.5) / CORNERS
    around = np.column_stack([np.cos(turn), np.sin(turn)])
    return around * (radius / math.cos(math.pi / CORNERS))


def _points(value: Any) -> Corners:
    """Return points as an array, without those that repeat the one before."""
    points = numbers("the points", value)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(
            f"it has shape {points.shape}, and not three or more points (x, y)"
        )
    points = points.astype(np.float64)
    if not (np.abs(points) <= FARTHEST).all():  # or NaN
        raise ValueError(
            f"its coordinates are no numbers from {-FARTHEST:g} to {FARTHEST:g} metres"
        )
    points = _without_repeats(points)
    if len(points) > MAX_CORNERS:
        raise ValueError(
            f"it has {len(points)} corners, and at most {MAX_CORNERS} are possible"
        )
    return points


def _without_repeats(points: Corners) -> Corners:
    """Return points without those that repeat the one before; the first comes after the last."""
    kept: list[Any] = []
    for point in points:
        if not kept or math.dist(point, kept[-1]) > SAME:
            kept.append(point)
    while len(kept) > 1 and math.dist(kept[0], kept[-1]) <= SAME:
        kept.pop()
    return np.array(kept, dtype=np.float64).reshape(-1, 2)


def _sides_cross(corners: Corners) -> bool:
    """Return whether a side leads from one side of another to its other side."""
    begin = corners @ (1, 1j)
    end = np.roll(begin, -1)

    def left_of(corner: Any) -> Any:
        """Return for each side (column) on which side of it the corners (rows) lie: -1, 0, 1."""
        along, there = end - begin, corner[:, None] - begin
        area = (along.conj() * there).imag  # cross product
        return np.where(np.abs(area) <= 1e-9 * np.abs(along), 0, np.sign(area))

    # Sides that meet in a corner, touch, or lie on one line do not part the ends of each other.
    parts = left_of(begin) * left_of(end) < 0
    return bool((parts & parts.T).any())


def _padded(corners: Corners, padding: float) -> Corners:
    """Return a polygon of which each side moved outward; corners that stick out far are cut."""
    points = corners @ (1, 1j)
    next_point = np.roll(points, -1)
    direction = (next_point - points) / np.abs(next_point - points)
    area = float((points.conj() * next_point).imag.sum())
    to_outside = -1j if area > 0 else 1j
    padded: list[complex] = []
    for point, before, after in zip(
        points, np.roll(direction, 1), direction, strict=True
    ):
        turn = (before.conjugate() * after).imag * area
        cosine = (
            abs(before + after) / 2
        )  # of half the angle by which the outline turns here
        if cosine > SHARP or turn < 0:
            mitre = to_outside * (before + after) / (2 * max(cosine, SHARPEST) ** 2)
            padded.append(point + padding * mitre)
            continue
        # Cut as far beyond the corner as the sides move.
        beyond = (before - after) / abs(before - after)
        aside = beyond / to_outside * (1 - cosine) / math.sqrt(1 - cosine**2)
        padded += [
            point + padding * (beyond - aside),
            point + padding * (beyond + aside),
        ]
    return np.column_stack([np.real(padded), np.imag(padded)])


def _is_padded(padded: Corners, corners: Corners, padding: float) -> bool:
    """Return whether a polygon contains all that is within the padding of another."""
    if _sides_cross(padded) or inside(padded, corners).any():
        return False
    gaps = _distances(padded, corners).min(), _distances(corners, padded).min()
    return bool(inside(corners, padded).all() and min(gaps) > padding * (1 - 1e-6))


def _distances(points: Corners, corners: Corners) -> NDArray[np.float64]:
    """Return how far points (N, 2) are from each side of a polygon, (N, K)."""
    along = np.roll(corners, -1, axis=0) - corners
    there = points[:, None] - corners
    share = ((there * along).sum(axis=2) / (along * along).sum(axis=1)).clip(0, 1)
    away: NDArray[np.float64] = there - share[..., None] * along
    return np.hypot(away[..., 0], away[..., 1])


def inside(points: NDArray[np.float64], corners: Corners) -> NDArray[np.bool_]:
    """Return around which points (N, 2) a polygon's outline leads: that is its inside."""
    winding = np.zeros(len(points), dtype=np.int64)
    x, y = points.T
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 != y1:
            is_left = ((y0 > y) != (y1 > y)) & (
                x < x0 + (y - y0) / (y1 - y0) * (x1 - x0)
            )
            winding += np.where(is_left, 1 if y1 > y0 else -1, 0)
    is_inside: NDArray[np.bool_] = winding != 0
    return is_inside


def outline(corners: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Return points along the sides of a polygon, (M, 2)."""
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    counted = ((a, b, math.ceil(math.dist(a, b) / spacing)) for a, b in sides)
    return np.concatenate(
        [np.linspace(a, b, count, endpoint=False) for a, b, count in counted]
    )


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
        raise ValueError(
            f"{problem}: give a coarser resolution than {motions.resolution} m"
        )
    edge = outline(body, MARGIN)
    square = MARGIN * np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)])
    cells = np.arange(-reach, reach + 1.0)
    centres = np.stack(np.meshgrid(cells, cells), axis=-1).reshape(-1, 2)
    swept = np.zeros((len(motions.poses), len(cells), len(cells)), dtype=np.bool_)
    for mask, poses in zip(swept, motions.poses, strict=True):
        for x, y, yaw in closer(poses, MARGIN, far):
            turn = np.array(
                [[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]]
            )
            around = (edge @ turn + (x, y))[:, None] + square
            column, row = np.rint(around).astype(np.int64).reshape(-1, 2).T + reach
            mask[row, column] = True
        for x, y, yaw in poses:
            turn = np.array(
                [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
            )
            mask |= inside((centres - (x, y)) @ turn, body).reshape(mask.shape)
    return swept


def placed(
    corners: NDArray[np.float64], poses: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the corners (K, 2) of a body at poses (N, 3), in metres: (N, K, 2)."""
    x, y, yaw = poses.T[..., None]
    u, v = corners.T
    turned = np.cos(yaw) * u - np.sin(yaw) * v, np.sin(yaw) * u + np.cos(yaw) * v
    return np.stack([turned[0] + x, turned[1] + y], axis=-1)
