import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import generalisation
import numpy as np
import pytest
from generalisation import (
    BenchmarkMap,
    RequestSettings,
    Rollout,
    illegal_moves,
    main,
    markdown,
)
from hypothesis import given
from hypothesis import strategies as st
from map_files import save_map
from networks import random_network
from random_maps import KINDS

from ddqn_planner import GridMap, MoveRule, Planner
from ddqn_planner.grid import (
    Cell,
    legal_moves,
    move_costs,
    neighbours,
    shortest_distances,
)
from ddqn_planner.model import ModelMetadata, QNetwork
from ddqn_planner.model.model_file import save_model

RULES = st.sampled_from(list(MoveRule))
SAFE = RequestSettings(MoveRule.ROBOT_SAFE)
METADATA = ModelMetadata(
    "propagation", {"filters": 4}, MoveRule.ROBOT_SAFE, 0.95, "", 1_000, 3, "0"
)


class PerfectNetwork:
    """Its Q is minus the cost of the best path through each move, plus a bonus where
    illegal.
    """

    def __init__(self, bonus: float = -math.inf) -> None:
        self.bonus = bonus

    supports, move_costs = QNetwork.supports, QNetwork.move_costs

    def q_values(self, grid: GridMap, goal: Cell, move_rule: MoveRule) -> np.ndarray:
        distance = np.append(shortest_distances(grid, goal, move_rule), np.inf)
        onward = distance[neighbours(grid.occupancy.shape)].reshape(
            -1, *grid.occupancy.shape
        )
        q = -move_costs(grid.cost_multiplier) - onward
        return np.where(legal_moves(grid.occupancy, move_rule), q, self.bonus).astype(
            np.float32
        )


class StubbornNetwork(PerfectNetwork):
    """It makes the same move in a cell wherever the goal is."""

    def __init__(self, action_of_cell: list[list[int]]) -> None:
        self.action_of_cell = np.array(action_of_cell)

    def q_values(self, grid: GridMap, goal: Cell, move_rule: MoveRule) -> np.ndarray:
        return np.float32([self.action_of_cell == action for action in range(8)])


def rollouts_of(
    network: Any, *maps: BenchmarkMap, rule: MoveRule = MoveRule.ROBOT_SAFE
) -> list[Rollout]:
    return list(generalisation.measure(Planner(network, METADATA), maps, rule))


def rows(rollouts: list[Rollout]) -> list[list[str]]:
    """The cells of the report's tables."""
    lines = re.findall(r"^\| (.*) \|$", markdown(rollouts), re.MULTILINE)
    return [line.split(" | ") for line in lines]


def total(rollouts: list[Rollout], *columns: str) -> list[str]:
    """Cells of the last row, which counts all rollouts."""
    row = dict(
        zip(
            ["all", *generalisation.COLUMNS.split(" | ")],
            rows(rollouts)[-1],
            strict=True,
        )
    )
    return [row[column] for column in columns]


def read(folder: Path, settings: RequestSettings = SAFE) -> list[BenchmarkMap]:
    return list(generalisation.read_maps(generalisation.find_files(folder), settings))


def free_map(*requests: tuple[Cell, Cell]) -> BenchmarkMap:
    return BenchmarkMap("free", "0", GridMap(np.zeros((2, 3))), list(requests))


def write_moving_ai(folder: Path, name: str, rows: list[str], lines: list[str]) -> None:
    header = f"type octile\nheight {len(rows)}\nwidth {len(rows[0])}\nmap\n"
    (folder / f"{name}.map").write_text(header + "\n".join(rows) + "\n")
    if lines:
        (folder / f"{name}.scen").write_text("\n".join(["version 1", *lines]) + "\n")


CORNER = ["..@", "...", "..."]
"""From (1, 0) to (2, 1) the diagonal move cuts a corner."""


@given(
    RULES,
    st.sampled_from([*generalisation.COSTS]),
    st.sampled_from([*KINDS]),
    st.integers(0, 99),
)
def test_a_perfect_network_solves_every_request_at_the_least_cost(
    rule: MoveRule, costs: str, kind: str, seed: int
) -> None:
    maps = list(
        generalisation.generated_maps(
            [kind], [9], 2, RequestSettings(rule, 27, costs, seed)
        )
    )
    for drawn in maps:
        assert len({goal for _, goal in drawn.requests}) <= generalisation.GOALS
        assert (drawn.grid.cost is None) == (costs == "none")
        for start, goal in drawn.requests:
            assert start != goal
            assert drawn.grid.reachable([goal], rule)[start[::-1]]
    rollouts = rollouts_of(PerfectNetwork(), *maps, rule=rule)
    columns = generalisation.COLUMNS.split(" | ")[:8]
    assert total(rollouts, *columns) == [
        "2",
        "54",
        *["54/54"] * 3,
        *["1.0000"] * 2,
        "0",
    ]
    assert rows(rollouts)[1][:4] == [kind, "9x9", "2", "54"]


