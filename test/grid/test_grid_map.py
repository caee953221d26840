import copy
import json
import math
import pickle
import re
import reprlib
from dataclasses import fields
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as numpy_st
from scipy.spatial.distance import cdist
from strategies import Data, grids_with_directions, occupancies, shapes

from ddqn_planner.grid import (
    UNKNOWN,
    GridMap,
    MoveRule,
    clearance,
    inflate,
)
from ddqn_planner.grid.arguments import as_cell
from ddqn_planner.grid.boxes import MAX_BOXES, Box, boxes_of, cells_in
from ddqn_planner.grid.inflation import Inflation, grid_from_costmap

ZEROS = np.zeros((2, 3))
origins = st.tuples(*3 * [st.floats(-100, 100)])


@given(occupancies, st.floats(0.01, 10), origins, st.data())
def test_cells_hold_centres(
    occupancy: np.ndarray, resolution: float, origin: Any, data: Data
) -> None:
    grid = GridMap(occupancy, resolution, origin)
    x, y = (data.draw(st.integers(0, side - 1)) for side in (grid.width, grid.height))
    assert grid.world_to_cell(*grid.cell_to_world((x, y))) == (x, y)


def test_a_cell_owns_its_lower_edges_and_the_origin_turns_the_map_to_the_left() -> None:
    grid = GridMap(np.zeros((4, 4)), resolution=0.5, origin=(-1.0, -1.0, 0.0))
    assert grid.world_to_cell(-1.0, -1.0) == (0, 0)
    assert grid.world_to_cell(-0.5, -0.75) == (1, 0)
    outside = (
        grid.world_to_cell(1.0, 0.0),
        grid.world_to_cell(math.nextafter(-1.0, -2.0), 0.0),
    )
    assert not any(map(grid.contains, [*outside, (-1, 0), (0, -1), (4, 0), (0, 4)]))
    assert all(map(grid.contains, [(0, 0), (3, 3)]))
    turned = GridMap(ZEROS, resolution=1.0, origin=(10.0, 20.0, math.pi / 2))
    assert turned.cell_to_world((2, 0)) == pytest.approx((9.5, 22.5))
    assert turned.world_to_cell(9.5, 22.5) == (2, 0)


@pytest.mark.parametrize(
    "cell",
    [
        (2, 1),
        [2, 1],
        np.array([2, 1]),
        (np.int64(2), np.uint8(1)),
        (2.0, 1),
        (Fraction(2), 1.0),
    ],
)
def test_a_cell_is_any_pair_of_whole_numbers(cell: Any) -> None:
    assert json.dumps(as_cell(cell)) == "[2, 1]"
    for occupied in (False, True):
        grid = GridMap(ZEROS).with_patch([[occupied]], 2, 1)
        assert grid.contains(cell)
        assert (grid.is_free(cell), grid.is_obstacle(cell)) == (not occupied, occupied)
    for wrong in ((0, None), (0, True), [np.True_, 0]):
        said = re.escape(f"the cell is {reprlib.repr(wrong)}; give two whole numbers")
        with pytest.raises(ValueError, match=said):
            grid.contains(wrong)


MALFORMED: list[tuple[str, list[Any], str]] = [
    ("occupancy", [np.zeros((0, 3)), np.zeros(3)], "has shape"),
    ("occupancy", [[[0.2]], [[math.nan]]], r"holds (0\.2|nan); give True or False"),
    ("resolution", [0.0, math.nan], r"is (0\.0|nan); give metres"),
    ("origin", [(0.0, math.inf, 0.0), (0.0, 0.0)], ".*; give"),
    ("cost", [np.zeros((1, 2)), np.zeros(()), np.zeros(6)], "has shape"),
    (
        "cost",
        [np.full((2, 3), n) for n in (-2, 100, 0.7, math.nan)],
        "holds .*numbers -1 to 99",
    ),
    ("cost", [np.full((2, 3), "dear")], ": the elements are of type <U"),
    ("obstacles", [np.eye(2, 3)], "lie on free cells; give some within"),
    ("obstacles", [np.eye(3)], r"has shape \(3, 3\)"),
    ("forbidden", [np.full((2, 3), n) for n in (-1, 256, 0.5)], "holds .* 0 to 255"),
    (
        "slowness",
        [np.full((2, 3), n) for n in (0.5, 100.1, np.nan, np.inf)],
        "holds .* 1 to 100",
    ),
    ("slowness", [np.ones((3, 3))], r"has shape \(3, 3\); give \(2, 3\)"),
    ("seconds_per_cell", [0.0, np.nan], "is (0.0|nan); give more than 0"),
]


