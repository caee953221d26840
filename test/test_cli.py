from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sysconfig
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from ddqn_planner.cli import main
from ddqn_planner.experiments import EXPERIMENTS
from ddqn_planner.grid import GridMap, MapFile, save_map
from ddqn_planner.model import load_model
from ddqn_planner.training.environment import Scenario


@pytest.fixture
def small_map(small: Scenario, tmp_path: Path) -> str:
    """A map file of the small scenario."""
    path = tmp_path / "small.yaml"
    percent = small.grid.occupancy.astype("int8") * 100
    save_map(MapFile(percent, start=small.start, goal=small.goal), path)
    return str(path)


def test_plan_prints_the_papers_path(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "dilemma", "--model", "dilemma"]) == 0
    printed = capsys.readouterr().out
    assert "length 22.97 cells, optimum 22.97 under corner_cutting" in printed
    assert printed.count("*") == 17
    assert printed.count("S") == printed.count("G") == 1


def test_plan_takes_the_model_for_any_map_and_prints_no_wide_map(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["plan", "office"]) == 0
    printed = capsys.readouterr().out
    assert "length 789.95 cells, optimum 789.95 under robot_safe" in printed
    assert "#" not in printed


def test_plan_writes_json_and_a_picture(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["plan", "dilemma", "--json", "--picture", str(tmp_path / "plan.png")]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["status"] == "SUCCEEDED"
    assert answer["cells"][0] == [6, 6]
    assert answer["cells"][-1] == [17, 19]
    assert answer["length"] == pytest.approx(answer["optimum"])
    with Image.open(tmp_path / "plan.png") as picture:
        colours = picture.convert("RGB").getcolors(picture.width * picture.height)
        assert len(colours) > 100


def test_plan_heeds_the_robots_body(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    values = np.zeros((11, 11), dtype=np.int8)
    values[:7, 5] = 100
    path = str(tmp_path / "wall.yaml")
    save_map(MapFile(values, resolution=0.1, start=(0, 0), goal=(10, 0)), path)

    def plan(*arguments: str) -> dict[str, Any]:
        assert main(["plan", path, "--json", *arguments]) == 0
        answer: dict[str, Any] = json.loads(capsys.readouterr().out)
        return answer

    point, body = plan(), plan("--robot-radius", "0.3")
    assert point["length"] < body["length"] == pytest.approx(body["optimum"])
    assert body["method"] == "greedy"
    beside = ["--start", "4", "0", "--goal", "6", "0"]
    assert plan("--clearance-weight", "1", *beside)["length"] > plan(*beside)["length"]
    near = plan("--robot-radius", "0.3", "--start", "4", "3")
    assert near["cells"][0] == [4, 3]
    assert near["optimum"] is None
    moved = plan("--robot-radius", "0.3", "--goal", "6", "3", "--tolerance", "0.2")
    assert moved["cells"][-1] == [8, 3]
    for bad, named in (
        (["--robot-radius", "-1"], "robot_radius is -1.0"),
        (["--clearance-weight", "2"], "clearance_weight is 2.0"),
        (["--tolerance", "nan"], "tolerance is nan"),
    ):
        assert main(["plan", path, *bad]) == 2
        assert named in capsys.readouterr().err


def test_plan_searches_in_guided_mode(capsys: pytest.CaptureFixture[str]) -> None:
    request = ["plan", "dilemma", "--model", "dilemma", "--goal", "0", "0"]
    assert main(request) == 1
    assert "greedy steps do not find it" in capsys.readouterr().err
    assert main([*request, "--mode", "guided"]) == 0
    assert "cells, optimum" in (printed := capsys.readouterr().out)
    assert ", guided, planned in" in printed


def test_plan_writes_an_animation(tmp_path: Path) -> None:
    assert main(["plan", "office", "--animate", str(tmp_path / "plan.gif")]) == 0
    assert (tmp_path / "plan.gif").stat().st_size < 2**21
    with Image.open(tmp_path / "plan.gif") as animation:
        assert 60 < animation.n_frames <= 81


@pytest.mark.parametrize(
    ("start", "goal", "spreads"), [("1", "6", True), ("6", "1", False), ("99", "6", True)]
)
def test_an_animation_without_a_path_shows_the_field_if_there_is_one(
    tmp_path: Path, start: str, goal: str, spreads: bool
) -> None:
    ends = ["--start", start, "19", "--goal", goal, "19"]
    assert main(["plan", "dilemma", *ends, "--animate", str(tmp_path / "plan.GIF")]) == 1
    with Image.open(tmp_path / "plan.GIF") as animation:
        assert (animation.n_frames > 1) == spreads


def test_an_animation_that_is_no_gif_is_refused_before_planning(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["plan", "no_such_map", "--animate", "plan.mp4"]) == 2
    assert "--animate is plan.mp4; give a file that ends in .gif" in capsys.readouterr().err


def test_plan_says_why_there_is_no_path(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "dilemma", "--start", "1", "19"]) == 1
    assert "the start is occupied" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["plan", "no_such_map.yaml"], "no_such_map.yaml"),
        (["plan", "dilemma", "--model", "no_such_model"], "no_such_model"),
        (["train", "dilemma", "--gamma", "2"], r"gamma is 2\.0"),
        (["train", "dilemma", "--start", "1", "19"], r"start \(1, 19\)"),
    ],
)
def test_bad_input_ends_with_2_and_its_name(
    capsys: pytest.CaptureFixture[str], arguments: list[str], named: str
) -> None:
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert re.search(named, error)
    assert "Traceback" not in error


