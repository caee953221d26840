"""``ddqn-planner plan``, for models without and with a body."""

import csv
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bodies import Oracle, occupied_cells
from map_files import save_map
from PIL import Image

from ddqn_planner import Planner, inflate, pictures
from ddqn_planner.grid import MapFile
from ddqn_planner.model import robot_network
from ddqn_planner.robot import footprint
from ddqn_planner.robot.footprint import placed


def test_plan_prints_the_papers_path_by_its_rule(console: Any) -> None:
    printed = console("plan dilemma --model dilemma").out
    assert "length 22.97 cells, optimum 22.97 under corner_cutting" in printed
    assert [printed.count(letter) for letter in "*SG"] == [17, 1, 1]
    assert "11.49 m" in printed
    assert "the start is occupied" in console("plan dilemma --start 1 19", status=1).err
    request = "plan dilemma --model dilemma --goal 0 0"
    assert "greedy steps do not find it" in console(request, status=1).err
    printed = console(f"{request} --mode astar_fallback").out
    assert re.search("cells, optimum.*, astar_fallback, planned in", printed)


CLEARED = {"start": (5, 0), "start_clearing_radius": 2}
# Options, and what they are for the library: of the map's values, of the body, of the
# plan.
ASKED: dict[str, tuple[dict[str, Any], tuple[float, float], dict[str, Any]]] = {
    "": ({}, (0, 0), {}),
    "--occupied-threshold 60": ({"occupied_threshold": 60}, (0, 0), {}),
    "--allow-unknown": ({"allow_unknown": True}, (0, 0), {}),
    "--use-map-costs": ({"use_map_costs": True}, (0, 0), {}),
    "--allow-unknown --use-map-costs": (
        {"allow_unknown": True, "use_map_costs": True},
        (0, 0),
        {},
    ),
    "--robot-radius 0.1": ({}, (0.1, 0), {}),
    "--clearance-weight 1": ({}, (0, 1), {}),
    "--move-rule corner_cutting": ({}, (0, 0), {"move_rule": "corner_cutting"}),
    "--goal 26 29 --tolerance 0.1": ({}, (0, 0), {"goal": (26, 29), "tolerance": 2}),
    "--start 5 0": ({}, (0, 0), {"start": (5, 0)}),
    "--start 5 0 --start-clearing-radius 0.1": ({}, (0, 0), CLEARED),
}


def test_plan_gives_as_the_library(console: Any, tmp_path: Path) -> None:
    random, planner, seen = np.random.default_rng(12), Planner.load("any_map"), set()
    values = random.choice([0, 60, -1, 100], (30, 30), p=[0.8, 0.08, 0.06, 0.06])
    values[0, 0], values[-1, -1], values[0, 5], values[-1, -4] = 0, 0, 100, 100
    map_file = MapFile(values, 0.05, start=(0, 0), goal=(29, 29))
    save_map(map_file, tmp_path / "map.yaml")
    for options, (rules, body, asked) in ASKED.items():
        grid = inflate(map_file.grid(**rules), *body)
        plan = planner.plan(grid, **{"start": (0, 0), "goal": (29, 29), **asked})
        given, status = options.split(), 0 if plan.cells else 1
        printed = console(
            "plan --json", tmp_path / "map.yaml", *given, status=status
        ).out
        answer = json.loads(printed)
        assert answer["cells"] == [list(cell) for cell in plan.cells]
        assert (answer["status"], answer["length"]) == (plan.status.name, plan.length)
        if plan.cells:
            assert (answer["optimum"] is None) == (not grid.is_free(plan.cells[0]))
            assert (answer["optimum"] or 0) <= plan.length + 1e-9
        seen.add(plan.cells)
    assert len(seen) == len(ASKED)  # each option counts


def test_plan_draws_a_wide_map_for_a_terminal(
    console: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    *rows, start, length = console("plan office --clearance-weight 1").out.splitlines()
    assert [len(row.split()) for row in rows] == [64] * 43  # squares of 9 cells
    assert "goal (550, 330)" in start
    assert re.search(r"cost \d{4}\.\d\d, greedy", length)


def test_plan_gives_every_cell(console: Any, tmp_path: Path) -> None:
    file = tmp_path / "path.csv"
    *cells, start, length = console("plan office --cells --csv", file).out.splitlines()
    assert start == "start (15, 15), goal (550, 330), 39.50 m"
    assert length.startswith(
        "length 789.95 cells, optimum 789.95 under robot_safe, greedy, "
    )
    assert (cells[0], cells[-1]) == ("15 15", "550 330")
    header, *rows = file.read_text().splitlines()
    assert (header, rows[0]) == ("x,y,x_metres,y_metres", "15,15,0.775,0.775")
    assert cells == [" ".join(row.split(",")[:2]) for row in rows]
    console("plan dilemma --start 1 19 --csv", file, status=1)
    assert file.read_text().splitlines() == [header]  # of no other plan


def test_plan_writes_json_and_a_picture(console: Any, tmp_path: Path) -> None:
    def plan(picture: str, *goal: Any) -> Any:
        file = tmp_path / picture
        return json.loads(console("plan dilemma --json --picture", file, *goal).out)

    answer = plan("plan.png")
    assert (answer["cells"][0], answer["cells"][-1]) == ([6, 6], [17, 19])
    assert (answer["status"], answer["length"]) == (
        "SUCCEEDED",
        pytest.approx(answer["optimum"]),
    )
    with Image.open(tmp_path / "plan.png") as picture:
        assert (
            len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0))
            > 100
        )
    moved = plan("moved.png", "--goal", 1, 19, "--tolerance", 9)
    assert moved["cells"][-1] != [1, 19]
    plan("there.png", "--goal", *moved["cells"][-1])  # the value is that of the end
    assert (tmp_path / "moved.png").read_bytes() == (
        tmp_path / "there.png"
    ).read_bytes()