def test_a_malformed_map_is_refused_by_name() -> None:
    for name, values, words in MALFORMED:
        for value in values:
            with pytest.raises(ValueError, match=f"^{name} ?{words}"):
                GridMap(**{"occupancy": ZEROS, name: value})


def test_the_map_keeps_read_only_copies_of_arrays_and_lists() -> None:
    occupancy = np.zeros((2, 2), dtype=bool)
    for cost in ([[99, 100], [-1, 7]], np.array([[99.0, np.nan], [-1.0, 7.0]])):
        grid = GridMap(occupancy, cost=np.full((2, 2), 7)).with_patch(
            [[0, 1], [0, 0]], 0, 0, cost
        )
        assert grid.cost is not None
        assert grid.cost.dtype == np.int8
        assert grid.cost.tolist() == [
            [99, 0],
            [-1, 7],
        ]  # those of occupied cells are ignored
        for array in (grid.occupancy, grid.cost):
            with pytest.raises(ValueError, match="read-only"):
                array[0, 0] = True
    assert GridMap([[1, 0]], obstacles=[[0, 0]]).is_obstacle((0, 0)) is False  # type: ignore[arg-type]
    plain = GridMap(occupancy)
    occupancy[0, 0] = True
    assert plain.is_free((0, 0))


@given(
    numpy_st.arrays(np.int8, (2, 5)), st.integers(1, 100), st.booleans(), st.booleans()
)
def test_each_value_has_a_meaning(
    values: np.ndarray, threshold: int, allow_unknown: bool, use_map_costs: bool
) -> None:
    options = (threshold, allow_unknown, use_map_costs)
    grid = GridMap.from_occupancy_values(values, 0.5, (1.0, 2.0, 3.0), *options)
    closed = (values >= threshold) | ((values < 0) & (not allow_unknown))
    np.testing.assert_array_equal(grid.occupancy, closed)
    cost = np.where(closed, 0, np.maximum(values, UNKNOWN)) if use_map_costs else None
    assert grid.same_cells(GridMap(closed, cost=cost))
    free = ~closed
    percent = np.where(values < 0, 100, values)[free] if use_map_costs else 0
    assert grid.cost_multiplier[free] == pytest.approx(1 + 0.04 * percent)


def test_a_wrong_occupancy_value_is_named() -> None:
    for values, threshold, named in (
        *(([[0, wrong]], 65, f"holds {wrong}") for wrong in (65536, 128, -129, 0.4)),
        ([[0.0, 1.0]], 65, "of type float64; give integers, percent"),
        ([[True, False]], 65, "holds True; give numbers"),
        ([[0, 1], [0]], 65, "no array"),
        *(
            ([[0, 1]], n, f"occupied_threshold is {n}; give 1 to 100")
            for n in (0, 101, math.nan)
        ),
    ):
        with pytest.raises(ValueError, match=named):
            GridMap.from_occupancy_values(values, occupied_threshold=threshold)


