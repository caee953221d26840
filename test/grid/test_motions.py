"""Motion primitives and the cells that a body sweeps on them."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from ddqn_planner.grid.footprint import read_footprint, swept_cells
from ddqn_planner.grid.motions import Motion, make_motions, read_lattice, turn_between

ARROW = "[[0.4, 0], [-0.3, 0.3], [-0.1, 0], [-0.3, -0.3]]"
LONG = "[[0.7, 0.2], [-0.2, 0.2], [-0.2, -0.2], [0.7, -0.2]]"


@given(motion=st.sampled_from(Motion), radius=st.floats(0.05, 1.5))
def test_primitives_lead_from_heading_to_heading_and_turn_no_sharper_than_allowed(
    motion: Motion, radius: float
) -> None:
    motions = make_motions(motion, radius, 0.05)
    for start, end, offset, poses in zip(
        motions.start, motions.end, motions.offset, motions.poses, strict=True
    ):
        first, last = motions.angles[[start, end]]
        assert np.abs(turn_between(poses[[0, -1], 2], [first, last])).max() < 1e-9
        assert np.abs(poses[[0, -1], :2] - [[0, 0], offset]).max() < 1e-9
        steps, turns = np.hypot(*np.diff(poses[:, :2].T)), np.abs(np.diff(poses[:, 2]))
        assert steps.max() <= 0.5 + 1e-9
        if offset.any() and motion is Motion.ACKERMANN:
            # A chord is shorter than its arc.
            assert (turns <= steps / (radius / 0.05) * 1.02 + 1e-9).all()


@given(padding=st.floats(1e-3, 0.5))
def test_padding_makes_a_body_larger_on_each_side(padding: float) -> None:
    for footprint in (LONG, "0.2"):
        body, padded = (shapely.Polygon(read_footprint(footprint, by)) for by in (0.0, padding))
        assert padded.buffer(1e-6).contains(body.buffer(padding))
        assert padded.hausdorff_distance(body) <= 1.5 * padding + 1e-6


def test_only_a_car_cannot_turn_on_the_spot_and_all_can_reverse() -> None:
    for motion in Motion:
        motions = make_motions(motion, 0.5, 0.05)
        on_the_spot = ~motions.offset.any(axis=1)
        assert on_the_spot.any() == (motion is not Motion.ACKERMANN)
        ahead = [
            float(poses[1, :2] @ [math.cos(poses[0, 2]), math.sin(poses[0, 2])])
            for poses in motions.poses
        ]
        assert min(ahead) < 0 < max(ahead)


@pytest.mark.parametrize(
    ("how", "problem"),
    [
        (("flying", 0.5, 0.05), "'flying' is unknown; give one of differential"),
        (("ackermann", 0.0, 0.05), "a car cannot turn on the spot: give at least"),
        (("ackermann", 50, 0.05), "is 1000 cells; give at most 100"),
        (("differential", -1, 0.05), "turning radius is -1"),
        (("differential", 0.5, 0), "resolution is 0"),
    ],
)
def test_wrong_motions_are_named(how: Any, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        make_motions(*how)


def test_a_lattice_is_read_as_nav2_writes_it(tmp_path: Path) -> None:
    angles = make_motions("ackermann", 0.5, 0.05).angles.tolist()
    about = {"grid_resolution": 0.05, "heading_angles": angles, "num_of_headings": 16}
    poses = [[0.05, 0.0, 0.0], [0.1, 0.0, 0.0], [0.15, 0.0, 0.0]]
    ahead = {"start_angle_index": 0, "end_angle_index": 0, "trajectory_length": 0.15}
    turn = {"start_angle_index": 15, "end_angle_index": 0, "trajectory_length": 0.0}
    spin = [[0, 0, angles[15]], [0, 0, 6.2], [0, 0, 0.0]]
    primitives = [{**ahead, "poses": poses}, {**turn, "poses": spin}]
    file = tmp_path / "lattice.json"
    file.write_text(json.dumps({"lattice_metadata": about, "primitives": primitives}))
    motions = read_lattice(file)
    assert motions.offset.tolist() == [[3, 0], [0, 0]]
    assert motions.cost[0] == pytest.approx(3)
    assert motions.cost[1] == pytest.approx(math.atan(0.5) * 0.5 / 0.05)
    assert np.ptp(motions.poses[1][:, 2]) == pytest.approx(math.atan(0.5))
    for broken in ("{}", "nothing", json.dumps({"lattice_metadata": about, "primitives": [{}]})):
        file.write_text(broken)
        with pytest.raises(ValueError, match="cannot be read as a lattice"):
            read_lattice(file)


@pytest.mark.parametrize("footprint", [LONG, "0.3", ARROW])
def test_swept_cells_are_those_that_a_polygon_touches(footprint: str) -> None:
    motions, corners = make_motions("differential", 0.3, 0.1), read_footprint(footprint)
    swept = swept_cells(corners, motions)
    reach = swept.shape[-1] // 2
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    cells = shapely.box(x - 0.5, y - 0.5, x + 0.5, y + 0.5)
    body = shapely.Polygon(corners / motions.resolution)
    for number in (0, 4, 11, 30):
        placed = [
            shapely.affinity.translate(
                shapely.affinity.rotate(body, yaw, origin=(0, 0), use_radians=True), x, y
            )
            for x, y, yaw in motions.poses[number]
        ]
        touched = shapely.intersects(cells, shapely.union_all(placed).buffer(-1e-6))
        near = shapely.distance(cells, shapely.union_all(placed)) < 0.25
        assert not (touched & ~swept[number]).any()
        assert not (swept[number] & ~near).any()


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[[1, 2], [3, 4]]", "three or more points"),
        ("a robot", "a robot.*give a radius"),
        ("[[0, 0], [1, 1], [1, 0], [0, 1]]", "cross"),
        ("[[1, 1], [2, 1], [2, 2]]", "does not contain the robot's origin"),
        ("-1", "the radius is -1"),
        ([[0, 1], [math.nan, 2], [1, 2]], "no numbers"),
    ],
)
def test_wrong_footprints_are_named(text: Any, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        read_footprint(text)


def test_a_body_that_is_too_large_for_its_cells_is_refused() -> None:
    with pytest.raises(ValueError, match="give a coarser resolution"):
        swept_cells(read_footprint("8.0"), make_motions("differential", 0.5, 0.05))
