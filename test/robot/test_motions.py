"""Motion primitives and the cells that a body sweeps on them."""

import json
import math
import re
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from ddqn_planner.robot.footprint import inside, read_footprint, swept_cells
from ddqn_planner.robot.motions import (
    OCTANTS,
    Motion,
    make_motions,
    read_lattice,
    turn_between,
)

ARROW = "[[0.4, 0], [-0.3, 0.3], [-0.1, 0], [-0.3, -0.3]]"
FORMS = {
    "U": [
        (0.5, 0.3),
        (0.5, 0.2),
        (0, 0.2),
        (0, -0.2),
        (0.5, -0.2),
        (0.5, -0.3),
        (-0.3, -0.3),
        (-0.3, 0.3),
    ],
    "T": [
        (0.4, 0.3),
        (0.4, -0.3),
        (0.2, -0.3),
        (0.2, -0.1),
        (-0.4, -0.1),
        (-0.4, 0.1),
        (0.2, 0.1),
        (0.2, 0.3),
    ],
    "L": [(0.5, 0.3), (0.1, 0.3), (0.1, 0.1), (-0.3, 0.1), (-0.3, -0.3), (0.5, -0.3)],
    "plus": [
        (0.4, 0.1),
        (0.1, 0.1),
        (0.1, 0.4),
        (-0.1, 0.4),
        (-0.1, 0.1),
        (-0.4, 0.1),
        (-0.4, -0.1),
        (-0.1, -0.1),
        (-0.1, -0.4),
        (0.1, -0.4),
        (0.1, -0.1),
        (0.4, -0.1),
    ],
    "forklift": [
        (1, 0.2),
        (1, 0.1),
        (0.3, 0.1),
        (0.3, -0.1),
        (1, -0.1),
        (1, -0.2),
        (-0.3, -0.2),
        (-0.3, 0.2),
    ],
    "closed": [(0.4, 0.2), (-0.4, 0.2), (-0.4, -0.2), (0.4, -0.2), (0.4, 0.2)],
    "corners twice": [
        (0.4, 0.2),
        (0.4, 0.2),
        (-0.4, 0.2),
        (-0.4, -0.2),
        (-0.4, -0.2),
        (0.4, -0.2),
    ],
    "points on a side": [
        (0.4, 0.2),
        (0.1, 0.2),
        (0, 0.2),
        (-0.4, 0.2),
        (-0.4, -0.2),
        (0.4, -0.2),
    ],
    "origin on a side": [(0, 0.2), (0, -0.2), (0.5, -0.2), (0.5, 0.2)],
    "origin in a corner": [(0, 0), (0.4, 0), (0.4, 0.4), (0, 0.4)],
    "origin outside": [(0.5, 0.2), (0.9, 0.2), (0.9, -0.2), (0.5, -0.2)],
}
LONG = "[[0.7, 0.2], [-0.2, 0.2], [-0.2, -0.2], [0.7, -0.2]]"