@st.composite
def full_grids(draw: st.DrawFn) -> GridMap:
    grid, _ = draw(grids_with_directions())
    shape = grid.occupancy.shape
    slowness = draw(
        st.none() | numpy_st.arrays(np.float32, shape, elements=st.integers(1, 100))
    )
    known = draw(st.none() | numpy_st.arrays(np.bool_, shape))
    obstacles = None if known is None else known & grid.occupancy
    layers = {"forbidden": grid.forbidden, "slowness": slowness}
    return GridMap(grid.occupancy, 0.5, (1.0, 2.0, 3.0), grid.cost, obstacles, **layers)


def derived(grid: GridMap) -> list[Any]:
    """All that a map computes and remembers, and a comparison with itself in new
    arrays.
    """
    rules = [grid.labels(rule).tolist() for rule in MoveRule]
    given_again = {field.name: getattr(grid, field.name) for field in fields(grid)}
    same = grid.same_cells(GridMap(**given_again))
    return [
        grid.fingerprint,
        grid.cost_multiplier.tolist(),
        grid.height,
        grid.width,
        rules,
        same,
    ]


@given(full_grids(), st.booleans(), st.booleans(), st.data())
def test_patches_are_exact(
    grid: GridMap, with_costs: bool, with_obstacles: bool, data: Data
) -> None:
    before = derived(grid)
    x, y = (data.draw(st.integers(0, side - 1)) for side in (grid.width, grid.height))
    shape = tuple(
        data.draw(st.integers(1, n)) for n in (grid.height - y, grid.width - x)
    )
    patch = data.draw(numpy_st.arrays(np.bool_, shape))
    costs = data.draw(numpy_st.arrays(np.int8, shape, elements=st.integers(-1, 99)))
    obstacles = data.draw(numpy_st.arrays(np.bool_, shape))
    patched = grid.with_patch(
        patch,
        x,
        y,
        costs if with_costs else None,
        obstacles if with_obstacles else None,
    )
    box = slice(y, y + shape[0]), slice(x, x + shape[1])
    layers = {
        field.name: copy.copy(getattr(grid, field.name)) for field in fields(grid)
    }
    layers["occupancy"][box] = patch
    if with_costs:
        layers["cost"] = (
            np.zeros(grid.occupancy.shape) if grid.cost is None else layers["cost"]
        )
        layers["cost"][box] = costs
    if grid.obstacles is not None:
        layers["obstacles"][box] = patch & obstacles if with_obstacles else patch
    expected = GridMap(**layers)
    assert derived(patched) == derived(expected)
    for field in fields(grid):
        np.testing.assert_array_equal(
            getattr(patched, field.name), getattr(expected, field.name)
        )
    assert patched.same_cells(expected)
    assert patched.same_cells(grid) == expected.same_cells(grid)
    assert derived(grid) == before


@given(full_grids(), full_grids())
def test_maps_of_the_same_fingerprint_have_the_same_layers(
    a: GridMap, b: GridMap
) -> None:
    names = "occupancy", "cost", "forbidden", "slowness"
    for changed in (None, *names):
        layers = {name: getattr(a, name) for name in names}
        if changed is not None and getattr(b, changed) is not None:
            layers[changed] = np.resize(getattr(b, changed), a.occupancy.shape)
        elif changed not in (None, "occupancy"):
            layers[changed] = None
        other = GridMap(**layers)
        equal = all(np.array_equal(getattr(a, n), getattr(other, n)) for n in names)
        assert a.same_cells(other) == equal
        assert (a.fingerprint == other.fingerprint) == equal


def test_a_wrong_patch_is_named_and_the_remedy_too() -> None:
    one = np.zeros((1, 1))
    for arguments, named in (
        (
            (np.zeros((2, 2)), 2, 0),
            r"2 x 2 cells from \(2, 0\) is not inside .* 3 x 2; cut",
        ),
        *(
            ((one, *cell), "is not inside")
            for cell in ((-1, 0), (0, -1), (3, 0), (0, 2))
        ),
        ((one, 0.5, 0), "first cell of the patch is .*; give two whole numbers"),
        ((one, 0, 0, [[1, 2]]), r"cost has shape \(1, 2\); give \(1, 1\)"),
        (
            (np.ones((1, 2)), 0, 0, None, [[1]]),
            r"obstacles has shape \(1, 1\); give \(1, 2\)",
        ),
    ):
        for cost in (None, ZEROS):
            with pytest.raises(ValueError, match=named):
                GridMap(ZEROS, cost=cost).with_patch(*arguments)


