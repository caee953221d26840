"""What bends, reverse and cusps cost, and motions that know the direction of travel."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

from ddqn_planner.planning.pose_paths import rate_of_slide
from ddqn_planner.robot.directions import (
    CUSP,
    cusps_before,
    directions_of_travel,
    with_directions,
)
from ddqn_planner.robot.driving_costs import DrivingCosts, rates_of, with_costs
from ddqn_planner.robot.motions import Motion, Motions, driven_length, make_motions

CELL = 0.1


def motions_of(motion: str, **costs: Any) -> Motions:
    made = make_motions(motion, 0.5, CELL)
    return with_costs(made, DrivingCosts(**costs), is_lattice=False)


@pytest.mark.parametrize("motion", Motion)
def test_each_kind_of_drive_costs_what_is_given(motion: str) -> None:
    plain = rates_of(make_motions(motion, 0.5, CELL))
    assert (plain.ahead, plain.bend_ahead, plain.behind) == pytest.approx((1, 1, 2))
    rates = rates_of(motions_of(motion, bend=1.2, reverse=3, cusp=0.7, spin=0.6))
    assert rates.ahead == pytest.approx(1)
    assert rates.bend_ahead == pytest.approx(1.2)
    assert (rates.behind, rates.bend_behind) == pytest.approx((3, 3.6))
    assert rates.spin == pytest.approx(1.2 * plain.spin)  # 0.6 and 0.5 m a radian
    assert rates.cusp == pytest.approx(7)  # cells of 0.1 m
    assert rates.aside == pytest.approx(3 if motion == "omnidirectional" else np.inf)


@pytest.mark.parametrize("reverse", [1, 2])
def test_a_line_in_a_held_heading_costs_what_the_motions_to_its_end_do(
    reverse: float,
) -> None:
    """In the heading in which these cost most: never less, and little more."""
    motions = motions_of("omnidirectional", reverse=reverse)
    slide = rates_of(motions).slide
    for bearing in np.linspace(-np.pi, np.pi, 50):
        least = [
            least_cost_of_lines(motions, heading, bearing)
            for heading in range(motions.headings)
        ]
        rate = rate_of_slide(bearing, slide)
        assert max(least) * (1 - 1e-6) <= rate <= max(least) * 1.005


def least_cost_of_lines(motions: Motions, heading: int, bearing: float) -> float:
    """The least cost of a way of one cell in a direction, by linear programming."""
    is_line = (motions.start == heading) & (motions.end == heading)
    offset = motions.offset[is_line]  # (L, 2)
    is_line[is_line] = offset.any(axis=1)
    direction = motions.angles[heading] + bearing
    way = [np.cos(direction), np.sin(direction)]
    result = linprog(motions.cost[is_line], A_eq=motions.offset[is_line].T, b_eq=way)
    return float(result.fun)


@pytest.mark.parametrize("motion", ["ackermann", "differential"])
def test_a_robot_that_cannot_move_sideways_has_no_such_lines(motion: str) -> None:
    assert not len(rates_of(motions_of(motion)).slide)


def test_by_default_bends_and_cusps_cost_something_and_bends_of_lattices_do_not() -> (
    None
):
    made = make_motions("ackermann", 0.5, CELL)
    assert rates_of(motions_of("ackermann")).bend_ahead == pytest.approx(1.15)
    of_lattice = with_costs(made, DrivingCosts(), is_lattice=True)
    assert np.array_equal(of_lattice.cost, made.cost)
    assert rates_of(of_lattice).cusp == pytest.approx(20)
    given = with_costs(made, DrivingCosts(bend=1.3), is_lattice=True)
    assert rates_of(given).bend_ahead == pytest.approx(1.3)


@pytest.mark.parametrize(
    ("costs", "words"),
    [
        ({"bend": 0.9}, "the cost of bends is 0.9; .*1 to 100"),
        ({"reverse": 0}, "the cost of reverse is 0; .*1 to 100"),
        ({"cusp": -1}, "the cost of a cusp is -1; .*metres"),
        ({"cusp": float("nan")}, "the cost of a cusp is nan"),
        ({"spin": 0.4}, "the cost of turns is 0.4; .*0.5 to 50"),
        ({"bend": "much"}, "the cost of bends is 'much'"),
    ],
)
def test_costs_that_lower_bounds_cannot_rely_on_are_refused(
    costs: dict[str, Any], words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        motions_of("ackermann", **costs)


@pytest.mark.parametrize("motion", Motion)
def test_directed_motions_are_the_robot_s_and_cusps(motion: str) -> None:
    motions = motions_of(motion)
    directed, primitive, directions = with_directions(motions)
    assert directions == 2
    assert np.array_equal(directed.angles[::2], motions.angles)
    assert np.array_equal(directed.angles[1::2], motions.angles)
    is_cusp = primitive == CUSP
    assert is_cusp.sum() == 2 * motions.headings
    kept = primitive[~is_cusp]
    assert np.array_equal(directed.start[~is_cusp] // 2, motions.start[kept])
    assert np.array_equal(directed.end[~is_cusp] // 2, motions.end[kept])
    assert np.array_equal(directed.cost[~is_cusp], motions.cost[kept])
    # A drive ahead or in reverse occurs once, in its direction; others in both.
    for number, poses in enumerate(motions.poses):
        layers = sorted((directed.start[primitive == number] % 2).tolist())
        direction = np.sign(directions_of_travel(poses).sum())
        assert layers == {1: [0], -1: [1], 0: [0, 1]}[int(direction)]
    # A cusp changes the direction alone.
    assert np.array_equal(directed.end[is_cusp], directed.start[is_cusp] ^ 1)
    assert not directed.offset[is_cusp].any()
    assert directed.cost[is_cusp] == pytest.approx(motions.cusp)
    assert with_directions(motions_of(motion, cusp=0)).directions == 1


def test_cusps_are_counted_also_with_a_turn_on_the_spot_between() -> None:
    forth = [(0, 0, 0), (1, 0, 0)]
    turned = [(1, 0, 0.5), (1, 0, 0)]
    back = [(0, 0, 0), (0.5, 0, 0), (0, 0, 0)]
    directions = directions_of_travel(np.array([*forth, *turned, *back], np.float64))
    assert directions.tolist() == [1, 0, 0, -1, 1, -1]
    assert cusps_before(directions).tolist() == [0, 0, 0, 0, 1, 2, 3]
    assert cusps_before(np.empty(0, np.int64)).tolist() == [0]


def test_no_motion_costs_less_than_its_way() -> None:
    for motion in Motion:
        motions = motions_of(motion, bend=1, reverse=1)
        for poses, cost in zip(motions.poses, motions.cost.tolist(), strict=True):
            assert cost >= driven_length(poses) * (1 - 1e-6)