def test_a_map_without_start_and_goal_asks_for_them(
    capsys: pytest.CaptureFixture[str], small: Scenario, tmp_path: Path
) -> None:
    save_map(GridMap(small.grid.occupancy), tmp_path / "bare.yaml")
    assert main(["plan", str(tmp_path / "bare.yaml")]) == 2
    assert "--start X Y" in capsys.readouterr().err


def test_a_trained_model_plans(
    capsys: pytest.CaptureFixture[str], small_map: str, tmp_path: Path
) -> None:
    train = ["train", small_map, "--out", str(tmp_path / "run"), "--steps", "3000"]
    train += ["--learning-rate", "0.003", "--epsilon-steps", "1500", "--target-interval", "100"]
    assert main(train) == 0
    assert "of 16 starts" in capsys.readouterr().out
    model = str(tmp_path / "run" / "model.safetensors")
    assert main(["plan", small_map, "--model", model]) == 0
    assert "length" in capsys.readouterr().out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_training_is_saved_and_goes_on(
    small_map: str, tmp_path: Path, number: int
) -> None:
    executable = Path(sysconfig.get_path("scripts")) / "ddqn-planner"
    command = [executable, "train", small_map, "--out", tmp_path / "run", "--filters", "4"]
    curves = tmp_path / "run" / "episodes.csv"
    child = subprocess.Popen([*command, "--steps", "1000000"], stdout=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not curves.exists() or curves.read_text().count("\n") < 50:
        assert time.monotonic() < deadline
        assert child.poll() is None
        time.sleep(0.05)
    os.kill(child.pid, number)
    printed, _ = child.communicate(timeout=30)
    assert child.returncode == 0
    assert "the same command goes on from there" in printed
    steps = load_model(tmp_path / "run" / "model.safetensors")[1].steps
    assert steps > 0
    subprocess.run([*command, "--steps", str(steps + 100)], check=True, capture_output=True)
    assert load_model(tmp_path / "run" / "model.safetensors")[1].steps == steps + 100


def test_reproduce_runs_every_experiment_and_writes_its_report(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    pytest.importorskip("pathfinding", reason="pathfinding, of the extra experiments, is missing")
    command = ["reproduce", "--quick", "--seeds", "2", "--out", str(tmp_path)]
    assert main(command) == 0
    folder = tmp_path / "quick"
    report = (folder / "report.md").read_text()
    assert report in capsys.readouterr().out
    for name in EXPERIMENTS:
        assert f"`ddqn-planner reproduce --experiment {name} --seeds 2 --quick`" in report
    for picture in re.findall(r"!\[.*?\]\((.*?)\)", report):
        with Image.open(folder / picture) as image:
            assert min(image.size) > 300
            assert len(image.convert("RGB").getcolors(image.width * image.height)) > 20
    assert "| best | 286 |" in report
    trained = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("evaluations.csv")}
    assert len(trained) == 2 * (8 + 2 + 2)
    assert main([*command[:4], "--experiment", "goal-2", *command[4:]]) == 0
    assert trained == {path: path.stat().st_mtime_ns for path in trained}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_experiments_end_with_all_their_processes(tmp_path: Path, number: int) -> None:
    executable = Path(sysconfig.get_path("scripts")) / "ddqn-planner"
    pytest.importorskip("pathfinding", reason="pathfinding, of the extra experiments, is missing")
    command = [executable, "reproduce", "--experiment", "goal-1", "--out", tmp_path]
    child = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not (curves := [*tmp_path.rglob("evaluations.csv")]):
        assert time.monotonic() < deadline
        assert child.poll() is None
        time.sleep(0.05)
    os.kill(child.pid, number)
    _, printed = child.communicate(timeout=30)  # to the end of what every process may print
    assert child.returncode == 130
    assert "the same command goes on" in printed
    before = [path.read_bytes() for path in curves]
    time.sleep(1.0)
    assert before == [path.read_bytes() for path in curves]


def test_reproduce_refuses_less_than_one_seed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reproduce", "--seeds", "0"]) == 2
    assert "--seeds is 0; give at least 1" in capsys.readouterr().err