@pytest.mark.parametrize(
    ("name", "value"),
    [("slowness", np.float32(2)), ("forbidden", np.uint8(2))],
)
def test_maps_tell_their_patches_where_all_else_is_the_same(
    name: str, value: Any
) -> None:
    grid = GridMap(ZEROS, cost=ZEROS)
    patched, layer = grid.with_patch([[1]], 2, 1), np.full((2, 3), value)
    before, after = (each.with_layers(**{name: layer}) for each in (grid, patched))
    assert after.patches_since(before) == [(slice(1, 2), slice(2, 3))]
    assert after.patches_since(after) == []
    for other in (grid, patched, grid.with_layers(**{name: layer.copy()})):
        assert after.patches_since(other) is None
    for name in ("occupancy", "cost"):
        assert (
            after.with_layers(**{name: getattr(after, name)}).patches_since(before)
            is None
        )


def test_a_map_knows_512_patches_and_no_more() -> None:
    cells = [(x, y) for y in range(2) for x in range(257)]
    maps = [GridMap(np.zeros((2, 257)))]
    for x, y in cells:
        maps.append(maps[-1].with_patch([[1]], x, y))
    boxes = [(slice(y, y + 1), slice(x, x + 1)) for x, y in cells]
    since = [maps[-1].patches_since(older) for older in maps]
    assert since == [None, None, *(boxes[number:] for number in range(2, 515))]
    assert maps[0].patches_since(maps[1]) is None
    assert not any(maps[-1].same_cells(older) for older in maps[:-1])


RESOLUTION = 0.05
RADII, WEIGHTS = (
    st.sampled_from([0.0, 0.03, 0.05, 0.1, 0.12, 0.2, 1.0]),
    st.floats(0, 1),
)


@given(occupancies, RADII, WEIGHTS, st.sampled_from([None, UNKNOWN, 0, 40]))
def test_inflation_is_exact(
    occupancy: np.ndarray, radius: float, weight: float, cost: int | None
) -> None:
    pairs = cdist(np.argwhere(np.ones_like(occupancy)), np.argwhere(occupancy))
    distance = pairs.min(axis=1, initial=math.inf).reshape(occupancy.shape)
    assert clearance(occupancy) == pytest.approx(distance)
    costs = None if cost is None else np.full(occupancy.shape, cost)
    # A message has the resolution in single precision: two cells of 0.05 m may be
    # 0.099999999 m.
    grid = inflate(
        GridMap(occupancy, float(np.float32(RESOLUTION)), cost=costs), radius, weight
    )
    closed = occupancy | (np.round(distance * RESOLUTION, 6) < radius)
    np.testing.assert_array_equal(grid.occupancy, closed)
    for y, x in np.ndindex(occupancy.shape):
        assert grid.is_obstacle((x, y)) == occupancy[y, x]
    # One metre beyond the body, the cost is an eighth of that beside it.
    added = 99 * weight / (1 + np.maximum(distance * RESOLUTION - radius, 0)) ** 3
    expected = cost if cost == UNKNOWN else np.maximum(np.rint(added), cost or 0)
    found = np.zeros(occupancy.shape) if grid.cost is None else grid.cost
    np.testing.assert_allclose(
        found, np.where(closed, 0, expected), atol=float(weight > 0)
    )


def test_a_value_out_of_range_is_named() -> None:
    grid = GridMap(np.zeros((2, 2)))
    for wrong in (-0.1, math.nan, math.inf, 1.1):
        with pytest.raises(
            ValueError, match=f"clearance_weight is {wrong}; give 0 to 1"
        ):
            inflate(grid, 0.0, wrong)
        if wrong != 1.1:
            with pytest.raises(
                ValueError, match=f"robot_radius is {wrong}; give metres"
            ):
                inflate(grid, wrong)


