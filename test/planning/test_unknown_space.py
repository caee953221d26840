"""Plans without a path name unknown space where it is the reason, and only there."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddqn_planner import GridMap, Planner, PlanStatus, inflate, load_map
from ddqn_planner.cli import main
from ddqn_planner.grid.inflation import grid_from_costmap
from ddqn_planner.planning.plan import Explanation
from ddqn_planner.planning.unknown_space import REMEDY

FREE, WALL, UNKNOWN = 0, 100, -1
START, GOAL = (2, 5), (27, 5)


@pytest.fixture(scope="module")
def planner() -> Planner:
    return Planner.load("any_map")


def hall(**values: int) -> np.ndarray:
    """(11, 30) int8: a hall whose middle column and places of start and goal have
    values.
    """
    hall = np.full((11, 30), FREE, dtype=np.int8)
    hall[:, 15] = values.get("across", FREE)
    hall[4:7, :5] = values.get("start", FREE)
    hall[4:7, 25:] = values.get("goal", FREE)
    return hall


def grid_of(radius: float = 0.0, **values: int) -> GridMap:
    return inflate(GridMap.from_occupancy_values(hall(**values)), radius)


THROUGH = (
    "no path leads from the start to the goal, but a path leads through unknown space"
)
IN_UNKNOWN, BUT = "lies in unknown space", ", but a path leads through unknown space"
NEAR = "the goal is nearer to unknown space than the robot's body allows"


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"start": UNKNOWN}, f"the start lies in unknown space; {REMEDY}"),
        ({"goal": UNKNOWN}, f"the goal lies in unknown space; {REMEDY}"),
        ({"across": UNKNOWN}, f"{THROUGH}; {REMEDY}"),
        ({"start": WALL}, "the start is occupied"),
        ({"goal": WALL, "across": UNKNOWN}, "the goal is occupied"),
        ({"across": WALL}, "no path leads from the start to the goal"),
        ({}, "succeeded"),
    ],
)
@pytest.mark.parametrize("radius", [0.0, 2.0])
def test_unknown_space_is_named(
    planner: Planner, values: dict[str, int], reason: str, radius: float
) -> None:
    plan = planner.plan(grid_of(radius, **values), START, GOAL)
    assert plan.reason == reason
    free = GridMap.from_occupancy_values(hall(**values), allow_unknown=True)
    freed = planner.plan(inflate(free, radius), START, GOAL)
    is_closed_by_unknown = REMEDY in reason
    assert (freed.status is PlanStatus.SUCCEEDED) == (
        is_closed_by_unknown or not values
    )


def test_too_near_to_unknown_space_is_no_obstacle(planner: Planner) -> None:
    values = hall()
    values[5, 29] = UNKNOWN
    raw = GridMap.from_occupancy_values(values)
    assert planner.plan(raw, START, GOAL).status is PlanStatus.SUCCEEDED
    near = planner.plan(inflate(raw, 2.5), START, GOAL)
    assert near.status is PlanStatus.GOAL_OCCUPIED
    assert near.reason == f"{NEAR}; {REMEDY}"
    assert planner.plan(inflate(raw, 2.0), START, GOAL).status is PlanStatus.SUCCEEDED
    values[7, 27] = WALL  # as near: to map what is unknown would not help
    both = inflate(GridMap.from_occupancy_values(values), 2.5)
    assert planner.plan(both, START, GOAL).reason == "the goal is occupied"
    values[7, 27], values[8, 28] = FREE, WALL  # not as near
    both = inflate(GridMap.from_occupancy_values(values), 2.5)
    assert planner.plan(both, START, GOAL).reason == f"{NEAR}; {REMEDY}"


def test_a_gap_that_the_body_does_not_fit_through_is_no_way(planner: Planner) -> None:
    values = hall(across=WALL)
    values[4:7, 15] = UNKNOWN
    raw = GridMap.from_occupancy_values(values)
    assert planner.plan(inflate(raw, 1.5), START, GOAL).reason.startswith(THROUGH)
    too_wide = planner.plan(inflate(raw, 2.5), START, GOAL)
    assert too_wide.reason == "no path leads from the start to the goal"


def test_a_goal_may_move_only_through_unknown_space(planner: Planner) -> None:
    grid = grid_of(across=UNKNOWN, goal=WALL)
    plan = planner.plan(grid, START, GOAL, tolerance=4.0)
    assert plan.status is PlanStatus.GOAL_OCCUPIED
    assert (
        plan.reason
        == f"the goal is occupied, but a path leads through unknown space; {REMEDY}"
    )
    assert (
        planner.plan(grid, START, GOAL, tolerance=1.0).reason == "the goal is occupied"
    )
    in_unknown = planner.plan(grid_of(goal=UNKNOWN), START, GOAL, tolerance=4.0)
    assert in_unknown.status is PlanStatus.SUCCEEDED


def test_each_of_several_goals_is_named(planner: Planner) -> None:
    grid = grid_of(goal=UNKNOWN, start=WALL)
    goals = [(3, 5), GOAL, (99, 5), (26, 5)]
    plan = planner.plan_nearest(grid, (10, 5), goals)
    assert plan.reason == (
        "goal 1 is occupied, goal 2 lies in unknown space, "
        f"goal 3 lies outside the map, goal 4 lies in unknown space; {REMEDY}"
    )
    through = planner.plan_through(grid, (10, 5), [(12, 5), GOAL])
    assert through.reason == f"goal 2 of 2: the goal lies in unknown space; {REMEDY}"
    assert through.goal == GOAL
    assert (
        planner.plan_through(grid, (10, 5), [(99, 5)]).reason
        == "the goal lies outside the map"
    )
    many = planner.plan_nearest(grid, (10, 5), [GOAL] * 7)
    assert many.reason.startswith("goal 1 lies")
    assert "goal 5 lies in unknown space, ...;" in many.reason
    late = planner.plan_nearest(grid, (10, 5), [*5 * [(3, 5)], GOAL, (3, 5)])
    occupied = ", ".join(f"goal {number} is occupied" for number in range(1, 5))
    assert late.reason == f"{occupied}, goal 6 lies in unknown space, ...; {REMEDY}"


@pytest.mark.parametrize(
    ("across", "goals", "reason"),
    [
        (
            UNKNOWN,
            [(15, 2), GOAL],
            f"goal 1 {IN_UNKNOWN}, no path leads to goal 2{BUT}; {REMEDY}",
        ),
        (WALL, [(15, 2), GOAL], "goal 1 is occupied, no path leads to goal 2"),
        (
            WALL,
            [GOAL, (15, 2), (28, 2)],
            "goal 2 is occupied, no path leads to goals 1, 3",
        ),
        (WALL, [(99, 5), (15, 2)], "goal 1 lies outside the map, goal 2 is occupied"),
        (
            WALL,
            [(99, 5), (-1, 2)],
            "goal 1 lies outside the map, goal 2 lies outside the map",
        ),
    ],
)
def test_each_of_several_goals_has_its_own_reason(
    planner: Planner, across: int, goals: list[tuple[int, int]], reason: str
) -> None:
    plan = planner.plan_nearest(grid_of(across=across), START, goals)
    assert plan.reason == reason
    grid = GridMap(
        np.array(hall(across=across) != FREE)
    )  # it does not know what is unknown
    occupied = (
        reason.replace(IN_UNKNOWN, "is occupied")
        .replace(BUT, "")
        .removesuffix(f"; {REMEDY}")
    )
    assert planner.plan_nearest(grid, START, goals).reason == occupied


def test_a_start_that_leaves_an_obstacle(planner: Planner) -> None:
    deep = grid_of(start=UNKNOWN)
    plan = planner.plan(deep, START, GOAL, start_clearing_radius=0.5)
    assert plan.reason == f"the start lies in unknown space; {REMEDY}"
    left = planner.plan(deep, START, GOAL, start_clearing_radius=1.0)
    assert left.status is PlanStatus.SUCCEEDED


def test_costmaps_name_unknown_space_but_not_what_is_inscribed(
    planner: Planner,
) -> None:
    for value, reason in (
        (UNKNOWN, f"the goal lies in unknown space; {REMEDY}"),
        (99, "the goal is occupied"),
        (100, "the goal is occupied"),
    ):
        assert (
            planner.plan(grid_from_costmap(hall(goal=value)), START, GOAL).reason
            == reason
        )
    closed = hall(across=UNKNOWN)
    assert (
        planner.plan(grid_from_costmap(closed), START, GOAL).reason
        == f"{THROUGH}; {REMEDY}"
    )
    closed[:, 14:17] = 99, UNKNOWN, 99
    inscribed = planner.plan(grid_from_costmap(closed), START, GOAL)
    assert inscribed.reason == "no path leads from the start to the goal"


def test_a_reason_is_made_of_its_parts(planner: Planner) -> None:
    remedy = {"remedy": REMEDY}
    occupied, unknown = (grid_of(goal=value) for value in (WALL, UNKNOWN))
    in_unknown, to_goal_2 = f"the goal {IN_UNKNOWN}", "goal 2 of 2: the goal"
    for plan, explanation in (
        (planner.plan(grid_of(), START, GOAL), Explanation("succeeded")),
        (planner.plan(occupied, START, GOAL), Explanation("the goal is occupied")),
        (planner.plan(unknown, START, GOAL), Explanation(in_unknown, **remedy)),
        (
            planner.plan_nearest(unknown, START, [GOAL, GOAL]),
            Explanation(f"goal 1 {IN_UNKNOWN}, goal 2 {IN_UNKNOWN}", **remedy),
        ),
        (
            planner.plan_through(unknown, START, [(3, 5), GOAL]),
            Explanation(f"{to_goal_2} {IN_UNKNOWN}", **remedy),
        ),
    ):
        assert plan.explanation == explanation
        assert plan.reason == str(explanation)


def test_plans_of_one_outcome_are_equal_whatever_their_reason(planner: Planner) -> None:
    plan = planner.plan(grid_of(goal=UNKNOWN), START, GOAL)
    assert plan == replace(plan, reason="another")
    assert replace(plan, reason="").reason == "the goal is occupied"


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1.0, 1.5, 2.3]))
def test_unknown_space_is_named_exactly_if_there_is_a_path_without_it(
    seed: int, radius: float
) -> None:
    random = np.random.default_rng(seed)
    values = random.choice(
        [FREE, FREE, FREE, FREE, FREE, WALL, UNKNOWN], (9, 12)
    ).astype(np.int8)
    start, goal = (tuple(random.integers(0, (12, 9)).tolist()) for _ in range(2))
    planner = Planner.load("any_map")
    grids = [
        inflate(GridMap.from_occupancy_values(values, allow_unknown=allow), radius)
        for allow in (False, True)
    ]
    plan, free = (planner.plan(grid, start, goal) for grid in grids)
    is_named = plan.reason.endswith(REMEDY)
    if plan.status is PlanStatus.NO_PATH:
        assert is_named == (free.status is PlanStatus.SUCCEEDED)
    elif plan.status is PlanStatus.GOAL_OCCUPIED:
        is_unknown = values[goal[::-1]] == UNKNOWN  # and perhaps near an obstacle
        assert is_named == (is_unknown or grids[1].is_free(goal))
    elif plan.status is PlanStatus.START_OCCUPIED:
        assert is_named == (values[start[::-1]] == UNKNOWN)
    else:
        assert not is_named


def test_a_map_knows_its_unknown_cells() -> None:
    values = hall(across=UNKNOWN, goal=WALL)
    grid = GridMap.from_occupancy_values(values)
    np.testing.assert_array_equal(grid.unknown, values == UNKNOWN)  # type: ignore[arg-type]
    assert GridMap.from_occupancy_values(values, allow_unknown=True).unknown is None
    assert GridMap.from_occupancy_values(hall()).unknown is None
    mapped = grid.with_patch(np.zeros((11, 1), np.bool_), 15, 0)
    assert mapped.unknown is not None
    assert not mapped.unknown.any()
    patch = np.ones((1, 2), np.bool_)
    patched = GridMap.from_occupancy_values(hall()).with_patch(
        patch, 3, 2, unknown=[[True, False]]
    )
    assert patched.unknown is not None
    assert np.argwhere(patched.unknown).tolist() == [[2, 3]]
    free = np.zeros((2, 2), np.bool_)
    with pytest.raises(ValueError, match="unknown cells are free"):
        GridMap(free, unknown=~free)
    for radius in (-0.1, np.nan, np.inf):
        with pytest.raises(ValueError, match="body_radius"):
            GridMap(free, body_radius=radius)


# Bodies


@pytest.fixture(scope="module")
def car() -> Planner:
    return Planner.load("car")


def body_hall(
    across: int = FREE, start: int = FREE, goal: int = FREE, beside: int = FREE
) -> Any:
    values = np.full((80, 160), FREE, dtype=np.int8)
    values[:, 80] = across
    values[40, 28] = start
    values[40, 138] = goal
    values[5, 20] = beside
    return GridMap.from_occupancy_values(values, 0.05)


POSES = (1.25, 2.0, 0.0), (6.75, 2.0, 0.0)


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        (
            {"start": UNKNOWN},
            "the start is so near to unknown space that the robot's body touches",
        ),
        (
            {"goal": UNKNOWN},
            "the goal is so near to unknown space that the robot's body touches",
        ),
        ({"across": UNKNOWN}, THROUGH),
        ({"start": WALL}, "the start is occupied"),
        ({"goal": WALL}, "the goal is occupied"),
        ({"goal": WALL, "across": UNKNOWN}, "the goal is occupied"),
        ({"across": WALL}, "no path leads from the start to the goal"),
        ({"across": WALL, "goal": UNKNOWN}, "the goal is so near to unknown space"),
    ],
)
def test_unknown_space_that_a_body_touches_is_named(
    car: Planner, values: dict[str, int], reason: str
) -> None:
    plan = car.plan_poses(body_hall(**values), *POSES)
    assert not plan.poses.size
    assert plan.reason.startswith(reason)
    assert plan.reason.endswith(REMEDY) == ("unknown" in reason)
    assert (
        plan.reason in (reason, plan.reason)
        if "unknown" in reason
        else plan.reason == reason
    )


def test_a_body_has_its_own_model_and_map(car: Planner) -> None:
    grid = body_hall()
    with pytest.raises(ValueError, match="use plan_poses, or a planner_node"):
        car.plan(grid, (28, 40), (138, 40))
    outside = car.plan_poses(grid, POSES[0], (99.0, 2.0, 0.0))
    assert outside.reason.startswith("the goal lies outside the map")


@pytest.mark.parametrize("to_goals", [{}, {"tolerance": (0.2, 0.1)}])
def test_what_lies_between_a_body_and_its_goals_is_named(
    car: Planner, to_goals: dict[str, Any]
) -> None:
    start, goal = POSES
    for across, words in ((UNKNOWN, ", but a path leads through unk"), (WALL, "")):
        grid = body_hall(across, beside=UNKNOWN)
        one = car.plan_poses(grid, start, goal, **to_goals).reason
        assert one.startswith(f"no path leads from the start to the goal{words}")
        several = car.plan_poses(grid, start, [goal, (6.5, 2.0, 0.0)]).reason
        assert several.startswith(f"no path leads to goals 1, 2{words}")
        assert all(("unknown" in reason) == bool(words) for reason in (one, several))


def test_the_goals_of_a_body_are_numbered(car: Planner) -> None:
    grid = body_hall(goal=UNKNOWN)
    plan = car.plan_poses(grid, POSES[0], [(99.0, 2.0, 0.0), POSES[1], (6.9, 2.0, 0.0)])
    assert plan.reason.startswith(
        "goal 1 lies outside the map, goal 2 is so near to unknown space"
    )
    assert "goal 3 lies in unknown space" in plan.reason


# The console


def test_the_console_names_unknown_space(
    tmp_path: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from map_files import save_map

    from ddqn_planner.grid import MapFile

    path = tmp_path / "hall.yaml"
    save_map(MapFile(hall(goal=UNKNOWN), 0.05), path)
    assert load_map(path).unknown is not None
    ends = ["--start", *map(str, START), "--goal", *map(str, GOAL)]
    assert main(["plan", str(path), *ends]) == 1
    assert (
        f"no path: the goal lies in unknown space; {REMEDY}" in capsys.readouterr().err
    )
    assert main(["plan", str(path), *ends, "--json"]) == 1
    answer = json.loads(capsys.readouterr().out)
    assert (answer["status"], answer["reason"]) == (
        "GOAL_OCCUPIED",
        f"the goal lies in unknown space; {REMEDY}",
    )
    assert main(["plan", str(path), *ends, "--allow-unknown"]) == 0
