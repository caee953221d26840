"""What users pass in wrongly is named, with a remedy, whatever its kind."""

import json
import math
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ddqn_planner import Experience, GridMap, MoveRule, Planner, inflate, simplify
from ddqn_planner.grid import MapFile
from ddqn_planner.grid.inflation import clearance
from ddqn_planner.grid.noise import scatter_obstacles
from ddqn_planner.planning.path_check import invalid_poses
from ddqn_planner.planning.path_finder import last_step
from ddqn_planner.planning.plan import PlanRequest
from ddqn_planner.robot.footprint import read_footprint
from ddqn_planner.robot.motions import make_motions, read_lattice
from ddqn_planner.training.environment import Scenario

GRID = GridMap(np.zeros((40, 40), np.bool_), 0.05).with_patch(np.ones((2, 2)), 30, 30)
START, GOAL = (0.7, 1.0, 0.0), (1.2, 1.0, 0.0)
CELLS = np.zeros((2, 2), np.int8)
RANDOM = np.random.default_rng(0)
# What stands in for any number, cell, pose, map or file.
KINDS = (
    None,
    "text",
    math.nan,
    math.inf,
    -math.inf,
    -1,
    1e300,
    10**400,
    True,
    2j,
    b"1",
    object(),
)
LISTS: tuple[Any, ...] = (
    [],
    [[]],
    (1,),
    (1, 2, 3, 4),
    {},
    np.array([None]),
    np.array([1, 2]),
    [True, 1],
)


@cache
def cells() -> Planner:
    return Planner.load("any_map")


@cache
def body() -> Planner:
    return Planner.load("differential_robot")


def calls(wrong: Any) -> Iterator[Any]:
    """Yield calls in which one argument is wrong."""
    here, there = (1, 1), (5, 5)
    yield lambda: cells().plan(wrong, here, there)
    yield lambda: cells().plan(GRID, wrong, there)
    yield lambda: cells().plan(GRID, here, wrong)
    yield lambda: cells().plan(GRID, here, there, tolerance=wrong)
    yield lambda: cells().plan(GRID, here, there, start_clearing_radius=wrong)
    yield lambda: cells().plan(GRID, here, there, simplified=wrong)
    yield lambda: cells().plan(GRID, here, there, "robot_safe", wrong)
    yield lambda: cells().plan_nearest(GRID, here, wrong)
    yield lambda: cells().plan_nearest(GRID, here, [wrong])
    yield lambda: cells().plan_through(GRID, here, wrong)
    yield lambda: cells().q_field(GRID, wrong)
    yield lambda: cells().q_field(GRID, here, wrong if wrong is not None else "x")
    yield lambda: cells().q_field(GRID, there).rollout(wrong)
    yield lambda: body().plan_poses(GRID, wrong, GOAL)
    yield lambda: body().plan_poses(GRID, START, wrong)
    yield lambda: body().plan_poses(GRID, START, [wrong])
    yield lambda: body().plan_poses(GRID, START, GOAL, wrong)
    yield lambda: body().plan_poses(GRID, START, GOAL, bound=wrong)
    yield lambda: GRID.reachable(wrong, "corner_cutting")
    yield lambda: GRID.reachable([here], wrong)
    yield lambda: GRID.is_free(wrong)
    yield lambda: GRID.cell_to_world(wrong)
    yield lambda: GRID.world_to_cell(wrong, 1.0)
    yield lambda: GRID.with_patch(wrong, 0, 0)
    yield lambda: GRID.with_patch([[True]], wrong, 0)
    yield lambda: GridMap(wrong)
    yield lambda: GridMap(np.zeros((2, 2), np.bool_), resolution=wrong)
    yield lambda: GridMap(np.zeros((2, 2), np.bool_), origin=wrong)
    yield lambda: GridMap.from_occupancy_values(
        np.zeros((2, 2)), occupied_threshold=wrong
    )
    yield lambda: GRID.with_layers(body_radius=wrong)
    yield lambda: MapFile(wrong)
    yield lambda: MapFile(CELLS, resolution=wrong)
    yield lambda: MapFile(CELLS, origin=wrong)
    yield lambda: MapFile(CELLS, start=wrong)
    yield lambda: MapFile(CELLS, goal=wrong)
    yield lambda: MapFile(CELLS, forbidden=wrong)
    yield lambda: inflate(wrong, 0.1)
    yield lambda: inflate(GRID, wrong)
    yield lambda: inflate(GRID, 0.1, wrong)
    yield lambda: simplify(wrong, GRID, "corner_cutting")
    yield lambda: simplify([here, there], wrong, "corner_cutting")
    yield lambda: simplify([here, there], GRID, wrong)
    yield lambda: Experience(wrong)
    yield lambda: Experience(0.5, robot_width=wrong)
    yield lambda: Experience(0.5, half_life=wrong)
    yield lambda: Experience(0.5, max_pause=wrong)
    yield lambda: Experience(0.5).merge(wrong)
    yield lambda: Experience(0.5).apply(wrong)
    yield lambda: Experience(0.5).apply(GRID, wrong)
    yield lambda: Experience(0.5).record([0, 1], wrong)
    yield lambda: Experience(0.5).record(wrong, [here, there])
    yield lambda: Experience(0.5).record_failure(wrong)
    yield lambda: Experience(0.5).expected_time(wrong, [here, there])
    yield lambda: Experience(0.5).expected_time(GRID, wrong)
    yield lambda: make_motions(wrong, 0.5, 0.05)
    yield lambda: make_motions("differential", wrong, 0.05)
    yield lambda: make_motions("differential", 0.5, wrong)
    yield lambda: read_footprint(wrong)
    yield lambda: read_footprint(0.2, wrong)
    yield lambda: Scenario(wrong, here, there)
    yield lambda: Scenario(GRID, wrong, there)
    yield lambda: Scenario(GRID, here, wrong)
    yield lambda: Scenario(GRID, here, there, wrong)
    yield lambda: clearance(wrong)
    yield lambda: scatter_obstacles(
        wrong, [here, there], MoveRule.CORNER_CUTTING, RANDOM
    )
    yield lambda: scatter_obstacles(GRID, wrong, MoveRule.CORNER_CUTTING, RANDOM)
    yield lambda: scatter_obstacles(GRID, [here, there], wrong, RANDOM)
    yield lambda: scatter_obstacles(
        GRID, [here, there], MoveRule.CORNER_CUTTING, RANDOM, wrong
    )