@settings(max_examples=25)
@given(
    motion=st.sampled_from(Motion),
    radius=st.floats(0.05, 1.5),
    headings=st.sampled_from([*OCTANTS]),
)
def test_primitives_lead_from_heading_to_heading_and_turn_no_sharper_than_allowed(
    motion: Motion, radius: float, headings: int
) -> None:
    motions = make_motions(motion, radius, 0.05, headings)
    assert motions.headings == headings
    quarter = motions.angles[: headings // 4]
    assert (np.diff(motions.angles) > 0).all()
    np.testing.assert_allclose(
        motions.angles, np.add.outer(np.arange(4) * math.pi / 2, quarter).ravel()
    )
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


@pytest.mark.parametrize("form", FORMS)
def test_footprints_are_taken_in_every_form_that_nav2_takes(form: str) -> None:
    points, expected = FORMS[form], shapely.Polygon(FORMS[form])
    text = str(points).replace("(", "[").replace(")", "]")
    written = (
        text,
        text.replace(",", " "),
        text.replace("], ", "],\n\t"),
        f'"{text}"',
        str(points),
    )
    for footprint in (
        points,
        points[::-1],
        [*map(list, points)],
        np.array(points),
        *written,
    ):
        corners = read_footprint(footprint)
        body = shapely.Polygon(corners)
        assert body.is_valid
        assert body.symmetric_difference(expected).area < 1e-9
        assert np.hypot(*np.diff(corners, axis=0, append=corners[:1]).T).min() > 0.01
    np.testing.assert_array_equal(read_footprint(corners), corners)


@pytest.mark.parametrize(
    "radius", [1, 0.5, "0.5", " .5\n", "5e-1", np.float32(0.5), np.array(0.5)]
)
def test_a_radius_is_a_circle_that_the_body_contains(radius: Any) -> None:
    body = shapely.Polygon(read_footprint(radius))
    assert body.buffer(1e-9).contains(shapely.Point(0, 0).buffer(float(radius)))
    assert body.area < 1.01 * math.pi * float(radius) ** 2


@given(
    points=st.lists(
        st.tuples(st.integers(-3, 3), st.integers(-3, 3)),
        min_size=3,
        max_size=7,
        unique=True,
    )
)
@example(points=[(-2, -1), (0, -2), (-2, 0), (-1, -1), (0, -1)])
def test_every_polygon_without_crossing_sides_is_taken(points: Any) -> None:
    polygon, sides = shapely.Polygon(points), list(pairwise([*points, points[0]]))
    lines = [shapely.LineString(side) for side in sides]
    # Sides cross within both of them, be it at a third side's corner.
    crosses = any(one.crosses(other) for one, other in combinations(lines, 2))
    if crosses or np.linalg.matrix_rank(np.subtract(points[1:], points[0])) < 2:
        with pytest.raises(ValueError, match=r"cross|on one line"):
            read_footprint(points)
    else:
        corners = read_footprint(points)
        if polygon.is_valid:
            assert shapely.Polygon(corners).equals(polygon)
            axes = (
                np.arange(first, 3.4, 0.2618) for first in (-3.31415, -3.2718)
            )  # on no side
            cells = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
            within = shapely.contains_xy(polygon, cells)
            np.testing.assert_array_equal(inside(cells, corners), within)


@given(
    form=st.sampled_from([*FORMS, LONG, "0.2", "triangle"]),
    padding=st.floats(1e-3, 0.5),
)
@example(form="triangle", padding=0.1)  # its tip is cut
@example(form="U", padding=0.3)
def test_padding_makes_a_body_larger_on_each_side(form: str, padding: float) -> None:
    footprint = {"triangle": [(0.9, 0), (-0.2, 0.05), (-0.2, -0.05)], **FORMS}.get(
        form, form
    )
    body = shapely.Polygon(read_footprint(footprint))
    half_gap = {"U": 0.2, "forklift": 0.1}.get(form, np.inf)
    # With just half of the gap, the sides touch, which rounding decides.
    assume(abs(padding / half_gap - 1) > 1e-5)
    if padding > half_gap:
        with pytest.raises(
            ValueError, match=r"padding of .* closes a gap .*; give less"
        ):
            read_footprint(footprint, padding)
        return
    padded = shapely.Polygon(read_footprint(footprint, padding))
    assert padded.is_valid
    assert padded.buffer(1e-6).contains(body.buffer(padding))
    assert padded.hausdorff_distance(body) <= 1.5 * padding + 1e-6


def test_an_outline_that_leads_around_twice_has_the_same_inside() -> None:
    once, points = (
        np.array(FORMS["L"]),
        np.random.default_rng(0).uniform(-0.6, 0.6, (200, 2)),
    )
    twice = read_footprint(np.tile(once, (2, 1)))
    assert 50 < inside(points, once).sum() < 150
    np.testing.assert_array_equal(inside(points, twice), inside(points, once))
    np.testing.assert_array_equal(inside(points, twice[::-1]), inside(points, once))


def test_a_rectangle_is_padded_as_nav2_pads_it() -> None:
    corners = np.array([(0.7, 0.2), (-0.2, 0.2), (-0.2, -0.2), (0.7, -0.2)])
    padded = read_footprint(corners, 0.03)
    np.testing.assert_allclose(padded, corners + 0.03 * np.sign(corners), atol=1e-12)


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
        (("ackermann", 50, 0.05), "is 50 m; give at most 360 cells"),
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
    for start, end in pairwise(range(16)):
        spin = [[0, 0, angles[start]], [0, 0, angles[end]]]
        indices = {"start_angle_index": start, "end_angle_index": end}
        primitives.append({**turn, **indices, "poses": spin})
    file = tmp_path / "lattice.json"
    file.write_text(json.dumps({"lattice_metadata": about, "primitives": primitives}))
    motions = read_lattice(file)
    assert motions.offset.tolist() == [[3, 0]] + [[0, 0]] * 16
    assert motions.cost[0] == pytest.approx(3)
    assert motions.start[-1] == 15
    assert motions.cost[-1] == pytest.approx(math.atan(0.5) * 0.5 / 0.05)
    assert np.ptp(motions.poses[-1][:, 2]) == pytest.approx(math.atan(0.5))


@pytest.mark.parametrize("footprint", [LONG, "0.3", ARROW, *FORMS.values()])
def test_swept_cells_are_those_that_a_polygon_touches(footprint: Any) -> None:
    motions, corners = make_motions("differential", 0.3, 0.1), read_footprint(footprint)
    swept = swept_cells(corners, motions)
    reach = swept.shape[-1] // 2
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    cells = shapely.box(x - 0.5, y - 0.5, x + 0.5, y + 0.5)
    body = shapely.Polygon(corners / motions.resolution)
    for number in (0, 4, 11, 30):
        placed = [
            shapely.affinity.translate(
                shapely.affinity.rotate(body, yaw, origin=(0, 0), use_radians=True),
                x,
                y,
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
        ("[[1, 2], [3, 4]]", "three points that differ"),
        ("a robot", "a robot.*give a radius"),
        ("[[0, 0], [1, 1], [1, 0], [0, 1]]", "cross"),
        ("[[0, 0], [1, 1], [2, 2]]", "on one line; give points around an area"),
        ([(0, 0), (1, 0), (1, 0), (0, 0)], "three points that differ"),
        ("-1", "the radius is -1"),
        (0, "the radius is 0; give 0.001 to 100 metres"),
        (True, "the radius is (True|np.False_|False); give 0.001"),
        (np.False_, "the radius is (True|np.False_|False); give 0.001"),
        ([[True, 1], [0, 1], [1, 0]], "the points holds True; give numbers"),
        ("True", "neither bracket nor number"),
        (math.nan, "the radius is nan"),
        (math.inf, "the radius is inf"),
        (10**400, "the radius is 1000"),
        ("0.3 m", "' m' is neither bracket nor number"),
        (None, "the footprint is None"),
        (2j, "the radius is 2j"),
        ("", "no single list"),
        ("[0.5]", "three or more points"),
        ("[0.3, 0.2, 0.3, -0.2, -0.3, -0.2]", "three or more points"),
        ("[[0.3, 0.2, 0], [0.3, -0.2, 0], [-0.3, -0.2, 0]]", "three or more points"),
        ("[[0.3, 0.2], [0.3], [-0.3, -0.2]]", "give rows of one length"),
        ("[[0.3, 0.2], [0.3, -0.2], [-0.3, -0.2]", "a bracket is not closed"),
        ("[[0.3, 0.2], [0.3, -0.2], [-0.3, -0.2]]]", "a bracket is closed that"),
        ("[" * 9999, "nested too deeply"),
        ([["0.3", "0.2"], ["0.1", "0"], ["0", "0"]], "of type <U3; give numbers"),
        ([[1j, 2], [0, 1], [1, 0]], "of type complex128; give numbers"),
        ([[0, 1], [math.nan, 2], [1, 2]], "no numbers"),
        ([[0, 1], [math.inf, 2], [1, 2]], "no numbers from -100 to 100 metres"),
        ([[0, 1e300], [0, 2], [1, 2]], "no numbers from -100 to 100 metres"),
        (
            [[x, x * x % 97] for x in np.linspace(0, 9, 2000)],
            "2000 corners, and at most 1000",
        ),
    ],
)
def test_wrong_footprints_are_named(text: Any, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        read_footprint(text)


@pytest.mark.parametrize(
    ("footprint", "radius", "resolution"),
    [("8.6", 0.5, 0.05), ("1.5", 17.9, 0.05)],
)
def test_a_body_that_is_too_large_for_its_cells_fits_larger_cells(
    footprint: str, radius: float, resolution: float
) -> None:
    def reach(cell_size: float) -> int:
        """Cells that a disc may sweep to each side, of its longest primitive alone."""
        motions = make_motions("ackermann", radius, cell_size)
        farthest = max(motions.poses, key=lambda poses: np.abs(poses[-1, :2]).max())
        longest = replace(motions, poses=(farthest[[0, -1]],))
        swept = swept_cells(read_footprint(footprint), longest)
        return int(swept.shape[-1]) // 2

    with pytest.raises(ValueError, match=r"sweeps .* cells to a side") as e:
        reach(resolution)
    remedy = re.search(r"give a resolution of ([\d.]+) m", str(e.value))
    assert remedy
    assert 130 < reach(float(remedy[1])) <= 180


def lattice_content() -> dict[str, Any]:
    """A lattice whose robot drives ahead and turns on the spot in each heading."""
    motions = make_motions("differential", 0.5, 0.05)
    angles = motions.angles.tolist()
    primitives = []
    for heading, start in enumerate(angles):
        numbers = np.flatnonzero((motions.start == heading) & (motions.end == heading))
        ahead = max(numbers.tolist(), key=lambda number: -motions.cost[number])
        poses = motions.poses[ahead][1:] * (0.05, 0.05, 1)
        straight = {"start_angle_index": heading, "end_angle_index": heading}
        length = float(motions.cost[ahead]) * 0.05
        primitives.append(
            {**straight, "trajectory_length": length, "poses": poses.tolist()}
        )
        end = (heading + 1) % 16
        turn = {"start_angle_index": heading, "end_angle_index": end}
        spin = [[0, 0, start], [0, 0, angles[end]]]
        primitives.append({**turn, "trajectory_length": 0.0, "poses": spin})
    metadata = {"grid_resolution": 0.05, "heading_angles": angles}
    return {"lattice_metadata": metadata, "primitives": primitives}


def written(folder: Path, lattice: Any) -> Path:
    file = folder / "lattice.json"
    file.write_text(json.dumps(lattice))
    return file


def test_a_lattice_may_be_driven_in_reverse(tmp_path: Path) -> None:
    file = written(tmp_path, lattice_content())
    ahead, both = read_lattice(file), read_lattice(file, allow_reverse=True)
    assert len(both.start) == len(ahead.start) + 16  # turns have no reverse
    rows = {
        (start, end, *offset): cost
        for start, end, offset, cost in zip(
            both.start.tolist(),
            both.end.tolist(),
            both.offset.tolist(),
            both.cost.tolist(),
            strict=True,
        )
    }
    for start, end, (x, y), cost in zip(
        ahead.start.tolist(),
        ahead.end.tolist(),
        ahead.offset.tolist(),
        ahead.cost.tolist(),
        strict=True,
    ):
        assert rows[start, end, x, y] == cost
        if x or y:
            assert rows[end, start, -x, -y] == 2 * cost
    for start, end, offset, poses in zip(
        both.start, both.end, both.offset, both.poses, strict=True
    ):
        first, last = both.angles[[start, end]]
        assert np.abs(turn_between(poses[[0, -1], 2], [first, last])).max() < 1e-6
        assert np.abs(poses[[0, -1], :2] - [[0, 0], offset]).max() < 1e-6


@pytest.mark.parametrize(
    ("name", "value", "problem"),
    [
        ("grid_resolution", 0, "grid_resolution is 0; give metres per cell"),
        ("grid_resolution", -0.05, "grid_resolution is -0.05; give metres per cell"),
        ("grid_resolution", math.nan, "grid_resolution is nan; give metres per cell"),
        ("grid_resolution", None, "grid_resolution is None; give metres per cell"),
        ("grid_resolution", ..., "lattice_metadata has no grid_resolution; give"),
        ("heading_angles", ..., "lattice_metadata has no heading_angles; give"),
        ("heading_angles", [0.1 * n for n in range(16)], "ends with a yaw of .*; give"),
        ("trajectory_length", ..., "primitive 0 has no trajectory_length; give"),
        ("trajectory_length", 0.02, "is 0.02, and its poses drive 0.05 m; give"),
        ("trajectory_length", 1e-9, "is 1e-09, and its poses drive 0.05 m; give"),
        ("trajectory_length", -1, "of primitive 0 is -1; give metres"),
        ("trajectory_length", math.nan, "of primitive 0 is nan; give metres"),
        ("poses", ..., "primitive 0 has no poses; give"),
        ("poses", [], "the poses of primitive 0 have shape .*; give"),
        ("start_angle_index", 16, "start_angle_index of primitive 0 is 16; give"),
    ],
)
def test_a_lattice_without_sense_is_refused_with_the_remedy(
    tmp_path: Path, name: str, value: Any, problem: str
) -> None:
    lattice = lattice_content()
    owner = lattice["lattice_metadata"]
    if name not in owner:
        owner = lattice["primitives"][0]
    owner[name] = value
    if value is ...:
        del owner[name]
    with pytest.raises(ValueError, match=rf"lattice\.json: .*{problem}"):
        read_lattice(written(tmp_path, lattice))


def test_a_turn_on_the_spot_that_costs_nothing_is_refused(tmp_path: Path) -> None:
    lattice = lattice_content()
    lattice["primitives"][1]["trajectory_length"] = 1e-9
    with pytest.raises(ValueError, match=r"of primitive 1 is 1e-09.*; give .* 0 for"):
        read_lattice(written(tmp_path, lattice))
