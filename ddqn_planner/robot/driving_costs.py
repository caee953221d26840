"""What it costs a robot to drive: in bends, in reverse, on the spot, and at cusps.

All costs are those of so many cells driven straight ahead.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from ddqn_planner.grid.arguments import as_number
from ddqn_planner.robot.directions import AHEAD, ON_THE_SPOT
from ddqn_planner.robot.motions import (
    BEHIND,
    MIN_COST,
    TURN,
    Float64,
    Motions,
    Poses,
    turn_between,
)

# Metres driven straight ahead that cost as much as a metre in a bend: without it, paths
# of least cost slalom.
BEND: Final = 1.15
# As a radian on the spot: 1.5 s at 0.5 m/s.
SPIN_METRES: Final = 0.75
# As a cusp: 4 s at 0.5 m/s, in which a car stops, turns its wheels from one side to the
# other, and drives off.
CUSP_METRES: Final = 2.0
MAX_FACTOR: Final = 100.0
MAX_CUSP: Final = 1000.0  # metres
MAX_SPIN: Final = TURN * MAX_FACTOR  # metres for a radian
# Bearings of lines in a held heading: one for each degree from the heading on.
BEARINGS: Final = 360
PARALLEL: Final = 1e-3  # radians between two lines
ROUNDING: Final = 1e-9
DIGITS: Final = 6  # of a bearing


class DrivingCosts(NamedTuple):
    """What a robot's drives cost, beside a drive straight ahead."""

    # Of a metre in a bend, in metres; None: `BEND`, or with a lattice what its file
    # says.
    bend: float | None = None
    reverse: float = BEHIND  # of a metre in reverse or sideways, in metres
    cusp: float = CUSP_METRES  # of a change between ahead and reverse, in metres
    spin: float = SPIN_METRES  # of a radian on the spot, in metres


class Rates(NamedTuple):
    """What a cell of length, a radian and a cusp cost a robot.

    A rate is infinite where the robot cannot drive so.
    """

    ahead: float
    bend_ahead: float
    behind: float
    bend_behind: float
    aside: float
    spin: float  # a radian on the spot
    cusp: float = 0.0
    # (BEARINGS,): a cell of a line in a held heading, see `slide_rates_of`; empty for a
    # robot that cannot move sideways.
    slide: Float64 = np.empty(0)


# The fields of `Rates` that a primitive may belong to.
KINDS: Final = "ahead", "bend_ahead", "behind", "bend_behind", "aside", "spin"


class PrimitiveRate(NamedTuple):
    """What one primitive costs, and how sharply it bends."""

    kind: str  # one of `KINDS`
    rate: float  # per cell of length, or per radian on the spot
    radius: float  # of its sharpest bend in cells; infinite without one


def with_costs(motions: Motions, costs: DrivingCosts, is_lattice: bool) -> Motions:
    """Return motions whose primitives and cusps cost what `costs` say.

    A ValueError if a cost is out of its range: bounds of paths rely on costs.
    """
    bend = costs.bend
    if bend is None:
        bend = 1.0 if is_lattice else BEND
    factor_range = f"1 to {MAX_FACTOR:g}: times that of a drive straight ahead"
    bend = as_number("the cost of bends", bend, 1, MAX_FACTOR, factor_range)
    reverse = as_number(
        "the cost of reverse", costs.reverse, 1, MAX_FACTOR, factor_range
    )
    cusp_range = f"metres driven ahead, 0 to {MAX_CUSP:g}"
    cusp = as_number("the cost of a cusp", costs.cusp, 0, MAX_CUSP, cusp_range)
    spin_range = f"metres driven ahead, {TURN:g} to {MAX_SPIN:g}"
    spin = as_number("the cost of turns", costs.spin, TURN, MAX_SPIN, spin_range)
    kinds = [primitive.kind for primitive in _rates_of_primitives(motions)]
    factors = {
        "ahead": 1.0,
        "bend_ahead": bend,
        "behind": reverse / BEHIND,
        "bend_behind": bend * reverse / BEHIND,
        "aside": reverse / BEHIND,
        "spin": spin / TURN,
    }
    factor = np.array([factors[kind] for kind in kinds])  # (P,)
    cusp_in_cells = cusp / motions.resolution
    return replace(
        motions,
        cost=(motions.cost * factor).astype(np.float32),
        # A path of primitives that cost nothing would not end.
        cusp=cusp_in_cells if cusp_in_cells >= MIN_COST else 0.0,
    )


