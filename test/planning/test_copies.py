"""Planners and what they give, pickled and copied; and dropped, without the
collector.
"""

import copy
import gc
import pickle
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from networks import ANY_MAP, new_planner, robot_model
from strategies import GRIDS, Place

from ddqn_planner import Experience, GridMap, MoveRule, Plan, Planner
from ddqn_planner.planning import PlanRequest, QField
from ddqn_planner.planning.plan import PosePlan
from ddqn_planner.planning.pose_planner import PoseRequest

CELL = 0.1
COPIES: dict[str, Callable[[Any], Any]] = {
    "pickle": lambda original: pickle.loads(pickle.dumps(original)),
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
}
COPY = pytest.mark.parametrize("make_copy", COPIES.values(), ids=COPIES)


def walls() -> GridMap:
    """A map of two rooms with costs."""
    occupancy = np.zeros((30, 40), dtype=bool)
    occupancy[:22, 20] = True
    cost = np.random.default_rng(0).integers(-1, 100, occupancy.shape)
    return GridMap(occupancy, CELL, cost=cost)


def robot(folder: Path) -> Planner:
    """A planner for a small robot with a body."""
    robot_model(folder / "robot.safetensors", "differential", CELL)
    return Planner.load(folder / "robot.safetensors")


def plan_of(planner: Planner, grid: GridMap) -> Plan:
    if planner.pose_planner is not None:
        return planner.plan_poses(grid, (0.55, 0.55, 0.0), (3.45, 0.55, 0.0))
    return planner.plan(grid, (5, 5), (34, 5))


@pytest.fixture(params=["any_map", "dilemma", "body"])
def planner(request: pytest.FixtureRequest, tmp_path: Path) -> Planner:
    return robot(tmp_path) if request.param == "body" else Planner.load(request.param)


def map_for(planner: Planner) -> GridMap:
    return (
        walls()
        if planner.network.supports((30, 40)) or planner.pose_planner
        else paper_map()
    )


def paper_map() -> GridMap:
    """A map of the size that the paper's network was trained for."""
    return GridMap(np.zeros((20, 20)))


@COPY
def test_a_copy_of_a_planner_plans_as_the_original_before_and_after_a_plan(
    make_copy: Callable[[Any], Any], planner: Planner
) -> None:
    planner.fields.max_bytes = 12_345
    grid, before = map_for(planner), make_copy(planner)
    ends = ((5, 5), (15, 5)) if grid.width == 20 else ()
    plan = planner.plan(grid, *ends) if ends else plan_of(planner, grid)
    after = make_copy(planner)
    for copied in (before, after):
        assert copied.metadata == planner.metadata
        assert copied.fields.max_bytes == 12_345
        assert copied.cell_planner.network is copied.network
        assert (copied.plan(grid, *ends) if ends else plan_of(copied, grid)) == plan
    assert plan.path.size or planner.metadata.network == "paper"


def test_a_process_pool_plans_for_cells_and_for_bodies(tmp_path: Path) -> None:
    of_cells, of_body, grid = new_planner(), robot(tmp_path), walls()
    plan, poses = plan_of(of_cells, grid), plan_of(of_body, grid)
    assert plan.path.size
    assert poses.path.size
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        planned = pool.submit(of_cells.plan, grid, (5, 5), (34, 5))
        of_poses = pool.submit(
            of_body.plan_poses, grid, (0.55, 0.55, 0.0), (3.45, 0.55, 0.0)
        )
        assert planned.result() == plan
        assert of_poses.result() == poses


@COPY
def test_copies_of_maps_and_plans_are_equal_and_read_only(
    make_copy: Callable[[Any], Any], tmp_path: Path
) -> None:
    grid = walls()
    plan, poses = plan_of(new_planner(), grid), plan_of(robot(tmp_path), grid)
    for original in (plan, poses):
        copied = make_copy(original)
        assert copied == original
        assert hash(copied) == hash(original)
        assert not copied.path.flags.writeable
    assert isinstance(poses, PosePlan)
    assert not make_copy(poses).poses.flags.writeable
    copied = make_copy(grid)
    assert copied.same_cells(grid)
    assert copied.fingerprint == grid.fingerprint
    for layer in (copied.occupancy, copied.cost):
        with pytest.raises(ValueError, match="read-only"):
            layer[0, 0] = 1
    with pytest.raises(ValueError, match="read-only"):
        copied.with_patch([[True]], 3, 3).occupancy[0, 0] = True