@pytest.mark.parametrize("wrong", [*KINDS, *LISTS], ids=lambda wrong: repr(wrong)[:20])
def test_each_error_about_a_wrong_kind_is_a_value_error_with_a_remedy(
    wrong: Any,
) -> None:
    unclear = []
    for number, call in enumerate(calls(wrong)):
        try:
            call()  # some kinds are right for some arguments
        except ValueError as error:
            if not re.search("give |; use |; cut it", str(error)):
                unclear.append((number, str(error)))
    assert not unclear


@pytest.mark.parametrize(
    ("tolerance", "said"),
    [(0.5, "0.5"), ((1,), r"\(1,\)"), ("12", "'12'"), ((0, -1), "-1")],
)
def test_a_tolerance_of_poses_is_two_numbers(tolerance: Any, said: str) -> None:
    with pytest.raises(
        ValueError, match=rf"tolerance is {said}; give two numbers \(metres, rad"
    ):
        body().plan_poses(GRID, START, GOAL, tolerance)


@pytest.mark.parametrize("bound", [math.inf, 1e300, 10**400, 1e6])
def test_any_path_is_within_an_infinite_bound(bound: float) -> None:
    walled = GridMap(np.zeros((80, 80), np.bool_), 0.05).with_patch(
        np.ones((20, 2)), 40, 30
    )
    least = body().plan_poses(walled, (1, 1, 0), (3, 3, 1), bound=1.0)
    planned = Planner.load("differential_robot").plan_poses(
        walled, (1, 1, 0), (3, 3, 1), bound=bound
    )
    assert planned.poses.size
    assert least.cost is not None
    assert planned.cost is not None
    assert least.cost <= planned.cost <= planned.bound * least.cost * 1.001
    closed = walled.with_patch(np.ones((80, 2)), 40, 0)
    assert not body().plan_poses(closed, (1, 1, 0), (3, 3, 1), bound=bound).poses.size


def test_a_model_with_a_body_has_no_q_field_of_cells() -> None:
    with pytest.raises(ValueError, match="no Q field of cells; use plan_poses"):
        body().q_field(GRID, (1, 1))


def test_no_path_is_sought_from_an_occupied_cell() -> None:
    with pytest.raises(
        ValueError, match=r"the cell \(30, 31\) is occupied; give free cells"
    ):
        GRID.reachable([(1, 1), (30, 31)], "corner_cutting")


