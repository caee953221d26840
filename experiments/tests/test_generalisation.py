from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import generalisation
import numpy as np
import pytest
from benchmark_files import describe_files, find_files, read_maps
from benchmark_maps import (
    COSTS,
    GOALS,
    BenchmarkMap,
    RequestSettings,
    generated_maps,
)
from generalisation import (
    Rollout,
    Summary,
    illegal_moves,
    main,
    markdown,
    measure,
    summarise,
)
from hypothesis import given
from hypothesis import strategies as st
from networks import random_network
from random_maps import KINDS

from ddqn_planner.grid import (
    MOVES,
    Cell,
    GridMap,
    MoveRule,
    legal_moves,
    move_costs,
    save_map,
    shortest_distances,
)
from ddqn_planner.model import ModelMetadata, QNetwork
from ddqn_planner.model.model_file import save_model
from ddqn_planner.planning import Planner

RULES = st.sampled_from(list(MoveRule))
SAFE = RequestSettings(MoveRule.ROBOT_SAFE)
METADATA = ModelMetadata(
    "propagation", {"filters": 4}, MoveRule.ROBOT_SAFE, 0.95, "", 1_000, 3, "0"
)


class PerfectNetwork:
    """Its Q is minus the cost of the best path through each move, plus a bonus where illegal."""

    def __init__(self, bonus: float = -math.inf) -> None:
        self.bonus = bonus

    supports, move_costs = QNetwork.supports, QNetwork.move_costs

    def q_values(self, grid: GridMap, goal: Cell, move_rule: MoveRule) -> np.ndarray:
        distance = np.pad(shortest_distances(grid, goal, move_rule), 1, constant_values=np.inf)
        height, width = grid.occupancy.shape
        onward = [distance[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width] for dx, dy in MOVES]
        q = -move_costs(grid.cost_multiplier, move_rule) - np.array(onward)
        return np.where(legal_moves(grid.occupancy, move_rule), q, self.bonus).astype(np.float32)


class StubbornNetwork(PerfectNetwork):
    """It makes the same move in a cell wherever the goal is."""

    def __init__(self, action_of_cell: list[list[int]]) -> None:
        self.action_of_cell = np.array(action_of_cell)

    def q_values(self, grid: GridMap, goal: Cell, move_rule: MoveRule) -> np.ndarray:
        actions = np.arange(len(MOVES)).reshape(-1, 1, 1)
        return (self.action_of_cell == actions).astype(np.float32)


def rollouts_of(
    network: Any, *maps: BenchmarkMap, rule: MoveRule = MoveRule.ROBOT_SAFE
) -> list[Rollout]:
    return list(measure(Planner(network, METADATA), maps, rule))


def without_times(summary: Summary) -> Summary:
    return {
        key: value
        for key, value in summary.items()
        if "ms" not in key and key != "field_per_dijkstra"
    }


def free_map(*requests: tuple[Cell, Cell], optima: list[float] | None = None) -> BenchmarkMap:
    array = None if optima is None else np.array(optima)
    return BenchmarkMap("free", "0", GridMap(np.zeros((2, 3))), list(requests), array)


def write_moving_ai(folder: Path, name: str, rows: list[str], lines: list[str]) -> None:
    header = f"type octile\nheight {len(rows)}\nwidth {len(rows[0])}\nmap\n"
    (folder / f"{name}.map").write_text(header + "\n".join(rows) + "\n")
    if lines:
        (folder / f"{name}.scen").write_text("\n".join(["version 1", *lines]) + "\n")


def write_mpd(path: Path, maps: int = 3) -> list[np.ndarray]:
    """Write random maps with the goal in cell (4, 2) of each; return their occupancies."""
    random = np.random.default_rng(0)
    occupancies = list(random.random((maps, 6, 7)) < 0.3)
    goals, distances = np.zeros((2, maps, 1, 6, 7))
    for occupancy, goal, distance in zip(occupancies, goals, distances, strict=True):
        occupancy[2, 4] = False
        goal[0, 2, 4] = 1
        exact = shortest_distances(GridMap(occupancy), (4, 2), MoveRule.UNIT)
        distance[0] = -np.where(np.isfinite(exact), exact, 1024)
    free = 1 - np.array(occupancies, dtype=np.float32)
    np.savez(path, arr_8=free, arr_9=goals, arr_11=distances)
    return occupancies


