"""Every public call of docs/python_api.md, with arguments of all kinds."""

from collections.abc import Callable
from contextlib import suppress
from fractions import Fraction
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ddqn_planner import (
    Experience,
    GridMap,
    Plan,
    Planner,
    PlanStatus,
    QField,
    inflate,
    load_map,
    simplify,
)

SHAPE = 5, 7
GRID = GridMap(np.zeros(SHAPE, np.bool_))
PLANNER, EXPERIENCE = Planner.load("any_map"), Experience(0.5)
Q, LEGAL = np.zeros((8, *SHAPE), np.float32), np.zeros((8, *SHAPE), np.bool_)
MAP = Path(__file__).parents[1] / "maps" / "dilemma.yaml"
EXPERIENCE.record(np.arange(9.0), np.stack([np.arange(9) / 2, np.ones(9)], axis=1))

CELLS = [(0, 0), (1, 1)]
ON_MAP = {"move_rule": "corner_cutting", "method": "greedy", "simplified": False}
AT_START = {**ON_MAP, "start_clearing_radius": 0.0}
OF_MAP = {"resolution": 1.0, "origin": (0.0, 0.0, 0.0), "forbidden": None}
FLAGS = {"occupied_threshold": 65, "allow_unknown": False, "use_map_costs": False}
LAYERS = {"cost": None, "obstacles": None}
TIMES = {"slowness": np.ones(SHAPE), "seconds_per_cell": 1.0}
CALLS: dict[Callable[..., Any], dict[str, Any]] = {
    GridMap: {"occupancy": np.zeros(SHAPE), **OF_MAP, **LAYERS, **TIMES},
    GridMap.from_occupancy_values: {"values": np.zeros(SHAPE, int), **OF_MAP, **FLAGS},
    GRID.with_patch: {"occupancy": [[0]], "x": 0, "y": 0, **LAYERS},
    GRID.labels: {"move_rule": "corner_cutting"},
    GRID.legal_moves: {"move_rule": "corner_cutting"},
    GRID.reachable: {"cells": CELLS, "move_rule": "corner_cutting", "backward": False},
    GRID.same_cells: {"other": GRID},
    GRID.contains: {"cell": (0, 0)},
    GRID.is_free: {"cell": (0, 0)},
    GRID.is_obstacle: {"cell": (0, 0)},
    GRID.cell_to_world: {"cell": (0, 0)},
    GRID.world_to_cell: {"x": 0.0, "y": 0.0},
    load_map: {"path": MAP, **FLAGS},
    inflate: {"grid": GRID, "robot_radius": 1.0, "clearance_weight": 0.5},
    Experience: dict.fromkeys(
        ("nominal_speed", "robot_width", "half_life", "max_pause"), 1.0
    ),
    EXPERIENCE.record: {"seconds": [0, 1], "positions": [(0, 0), (0, 1)]},
    EXPERIENCE.record_failure: {"position": (0, 0)},
    EXPERIENCE.apply: {"grid": GRID},
    EXPERIENCE.slowness: {"grid": GRID},
    EXPERIENCE.uncertainty: {"grid": GRID},
    EXPERIENCE.expected_time: {"grid": GRID, "cells": CELLS},
    Planner: {"network": PLANNER.network, "metadata": PLANNER.metadata},
    Planner.load: {"model": "any_map"},
    PLANNER.plan: {
        "grid": GRID,
        "start": (0, 0),
        "goal": (3, 3),
        "tolerance": 0.0,
        **AT_START,
    },
    PLANNER.plan_nearest: {"grid": GRID, "start": (0, 0), "goals": CELLS, **AT_START},
    PLANNER.plan_through: {"grid": GRID, "start": (0, 0), "goals": CELLS, **AT_START},
    PLANNER.q_field: {"grid": GRID, "goal": (3, 3), "move_rule": "corner_cutting"},
    Plan: {
        "status": PlanStatus.SUCCEEDED,
        "path": CELLS,
        "method": "greedy",
        "move_rule": "corner_cutting",
    },
    QField: {"goal": (0, 0), "q": Q, "legal": LEGAL, "move_rule": "corner_cutting"},
    QField((0, 0), Q, LEGAL).rollout: {"start": (0, 0)},
    PLANNER.q_field(GRID, (3, 3)).rollout: {"start": (0, 0)},
    simplify: {"cells": CELLS, "grid": GRID, "move_rule": "corner_cutting"},
}
ARGUMENTS = [(call, name) for call, arguments in CALLS.items() for name in arguments]

# Right for no argument.
WRONG = [
    *(
        object(),
        1j,
        len,
        b"x",
        "no such",
        [object()],
        [[1], [1, 2]],
        (None, None),
        np.ones(3, "U"),
    ),
    *(
        {"x": 1, "y": 2},
        np.full(SHAPE, None),
        [[1j]],
        np.full(SHAPE, "a"),
        [["a", "b"]],
    ),
]

