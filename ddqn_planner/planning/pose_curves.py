"""Curves of a body: Dubins curves, lines between turns, the room and the cost of each.

Dubins curves (Dubins 1957; the words of Shkel and Lumelsky 2001 without three arcs) are
driven ahead or in reverse. A robot that can turn on the spot drives a line between two
turns, too, and one that can move sideways a line in any direction in a held heading.
"""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place
from ddqn_planner.grid.layers import forbids, has_costs, multiplier_at
from ddqn_planner.grid.moves import ACTION_OF_STEP
from ddqn_planner.planning.pose_paths import (
    Float64,
    least_cost_of_step,
    rate_of_slide,
)
from ddqn_planner.planning.pose_world import (
    BORDER,
    LAST_BIT,
    ONE,
    WORD,
    World,
    is_far,
    is_inside,
)
from ddqn_planner.robot.directions import AHEAD, ON_THE_SPOT
from ddqn_planner.robot.driving_costs import Rates
from ddqn_planner.robot.motions import ANGLE, SPACING

Int64 = NDArray[np.int64]

# Cells that a point of the body moves between two poses that are checked, at most.
STEP: Final = 0.25
# So far is a point of the body, between two poses that are checked, from where it is at
# the nearer of them; and the poses of a path are joined by straight lines, not by arcs.
MARGIN: Final = STEP / 2 + 0.01
# The poses of masks: yaws, and places in a cell along each axis.
YAWS: Final = 128
PLACES: Final = 4
SAME_END: Final = 1e-9  # cells and radians
# The columns of `Course.pieces`: the radians that a piece turns to the left, the cells
# that it is long, and the direction of travel from the robot's heading, in radians.
TURN_OF_PIECE: Final = 0
LENGTH_OF_PIECE: Final = 1
BEARING_OF_PIECE: Final = 2
# Dubins curves ahead are the words 0 to 3, those in reverse 4 to 7.
DUBINS_WORDS: Final = 4
SPIN_AHEAD: Final = 8
SPIN_BEHIND: Final = 9
# A line in a held heading, and a turn on the spot after or before it.
SLIDE_BEFORE_TURN: Final = 10
SLIDE_AFTER_TURN: Final = 11
# Bearings: directions of travel from the robot's heading, in radians.
AHEAD_BEARING: Final = 0.0
BEHIND_BEARING: Final = math.pi
FINE: Final = 0.02  # cells between points of a curve that tell the cells that it passes
COARSE: Final = 0.5  # likewise, where no cell forbids a move


class Course(NamedTuple):
    """A robot on a map, as the kernels of this file use it."""

    corners: Float64  # (K, 2): of the body, in cells
    # (YAWS * PLACES**2, S, W): the cells that the outline may touch at all poses that
    # are rounded to one; bit b of word w is the cell in column 64 w + b of S.
    mask: NDArray[np.uint64]
    far: float  # cells from the origin to the farthest corner
    radius: float  # of the sharpest bend, in cells
    words: Int64  # that the robot can drive
    rates: Rates
    steps_when_far: int  # that lead from a tile far from obstacles to free poses alone
    world: World
    placed: Float64  # (K, 2): a buffer for the corners at a pose
    pieces: Float64  # (3, 3): a buffer for a curve, see `write_pieces`


# The body, exactly


@in_place
def _overlap(
    begin: Float64, end: Float64, row: float, half: float
) -> tuple[float, float]:
    """Return the columns, least and greatest, whose squares in a row meet a segment.

    A square has the half side `half` around the centre of its cell. Without such a
    column, the least is greater than the greatest.
    """
    rise = end[1] - begin[1]
    first_share = 0.0  # of the segment between the two sides of the row
    last_share = 1.0
    if rise == 0.0:
        if abs(begin[1] - row) > half:
            return np.inf, -np.inf
    else:
        share_below = (row - half - begin[1]) / rise
        share_above = (row + half - begin[1]) / rise
        first_share = max(first_share, min(share_below, share_above))
        last_share = min(last_share, max(share_below, share_above))
        if first_share > last_share:
            return np.inf, -np.inf
    run = end[0] - begin[0]
    first_x = begin[0] + first_share * run
    last_x = begin[0] + last_share * run
    return min(first_x, last_x) - half, max(first_x, last_x) + half


