"""Random maps for the property tests."""

from dataclasses import replace

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as numpy_st

from ddqn_planner.grid import Cell, GridMap, MoveRule

Place = tuple[GridMap, Cell]
Data = st.DataObject
RULES = st.sampled_from(list(MoveRule))
shapes = numpy_st.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9)
occupancies = numpy_st.arrays(
    np.bool_, shapes, elements=st.sampled_from([False, False, True])
)


@st.composite
def grids_with_free_cell(draw: st.DrawFn) -> Place:
    occupancy = draw(occupancies)
    y = draw(st.integers(0, occupancy.shape[0] - 1))
    x = draw(st.integers(0, occupancy.shape[1] - 1))
    occupancy[y, x] = False
    return GridMap(occupancy), (x, y)


@st.composite
def grids_in_parts(draw: st.DrawFn) -> Place:
    grid, (x, y) = draw(grids_with_free_cell())
    occupancy = grid.occupancy.copy()
    for column in draw(st.lists(st.integers(0, grid.width - 1), max_size=2)):
        occupancy[:, column] = True
    for row in draw(st.lists(st.integers(0, grid.height - 1), max_size=1)):
        occupancy[row] = True
    occupancy[y, x] = False
    return GridMap(occupancy), (x, y)


@st.composite
def grids_with_costs(draw: st.DrawFn) -> Place:
    grid, cell = draw(grids_with_free_cell())
    costs = numpy_st.arrays(np.int8, grid.occupancy.shape, elements=st.integers(-1, 99))
    return GridMap(grid.occupancy, cost=draw(costs)), cell


@st.composite
def grids_with_directions(draw: st.DrawFn) -> Place:
    grid, cell = draw(grids_with_free_cell() | grids_with_costs())
    # Few or many different sets of forbidden actions, and cells without any.
    masks = [*draw(st.lists(st.integers(0, 255), min_size=1, max_size=4)), 0]
    elements = st.sampled_from(masks) | st.integers(0, 255)
    forbidden = draw(numpy_st.arrays(np.uint8, grid.occupancy.shape, elements=elements))
    return GridMap(grid.occupancy, cost=grid.cost, forbidden=forbidden), cell


def json_values(scalars: st.SearchStrategy[object]) -> st.SearchStrategy[object]:
    return st.recursive(
        scalars, lambda it: st.lists(it) | st.dictionaries(st.text(), it), max_leaves=8
    )


def cells_of(grid: GridMap) -> st.SearchStrategy[Cell]:
    return st.tuples(st.integers(0, grid.width - 1), st.integers(0, grid.height - 1))


@st.composite
def patched(draw: st.DrawFn, grid: GridMap) -> GridMap:
    """The same place with other cells, or other directions, in a box."""
    width, height = draw(st.integers(1, grid.width)), draw(st.integers(1, grid.height))
    x, y = (
        draw(st.integers(0, grid.width - width)),
        draw(st.integers(0, grid.height - height)),
    )
    if grid.forbidden is not None and draw(st.booleans()):
        forbidden = grid.forbidden.copy()
        forbidden[y : y + height, x : x + width] = draw(st.integers(0, 255))
        return replace(grid, forbidden=forbidden)
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    patch = random.random((height, width)) < draw(st.sampled_from([0, 0.3, 1]))
    cost = None if grid.cost is None else random.integers(-1, 100, patch.shape)
    return grid.with_patch(patch, x, y, cost)


GRIDS = grids_with_free_cell() | grids_with_costs() | grids_in_parts()
GRIDS |= grids_with_directions()