def test_detours_loops_and_starts_on_the_goal_count_as_they_should() -> None:
    # From (0, 0) it goes down, right, right, up; from (1, 0) back to (0, 0) and so
    # round as well.
    network = StubbornNetwork([[2, 4, 0], [0, 0, 6]])
    rollouts = rollouts_of(
        network, free_map(((0, 0), (2, 0)), ((1, 0), (1, 1)), ((0, 0), (1, 0)))
    )
    assert sorted(rollout.ratio for rollout in rollouts) == [2.0, 3.0, math.inf]
    cells = total(rollouts, "success", "optimal", "mean", "worst")
    assert cells == ["2/3", "0/3", "2.5000", "3.0000"]
    trapped = rollouts_of(
        StubbornNetwork([[4, 4, 4], [4, 4, 4]]), free_map(((0, 0), (2, 0)))
    )
    assert total(trapped, "success", "mean", "worst") == ["0/1", "nan", "nan"]
    at_goal = rollouts_of(PerfectNetwork(), free_map(((1, 1), (1, 1))))
    assert total(at_goal, "success", "optimal", "worst") == ["1/1", "1/1", "1.0000"]


def test_masks_and_costs_count() -> None:
    illegal = rollouts_of(PerfectNetwork(bonus=1.0), free_map(((0, 0), (2, 0))))
    assert total(illegal, "success", "without action masking", "illegal") == [
        "1/1",
        "0/1",
        "0",
    ]
    cost = np.array([[0, 99, 0], [0, 0, 0]], dtype=np.int8)
    grid = GridMap(np.zeros((2, 3)), cost=cost)
    straight = StubbornNetwork([[0, 0, 0], [0, 0, 0]])
    (costs,) = rollouts_of(
        straight, BenchmarkMap("costs", "0", grid, [((0, 0), (2, 0))])
    )
    assert costs.optimum == pytest.approx(2 * 2**0.5)
    assert costs.ratio == pytest.approx((1 + 4.96) / (2 * 2**0.5))


def test_steps_through_walls_over_corners_and_of_two_cells_are_illegal() -> None:
    occupancy = np.array([[letter == "@" for letter in row] for row in CORNER])
    legal = legal_moves(occupancy, MoveRule.ROBOT_SAFE)
    assert illegal_moves([(0, 0), (1, 0), (1, 1), (2, 1)], legal) == 0
    assert illegal_moves([(0, 0), (1, 0), (2, 1)], legal) == 1
    assert illegal_moves([(1, 0), (2, 0), (2, 1)], legal) == 2
    assert illegal_moves([(0, 0), (0, 2), (0, 2)], legal) == 2
    assert illegal_moves([(0, 0)], legal) == illegal_moves([], legal) == 0


def test_optima_lie_in_groups_that_double_and_a_millionth_more_is_optimal() -> None:
    one = Rollout("set", "map", "9x9", 70.0, None, 1.00001, True, 0, 1.0, 1.0)
    others = [
        replace(one, optimum=optimum, ratio=1.0000009)
        for optimum in (16, 3, 31.9, 15.9)
    ]
    groups = [(row[0], row[2], row[5]) for row in rows([one, *others])[-4:]]
    expected = [("0-16", "2", "2/2"), ("16-32", "2", "2/2"), ("64-128", "1", "0/1")]
    assert groups == [*expected, ("all", "5", "4/5")]


@pytest.mark.parametrize("costs", generalisation.COSTS)
def test_the_same_seed_draws_the_same_whichever_other_maps_there_are(
    costs: str,
) -> None:
    def drawn(kinds: list[str], seed: int) -> tuple[str, Sequence[tuple[Cell, Cell]]]:
        settings = replace(SAFE, requests=30, costs=costs, seed=seed)
        *_, other, last = generalisation.generated_maps(kinds, [20], 2, settings)
        assert other.grid.fingerprint != last.grid.fingerprint
        return last.grid.fingerprint, last.requests

    first, second = drawn(["rooms"], 1), drawn(["rooms"], 2)
    assert first == drawn(["maze", "rooms"], 1)
    assert first[0] != second[0]
    assert first[1] != second[1]