BODIES = st.tuples(
    st.sampled_from([0.0, 0.4, 1.0, 2.3]), st.sampled_from([0.0, 0.3, 1.0])
)


@given(
    st.integers(0, 2**32),
    st.lists(BODIES, min_size=1, max_size=2),
    st.booleans(),
    st.data(),
)
def test_maps_that_come_one_after_another_are_inflated_as_if_each_were_the_first(
    seed: int, bodies: list[tuple[float, float]], with_costs: bool, data: Data
) -> None:
    random, inflation = np.random.default_rng(seed), Inflation()
    occupancy = random.random((30, 45)) < random.choice([0.0, 0.02, 0.3])
    cost = random.integers(-1, 100, occupancy.shape) if with_costs else None
    grid = GridMap(occupancy, 0.5, cost=cost)
    for _ in range(4):
        change = data.draw(
            st.sampled_from(["none", "cells", "costs", "resolution", "size"])
        )
        x, y = random.integers(0, 20, 2).tolist()
        if change == "cells":
            grid = grid.with_patch(random.random((2, 2)) < 0.5, x, y)
        elif change == "costs":
            grid = grid.with_patch([[0]], x, y, cost=[[7]])
        elif change == "resolution":
            grid = GridMap(grid.occupancy, 0.75 - grid.resolution, cost=grid.cost)
        elif change == "size":
            grid = GridMap(grid.occupancy[:-1], grid.resolution)
        body = data.draw(st.sampled_from(bodies))
        found, expected = inflation(grid, *body), inflate(grid, *body)
        assert found.same_cells(expected)
        assert found.resolution == grid.resolution
        if body != (0.0, 0.0):
            np.testing.assert_array_equal(found.obstacles, grid.occupancy)  # type: ignore[arg-type]


def test_patches_side_by_side_are_inflated_as_one_box() -> None:
    body, inflation = (2.0, 0.5), Inflation()
    grid = GridMap(np.zeros((40, 60)), 0.5)
    inflation(grid, *body)
    for x in range(10, 20):
        grid = grid.with_patch([[True]], x, 20)
    found, expected = inflation(grid, *body), inflate(grid, *body)
    assert found.same_cells(expected)
    np.testing.assert_array_equal(found.obstacles, grid.occupancy)  # type: ignore[arg-type]


def test_costs_are_those_of_navfn() -> None:
    costs = np.arange(253).reshape(1, -1)
    published = np.where(
        costs > 0, 1 + 97 * (costs - 1) // 251, 0
    )  # by Nav2, for free cells
    grid = grid_from_costmap(published.astype(np.int8))
    assert not grid.occupancy.any()
    navfn = np.minimum(50 + 0.8 * costs, 253).astype(int) / 50
    # A value stands for two or three costs, and steps of 0.04 are what a map holds.
    assert np.abs(grid.cost_multiplier - navfn).max() <= 0.0701
    assert (np.diff(grid.cost_multiplier) >= 0).all()
    assert grid.cost_multiplier[0, [0, -1]] == pytest.approx([1, 4.96])


@given(numpy_st.arrays(np.int8, shapes), st.booleans())
def test_unknown_inscribed_lethal_cells_are_closed(
    values: np.ndarray, allow_unknown: bool
) -> None:
    grid = grid_from_costmap(values, allow_unknown=allow_unknown)
    unknown = values < 0
    assert (
        grid.occupancy.tolist()
        == ((values >= 99) | (unknown & (not allow_unknown))).tolist()
    )
    assert grid.obstacles is not None
    assert grid.obstacles.tolist() == (grid.occupancy & (values != 99)).tolist()
    if allow_unknown:
        assert (grid.cost_multiplier[unknown] == 5).all()
    free = ~grid.occupancy & ~unknown
    assert ((grid.cost_multiplier[free] == 1) == (values[free] <= 1)).all()