CORNER = ["..@", "...", "..."]
"""From (1, 0) to (2, 1) the diagonal move cuts a corner."""


@given(RULES, st.sampled_from([*COSTS]), st.sampled_from([*KINDS]), st.integers(0, 99))
def test_a_perfect_network_solves_every_request_at_the_least_cost(
    rule: MoveRule, costs: str, kind: str, seed: int
) -> None:
    settings = RequestSettings(rule, 7, costs, seed)
    rollouts = rollouts_of(PerfectNetwork(), *generated_maps([kind], [9], 2, settings), rule=rule)
    *groups, total = summarise(rollouts)
    assert without_times(groups[0]) == {**without_times(total), "set_name": kind, "size": "9x9"}
    assert (total["maps"], total["requests"], total["illegal"]) == (2, 14, 0)
    assert total["success"] == total["unmasked"] == total["optimal"] == 14
    assert total["mean"] == pytest.approx(1.0)
    assert total["worst"] == pytest.approx(1.0)
    assert sum(group["requests"] for group in groups[1:]) == 14


def test_a_detour_counts_as_solved_but_not_optimal_and_a_loop_as_not_solved() -> None:
    # From (0, 0) it goes down, right, right, up; from (1, 0) back to (0, 0) and so round as well.
    network = StubbornNetwork([[2, 4, 0], [0, 0, 6]])
    rollouts = rollouts_of(network, free_map(((0, 0), (2, 0)), ((1, 0), (1, 1)), ((0, 0), (1, 0))))
    assert sorted(rollout.ratio for rollout in rollouts) == [2.0, 3.0, math.inf]
    total = summarise(rollouts)[-1]
    assert (total["requests"], total["success"], total["optimal"]) == (3, 2, 0)
    assert (total["mean"], total["worst"]) == (2.5, 3.0)


def test_a_group_in_which_nothing_is_solved_has_no_mean() -> None:
    total = summarise(
        rollouts_of(StubbornNetwork([[4, 4, 4], [4, 4, 4]]), free_map(((0, 0), (2, 0))))
    )[-1]
    assert (total["success"], total["unmasked"], total["optimal"]) == (0, 0, 0)
    assert math.isnan(total["mean"])
    assert math.isnan(total["worst"])


def test_a_start_on_its_goal_is_solved_at_the_least_cost() -> None:
    total = summarise(rollouts_of(PerfectNetwork(), free_map(((1, 1), (1, 1)))))[-1]
    assert (total["success"], total["optimal"], total["worst"]) == (1, 1, 1.0)


def test_a_network_that_prefers_illegal_moves_is_found_out_without_the_mask() -> None:
    total = summarise(rollouts_of(PerfectNetwork(bonus=1.0), free_map(((0, 0), (2, 0)))))[-1]
    assert (total["success"], total["unmasked"], total["illegal"]) == (1, 0, 0)


def test_costs_count_in_the_ratio() -> None:
    cost = np.array([[0, 99, 0], [0, 0, 0]], dtype=np.int8)
    grid = GridMap(np.zeros((2, 3)), cost=cost)
    straight = StubbornNetwork([[0, 0, 0], [0, 0, 0]])
    (costs,) = rollouts_of(straight, BenchmarkMap("costs", "0", grid, [((0, 0), (2, 0))]))
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


def rollout_of_optimum(optimum: float) -> Rollout:
    return Rollout("set", "map", "9x9", optimum, None, 1.0, True, 0, 1.0, 1.0, 1.0)


@given(st.floats(0, 1e6))
def test_an_optimum_lies_in_its_group_and_groups_double(optimum: float) -> None:
    low, high = map(int, rollout_of_optimum(optimum).length_group.split("-"))
    assert low <= optimum < high
    assert (low, high) == (0, 16) or (high == 2 * low and math.log2(low / 16).is_integer())


