"""The finish of a body's path: straight lines and curves from the exact start to goal.

A path of primitives begins and ends in the centres of cells, in one of 16 headings, and
bends more often than it must. Between poses of such a path, the finish tries Dubins
curves (Dubins 1957; the words of Shkel and Lumelsky 2001 without three arcs), driven
ahead or in reverse, and for a robot that can turn on the spot a line between two turns.
Curves with cusps between them are those of Reeds and Shepp (1990). The cheapest chain
of free curves and of stretches of the path is found from the goal on, as by dynamic
programming.
"""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.layers import forbids, multiplier_at
from ddqn_planner.grid.moves import ACTION_OF_STEP
from ddqn_planner.planning.pose_paths import (
    AHEAD,
    ON_THE_SPOT,
    BodyPoints,
    Float64,
    PosePath,
    cells_of,
    in_cells,
    touches,
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
from ddqn_planner.robot.motions import ANGLE, SPACING, Motions, turn_between

Int64 = NDArray[np.int64]

# Cells that a point of the body moves between two poses that are checked, at most.
STEP: Final = 0.25
# So far is a point of the body, between two poses that are checked, from where it is at
# the nearer of them; and the poses of a path are joined by straight lines, not by arcs.
MARGIN: Final = STEP / 2 + 0.01
# The poses of masks: yaws, and places in a cell along each axis.
YAWS: Final = 128
PLACES: Final = 4
# So many steps apart are the poses of a curve that are checked first, and then.
STRIDES: Final = (40, 8, 1)
# The poses of a path at which a curve may begin or end are so many cells apart.
NODE_SPACING: Final = 8.0
# A curve leads from a node to the next one, and to those that are farther and farther:
# each time by this factor.
JUMP: Final = 1.35
# An arc counts a little more than a line, and each curve and each stretch of the path
# costs something: so that a path bends less often.
BEND_WEIGHT: Final = 1.05
CURVE_COST: Final = 1.0
# What a curve may cost, as a share of what it replaces, if the whole path costs no more
# than before; and else.
SLACKS: Final = (1.05, 1.0)
# Cells that an exact end may cost more than the end in the centre of a cell.
END_COST: Final = 3.0
NODES_OF_END: Final = 12  # at which the path is tried moved to an exact end
SAME_END: Final = 1e-9  # cells and radians
# Dubins curves ahead are the words 0 to 3, those in reverse 4 to 7.
DUBINS_WORDS: Final = 4
SPIN_AHEAD: Final = 8
SPIN_BEHIND: Final = 9
KEPT: Final = -1  # no word: a stretch of the path
# Which path a node lies on: the planned one, or this moved to the exact start or goal.
PLANNED, FROM_START, TO_GOAL = 0, 1, 2
NO_NODE: Final = -1
FINE: Final = 0.02  # cells between points of a curve that tell the cells that it passes
COARSE: Final = 0.5  # likewise, where no cell forbids a move
MAX_FAR: Final = BORDER - 8.0  # cells: masks of a larger body do not fit in the border


class Rates(NamedTuple):
    """What a cell of length and a radian cost; infinite where a robot cannot drive."""

    ahead: float
    bend_ahead: float
    behind: float
    bend_behind: float
    aside: float
    spin: float  # a radian on the spot


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
    pieces: Float64  # (3, 2): a buffer for a curve, see `write_pieces`


class Nodes(NamedTuple):
    """N poses at which a curve may begin or end, in G groups along the path."""

    pose: Float64  # (N, 3), in cells
    path: Int64  # (N,): PLANNED, FROM_START or TO_GOAL
    pose_index: Int64  # (N,): of the pose in its path
    next_node: Int64  # (N,): of the same path, or NO_NODE
    next_cost: Float64  # (N,): of the stretch to it
    first: Int64  # (G + 1,): where the nodes of each group begin
    cost_before: Float64  # (G,): of the planned path
    is_behind: NDArray[np.bool_]  # (G,): whether the robot drives in reverse there
    # What is found: the least that a chain to the goal counts, its next node, the word.
    value: Float64  # (N,)
    chosen_node: Int64  # (N,)
    chosen_word: Int64  # (N,)


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
def _half_turn(angle: float) -> float:
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
    if word == SPIN_BEHIND:
        yaw += math.pi
    distance = math.sqrt(dx * dx + dy * dy)
    pieces[0] = (_half_turn(yaw - begin[2]), 0.0)
    pieces[1] = (0.0, distance)
    pieces[2] = (_half_turn(end[2] - yaw), 0.0)
    return distance


@in_place
def write_pieces(
    begin: Float64, end: Float64, word: int, radius: float, pieces: Float64
) -> float:
    """Write the turn and the length of each piece of a curve; return its length.

    The curve leads from one pose (3,) to another. The length is infinite if there is no
    such curve.
    """
    if word >= SPIN_AHEAD:
        return _write_line_between_turns(begin, end, word, pieces)
    dx = end[0] - begin[0]
    dy = end[1] - begin[1]
    # In reverse, the robot drives where its back points.
    back = math.pi if word >= DUBINS_WORDS else 0.0
    begin_yaw = begin[2] + back
    end_yaw = end[2] + back
    first_side = 1 if word & 1 else -1  # 1: the arc turns left
    last_side = 1 if word & 2 else -1
    # From the centre of the first circle to that of the last.
    first_radius = first_side * radius
    last_radius = last_side * radius
    centre_x = dx - last_radius * math.sin(end_yaw) + first_radius * math.sin(begin_yaw)
    centre_y = dy + last_radius * math.cos(end_yaw) - first_radius * math.cos(begin_yaw)
    # The line is a tangent of both circles.
    across = first_radius - last_radius
    square = centre_x * centre_x + centre_y * centre_y - across * across
    if square < 0:
        return np.inf
    line = math.sqrt(square)
    line_yaw = math.atan2(centre_y, centre_x) + math.atan2(across, line)
    first_turn = _whole_turn(first_side * (line_yaw - begin_yaw))
    last_turn = _whole_turn(last_side * (end_yaw - line_yaw))
    pieces[0] = (first_side * first_turn, radius * first_turn)
    pieces[1] = (0.0, line)
    pieces[2] = (last_side * last_turn, radius * last_turn)
    return line + radius * (first_turn + last_turn)


@in_place
def _is_behind(word: int) -> bool:
    """Return whether a curve is driven in reverse."""
    return DUBINS_WORDS <= word < SPIN_AHEAD or word == SPIN_BEHIND


@in_place
def _is_empty(turn: float, length: float) -> bool:
    """Return whether a piece of a curve has neither a turn nor a length."""
    return abs(turn) < SAME_END and length < SAME_END


@in_place
def _pose_on(
    pose: tuple[float, float, float], turn: float, length: float, is_behind: bool
) -> tuple[float, float, float]:
    """Return the pose that a turn and a length lead to from a pose."""
    x, y, yaw = pose
    half = turn / 2
    chord = length * (math.sin(half) / half if abs(half) > SAME_END else 1.0)
    direction = yaw + half + (math.pi if is_behind else 0.0)
    return x + chord * math.cos(direction), y + chord * math.sin(direction), yaw + turn


@in_place
def _is_piece_free(
    begin: tuple[float, float, float],
    turn: float,
    length: float,
    is_behind: bool,
    stride: int,
    course: Any,
) -> bool:
    """Return whether the body has room along a piece, at every `stride`-th pose."""
    count = max(math.ceil((length + course.far * abs(turn)) / STEP), 1)
    number = min(stride, count)
    while True:
        share = number / count
        x, y, yaw = _pose_on(begin, share * turn, share * length, is_behind)
        steps = free_steps(x, y, yaw, course)
        if steps == 0:
            return False
        if number == count:
            return True
        number = min(number + max(steps, stride), count)


@in_place
def is_curve_free(begin: Float64, word: int, stride: int, course: Any) -> bool:
    """Return whether the body has room along a curve from a free pose (3,) on."""
    is_behind = _is_behind(word)
    pose = (begin[0], begin[1], begin[2])
    for piece in range(3):
        turn = course.pieces[piece, 0]
        length = course.pieces[piece, 1]
        if _is_empty(turn, length):
            continue
        if not _is_piece_free(pose, turn, length, is_behind, stride, course):
            return False
        pose = _pose_on(pose, turn, length, is_behind)
    return True


@in_place
def _mean_multiplier(
    begin: tuple[float, float, float],
    turn: float,
    length: float,
    is_behind: bool,
    layers: Any,
) -> float:
    """Return the mean multiplier of the cells of a piece; infinite if one forbids it.

    The body has room along the piece, so the origin does not leave the map.
    """
    has_forbidden = layers.forbidden.size > 0
    count = max(math.ceil(length / (FINE if has_forbidden else COARSE)), 1)
    total = 0.0
    last_column = math.floor(begin[0] + 0.5)
    last_row = math.floor(begin[1] + 0.5)
    for number in range(count):
        share = (number + 0.5) / count
        x, y, _ = _pose_on(begin, share * turn, share * length, is_behind)
        column = math.floor(x + 0.5)
        row = math.floor(y + 0.5)
        if has_forbidden:
            action = ACTION_OF_STEP[row - last_row + 1, column - last_column + 1]
            if forbids(last_column, last_row, action, layers):
                return np.inf
            last_column = column
            last_row = row
        total += max(multiplier_at(column, row, np.float64(1), layers), 1.0)
    return total / count


@in_place
def cost_of_curve(begin: Float64, word: int, course: Any) -> tuple[float, float]:
    """Return what a curve costs, and what it counts while curves are chosen."""
    is_behind = _is_behind(word)
    rates = course.rates
    pose = (begin[0], begin[1], begin[2])
    cost = 0.0
    counted = CURVE_COST
    for piece in range(3):
        turn = course.pieces[piece, 0]
        length = course.pieces[piece, 1]
        if _is_empty(turn, length):
            continue
        is_arc = turn != 0 and length > 0
        if length == 0:
            piece_cost = abs(turn) * rates.spin
        elif is_arc:
            piece_cost = length * (rates.bend_behind if is_behind else rates.bend_ahead)
        else:
            piece_cost = length * (rates.behind if is_behind else rates.ahead)
        layers = course.world.layers
        piece_cost *= _mean_multiplier(pose, turn, length, is_behind, layers)
        cost += piece_cost
        counted += piece_cost * (BEND_WEIGHT if is_arc else 1.0)
        pose = _pose_on(pose, turn, length, is_behind)
    return cost, counted


@in_place
def write_curve(begin: Float64, word: int, pieces: Float64, poses: Float64) -> int:
    """Write the poses of a curve except the first; return how many, or would be."""
    is_behind = _is_behind(word)
    pose = (begin[0], begin[1], begin[2])
    count = 0
    for piece in range(3):
        turn = pieces[piece, 0]
        length = pieces[piece, 1]
        if _is_empty(turn, length):
            continue
        steps_of_length = math.ceil(length / SPACING - 1e-9)
        steps = max(steps_of_length, math.ceil(abs(turn) / ANGLE - 1e-9), 1)
        for number in range(1, steps + 1):
            share = number / steps
            if count < len(poses):
                x, y, yaw = _pose_on(pose, share * turn, share * length, is_behind)
                poses[count] = (x, y, yaw)
            count += 1
        pose = _pose_on(pose, turn, length, is_behind)
    return count


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
def write_costs(path: Float64, count: int, course: Any, costs: Float64) -> None:
    """Write what a path (N, 3) costs up to each pose, along its first poses.

    From pose number `count` on, and behind a forbidden move, the cost is infinite.
    """
    rates = course.rates
    layers = course.world.layers
    costs[:] = np.inf
    for number in range(count):
        if number == 0:
            costs[0] = 0.0
            continue
        dx = path[number, 0] - path[number - 1, 0]
        dy = path[number, 1] - path[number - 1, 1]
        turn = path[number, 2] - path[number - 1, 2]
        yaw = path[number - 1, 2] + turn / 2
        length = math.sqrt(dx * dx + dy * dy)
        ahead = dx * math.cos(yaw) + dy * math.sin(yaw)
        is_bend = abs(turn) > ON_THE_SPOT
        if length < ON_THE_SPOT:
            cost = abs(turn) * rates.spin if is_bend else 0.0
        elif ahead > AHEAD * length:
            cost = length * (rates.bend_ahead if is_bend else rates.ahead)
        elif ahead < -AHEAD * length:
            cost = length * (rates.bend_behind if is_bend else rates.behind)
        else:
            cost = length * rates.aside
        direction = math.atan2(dy, dx)
        pose = (path[number - 1, 0], path[number - 1, 1], direction)
        multiplier = _mean_multiplier(pose, 0.0, length, False, layers)
        costs[number] = costs[number - 1] + cost * multiplier


# Which curves


@in_place
def choose(
    nodes: Any, jumps: Int64, slack: float, end_cost: float, course: Any
) -> None:
    """Write the cheapest chain to the goal from each node, from the last group on.

    The nodes of the last group have their values already.
    """
    groups = len(nodes.first) - 1
    for group in range(groups - 2, -1, -1):
        for node in range(nodes.first[group], nodes.first[group + 1]):
            next_node = nodes.next_node[node]
            if next_node != NO_NODE:
                kept = nodes.next_cost[node] + CURVE_COST + nodes.value[next_node]
                nodes.value[node] = kept
                nodes.chosen_node[node] = next_node
            # The farthest first: most of the others cannot be better then.
            for number in range(len(jumps) - 1, -1, -1):
                next_group = group + jumps[number]
                if next_group < groups:
                    _try_group(nodes, node, group, next_group, slack, end_cost, course)


@in_place
def _try_group(
    nodes: Any,
    node: int,
    group: int,
    next_group: int,
    slack: float,
    end_cost: float,
    course: Any,
) -> None:
    """Choose a curve from a node to a node of another group, if it counts less."""
    planned_cost = nodes.cost_before[next_group] - nodes.cost_before[group]
    may_reverse = nodes.is_behind[group] or nodes.is_behind[next_group]
    for next_node in range(nodes.first[next_group], nodes.first[next_group + 1]):
        # From the path that is moved to the start, or to that moved to the goal.
        changes = int(nodes.path[node] == FROM_START) + int(
            nodes.path[next_node] == TO_GOAL
        )
        if nodes.path[node] == nodes.path[next_node]:
            changes = 0
        most = slack * planned_cost + changes * end_cost
        dx = nodes.pose[next_node, 0] - nodes.pose[node, 0]
        dy = nodes.pose[next_node, 1] - nodes.pose[node, 1]
        after = nodes.value[next_node] + CURVE_COST
        if (
            course.rates.ahead * math.sqrt(dx * dx + dy * dy) + after
            >= nodes.value[node]
        ):
            continue
        for number in range(len(course.words)):
            word = course.words[number]
            if may_reverse or not _is_behind(word):
                _try_curve(nodes, node, next_node, word, most, course)


@in_place
def _try_curve(
    nodes: Any, node: int, next_node: int, word: int, most: float, course: Any
) -> None:
    """Choose a curve from a node to another if it counts less than what is chosen."""
    begin = nodes.pose[node]
    end = nodes.pose[next_node]
    length = write_pieces(begin, end, word, course.radius, course.pieces)
    rate = course.rates.behind if _is_behind(word) else course.rates.ahead
    after = nodes.value[next_node]
    least = length * rate
    if not (least <= most and least + CURVE_COST + after < nodes.value[node]):
        return
    for number in range(len(STRIDES)):
        if not is_curve_free(begin, word, STRIDES[number], course):
            return
    cost, counted = cost_of_curve(begin, word, course)
    if cost <= most and counted + after < nodes.value[node]:
        nodes.value[node] = counted + after
        nodes.chosen_node[node] = next_node
        nodes.chosen_word[node] = word


# From Python


class Track(NamedTuple):
    """A path of N poses along which a chain may lead."""

    poses: Float64  # (N, 3), in cells
    costs: Float64  # (N,): up to each pose; infinite where the body has no room


class Chain(NamedTuple):
    """The poses of a chain of curves and of stretches of paths."""

    poses: Float64  # (M, 3), in cells
    costs: Float64  # (M,): from the first pose to each
    planned_costs: Float64  # (M,): up to the same place of the planned path
    tracks: list[int]  # on which its nodes lie

    @property
    def cost(self) -> float:
        """Of the whole chain."""
        return float(self.costs[-1])


class Finish:
    """Finishes the paths of a robot.

    Parameters
    ----------
    motions : Motions
    footprint : (K, 2)
        The corners of the body, in metres.
    points : BodyPoints
        Of the same body, in cells.
    """

    def __init__(
        self, motions: Motions, footprint: Float64, points: BodyPoints
    ) -> None:
        self._points = points
        self._corners = np.ascontiguousarray(footprint / motions.resolution)
        self._far = float(np.hypot(*self._corners.T).max())
        self._rates = rates_of(motions)
        self._radius = least_radius_of(motions)
        self._words = words_of(self._rates)
        self._mask = np.empty((0, 0, 0), np.uint64)

    def course(self, world: World) -> Course:
        """Return the robot on a map for one request, with buffers of its own."""
        if not self._mask.size:
            self._mask = self._masks()
        cells_free = world.body.reach - self._far - 1 - MARGIN
        corners = len(self._corners)
        return Course(
            self._corners,
            self._mask,
            self._far,
            self._radius,
            self._words,
            self._rates,
            steps_when_far=max(int(cells_free / STEP), 0),
            world=world,
            placed=np.empty((corners, 2)),
            pieces=np.empty((3, 2)),
        )

    def _masks(self) -> NDArray[np.uint64]:
        """Return the masks of the body at rounded poses, see `Course.mask`."""
        # So far is a point of the body from where the rounded pose has it, at most.
        rounded = math.sqrt(0.5) / PLACES + self._far * math.pi / YAWS
        reach = math.ceil(self._far + rounded + MARGIN) + 1
        side = 2 * reach + 1
        mask = np.zeros((YAWS * PLACES**2, side, math.ceil(side / 64)), np.uint64)
        placed = np.empty_like(self._corners)
        write_masks(self._corners, placed, 0.5 + rounded + MARGIN, mask)
        return mask

    def finished(
        self, path: PosePath, start: Any, goal: Any, grid: GridMap, world: World
    ) -> PosePath:
        """Return a path with exact ends that costs no more than a path of primitives.

        Parameters
        ----------
        path : PosePath
        start, goal : (x, y, yaw)
            In metres and radians, in the map's frame. If the body has no room there, or
            no curve leads there at little cost, an end of the path stays.
        grid : GridMap
        world : World
            The body on it.
        """
        if len(path.poses) < 2 or not len(self._words) or self._far > MAX_FAR:
            return path
        course = self.course(world)
        planned = in_cells(path.poses, grid)  # (N, 3)
        planned[:, 2] = np.unwrap(planned[:, 2])
        ends = in_cells(np.array([start, goal], np.float64), grid)  # (2, 3)
        ends[:, 2] = planned[[0, -1], 2] + turn_between(planned[[0, -1], 2], ends[:, 2])
        tracks = [Track(planned, path.costs - path.costs[0])]
        for number, end in zip((0, len(planned) - 1), ends, strict=True):
            tracks.append(self._moved(tracks[PLANNED], number, end, grid, course))
        chain = self._chain(tracks, course)
        if chain is None:
            return path
        finished = _path_of(chain, path, grid)
        for number, pose, track in ((0, start, FROM_START), (-1, goal, TO_GOAL)):
            if chain.tracks[number] == track:  # without the rounding of its way here
                x, y, yaw = pose
                finished.poses[number] = x, y, turn_between(0, yaw)
        return finished

    def joined(
        self, path: PosePath, start: Any, grid: GridMap, world: World
    ) -> PosePath:
        """Return a path that begins exactly at a start near its first pose, with room.

        Only the first part of the path changes. For the rest, see `finished`.
        """
        if np.abs(path.poses[0] - start).max() < SAME_END:
            return path
        lengths = _lengths(in_cells(path.poses, grid))
        count = int(np.searchsorted(lengths[:-1], NODES_OF_END * NODE_SPACING)) + 1
        head = path.part(0, count)
        joint = head.poses[-1]
        new_head = self.finished(head, start, joint, grid, world)
        if new_head is head:
            return path
        return new_head.followed_by(path.part(count - 1, len(path.poses)))

    def _moved(
        self,
        planned: Track,
        number: int,
        end: Float64,
        grid: GridMap,
        course: Course,
    ) -> Track:
        """Return the path moved so that pose `number`, its first or last, is an end."""
        poses = _moved_poses(planned.poses, number, end)
        costs = np.full(len(poses), np.inf)
        is_same = np.abs(planned.poses[number] - end).max() < SAME_END
        occupied = grid.uninflated.view(np.uint8)
        if is_same or touches(end[None], self._points.inside, occupied):
            return Track(poses, costs)
        if number == 0:
            write_costs(poses, count_free(poses, course), course, costs)
            return Track(poses, costs)
        # From the goal on, against the drive: the costs that remain.
        first = len(poses) - count_free(np.ascontiguousarray(poses[::-1]), course)
        write_costs(poses[first:], len(poses) - first, course, costs[first:])
        return Track(poses, costs)

    def _chain(self, tracks: list[Track], course: Course) -> Chain | None:
        """Return the best chain that costs no more than the path; None without one."""
        planned = tracks[PLANNED]
        cost = float(planned.costs[-1])
        end_cost = END_COST * cost / max(float(_lengths(planned.poses)[-1]), 1.0)
        for slack in SLACKS:
            chain = _best_chain(tracks, slack, end_cost, course)
            exact_ends = len({FROM_START, TO_GOAL} & {*chain.tracks})
            if chain.cost <= cost * (1 + SAME_END) + exact_ends * end_cost:
                return chain
        chain = _best_chain(tracks[:1], 1.0, end_cost, course)
        return chain if chain.cost <= cost * (1 + SAME_END) else None


class PrimitiveRate(NamedTuple):
    """What one primitive costs, and how sharply it bends."""

    kind: str  # the field of `Rates` that it belongs to
    rate: float  # per cell of length, or per radian on the spot
    radius: float  # of its sharpest bend in cells; infinite without one


def _rate_of_primitive(poses: Float64, cost: float) -> PrimitiveRate:
    """Return the rate of a primitive with these poses (N, 3) and this cost."""
    dx, dy, turn = np.diff(poses, axis=0).T  # (N - 1,) each
    lengths = np.hypot(dx, dy)
    length = float(lengths.sum())
    if length < ON_THE_SPOT:
        return PrimitiveRate("spin", cost / float(np.abs(turn).sum()), math.inf)
    rate = cost / length
    yaw = poses[:-1, 2] + turn / 2
    ahead = float((dx * np.cos(yaw) + dy * np.sin(yaw)).sum())
    if abs(ahead) <= AHEAD * length:
        return PrimitiveRate("aside", rate, math.inf)
    direction = "ahead" if ahead > 0 else "behind"
    is_bend = np.abs(turn) > ON_THE_SPOT
    if not is_bend.any():
        return PrimitiveRate(direction, rate, math.inf)
    radii = lengths[is_bend] / np.abs(turn[is_bend])
    return PrimitiveRate(f"bend_{direction}", rate, float(radii.min()))


def _rates_of_primitives(motions: Motions) -> list[PrimitiveRate]:
    """Return the rate of each of a robot's primitives."""
    costs = motions.cost.tolist()
    return list(map(_rate_of_primitive, motions.poses, costs))


def least_radius_of(motions: Motions) -> float:
    """Return the radius of a robot's sharpest bend, in cells; infinite without one.

    It is a little greater, so that no curve bends more sharply than a primitive.
    """
    radii = [primitive.radius for primitive in _rates_of_primitives(motions)]
    return min(radii, default=math.inf) * (1 + 1e-3)


def rates_of(motions: Motions) -> Rates:
    """Return what a robot's motions cost: of a kind, the dearest primitive counts."""
    rates = dict.fromkeys(Rates._fields, 0.0)
    for primitive in _rates_of_primitives(motions):
        rates[primitive.kind] = max(rates[primitive.kind], primitive.rate)
    # A kind without a primitive cannot be driven.
    drivable_rates = {kind: rate or math.inf for kind, rate in rates.items()}
    return Rates(**drivable_rates)


def words_of(rates: Rates) -> Int64:
    """Return the words that a robot can drive; none if it cannot drive ahead."""
    words: list[int] = []
    if math.isfinite(rates.ahead + rates.bend_ahead):
        words += range(DUBINS_WORDS)
    if math.isfinite(rates.behind + rates.bend_behind):
        words += range(DUBINS_WORDS, 2 * DUBINS_WORDS)
    if math.isfinite(rates.ahead + rates.spin):
        words.append(SPIN_AHEAD)
    if math.isfinite(rates.behind + rates.spin):
        words.append(SPIN_BEHIND)
    return np.array(words if math.isfinite(rates.ahead) else [], np.int64)


def _moved_poses(poses: Float64, number: int, end: Float64) -> Float64:
    """Return poses (N, 3) turned and moved together, so that one becomes `end`."""
    x, y, yaw = poses[number]
    turn = end[2] - yaw
    cos = math.cos(turn)
    sin = math.sin(turn)
    dx = poses[:, 0] - x
    dy = poses[:, 1] - y
    moved_x = end[0] + cos * dx - sin * dy
    moved_y = end[1] + sin * dx + cos * dy
    moved = np.column_stack([moved_x, moved_y, poses[:, 2] + turn])
    moved[number] = end
    return moved


def _lengths(poses: Float64) -> Float64:
    """Return the length of a path (N, 3) up to each pose: (N,), in cells."""
    steps = np.diff(poses[:, :2], axis=0)
    return np.append(0.0, np.cumsum(np.hypot(steps[:, 0], steps[:, 1])))


def _node_poses(poses: Float64, is_behind: NDArray[np.bool_]) -> Int64:
    """Return the numbers of the poses at which a curve may begin or end, sorted.

    These are the ends of the path (N, 3), its cusps, and poses at even distances.
    `is_behind` (N - 1,) tells which steps are driven in reverse.
    """
    lengths = _lengths(poses)
    last = len(poses) - 1
    even = np.searchsorted(lengths, np.arange(0, lengths[-1], NODE_SPACING))
    cusps = np.flatnonzero(is_behind[1:] != is_behind[:-1]) + 1
    return np.unique(np.concatenate([[0, last], even.clip(0, last), cusps]))


def _steps_behind(poses: Float64) -> NDArray[np.bool_]:
    """Return which steps of a path (N, 3) are driven in reverse: (N - 1,)."""
    dx, dy, turn = np.diff(poses, axis=0).T
    yaw = poses[:-1, 2] + turn / 2
    is_behind: NDArray[np.bool_] = dx * np.cos(yaw) + dy * np.sin(yaw) < -ON_THE_SPOT
    return is_behind


def _nodes_of(tracks: list[Track]) -> Nodes:
    """Return the nodes of the planned path and of its moved copies."""
    planned = tracks[PLANNED]
    is_behind = _steps_behind(planned.poses)
    indices = _node_poses(planned.poses, is_behind)  # (G,)
    groups = len(indices)
    rows: list[tuple[int, int]] = []  # the track of each node, and its pose there
    node_of: dict[tuple[int, int], int] = {}  # by track and group
    first = [0]
    for group, index in enumerate(indices.tolist()):
        for number, track in enumerate(tracks):
            is_near_end = (
                number == PLANNED
                or (number == FROM_START and group < NODES_OF_END)
                or (number == TO_GOAL and group >= groups - NODES_OF_END)
            )
            if is_near_end and np.isfinite(track.costs[index]):
                node_of[number, group] = len(rows)
                rows.append((number, index))
        first.append(len(rows))
    count = len(rows)
    next_node = np.full(count, NO_NODE)
    next_cost = np.zeros(count)
    for (number, group), node in node_of.items():
        following = node_of.get((number, group + 1))
        if following is not None:
            costs = tracks[number].costs
            next_node[node] = following
            next_cost[node] = costs[indices[group + 1]] - costs[indices[group]]
    path, index = np.array(rows).T
    is_after = np.append(is_behind, is_behind[-1])[indices]
    is_before = is_behind[np.maximum(indices - 1, 0)]
    return Nodes(
        pose=np.array([tracks[number].poses[pose] for number, pose in rows]),
        path=path.copy(),
        pose_index=index.copy(),
        next_node=next_node,
        next_cost=next_cost,
        first=np.array(first),
        cost_before=planned.costs[indices],
        is_behind=is_before | is_after,
        value=np.full(count, np.inf),
        chosen_node=np.full(count, NO_NODE),
        chosen_word=np.full(count, KEPT),
    )


def _best_chain(
    tracks: list[Track], slack: float, end_cost: float, course: Course
) -> Chain:
    """Return the chain that counts least; with exact ends, where there is one."""
    nodes = _nodes_of(tracks)
    groups = len(nodes.first) - 1
    # An end in the centre of a cell counts as much as the path, if there is another.
    price = float(tracks[PLANNED].costs[-1]) + 2 * end_cost
    ends = np.arange(nodes.first[-2], nodes.first[-1])
    goals = ends[nodes.path[ends] != FROM_START]
    has_exact = (nodes.path[goals] == TO_GOAL).any()
    is_inexact = nodes.path[goals] == PLANNED
    nodes.value[goals] = np.where(is_inexact & has_exact, price, 0.0)
    factors = np.rint(JUMP ** np.arange(math.log(groups + 1, JUMP) + 1))
    jumps = np.unique(factors.astype(np.int64))
    choose(nodes, jumps, slack, end_cost, course)
    starts = np.arange(nodes.first[1])
    starts = starts[nodes.path[starts] != TO_GOAL]
    prices = np.where(nodes.path[starts] == PLANNED, price, 0.0)
    first = int(starts[np.argmin(nodes.value[starts] + prices)])
    return _follow(first, nodes, tracks, course)


def _follow(first: int, nodes: Nodes, tracks: list[Track], course: Course) -> Chain:
    """Return the chain that leads on from a node."""
    node = first
    cost = 0.0
    poses = [nodes.pose[first][None]]
    costs = [np.zeros(1)]
    planned_costs = [np.zeros(1)]
    numbers = [int(nodes.path[first])]
    planned = tracks[PLANNED].costs
    while nodes.chosen_node[node] != NO_NODE:
        next_node = int(nodes.chosen_node[node])
        word = int(nodes.chosen_word[node])
        begin = int(nodes.pose_index[node])
        end = int(nodes.pose_index[next_node])
        if word == KEPT:
            track = tracks[nodes.path[node]]
            part = track.poses[begin + 1 : end + 1]
            costs_of_part = track.costs[begin + 1 : end + 1] - track.costs[begin]
        else:
            part, cost_of_part = _curve(
                nodes.pose[node], nodes.pose[next_node], word, course
            )
            costs_of_part = cost_of_part * np.arange(1, len(part) + 1) / len(part)
        shares = np.arange(1, len(part) + 1) / len(part)
        poses.append(part)
        costs.append(cost + costs_of_part)
        planned_costs.append(planned[begin] + shares * (planned[end] - planned[begin]))
        cost = float(costs[-1][-1])
        node = next_node
        numbers.append(int(nodes.path[node]))
    return Chain(
        np.concatenate(poses),
        np.concatenate(costs),
        np.concatenate(planned_costs),
        numbers,
    )


def _curve(
    begin: Float64, end: Float64, word: int, course: Course
) -> tuple[Float64, float]:
    """Return the poses (N, 3) of a curve except the first, and its cost."""
    write_pieces(begin, end, word, course.radius, course.pieces)
    cost, _ = cost_of_curve(begin, word, course)
    count = write_curve(begin, word, course.pieces, np.empty((0, 3)))
    poses = np.empty((count, 3))
    write_curve(begin, word, course.pieces, poses)
    poses[-1] = end
    return poses, cost


def _path_of(chain: Chain, path: PosePath, grid: GridMap) -> PosePath:
    """Return a chain as a path in the place of the planned path."""
    yaw = turn_between(0, chain.poses[:, 2] + grid.origin[2])
    return PosePath(
        poses=np.column_stack([grid.centres(chain.poses[:, :2]), yaw]),
        cells=cells_of(chain.poses),
        costs=chain.costs,
        least_costs=path.least_costs[0] - chain.planned_costs,
    )