# Right for some arguments.
ANY = [
    *(
        None,
        True,
        np.nan,
        np.inf,
        -np.inf,
        -1,
        0.5,
        10**30,
        10**400,
        -(10**400),
        "",
        "1",
        "a\0b",
    ),
    *(
        [],
        {},
        iter(()),
        [1, 2],
        (1, 2, 3),
        (-1, -1),
        (7, 5),
        (0.5, 1),
        (10**30, 0),
        (np.inf, 0),
    ),
    *([(-1, -1)], [(7, 5)], [(0.5, 1)], [(10**30, 0)], np.array(1.0), np.zeros((0, 0))),
    *(
        np.full(SHAPE, np.nan),
        np.full(SHAPE, -np.inf),
        np.full(SHAPE, 1e5),
        np.ones((7, 7)),
    ),
    *(
        np.array([[-1, -1]]),
        np.array([[7, 5]]),
        np.array([[2**63, 0]], np.uint64),
        Fraction(1, 2),
    ),
    *(
        np.float32(1),
        np.int64(1),
        np.uint8(1),
        np.bool_(True),
        np.str_("corner_cutting"),
    ),
]


def in_numpy(value: Any) -> list[Any]:
    """The same flag, text, number or tuple, of other types."""
    if isinstance(value, bool):
        return [np.bool_(value)]
    if isinstance(value, int | float):
        return [kind(value) for kind in (np.float32, np.float64, np.int64, np.uint8)]
    if isinstance(value, tuple):
        return [tuple(map(np.int32, value)), np.array(value), [*map(np.float32, value)]]
    return [np.str_(value)] if type(value) is str else []


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("call", "name"), ARGUMENTS)
def test_a_wrong_argument_is_a_value_error_that_names_it(
    call: Callable[..., Any], name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = CALLS[call]
    call(**right)
    monkeypatch.chdir(tmp_path)
    names = dict.fromkeys(
        ("move_rule", "method", "status"), "MoveRule|PlanMethod|PlanStatus"
    )
    names |= dict.fromkeys("xy", "first cell|point")
    for wrong in WRONG:
        with pytest.raises(
            ValueError, match=f"(?s){names.get(name, name.removesuffix('s'))}"
        ):
            call(**{**right, name: wrong})
    for value in ANY:
        with suppress(ValueError):
            call(**{**right, name: value})
    for value in in_numpy(right[name]):
        call(**{**right, name: value})


def test_a_number_that_python_does_not_write_is_named() -> None:
    with pytest.raises(ValueError, match="tolerance is a number of thousands of digit"):
        PLANNER.plan(GRID, (0, 0), (1, 1), tolerance=-(10**5000))


def test_a_path_for_experience_is_a_path() -> None:
    for wrong, call in product(
        (3, None, b"x", ["x"]), (EXPERIENCE.save, Experience.load)
    ):
        with pytest.raises(ValueError, match="path is"):
            call(wrong)


@pytest.mark.parametrize(
    "cell", [(-1, 0), (0, -1), (7, 0), (0, 5), (10**30, 0), (0.5, 0)]
)
def test_cells_outside_the_map_and_fractions_are_refused(cell: Any) -> None:
    timed = GRID.with_patch([[1]], 6, 4)  # what the cell (-1, -1) would be
    field = PLANNER.q_field(timed, (3, 3))
    calls: list[Callable[[], Any]] = [
        lambda: timed.is_obstacle(cell),
        lambda: timed.reachable([(0, 0), cell], "corner_cutting"),
        lambda: timed.reachable(np.array([cell]), "corner_cutting"),
        lambda: EXPERIENCE.expected_time(timed, [(0, 0), cell]),
        lambda: simplify([(0, 0), cell], timed, "corner_cutting"),
        lambda: field.rollout(cell),
    ]
    for call in calls:
        with pytest.raises(
            ValueError, match=r"outside the map of 7 x 5|give two whole numbers"
        ):
            call()
    with pytest.raises(ValueError, match=r"holds 0\.5"):
        Plan(PlanStatus.SUCCEEDED, [(0.5, 0)])  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (GridMap, "occupancy"),
        (GridMap, "cost"),
        (GridMap, "slowness"),
        (GridMap.from_occupancy_values, "values"),
        (GRID.reachable, "cells"),
        (GRID.contains, "cell"),
        (EXPERIENCE.record, "positions"),
        (QField, "q"),
    ],
)
def test_masked_elements_are_refused_and_a_mask_of_none_is_not(
    call: Callable[..., Any], name: str
) -> None:
    right = CALLS[call]
    value = np.zeros(SHAPE) if right[name] is None else np.asarray(right[name])
    masked = np.ma.masked_array(value)
    call(**{**right, name: masked})
    first_element = (0,) * value.ndim
    masked[first_element] = np.ma.masked
    reason = r"has 1 masked elements; give array\.filled\(VALUE\)|the cell is masked_"
    with pytest.raises(ValueError, match=reason):
        call(**{**right, name: masked})