def test_a_patched_map_is_copied_whole_and_shares_nothing_with_its_origin() -> None:
    given, patch = np.zeros((20, 20), dtype=np.bool_), np.ones((2, 2), dtype=np.bool_)
    grid = GridMap(given)
    patched = grid.with_patch(patch, 3, 3)
    given[:], patch[:] = True, False
    assert [int(each.occupancy.sum()) for each in (grid, patched)] == [0, 4]
    for copied in (
        pickle.loads(pickle.dumps(patched)),
        copy.deepcopy(patched),
        copy.copy(patched),
    ):
        assert copied.same_cells(patched)
        assert copied.fingerprint == patched.fingerprint
        assert copied.with_patch([[0, 0], [0, 0]], 3, 3).same_cells(grid)
    with pytest.raises(ValueError, match="read-only"):
        patched.occupancy[0, 0] = True


@given(st.lists(st.tuples(st.integers(0, 69), st.integers(0, 69)), max_size=30))
def test_a_few_boxes_hold_all_changes(cells: list[tuple[int, int]]) -> None:
    is_set = np.zeros((70, 70), dtype=np.bool_)
    for cell in cells:
        is_set[cell] = True
    boxes, covered = boxes_of(is_set), np.zeros_like(is_set)
    for box in boxes:
        assert is_set[box].any()
        covered[box] = True
    assert len(boxes) <= MAX_BOXES
    assert not (is_set & ~covered).any()


def test_changes_that_lie_apart_have_small_boxes() -> None:
    is_set = np.zeros((200, 300), dtype=np.bool_)
    is_set[5:8, 5:9] = is_set[[100, 101], [7, 8]] = is_set[101, 250] = True
    assert sum(cells_in(box) for box in boxes_of(is_set)) == 12 + 4 + 2
    is_set[::50, ::50] = True
    assert boxes_of(is_set) == [(slice(0, 151), slice(0, 251))]


@pytest.mark.parametrize(
    "wrong",
    [np.array([1, 2]), np.array(["corner_cutting"]), ["corner_cutting"], {}, None],
)
def test_what_is_no_choice_is_named_whatever_its_kind(wrong: Any) -> None:
    with pytest.raises(
        ValueError, match=r"(?s)MoveRule .* is unknown; give one of robot_safe"
    ):
        MoveRule(wrong)
    rule = MoveRule.CORNER_CUTTING
    assert MoveRule(np.str_("corner_cutting")) is copy.deepcopy(rule) is rule


@pytest.mark.parametrize("layer", ["occupancy", "cost", "forbidden", "slowness"])
@pytest.mark.parametrize("row", range(20))
def test_maps_that_differ_in_one_cell_are_not_the_same(layer: str, row: int) -> None:
    ones = np.ones((20, 3), np.uint8)
    layers = {"cost": ones, "forbidden": ones, "slowness": ones}
    grid = GridMap(np.zeros((20, 3), np.bool_), **layers)
    changed = grid.occupancy.copy() if layer == "occupancy" else layers[layer].copy()
    changed[row, 1] = 1 - changed[row, 1] if layer == "occupancy" else 2
    other = GridMap(**{"occupancy": grid.occupancy, **layers, layer: changed})
    assert not grid.same_cells(other)
    assert np.argwhere(grid.differs(other, Box(slice(None), slice(None)))).tolist() == [
        [row, 1]
    ]


def test_a_map_with_two_patches_is_the_same_only_if_both_change_nothing() -> None:
    grid = GridMap(np.zeros((9, 9), np.bool_))
    for x, y in ((1, 1), (7, 7)):
        closed = grid.with_patch([[True]], x, y)
        assert not closed.with_patch([[False]], 8 - x, 8 - y).same_cells(grid)
        assert closed.with_patch([[False]], x, y).same_cells(grid)