def test_missing_matplotlib_is_named(
    console: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    said = console("plan dilemma --picture", tmp_path / "plan.png", status=2).err
    assert said.endswith("; pip install matplotlib\n")


@pytest.fixture(scope="module", autouse=True)
def swept_once() -> Iterator[None]:
    """Each load of a body computes what it sweeps: here only one."""
    known: dict[bytes, Any] = {}

    def swept_cells(corners: Any, motions: Any) -> Any:
        key = b"".join(array.tobytes() for array in (corners, *motions.poses))
        if key not in known:
            known[key] = footprint.swept_cells(corners, motions)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(robot_network, "swept_cells", swept_cells)
        yield


@pytest.fixture
def rooms(tmp_path: Path) -> tuple[MapFile, str]:
    """Two rooms of 3 x 3.5 m and a door of 1 m between them, and the map's file."""
    values = np.zeros((70, 130), np.int8)
    values[[0, -1]] = values[:, [0, -1]] = values[:25, 64] = values[45:, 64] = 100
    values[20:30, 30], values[30:45, 90], values[10:15, 110] = -1, 60, 100
    map_file = MapFile(values, 0.05, (1, -2, 0), start=(15, 25), goal=(112, 40))
    save_map(map_file, tmp_path / "rooms.yaml")
    return map_file, str(tmp_path / "rooms.yaml")


# Options, and what they are for the library: of the map's values, of costs, of ends and
# of plans.
TURNED, MOVED = {"yaws": (0, 3)}, {"goal": (102, 12)}
BODY_ASKED: dict[str, tuple[dict[str, Any], float, dict[str, Any], dict[str, Any]]] = {
    "": ({}, 0, {}, {}),
    "--occupied-threshold 60": ({"occupied_threshold": 60}, 0, {}, {}),
    "--allow-unknown": ({"allow_unknown": True}, 0, {}, {}),
    "--use-map-costs": ({"use_map_costs": True}, 0, {}, {}),
    "--clearance-weight 1": ({}, 1, {}, {}),
    "--yaws 0 3": ({}, 0, TURNED, {}),
    "--start 15 50": ({}, 0, {"start": (15, 50)}, {}),
    "--bound 3": ({}, 0, {}, {"bound": 3.0}),
    "--goal 102 12": ({}, 0, MOVED, {}),
    "--goal 102 12 --tolerance 0.6": ({}, 0, MOVED, {"tolerance": (0.6, 0)}),
    "--goal 102 12 --yaw-tolerance 2": ({}, 0, MOVED, {"tolerance": (0, 2)}),
}


def test_plan_drives_a_body_as_the_library_and_without_a_collision(
    rooms: Any, console: Any, tmp_path: Path
) -> None:
    map_file, path = rooms
    file, seen = tmp_path / "poses.csv", set()
    car = Planner.load("car")
    assert car.pose_planner is not None
    body = str(car.pose_planner.footprint.tolist())
    for options, (rules, weight, ends, asked) in BODY_ASKED.items():
        grid = inflate(map_file.grid(**rules), 0, weight)
        cells = ends.get("start", (15, 25)), ends.get("goal", (112, 40))
        start, goal = (
            (*grid.cell_to_world(cell), yaw)
            for cell, yaw in zip(cells, ends.get("yaws", (0, 0)), strict=True)
        )
        planner = Planner.load("car")  # it knows no map yet, and has no tables
        plan = planner.plan_poses(grid, start, goal, **{"bound": 1.0, **asked})
        given, status = [path, "--csv", file, *options.split()], 0 if plan.cells else 1
        answer = json.loads(
            console("plan --model car --json", *given, status=status).out
        )
        assert answer["poses"] == plan.poses.tolist()
        assert (answer["status"], answer["reason"]) == (
            plan.status.name,
            plan.status.value,
        )
        assert (answer["bound"], answer["cost"]) == (plan.bound, plan.cost)
        assert answer["metres"] == pytest.approx(plan.length * 0.05)
        header, *rows = csv.reader(file.read_text().splitlines())
        assert header == ["x", "y", "yaw"]
        assert len(rows) == len(plan.poses)
        if rows:
            poses = np.array(rows, dtype=float)
            np.testing.assert_allclose(poses, plan.poses, atol=1e-6)
            assert Oracle(occupied_cells(grid), body).collisions(poses) == 0
        seen.add((plan.poses.tobytes(), plan.cost))
    assert len(seen) == len(BODY_ASKED)  # each option counts


def test_plan_leads_a_body_out_of_an_obstacle(rooms: Any, console: Any) -> None:
    map_file, path = rooms
    x, y = 15, 25
    grid = map_file.grid().with_patch([[True]], x, y)
    start, goal = ((*grid.cell_to_world(cell), 0.0) for cell in ((x, y), (112, 40)))
    file = Path(path).with_name("marked.yaml")
    save_map(grid, file)
    command = f"plan --model car --json {file} --start {x} {y} --goal 112 40"
    console(command, status=1)
    answer = json.loads(console(f"{command} --start-clearing-radius 2").out)
    plan = Planner.load("car").plan_poses(
        grid, start, goal, bound=1.0, start_clearing_radius=2.0
    )
    assert answer["poses"] == plan.poses.tolist()
    assert answer["escape"] == plan.escape > 0
    assert plan.reason.startswith("succeeded; the start is occupied")


def test_plan_tells_how_a_body_drives_or_why_it_cannot(
    rooms: Any, console: Any
) -> None:
    words = (
        r"\d\.\d\d m, \d+ poses, at most 1\.000 times the least cost, "
        r"planned in \d+\.\d ms\n"
    )
    assert re.fullmatch(words, console("plan --model car", rooms[1]).out)
    for options, reason in (
        ("--start 64 10", "the start is occupied"),
        ("--start 3 25", "the start is occupied"),  # not by its cell
        ("--goal 200 40", "the goal lies outside the map"),
        ("--goal 112 -1", "the goal lies outside the map"),
    ):
        said = console(f"plan --model car {options}", rooms[1], status=1).err
        assert said == f"no path: {reason} for the body; --picture shows it\n"


REFUSED = {
    "--model car --robot-radius 0": "--robot-radius is for models without a body,",
    "--model car --move-rule corner_cutting": "--move-rule is for models without",
    "--model car --mode greedy": "--mode is for models without",
    "--model car --cells": "--cells is for models without",
    "--yaws 0 0": "--yaws is for models with a body, unlike any_map; leave it out,",
    "--yaw-tolerance 0": "--yaw-tolerance is for models with a",
    "--bound 1.2": "--bound is for models with a",
    "--model car --yaws nan 0": "nan); give three finite numbers x, y, yaw",
    "--model car --bound nan": "the bound is nan; give 1 or more",
    "--model car --bound 0.9": "the bound is 0.9; give 1 or more",
    "--model car --tolerance -1": "the tolerance is -1.0; give two numbers",
    "--model car --yaw-tolerance nan": "the tolerance is nan; give two numbers",
    "--model cart": "no 'cart.safetensors'",
}


@pytest.mark.parametrize("options", REFUSED)
def test_plan_refuses_what_a_model_cannot_follow(
    rooms: Any, console: Any, options: str
) -> None:
    assert REFUSED[options] in console(f"plan {options}", rooms[1], status=2).err


def test_a_picture_shows_what_a_body_sweeps_and_where_it_has_no_room(
    rooms: Any, console: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    drawn, draw_body = [], pictures.draw_body
    planner: Any = Planner.load("car").pose_planner

    def draw(*body: Any) -> None:
        drawn.append(body)
        draw_body(*body)

    monkeypatch.setattr(pictures, "draw_body", draw)
    file = tmp_path / "plan.png"
    for ends, status in (("40", 0), ("12", 1), ("12 --tolerance 0.6", 0)):
        words = f"plan --model car --json --goal 102 {ends} --picture"
        printed = console(words, file, rooms[1], status=status).out
        # Cells, counted from the centre of the first one, are the metres of the plan.
        _, footprint, *poses = drawn[-1]
        swept, marked = (
            (placed(footprint, each) + 0.5) * 0.05 + (1, -2) for each in poses
        )
        driven = np.reshape(json.loads(printed)["poses"], (-1, 3))
        asked = (
            np.array([[1.775, -0.725, 0], [6.125, -1.375, 0]])
            if status
            else driven[[0, -1]]
        )
        np.testing.assert_allclose(swept, placed(planner.footprint, driven), atol=1e-9)
        np.testing.assert_allclose(marked, placed(planner.footprint, asked), atol=1e-9)