def lattice() -> dict[str, Any]:
    """A lattice with a primitive straight ahead, and turns on the spot to each
    heading.
    """
    angles = make_motions("ackermann", 0.5, 0.05).angles.tolist()
    about = {"grid_resolution": 0.05, "heading_angles": angles, "num_of_headings": 16}
    ahead = {"start_angle_index": 0, "end_angle_index": 0, "trajectory_length": 0.15}
    ahead["poses"] = [[0.05, 0.0, 0.0], [0.15, 0.0, 0.0]]  # type: ignore[assignment]
    turns = [
        {
            "start_angle_index": start,
            "end_angle_index": (start + 1) % 16,
            "trajectory_length": 0.0,
            "poses": [[0.0, 0.0, angles[(start + 1) % 16]]],
        }
        for start in range(16)
    ]
    return {"lattice_metadata": about, "primitives": [ahead, *turns]}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"heading_angles": [0.1] * 15}, "it has 15 headings; give one of 16, "),
        (
            {"heading_angles": [math.nan] * 16},
            "heading_angles holds nan; give finite radians",
        ),
        ({"heading_angles": [True] * 16}, "heading_angles holds True; give numbers"),
        ({"heading_angles": "north"}, "heading_angles.*give numbers"),
        ({"num_of_headings": -16}, "num_of_headings is -16; give 16"),
        ({"num_of_headings": 10**12}, "num_of_headings is 1000000000000; give 16"),
        ({"grid_resolution": 0}, "grid_resolution is 0; give metres per cell"),
        ({"grid_resolution": True}, "grid_resolution is True; give metres per cell"),
        ({"grid_resolution": "0.05"}, "grid_resolution is '0.05'; give metres"),
        (
            {"grid_resolution": 1e300},
            r"grid_resolution is 1e\+300; give metres per cell, 0.001 to",
        ),
        (
            {"start_angle_index": 16},
            "start_angle_index of primitive 0 is 16; give .* 0 to 15",
        ),
        (
            {"end_angle_index": -1},
            "end_angle_index of primitive 0 is -1; give .* 0 to 15",
        ),
        (
            {"end_angle_index": 0.5},
            "end_angle_index of primitive 0 is 0.5; give a whole number",
        ),
        (
            {"trajectory_length": math.nan},
            "trajectory_length of primitive 0 is nan; give metres",
        ),
        (
            {"trajectory_length": 0.01},
            "trajectory_length of .* is 0.01, .* drive 0.15 m; give",
        ),
        ({"poses": []}, r"the poses of primitive 0 have shape \(0,\); give 1 to"),
        (
            {"poses": [[0.05, 0.0]]},
            r"the poses of primitive 0 have shape \(1, 2\); give",
        ),
        (
            {"poses": [[0.05, 0.0], [0.1]]},
            "the poses of primitive 0: .*give rows of one length",
        ),
        (
            {"poses": [[math.nan, 0, 0]]},
            "the poses of primitive 0 holds nan; give metres",
        ),
        (
            {"poses": [[0.15, 0, math.nan]]},
            "the poses of primitive 0 holds nan; give radians",
        ),
        (
            {"poses": [[0.15, 1e300, 0]]},
            r"the poses of primitive 0 holds 1e\+300; give metres",
        ),
        ({"poses": {"x": 1}}, "the poses of primitive 0.*give numbers"),
        (
            {"grid_resolution": 0.07},
            "off the centres of cells; give a file of the same",
        ),
        ({"primitives": []}, "its primitives are no list of one or more; give a file"),
        ({"primitives": {}}, "its primitives are no list of one or more; give a file"),
        ({"primitives": [3]}, "primitive 0 has no start_angle_index; give a file"),
        (
            {"primitives": lattice()["primitives"][:9]},
            r"starts with the headings \[8, 9.*; give",
        ),
        (
            {"lattice_metadata": {}},
            "lattice_metadata has no grid_resolution; give a file",
        ),
    ],
)
def test_a_wrong_lattice_is_named(tmp_path: Path, changes: Any, reason: str) -> None:
    wrong = lattice()
    for part in (wrong, wrong["lattice_metadata"], wrong["primitives"][0]):
        part |= {key: value for key, value in changes.items() if key in part}
    file = tmp_path / "lattice.json"
    file.write_text(json.dumps(wrong))
    with pytest.raises(
        ValueError, match=f"(?s)lattice {re.escape(str(file))}: .*{reason}"
    ):
        read_lattice(file)


@pytest.mark.parametrize(
    "text",
    ["", "[]", "3", "nothing", "{}", "[" * 10**5, "1" * 5000, "\ud800", '{"a": 1}}'],
)
def test_a_file_that_is_no_lattice_is_named(tmp_path: Path, text: str) -> None:
    file = tmp_path / "lattice.json"
    file.write_bytes(text.encode("utf-8", "surrogatepass"))
    for wrong in (file, tmp_path, tmp_path / "none.json"):
        with pytest.raises(
            ValueError, match=rf"{wrong.name}(:| is) .*; give a (regular )?file"
        ) as raised:
            read_lattice(wrong)
        assert "Error" not in str(raised.value)


def test_a_path_far_beyond_the_map_takes_no_memory() -> None:
    far = [(0, 0), (2 * 10**9, 0)]
    poses = np.array([(*GRID.cell_to_world(cell), 0.0) for cell in (*far, (5, 0))])
    assert invalid_poses(poses, GRID).tolist() == [1]
    request = PlanRequest(
        GRID, (0, 0), ((5, 0),), MoveRule.CORNER_CUTTING, under_way=far
    )
    assert last_step(cells().steps(request)).goal == (5, 0)