def test_a_rollout_is_optimal_within_a_millionth() -> None:
    rollouts = [
        replace(rollout_of_optimum(10.0), ratio=ratio) for ratio in (1.0, 1.0000009, 1.00001)
    ]
    assert summarise(rollouts)[-1]["optimal"] == 2


def test_groups_of_optima_are_in_order() -> None:
    rollouts = [rollout_of_optimum(optimum) for optimum in (70.0, 16.0, 3.0, 31.9, 15.9)]
    groups = [(group["optimum"], group["requests"]) for group in summarise(rollouts)]
    assert groups == [("all", 5), ("0-16", 2), ("16-32", 2), ("64-128", 1), ("all", 5)]


@given(RULES, st.integers(1, 40), st.sampled_from([*KINDS]), st.integers(0, 99))
def test_a_path_joins_start_and_goal_of_each_drawn_request_and_few_goals_are_drawn(
    rule: MoveRule, count: int, kind: str, seed: int
) -> None:
    (drawn,) = generated_maps([kind], [10], 1, RequestSettings(rule, count, "none", seed))
    assert len(drawn.requests) == count
    assert len({goal for _, goal in drawn.requests}) <= GOALS
    for start, goal in drawn.requests:
        assert start != goal
        assert drawn.grid.reachable([goal], rule)[start[1], start[0]]


@pytest.mark.parametrize("costs", COSTS)
def test_the_same_seed_draws_the_same_whichever_other_maps_there_are(costs: str) -> None:
    def drawn(kinds: list[str], seed: int) -> tuple[str, list[tuple[Cell, Cell]]]:
        settings = RequestSettings(MoveRule.ROBOT_SAFE, 30, costs, seed)
        last = list(generated_maps(kinds, [20], 2, settings))[-1]
        assert (last.grid.cost is None) == (costs == "none")
        return last.grid.fingerprint, last.requests

    assert drawn(["rooms"], 1) == drawn(["maze", "rooms"], 1)
    first, second = drawn(["rooms"], 1), drawn(["rooms"], 2)
    assert first[0] != second[0]
    assert first[1] != second[1]


def test_the_maps_of_a_kind_differ() -> None:
    maps = list(generated_maps(["rooms"], [20], 5, SAFE))
    assert len({drawn.grid.fingerprint for drawn in maps}) == 5


def test_the_optima_of_a_scenario_file_hold_under_the_robot_safe_rule(tmp_path: Path) -> None:
    lines = ["0\tc.map\t3\t3\t1\t0\t2\t1\t2", "0\tc.map\t3\t3\t0\t0\t2\t2\t2.82842712"]
    write_moving_ai(tmp_path, "c", CORNER, lines)
    (read,) = read_maps(find_files(tmp_path), SAFE)
    assert read.requests == [((1, 0), (2, 1)), ((0, 0), (2, 2))]
    rollouts = rollouts_of(PerfectNetwork(), read)
    assert "the oracle agrees with 2/2" in markdown(rollouts, "")
    assert [rollout.ratio for rollout in rollouts] == pytest.approx([1.0, 1.0])
    for settings in (
        RequestSettings(MoveRule.CORNER_CUTTING),
        RequestSettings(MoveRule.ROBOT_SAFE, costs="random"),
    ):
        (read,) = read_maps(find_files(tmp_path), settings)
        assert read.optima is None


def test_a_wrong_optimum_of_a_file_is_told() -> None:
    rollouts = rollouts_of(
        PerfectNetwork(), free_map(((0, 0), (2, 0)), ((0, 0), (1, 1)), optima=[2.0, 2.0])
    )
    assert "the oracle agrees with 1/2" in markdown(rollouts, "")