@pytest.mark.parametrize(
    ("optima", "agree"),
    [
        (("1.4142", "2.82843", "2"), 3),
        (("1.41", "2.82843", "2"), 2),
        (("2", "2", "3"), 0),
    ],
)
def test_optima_of_a_file_hold_under_the_robot_safe_rule_within_their_rounding(
    tmp_path: Path, optima: tuple[str, ...], agree: int
) -> None:
    ends = ("0 0 1 1", "0 0 2 2", "1 0 2 1")
    lines = [f"0 c.map 3 3 {both} {o}" for both, o in zip(ends, optima, strict=True)]
    write_moving_ai(tmp_path, "c", CORNER, lines)
    rollouts = rollouts_of(PerfectNetwork(), *read(tmp_path))
    assert f"the oracle agrees with {agree}/3." in markdown(rollouts)
    for settings in (
        RequestSettings(MoveRule.CORNER_CUTTING),
        replace(SAFE, costs="random"),
    ):
        assert read(tmp_path, settings)[0].optima is None


def test_a_sample_of_a_scenario_file_has_short_and_long_paths_alike(
    tmp_path: Path,
) -> None:
    lines = [f"0 long.map 100 1 0 0 {x} 0 {x}" for x in range(99, 0, -1)]
    for folder in ("maps", "scenarios"):
        (tmp_path / folder).mkdir()
    write_moving_ai(tmp_path / "maps", "long", ["." * 100], [])
    (tmp_path / "scenarios" / "long.map.scen").write_text("\n".join(lines))

    def lengths(requests: int, seed: int = 0) -> list[float]:
        return list(
            read(tmp_path, replace(SAFE, requests=requests, seed=seed))[0].optima or []
        )

    assert [int(length - 1) // 9 for length in lengths(11)] == [*range(11)]
    assert lengths(11) == lengths(11) != lengths(11, seed=1)
    assert lengths(1000) == [*range(1, 100)]


@pytest.mark.parametrize(
    ("name", "content", "named"),
    [
        ("bad.map", "no map", r"bad\.map: begins with"),
        ("bad.yaml", "services: {}", r"bad\.yaml: image"),
        (
            "walls.map",
            "type octile\nheight 1\nwidth 2\nmap\n@@\n",
            r"walls\.map: no two free",
        ),
        ("c.scen", "0 c.map 3 3 0 0 1", r"c\.scen: .*; end each line"),
        (
            "c.scen",
            "0 c.map 9 9 0 0 8 0 1",
            r"no path joins \(0, 0\) and \(8, 0\) on this map",
        ),
        ("c.scen", "version 1", r"c\.scen: has no requests"),
    ],
)
def test_a_file_that_cannot_be_used_is_named_and_the_others_go_on(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    name: str,
    content: str,
    named: str,
) -> None:
    write_moving_ai(tmp_path, "c", CORNER, [])
    save_map(GridMap(np.zeros((4, 5))), tmp_path / "hall.yaml")
    (tmp_path / name).write_text(content)
    sets = [drawn.set_name for drawn in read(tmp_path)]
    assert sets == (["ros hall"] if name == "c.scen" else ["movingai c", "ros hall"])
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(rf"skipped: .*{named}", line)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("model") / "model.safetensors"
    save_model(path, random_network("propagation", filters=4), METADATA)
    return str(path)


def test_the_program_prints_its_tables(
    capsys: pytest.CaptureFixture[str], model: str
) -> None:
    command = ["--model", model, "--kinds", "maze", "random_10", "--sizes", "8", "16"]
    assert main([*command, "--maps", "2", "--requests", "12"]) == 0
    printed = capsys.readouterr().out
    assert "move rule robot_safe, costs none, requests of seed 0." in printed
    for row in ("maze | 8x8", "maze | 16x16", "random_10 | 8x8", "random_10 | 16x16"):
        assert f"| {row} | 2 | 24 |" in printed


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--maps", "0"], "--maps is 0; give at least 1"),
        (["--seed", "-1"], "seed is -1; give at least 0"),
        (["--sizes", "4"], "H, W >= 5"),
        (["--data", "no_such_folder"], "no_such_folder: .*check the path"),
        (["--model", "no_such_model"], "no_such_model"),
        (["--model", "dilemma"], "not trained for maps of 32 x 32"),
    ],
)
def test_bad_input_is_refused_with_its_name(
    capsys: pytest.CaptureFixture[str], model: str, arguments: list[str], named: str
) -> None:
    assert main(["--model", model, *arguments]) == 2
    assert re.search(named, capsys.readouterr().err)


def test_an_interrupted_program_prints_what_it_has(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, model: str
) -> None:
    measure = generalisation.measure

    def interrupted(*arguments: Any) -> Iterator[Rollout]:
        rollouts = measure(*arguments)
        yield from (next(rollouts) for _ in range(250))
        raise KeyboardInterrupt

    monkeypatch.setattr(generalisation, "measure", interrupted)
    assert main(["--model", model, "--kinds", "maze", "--sizes", "8"]) == 130
    printed, error = capsys.readouterr()
    assert "| all | 2 | 250 |" in printed
    assert "interrupted" in error