@in_place
def _place(x: float, y: float, yaw: float, corners: Float64, placed: Float64) -> None:
    """Write the corners of a body at a pose."""
    cos = math.cos(yaw)
    sin = math.sin(yaw)
    for corner in range(len(corners)):
        ahead = corners[corner, 0]
        left = corners[corner, 1]
        placed[corner, 0] = x + cos * ahead - sin * left
        placed[corner, 1] = y + sin * ahead + cos * left


@in_place
def write_masks(
    corners: Float64, placed: Float64, half: float, mask: NDArray[np.uint64]
) -> None:
    """Write the cells whose squares of half side `half` the outline meets, by poses."""
    middle = mask.shape[1] // 2
    for number in range(len(mask)):
        x = (number % PLACES + 0.5) / PLACES - 0.5
        y = (number // PLACES % PLACES + 0.5) / PLACES - 0.5
        yaw = 2 * math.pi * (number // PLACES**2) / YAWS
        _place(x, y, yaw, corners, placed)
        for side in range(len(corners)):
            begin = placed[side - 1]
            end = placed[side]
            for row in range(mask.shape[1]):
                lowest, highest = _overlap(begin, end, row - middle, half)
                if lowest > highest:
                    continue
                for column in range(math.ceil(lowest), math.floor(highest) + 1):
                    bit = np.uint64(column + middle)
                    mask[number, row, bit // WORD] |= ONE << (bit & LAST_BIT)


@in_place
def _touches_cell(column: int, row: int, placed: Float64) -> bool:
    """Return whether an outline comes nearer than `MARGIN` to a cell."""
    for side in range(len(placed)):
        lowest, highest = _overlap(placed[side - 1], placed[side], row, 0.5 + MARGIN)
        if lowest <= column <= highest:
            return True
    return False


@in_place
def free_steps(x: float, y: float, yaw: float, course: Any) -> int:
    """Return how many steps from a pose on are free, or 0 if it is not.

    It is free if no occupied cell is nearer than `MARGIN` to the body's outline.
    """
    column = math.floor(x + 0.5)
    row = math.floor(y + 0.5)
    world = course.world
    if not is_inside(column, row, world):
        return 0
    if course.steps_when_far > 0 and is_far(column, row, world):
        return int(course.steps_when_far)
    number = round(yaw * YAWS / (2 * math.pi)) % YAWS
    place_x = min(int((x + 0.5 - column) * PLACES), PLACES - 1)
    place_y = min(int((y + 0.5 - row) * PLACES), PLACES - 1)
    number = (number * PLACES + place_y) * PLACES + place_x
    mask = course.mask
    middle = mask.shape[1] // 2
    is_placed = False
    for mask_row in range(mask.shape[1]):
        for mask_word in range(mask.shape[2]):
            bits = mask[number, mask_row, mask_word]
            if not bits:
                continue
            # 64 cells of the map lie in two words, see `pose_world.touches`.
            map_row = row + mask_row - middle
            first_column = column + 64 * mask_word - middle
            place = np.uint64(first_column + BORDER)
            word = place // WORD
            bit = place & LAST_BIT
            occupied = world.occupied_bits[map_row + BORDER, word] >> bit
            next_word = world.occupied_bits[map_row + BORDER, word + ONE]
            occupied |= (next_word << ONE) << (LAST_BIT - bit)
            # Cells that the outline may touch at the rounded pose: at the exact one?
            occupied &= bits
            cell_column = first_column
            while occupied:
                if occupied & ONE:
                    if not is_placed:
                        _place(x, y, yaw, course.corners, course.placed)
                        is_placed = True
                    if _touches_cell(cell_column, map_row, course.placed):
                        return 0
                occupied >>= ONE
                cell_column += 1
    return 1


# Curves: a curve has three pieces, each an arc, a line or a turn on the spot


@in_place
def _whole_turn(angle: float) -> float:
    """Return an angle from 0 to 2 pi; 0 for an angle that is rounded below 2 pi."""
    positive = angle % (2 * math.pi)
    return 0.0 if positive > 2 * math.pi - 1e-7 else positive


@in_place
def half_turn(angle: float) -> float:
    """Return an angle from -pi to pi."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


@in_place
def _write_line_between_turns(
    begin: Float64, end: Float64, word: int, pieces: Float64
) -> float:
    """Write the pieces of a line between two turns on the spot; return its length."""
    dx = end[0] - begin[0]
    dy = end[1] - begin[1]
    yaw = math.atan2(dy, dx)
    bearing = AHEAD_BEARING
    if word == SPIN_BEHIND:
        bearing = BEHIND_BEARING
        yaw += math.pi
    distance = math.sqrt(dx * dx + dy * dy)
    pieces[0] = (half_turn(yaw - begin[2]), 0.0, bearing)
    pieces[1] = (0.0, distance, bearing)
    pieces[2] = (half_turn(end[2] - yaw), 0.0, bearing)
    return distance


@in_place
def _centre_of_circle(yaw: float, side: int, radius: float) -> tuple[float, float]:
    """Return the centre of the circle of an arc, from a pose on the arc.

    The pose has a yaw, and the arc turns to the left if its side is 1, to the right if
    its side is -1.
    """
    to_left = side * radius
    return -to_left * math.sin(yaw), to_left * math.cos(yaw)


@in_place
def _write_line_between_arcs(
    begin: Float64, end: Float64, word: int, radius: float, pieces: Float64
) -> float:
    """Write the pieces of a line between two arcs; return the length of the curve.

    The length is infinite if one circle crosses the other, so that no line lies between
    an arc of one and an arc of the other.
    """
    # In reverse, the robot drives where its back points.
    bearing = BEHIND_BEARING if word >= DUBINS_WORDS else AHEAD_BEARING
    begin_yaw = begin[2] + bearing
    end_yaw = end[2] + bearing
    first_side = 1 if word & 1 else -1  # 1: the arc turns left
    last_side = 1 if word & 2 else -1
    # From the centre of the first circle to that of the last one.
    first_x, first_y = _centre_of_circle(begin_yaw, first_side, radius)
    last_x, last_y = _centre_of_circle(end_yaw, last_side, radius)
    dx = end[0] - begin[0] + last_x - first_x
    dy = end[1] - begin[1] + last_y - first_y
    # The line is a tangent of both circles. Between arcs to different sides, it crosses
    # from one side of the centres to the other.
    across = (first_side - last_side) * radius
    square_of_line = dx * dx + dy * dy - across * across
    if square_of_line < 0:
        return np.inf
    line = math.sqrt(square_of_line)
    line_yaw = math.atan2(dy, dx) + math.atan2(across, line)
    first_turn = _whole_turn(first_side * (line_yaw - begin_yaw))
    last_turn = _whole_turn(last_side * (end_yaw - line_yaw))
    pieces[0] = (first_side * first_turn, radius * first_turn, bearing)
    pieces[1] = (0.0, line, bearing)
    pieces[2] = (last_side * last_turn, radius * last_turn, bearing)
    return line + radius * (first_turn + last_turn)


@in_place
def _write_slide(begin: Float64, end: Float64, word: int, pieces: Float64) -> float:
    """Write the pieces of a line in a held heading and of a turn; return its length.

    Without a turn, only `SLIDE_BEFORE_TURN` is such a curve.
    """
    dx = end[0] - begin[0]
    dy = end[1] - begin[1]
    distance = math.sqrt(dx * dx + dy * dy)
    direction = math.atan2(dy, dx)
    turn = half_turn(end[2] - begin[2])
    pieces[2] = (0.0, 0.0, AHEAD_BEARING)
    if word == SLIDE_BEFORE_TURN:
        pieces[0] = (0.0, distance, half_turn(direction - begin[2]))
        pieces[1] = (turn, 0.0, AHEAD_BEARING)
        return distance
    pieces[0] = (turn, 0.0, AHEAD_BEARING)
    pieces[1] = (0.0, distance, half_turn(direction - end[2]))
    return distance if abs(turn) >= SAME_END else np.inf


@in_place
def write_pieces(
    begin: Float64, end: Float64, word: int, radius: float, pieces: Float64
) -> float:
    """Write the turn, length and bearing of each piece of a curve; return its length.

    The curve leads from one pose (3,) to another. The length is infinite if there is no
    such curve.
    """
    if word >= SLIDE_BEFORE_TURN:
        return _write_slide(begin, end, word, pieces)
    if word >= SPIN_AHEAD:
        return _write_line_between_turns(begin, end, word, pieces)
    return _write_line_between_arcs(begin, end, word, radius, pieces)


@in_place
def is_in_reverse(word: int) -> bool:
    """Return whether a curve is driven in reverse."""
    return DUBINS_WORDS <= word < SPIN_AHEAD or word == SPIN_BEHIND


@in_place
def direction_of_curve(word: int, pieces: Float64) -> int:
    """Return in which direction a curve is driven, see `directions_of_travel`.

    It is 1 ahead, -1 in reverse, and 0 sideways.
    """
    if word < SLIDE_BEFORE_TURN:
        return -1 if is_in_reverse(word) else 1
    line = 0 if word == SLIDE_BEFORE_TURN else 1
    ahead = math.cos(pieces[line, BEARING_OF_PIECE])
    if pieces[line, LENGTH_OF_PIECE] <= ON_THE_SPOT or abs(ahead) <= AHEAD:
        return 0
    return 1 if ahead > 0 else -1


@in_place
def _is_empty(turn: float, length: float) -> bool:
    """Return whether a piece of a curve has neither a turn nor a length."""
    return abs(turn) < SAME_END and length < SAME_END


@in_place
def _pose_on(
    pose: tuple[float, float, float], turn: float, length: float, bearing: float
) -> tuple[float, float, float]:
    """Return the pose to which a piece of a curve leads from a pose."""
    x, y, yaw = pose
    half = turn / 2
    chord = length * (math.sin(half) / half if abs(half) > SAME_END else 1.0)
    direction = yaw + half + bearing
    return x + chord * math.cos(direction), y + chord * math.sin(direction), yaw + turn


@in_place
def _is_piece_free(
    begin: tuple[float, float, float],
    turn: float,
    length: float,
    bearing: float,
    stride: int,
    course: Any,
) -> bool:
    """Return whether the body has room along a piece, at every `stride`-th pose."""
    count = max(math.ceil((length + course.far * abs(turn)) / STEP), 1)
    number = min(stride, count)
    while True:
        share = number / count
        x, y, yaw = _pose_on(begin, share * turn, share * length, bearing)
        steps = free_steps(x, y, yaw, course)
        if steps == 0:
            return False
        if number == count:
            return True
        number = min(number + max(steps, stride), count)


@in_place
def is_curve_free(begin: Float64, stride: int, course: Any) -> bool:
    """Return whether the body has room along the curve of `course.pieces`.

    It leads from a free pose (3,) on, and is looked at at every `stride`-th pose.
    """
    pose = (begin[0], begin[1], begin[2])
    for piece in range(3):
        turn = course.pieces[piece, TURN_OF_PIECE]
        length = course.pieces[piece, LENGTH_OF_PIECE]
        bearing = course.pieces[piece, BEARING_OF_PIECE]
        if _is_empty(turn, length):
            continue
        if not _is_piece_free(pose, turn, length, bearing, stride, course):
            return False
        pose = _pose_on(pose, turn, length, bearing)
    return True


@in_place
def _mean_multiplier(
    begin: tuple[float, float, float],
    turn: float,
    length: float,
    bearing: float,
    world: Any,
) -> float:
    """Return the mean multiplier of the cells of a piece.

    It is infinite if a cell forbids the piece, or lies outside the map.
    """
    layers = world.layers
    has_forbidden = layers.forbidden.size > 0
    if not has_forbidden and not has_costs(layers):
        return 1.0
    count = max(math.ceil(length / (FINE if has_forbidden else COARSE)), 1)
    # The middles of equal parts: from one to the next, the robot moves by a chord, and
    # each chord is the one before it turned by the same angle.
    part_turn = turn / count
    part_length = length / count
    middle = _pose_on(begin, part_turn / 2, part_length / 2, bearing)
    next_x, next_y, _ = _pose_on(middle, part_turn, part_length, bearing)
    x, y, _ = middle
    chord_x = next_x - x
    chord_y = next_y - y
    cos = math.cos(part_turn)
    sin = math.sin(part_turn)
    total = 0.0
    last_column = math.floor(begin[0] + 0.5)
    last_row = math.floor(begin[1] + 0.5)
    for _ in range(count):
        column = math.floor(x + 0.5)
        row = math.floor(y + 0.5)
        if not is_inside(column, row, world):
            return np.inf
        if has_forbidden:
            action = ACTION_OF_STEP[row - last_row + 1, column - last_column + 1]
            if forbids(last_column, last_row, action, layers):
                return np.inf
            last_column = column
            last_row = row
        total += max(multiplier_at(column, row, np.float64(1), layers), 1.0)
        x += chord_x
        y += chord_y
        straight_x = chord_x
        chord_x = cos * straight_x - sin * chord_y
        chord_y = sin * straight_x + cos * chord_y
    return total / count


@in_place
def _least_cost_of_piece(
    turn: float, length: float, bearing: float, rates: Any
) -> float:
    """Return what a piece costs where each cell costs 1."""
    if length == 0:
        cost: float = abs(turn) * rates.spin
    elif bearing == AHEAD_BEARING:
        cost = length * (rates.ahead if turn == 0 else rates.bend_ahead)
    elif bearing == BEHIND_BEARING:
        cost = length * (rates.behind if turn == 0 else rates.bend_behind)
    else:
        cost = length * rate_of_slide(bearing, rates.slide)
    return cost


@in_place
def least_cost_of_curve(course: Any) -> float:
    """Return what the curve of `course.pieces` costs where each cell costs 1."""
    cost = 0.0
    for piece in range(3):
        turn = course.pieces[piece, TURN_OF_PIECE]
        length = course.pieces[piece, LENGTH_OF_PIECE]
        bearing = course.pieces[piece, BEARING_OF_PIECE]
        if not _is_empty(turn, length):
            cost += _least_cost_of_piece(turn, length, bearing, course.rates)
    return cost


@in_place
def cost_of_curve(begin: Float64, course: Any) -> float:
    """Return what the curve of `course.pieces` costs from a pose (3,) on.

    It is infinite if a cell forbids the curve.
    """
    pose = (begin[0], begin[1], begin[2])
    cost = 0.0
    for piece in range(3):
        turn = course.pieces[piece, TURN_OF_PIECE]
        length = course.pieces[piece, LENGTH_OF_PIECE]
        bearing = course.pieces[piece, BEARING_OF_PIECE]
        if _is_empty(turn, length):
            continue
        least = _least_cost_of_piece(turn, length, bearing, course.rates)
        cost += least * _mean_multiplier(pose, turn, length, bearing, course.world)
        pose = _pose_on(pose, turn, length, bearing)
    return cost


@in_place
def write_curve(begin: Float64, pieces: Float64, poses: Float64) -> int:
    """Write the poses of a curve except the first; return how many, or would be."""
    pose = (begin[0], begin[1], begin[2])
    count = 0
    for piece in range(3):
        turn = pieces[piece, TURN_OF_PIECE]
        length = pieces[piece, LENGTH_OF_PIECE]
        bearing = pieces[piece, BEARING_OF_PIECE]
        if _is_empty(turn, length):
            continue
        steps_of_length = math.ceil(length / SPACING - 1e-9)
        steps = max(steps_of_length, math.ceil(abs(turn) / ANGLE - 1e-9), 1)
        for number in range(1, steps + 1):
            share = number / steps
            if count < len(poses):
                x, y, yaw = _pose_on(pose, share * turn, share * length, bearing)
                poses[count] = (x, y, yaw)
            count += 1
        pose = _pose_on(pose, turn, length, bearing)
    return count


def poses_of_curve(begin: Float64, course: Course) -> Float64:
    """Return the poses (N, 3) of the curve of `course.pieces`, except the first."""
    count = write_curve(begin, course.pieces, np.empty((0, 3)))
    poses = np.empty((count, 3))
    write_curve(begin, course.pieces, poses)
    return poses


# The planned path


@in_place
def count_free(path: Float64, course: Any) -> int:
    """Return how many poses of a path (N, 3), from the first on, the body can drive."""
    for number in range(len(path)):
        x = path[number, 0]
        y = path[number, 1]
        yaw = path[number, 2]
        if free_steps(x, y, yaw, course) == 0:
            return number
        if number + 1 == len(path):
            break
        dx = path[number + 1, 0] - x
        dy = path[number + 1, 1] - y
        turn = path[number + 1, 2] - yaw
        movement = math.sqrt(dx * dx + dy * dy) + course.far * abs(turn)
        parts = math.ceil(movement / STEP)
        for part in range(1, parts):
            share = part / parts
            steps = free_steps(
                x + share * dx, y + share * dy, yaw + share * turn, course
            )
            if steps == 0:
                return number
    return len(path)


@in_place
def _direction_of_step(
    dx: float, dy: float, length: float, yaw: float, turn: float
) -> int:
    """Return the direction of travel of a step, see `directions_of_travel`.

    It leads by (dx, dy), in cells, and turns from a yaw on.
    """
    mean_yaw = yaw + turn / 2
    ahead = dx * math.cos(mean_yaw) + dy * math.sin(mean_yaw)
    if ahead > AHEAD * length:
        return 1
    return -1 if ahead < -AHEAD * length else 0


@in_place
def write_costs(path: Float64, count: int, course: Any, costs: Float64) -> None:
    """Write what a path (N, 3) costs up to each pose, along its first poses.

    From pose number `count` on, and behind a forbidden move, the cost is infinite.
    """
    costs[:] = np.inf
    if count > 0:
        costs[0] = 0.0
    for number in range(1, count):
        x = path[number - 1, 0]
        y = path[number - 1, 1]
        yaw = path[number - 1, 2]
        dx = path[number, 0] - x
        dy = path[number, 1] - y
        turn = path[number, 2] - yaw
        length = math.sqrt(dx * dx + dy * dy)
        direction = _direction_of_step(dx, dy, length, yaw, turn)
        yaw_of_line = math.atan2(dy, dx)
        bearing = yaw_of_line - yaw
        least = least_cost_of_step(length, turn, direction, bearing, course.rates)
        # The cells that the step passes, as those of a line.
        line = (x, y, yaw_of_line)
        multiplier = _mean_multiplier(line, 0.0, length, AHEAD_BEARING, course.world)
        costs[number] = costs[number - 1] + least * multiplier