def test_a_bad_line_of_a_scenario_file_is_told_and_the_others_are_used(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    good = ["0 c.map 3 3 0 0 1 0 1", "0 c.map 3 3 0 0 0 2 2"]
    write_moving_ai(tmp_path, "c", CORNER, [good[0], "0 c.map 3 3 0 0 2 0 2", good[1]])
    (read,) = read_maps(find_files(tmp_path), SAFE)
    assert read.requests == [((0, 0), (1, 0)), ((0, 0), (0, 2))]
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(r"skipped: .*c\.scen: line 3 goes from \(0, 0\) to \(2, 0\).*cells$", line)
    write_moving_ai(tmp_path, "c", CORNER, ["broken", good[0], "broken too", "0 c.map 1"])
    (read,) = read_maps(find_files(tmp_path), SAFE)
    assert read.requests == [((0, 0), (1, 0))]
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(r"line 2 is 'broken'; give .* \(and 2 more lines\)$", line)


@pytest.mark.parametrize(
    ("optima", "agree"),
    [
        (("1.41", "2.83", "2"), 3),  # two decimals, as the longest
        (("1.40", "2.82", "2"), 1),
        (("1.41", "2.83000000", "2"), 1),
        (("1", "3", "2"), 3),  # whole cells
        (("2", "2", "3"), 0),
        (("1.41421356", "2.82842712", "2.00000000"), 3),
    ],
)
def test_a_rounded_optimum_agrees_within_what_its_file_gives(
    tmp_path: Path, optima: tuple[str, ...], agree: int
) -> None:
    goals = ("1 1", "2 2", "0 2")
    lines = [f"0 c.map 3 3 0 0 {goal} {o}" for goal, o in zip(goals, optima, strict=True)]
    write_moving_ai(tmp_path, "c", ["...", "...", "..."], lines)
    rollouts = rollouts_of(PerfectNetwork(), *read_maps(find_files(tmp_path), SAFE))
    assert f"the oracle agrees with {agree}/3." in markdown(rollouts, "")


def test_a_sample_of_a_scenario_file_has_short_and_long_paths_alike(tmp_path: Path) -> None:
    lines = [f"0 long.map 100 1 0 0 {x} 0 {x}" for x in range(99, 0, -1)]
    write_moving_ai(tmp_path, "long", ["." * 100], lines)

    def lengths(requests: int, seed: int = 0) -> list[float]:
        settings = RequestSettings(MoveRule.ROBOT_SAFE, requests, seed=seed)
        (read,) = read_maps(find_files(tmp_path), settings)
        assert read.optima is not None
        return read.optima.tolist()

    assert [int(length - 1) // 9 for length in lengths(11)] == [*range(11)]
    assert lengths(11) == lengths(11)
    assert lengths(11) != lengths(11, seed=1)
    assert lengths(1000) == [*range(1, 100)]
    assert len(set(lengths(98))) == 98


def test_a_scenario_file_is_found_in_another_folder_and_under_either_name(tmp_path: Path) -> None:
    for folder in ("maps", "scenarios"):
        (tmp_path / folder).mkdir()
    write_moving_ai(tmp_path / "maps", "c", CORNER, [])
    (tmp_path / "scenarios" / "c.map.scen").write_text("0 c.map 3 3 0 0 1 0 1\n")
    (read,) = read_maps(find_files(tmp_path), SAFE)
    assert read.requests == [((0, 0), (1, 0))]


def test_maps_without_requests_of_their_own_get_random_ones(tmp_path: Path) -> None:
    write_moving_ai(tmp_path, "bare", CORNER, [])
    save_map(GridMap(np.zeros((4, 5))), tmp_path / "deeper" / "hall.yaml")
    files = find_files(tmp_path)
    assert describe_files(files) == "1 MovingAI maps, 1 ROS maps"
    bare, hall = read_maps(files, SAFE)
    assert (bare.set_name, bare.size, len(bare.requests)) == ("movingai bare", "3x3", 200)
    assert (hall.set_name, hall.size, len(hall.requests)) == ("ros hall", "5x4", 200)
    assert bare.optima is hall.optima is None


@given(RULES, st.integers(0, 99))
def test_mpd_maps_keep_their_goal_and_give_the_optimum_under_their_rule(
    tmp_path_factory: pytest.TempPathFactory, rule: MoveRule, seed: int
) -> None:
    path = tmp_path_factory.mktemp("mpd") / "m.npz"
    occupancies = write_mpd(path)
    read = list(read_maps([path], RequestSettings(rule, 4, "none", seed)))
    for benchmark_map, occupancy in zip(read, occupancies, strict=True):
        np.testing.assert_array_equal(benchmark_map.grid.occupancy, occupancy)
        assert len(benchmark_map.requests) == 4
        for start, goal in benchmark_map.requests:
            assert goal == (4, 2) != start
            assert GridMap(occupancy).reachable([goal], rule)[start[1], start[0]]
        assert (benchmark_map.optima is not None) == (rule is MoveRule.UNIT)
    rollouts = rollouts_of(PerfectNetwork(), *read, rule=rule)
    agrees = "the oracle agrees with 12/12" in markdown(rollouts, "")
    assert agrees == (rule is MoveRule.UNIT)
    assert all(rollout.ratio == pytest.approx(1.0) for rollout in rollouts)


@pytest.mark.parametrize(
    ("name", "content", "named"),
    [
        ("bad.map", "no map", r"bad\.map: begins with"),
        ("bad.yaml", "services: {}", r"bad\.yaml: image"),
        ("bad.npz", "text", r"bad\.npz: cannot be read .*arr_8"),
        ("walls.map", "type octile\nheight 1\nwidth 2\nmap\n@@\n", r"walls\.map: no two free"),
        ("c.scen", "0 c.map 3 3 0 0 1", r"c\.scen: line 1 is '0 c\.map 3 3 0 0 1'; give"),
        ("c.scen", "version 1\n0 c.map 3 3 0 0 2 0 2", r"line 2 .*\(2, 0\) .*give free cells"),
        ("c.scen", "0 c.map 9 9 0 0 1 0 1", r"on 9 x 9 cells; .* of 3 x 3 cells"),
        ("c.scen", "version 1", r"c\.scen: has no requests"),
        ("c.scen", "0 c.map 3 3 0 0 1 0 nan", r"line 1 is .* nan'; give"),
        ("cut.scen", "0 cut.map 3 1 0 0 2 0 2", r"cut\.scen: line 1 .* from \(0, 0\) to \(2, 0\)"),
    ],
)
def test_a_file_that_cannot_be_used_is_named_and_the_others_go_on(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, name: str, content: str, named: str
) -> None:
    write_moving_ai(tmp_path, "c", CORNER, [])
    if name == "cut.scen":
        write_moving_ai(tmp_path, "cut", [".@."], [])
    write_mpd(tmp_path / "z.npz", maps=1)
    (tmp_path / name).write_text(content)
    sets = [read.set_name for read in read_maps(find_files(tmp_path), SAFE)]
    assert sets == (["mpd z"] if name == "c.scen" else ["movingai c", "mpd z"])
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(rf"skipped: .*{named}", line)


@pytest.mark.parametrize("missing", ["arr_8", "arr_9", "arr_11"])
def test_an_mpd_file_without_its_test_maps_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, missing: str
) -> None:
    arrays = {name: np.zeros((1, 1, 2, 2)) for name in ("arr_8", "arr_9", "arr_11")}
    del arrays[missing]
    np.savez(tmp_path / "m.npz", **arrays)
    assert list(read_maps([tmp_path / "m.npz"], SAFE)) == []
    assert missing in capsys.readouterr().err


def test_mpd_goals_on_obstacles_are_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    array = np.zeros((1, 2, 2))
    np.savez(tmp_path / "m.npz", arr_8=array, arr_9=array, arr_11=array)
    assert list(read_maps([tmp_path / "m.npz"], SAFE)) == []
    assert "goal (0, 0) of map 0 is occupied" in capsys.readouterr().err


@pytest.fixture
def model(tmp_path: Path) -> str:
    """A network that takes every move as possible: the mask makes it solve what is convex."""
    network = random_network("propagation", filters=4)
    network.tensors["moves.weight"].fill(0)
    network.tensors["moves.bias"].fill(1)
    save_model(tmp_path / "model.safetensors", network, METADATA)
    return str(tmp_path / "model.safetensors")


@pytest.mark.parametrize("ending", ["md", "csv"])
def test_evaluate_prints_and_writes_its_tables(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, model: str, ending: str
) -> None:
    out = tmp_path / "deeper" / f"tables.{ending}"
    command = ["--model", model, "--kinds", "maze", "random_10", "--sizes", "8", "16"]
    assert main([*command, "--maps", "2", "--requests", "12", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert f"Model {model} (propagation, 1,000 steps, seed 3), move rule robot_safe" in printed
    assert re.search(r"^\| maze \| 16x16 \| 2 \| 24 \| \d+/24 \|", printed, re.MULTILINE)
    assert re.search(r"^\| all \| all \| 8 \| 96 \| \d+/96 \|", printed, re.MULTILINE)
    assert re.search(r"^\| 0-16 \| 8 \| ", printed, re.MULTILINE)
    if ending == "md":
        assert out.read_text() == printed
        return
    rows = list(csv.DictReader(out.read_text().splitlines()))
    assert [row["set_name"] for row in rows[:4]] == ["maze", "maze", "random_10", "random_10"]
    by_optimum = [row for row in rows[4:-1] if row["optimum"] != "all"]
    assert len(by_optimum) == len(rows) - 5
    for column in ("requests", "success", "illegal"):
        sums = [sum(int(row[column]) for row in part) for part in (rows[:4], by_optimum, rows[-1:])]
        assert sums[0] == sums[1] == sums[2]


def test_evaluate_gives_free_cells_the_costs_asked_for(tmp_path: Path, model: str) -> None:
    means = {}
    for costs in ("none", "random"):
        out = tmp_path / f"{costs}.csv"
        command = ["--model", model, "--kinds", "random_10", "--sizes", "16"]
        assert main([*command, "--costs", costs, "--out", str(out)]) == 0
        means[costs] = float(list(csv.DictReader(out.read_text().splitlines()))[-1]["mean"])
    assert means["random"] > 1.1 * means["none"]  # this model does not see them


def test_evaluate_says_which_sets_it_found(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, model: str
) -> None:
    data = tmp_path / "data"
    data.mkdir()
    write_moving_ai(data, "c", CORNER, ["0 c.map 3 3 0 0 0 2 2"])
    write_mpd(data / "m.npz")
    (data / "LICENCE").write_text("free")
    command = ["--model", model, "--data", str(data), "--move-rule", "unit"]
    assert main(command) == 0
    printed, error = capsys.readouterr()
    assert "1 MovingAI maps, 1 MovingAI scenario files, 1 MPD files" in error
    assert "skipped" not in error
    assert "| movingai c | 3x3 | 1 | 1 | 1/1 |" in printed
    assert "| mpd m | 7x6 | 3 | 600 |" in printed


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--maps", "0"], "--maps is 0; give at least 1"),
        (["--requests", "0"], "requests is 0; give at least 1"),
        (["--seed", "-1"], "seed is -1; give at least 0"),
        (["--sizes", "4"], "H, W >= 5"),
        (["--out", "tables.txt"], r"tables\.txt; give a file that ends in \.csv or \.md"),
        (["--data", "no_such_folder"], "no_such_folder: .*check the path"),
        (["--model", "no_such_model"], "no_such_model"),
        (["--model", "dilemma"], "not trained for maps of 32 x 32"),
    ],
)
def test_evaluate_refuses_bad_input_with_its_name(
    capsys: pytest.CaptureFixture[str], model: str, arguments: list[str], named: str
) -> None:
    assert main(["--model", model, *arguments]) == 2
    error = capsys.readouterr().err
    assert re.search(named, error)
    assert "Traceback" not in error


def test_evaluate_ends_with_2_if_no_file_can_be_read(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, model: str
) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "compose.yaml").write_text("services: {}")
    assert main(["--model", model, "--data", str(tmp_path / "data")]) == 2
    error = capsys.readouterr().err
    assert "compose.yaml" in error
    assert "none of its files has a request" in error


def test_an_interrupted_evaluation_prints_what_it_has(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, model: str
) -> None:
    def interrupted(*arguments: Any) -> Iterator[Rollout]:
        rollouts = measure(*arguments)
        yield from (next(rollouts) for _ in range(250))
        raise KeyboardInterrupt

    monkeypatch.setattr(generalisation, "measure", interrupted)
    assert main(["--model", model, "--kinds", "maze", "--sizes", "8"]) == 130
    printed, error = capsys.readouterr()
    assert "| all | all | 2 | 250 |" in printed
    assert "interrupted" in error