@COPY
def test_copies_of_requests_experience_and_fields_answer_alike(
    make_copy: Callable[[Any], Any],
) -> None:
    grid, planner = walls(), new_planner()
    request = make_copy(PlanRequest(grid, (5, 5), ((34, 5),), MoveRule.ROBOT_SAFE))
    assert [*planner.steps(request)][-1] == plan_of(planner, grid)
    experience = Experience(0.5)
    seconds = np.arange(0, 30, 0.2)
    experience.record(
        seconds, np.column_stack([0.5 + 0.1 * seconds, np.full(seconds.size, 0.5)])
    )
    timed, its = experience.apply(grid), make_copy(experience).apply(grid)
    assert timed.same_cells(its)
    assert plan_of(planner, make_copy(timed)) == plan_of(planner, timed)  # it explores
    pose_request = PoseRequest(grid, (0.5, 0.5, 0.0), ((3.0, 0.5, 0.0),))
    assert make_copy(pose_request).goals == pose_request.goals


@COPY
@pytest.mark.parametrize("name", ["any_map", "dilemma"])
def test_a_copy_of_a_field_has_its_values_and_paths(
    make_copy: Callable[[Any], Any], name: str
) -> None:
    planner, grid = Planner.load(name), paper_map()
    for field in (
        planner.q_field(grid, (15, 5)),
        planner.q_field(grid, (15, 5)).unmasked(),
    ):
        _ = field.rollout((2, 2)), field.policy
        copied: QField = make_copy(field)
        assert copied.rollout((3, 17)) == field.rollout((3, 17))
        for layer in ("q", "value", "policy", "legal"):
            np.testing.assert_array_equal(getattr(copied, layer), getattr(field, layer))


@given(GRIDS, st.sampled_from([COPIES["pickle"], COPIES["deepcopy"]]), st.booleans())
def test_a_copied_map_is_never_taken_for_its_original_with_a_patch(
    place: Place, make_copy: Callable[[Any], Any], copied_first: bool
) -> None:
    grid, (x, y) = place
    patched = grid.with_patch([[True]], x, y)
    copies = [make_copy(grid), make_copy(grid)]
    others = [copied.with_patch([[True]], x, y) for copied in copies]
    first, second = (patched, others[0]) if copied_first else (others[0], others[1])
    # Each was patched by itself: that one has no patches "since" the other.
    assert first.patches_since(second) is None or grid.occupancy.size < 2
    assert second.patches_since(first) is None or grid.occupancy.size < 2
    assert first.same_cells(second)
    assert not first.same_cells(grid)
    # Copied together, they stay a map and its patch.
    before, after = make_copy((grid, patched))
    assert after.patches_since(before) == patched.patches_since(grid)
    assert np.array_equal(
        np.flatnonzero(before.occupancy != after.occupancy), [y * grid.width + x]
    )


@pytest.fixture
def uncollected() -> Iterator[None]:
    """Without the collector of cycles."""
    gc.disable()
    yield
    gc.enable()


@pytest.mark.usefixtures("uncollected")
@pytest.mark.parametrize("has_planned", [False, True])
def test_a_dropped_planner_is_freed_at_once(
    planner: Planner, has_planned: bool
) -> None:
    dropped = copy.deepcopy(planner)  # the fixture keeps the other
    grid = map_for(dropped)
    _ = str(dropped.network.certificate(dropped.metadata.move_rule))
    if has_planned and grid.width == 20:
        dropped.plan(grid, (5, 5), (15, 5), method="astar_fallback")
        dropped.q_field(grid, (1, 1))
    elif has_planned:
        assert plan_of(dropped, grid).path.size
    parts = [dropped, dropped.network, dropped.fields, dropped.pose_planner]
    references = [weakref.ref(part) for part in parts if part is not None]
    references += [weakref.ref(field) for field in dropped.fields.kept]
    assert len(references) > 3 or not has_planned
    del dropped, parts
    assert [reference() for reference in references] == [None] * len(references)


@pytest.mark.usefixtures("uncollected")
def test_a_map_that_nobody_has_is_freed_at_once() -> None:
    planner = new_planner()
    for _ in range(2):
        grid = walls().with_patch([[True]], 3, 3)
        reference = weakref.ref(grid)
        assert plan_of(planner, grid).path.size
        planner.fields.kept.clear()
        del grid
        assert reference() is None
    assert ANY_MAP.network is planner.network