def rates_of(motions: Motions) -> Rates:
    """Return what a robot's motions cost: of a kind, the dearest primitive counts."""
    rates = dict.fromkeys(KINDS, 0.0)
    for primitive in _rates_of_primitives(motions):
        rates[primitive.kind] = max(rates[primitive.kind], primitive.rate)
    # A kind without a primitive cannot be driven.
    drivable_rates = {kind: rate or math.inf for kind, rate in rates.items()}
    slide = np.empty(0)
    if math.isfinite(drivable_rates["aside"]):
        slide = slide_rates_of(motions)
    return Rates(**drivable_rates, cusp=motions.cusp, slide=slide)


def slide_rates_of(motions: Motions) -> Float64:
    """Return what a cell of a line in a held heading costs, by bearing: (BEARINGS,).

    A bearing is the direction of travel, from the heading. A line costs as much as
    the cheapest of the robot's lines to the same place, one after another, and in the
    heading in which these cost most: so no line is cheaper than the robot's motions.
    Without lines to both sides in all headings, there are no rates.
    """
    bearings = np.linspace(0, 2 * math.pi, BEARINGS, endpoint=False)
    greatest_rates = np.zeros(BEARINGS)
    for rate_of_bearing in _lines_of_headings(motions):
        least_rates = _least_rates(rate_of_bearing, bearings)
        greatest_rates = np.maximum(greatest_rates, least_rates)
    to_both_sides = [0, BEARINGS // 4, -BEARINGS // 4]
    can_slide = np.isfinite(greatest_rates[to_both_sides]).all()
    return greatest_rates if can_slide else np.empty(0)


def _least_rates(rate_of_bearing: dict[float, float], bearings: Float64) -> Float64:
    """Return the least costs of a cell in each direction, by lines one after another.

    Two lines lead to each place at the least cost: more cost no less.

    Parameters
    ----------
    rate_of_bearing : dict
        What a cell of each line costs, by the bearing of the line in radians.
    bearings : (B,)
        The directions, in radians.

    Returns
    -------
    (B,)
        Infinite where no two of the lines lead.
    """
    directions = np.array([np.cos(bearings), np.sin(bearings)])  # (2, B)
    angles = np.array(list(rate_of_bearing))  # (L,)
    rates = np.array(list(rate_of_bearing.values()))  # (L,)
    lines = np.array([np.cos(angles), np.sin(angles)])  # (2, L)
    first, last = np.triu_indices(len(angles), 1)  # (M,): pairs of lines
    is_pair = np.abs(np.sin(angles[first] - angles[last])) > PARALLEL
    first = first[is_pair]
    last = last[is_pair]
    pairs = np.stack([lines[:, first], lines[:, last]], axis=-1)  # (2, M, 2)
    # How far each line of a pair leads on the way of one cell in each direction.
    cells = np.linalg.inv(pairs.swapaxes(0, 1)) @ directions  # (M, 2, B)
    cost_of_first = rates[first, None] * cells[:, 0]  # (M, B)
    cost_of_last = rates[last, None] * cells[:, 1]
    leads_there = (cells > -ROUNDING).all(axis=1)  # (M, B)
    costs = np.where(leads_there, cost_of_first + cost_of_last, np.inf)
    least_rates: Float64 = costs.min(axis=0, initial=np.inf)
    return least_rates


def _lines_of_headings(motions: Motions) -> Iterator[dict[float, float]]:
    """Yield, for each heading, the rate of each line in it by the line's bearing.

    Of several lines with one bearing, the dearest counts.
    """
    rate_of_primitive = [primitive.rate for primitive in _rates_of_primitives(motions)]
    for heading in range(motions.headings):
        lines: dict[float, float] = {}
        for number in np.flatnonzero(motions.start == heading).tolist():
            poses = motions.poses[number]
            dx, dy, _ = poses[-1] - poses[0]
            turned = float(np.abs(np.diff(poses[:, 2])).sum())
            if turned > ON_THE_SPOT or math.hypot(dx, dy) < ON_THE_SPOT:
                continue
            bearing = float(turn_between(poses[0, 2], math.atan2(dy, dx)))
            bearing = round(bearing, DIGITS)
            lines[bearing] = max(lines.get(bearing, 0.0), rate_of_primitive[number])
        yield lines


def least_radius_of(motions: Motions) -> float:
    """Return the radius of a robot's sharpest bend, in cells; infinite without one.

    It is a little greater, so that no curve bends more sharply than a primitive.
    """
    radii = [primitive.radius for primitive in _rates_of_primitives(motions)]
    return min(radii, default=math.inf) * (1 + 1e-3)


def _rates_of_primitives(motions: Motions) -> list[PrimitiveRate]:
    """Return the rate of each of a robot's primitives."""
    costs: list[float] = motions.cost.tolist()
    return list(map(_rate_of_primitive, motions.poses, costs))


def _rate_of_primitive(poses: Poses, cost: float) -> PrimitiveRate:
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
