import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from processes import executable

from ddqn_planner import Planner, inflate
from ddqn_planner.cli import main
from ddqn_planner.grid import GridMap, MapFile, save_map
from ddqn_planner.model import load_model
from ddqn_planner.training.any_map import ANY_MAP, random_scenarios
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import Trainer

PARAMETERS: Any = fields(HyperParameters)
PATIENCE = 300  # seconds to wait for what should come at once: a loaded machine is slow, not wrong


@pytest.fixture
def small_map(small: Scenario, tmp_path: Path) -> str:
    path = tmp_path / "small.yaml"
    percent = small.grid.occupancy.astype("int8") * 100
    save_map(MapFile(percent, start=small.start, goal=small.goal), path)
    return str(path)


def test_plan_prints_the_papers_path_by_its_rule(capsys: Any) -> None:
    assert main(["plan", "dilemma", "--model", "dilemma"]) == 0
    printed = capsys.readouterr().out
    assert "length 22.97 cells, optimum 22.97 under corner_cutting" in printed
    assert [printed.count(letter) for letter in "*SG"] == [17, 1, 1]
    assert main(["plan", "dilemma", "--move-rule", "unit"]) == 0
    printed = capsys.readouterr().out
    assert "length 18.00 cells, optimum 18.00 under unit" in printed
    assert "11.49 m" in printed  # as the robot drives, whatever the rule counts
    assert main(["plan", "dilemma", "--start", "1", "19"]) == 1
    assert "the start is occupied" in capsys.readouterr().err
    request = ["plan", "dilemma", "--model", "dilemma", "--goal", "0", "0"]
    assert main(request) == 1
    assert "greedy steps do not find it" in capsys.readouterr().err
    assert main([*request, "--mode", "astar_fallback"]) == 0
    assert re.search("cells, optimum.*, astar_fallback, planned in", capsys.readouterr().out)


CLEARED = {"start": (5, 0), "start_clearing_radius": 2}
# Options, and what they are for the library: of the map's values, of the body, of the plan.
ASKED: dict[str, tuple[dict[str, Any], tuple[float, float], dict[str, Any]]] = {
    "": ({}, (0, 0), {}),
    "--occupied-threshold 60": ({"occupied_threshold": 60}, (0, 0), {}),
    "--allow-unknown": ({"allow_unknown": True}, (0, 0), {}),
    "--use-map-costs": ({"use_map_costs": True}, (0, 0), {}),
    "--allow-unknown --use-map-costs": ({"allow_unknown": True, "use_map_costs": True}, (0, 0), {}),
    "--robot-radius 0.1": ({}, (0.1, 0), {}),
    "--clearance-weight 1": ({}, (0, 1), {}),
    "--move-rule unit": ({}, (0, 0), {"move_rule": "unit"}),
    "--goal 26 29 --tolerance 0.1": ({}, (0, 0), {"goal": (26, 29), "tolerance": 2}),
    "--start 5 0": ({}, (0, 0), {"start": (5, 0)}),
    "--start 5 0 --start-clearing-radius 0.1": ({}, (0, 0), CLEARED),
}


def test_plan_gives_as_the_library(capsys: Any, tmp_path: Path) -> None:
    random, planner, seen = np.random.default_rng(12), Planner.load("any_map"), set()
    values = random.choice([0, 60, -1, 100], (30, 30), p=[0.8, 0.08, 0.06, 0.06])
    values[0, 0], values[-1, -1], values[0, 5], values[-1, -4] = 0, 0, 100, 100
    map_file = MapFile(values, 0.05, start=(0, 0), goal=(29, 29))
    save_map(map_file, tmp_path / "map.yaml")
    for options, (rules, body, asked) in ASKED.items():
        grid = inflate(map_file.grid(**rules), *body)
        plan = planner.plan(grid, **{"start": (0, 0), "goal": (29, 29), **asked})
        command = ["plan", str(tmp_path / "map.yaml"), "--json", *options.split()]
        assert main(command) == (0 if plan.cells else 1)
        answer = json.loads(capsys.readouterr().out)
        assert answer["cells"] == [list(cell) for cell in plan.cells]
        assert (answer["status"], answer["length"]) == (plan.status.name, plan.length)
        if plan.cells:
            assert (answer["optimum"] is None) == (not grid.is_free(plan.cells[0]))
            assert (answer["optimum"] or 0) <= plan.length + 1e-9
        seen.add(plan.cells)
    assert len(seen) == len(ASKED)  # each option counts


def test_plan_draws_a_wide_map_for_a_terminal(capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("LINES", "40")
    assert main(["plan", "office", "--clearance-weight", "1"]) == 0
    *blocks, start, length = capsys.readouterr().out.splitlines()
    assert [line.count("▀") for line in blocks] == [96] * 32  # 6 cells per square
    assert "goal (550, 330)" in start
    assert re.search(r"cost \d{4}\.\d\d, greedy", length)


def test_plan_gives_every_cell(capsys: Any, tmp_path: Path) -> None:
    file = tmp_path / "path.csv"
    assert main(["plan", "office", "--cells", "--csv", str(file)]) == 0
    *cells, start, length = capsys.readouterr().out.splitlines()
    assert start == "start (15, 15), goal (550, 330), 39.50 m"
    assert length.startswith("length 789.95 cells, optimum 789.95 under robot_safe, greedy, ")
    assert (cells[0], cells[-1]) == ("15 15", "550 330")
    header, *rows = file.read_text().splitlines()
    assert (header, rows[0]) == ("x,y,x_metres,y_metres", "15,15,0.775,0.775")
    assert cells == [" ".join(row.split(",")[:2]) for row in rows]
    assert main(["plan", "dilemma", "--start", "1", "19", "--csv", str(file)]) == 1
    assert file.read_text().splitlines() == [header]  # of no other plan


def test_plan_writes_json_and_a_picture(capsys: Any, tmp_path: Path) -> None:
    def plan(picture: str, *goal: Any) -> Any:
        command = ["plan", "dilemma", "--json", "--picture", str(tmp_path / picture)]
        assert main([*command, *map(str, goal)]) == 0
        return json.loads(capsys.readouterr().out)

    answer = plan("plan.png")
    assert (answer["cells"][0], answer["cells"][-1]) == ([6, 6], [17, 19])
    assert (answer["status"], answer["length"]) == ("SUCCEEDED", pytest.approx(answer["optimum"]))
    with Image.open(tmp_path / "plan.png") as picture:
        assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 100
    moved = plan("moved.png", "--goal", 1, 19, "--tolerance", 9)
    assert moved["cells"][-1] != [1, 19]
    plan("there.png", "--goal", *moved["cells"][-1])  # the value is that of the end
    assert (tmp_path / "moved.png").read_bytes() == (tmp_path / "there.png").read_bytes()


def test_missing_matplotlib_is_named(
    capsys: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert main(["plan", "dilemma", "--picture", str(tmp_path / "plan.png")]) == 2
    assert capsys.readouterr().err.endswith("; pip install matplotlib\n")


ABSENT = """
import sys

class Absent:
    def find_spec(name, *_):
        library = name.partition(".")[0]
        if library in {libraries} or library.endswith("_msgs"):
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Absent)
"""
"""What a process runs first, as its ``sitecustomize``."""


@pytest.fixture
def without(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run an executable of the package as if neither ROS nor some libraries were installed."""

    def run(libraries: Sequence[str], *command: str) -> subprocess.CompletedProcess[str]:
        (tmp_path / "sitecustomize.py").write_text(ABSENT.format(libraries=libraries))
        path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
        environment, program = {**os.environ, "PYTHONPATH": path}, executable(command[0])
        arguments = [program, *command[1:]]
        return subprocess.run(arguments, env=environment, capture_output=True, text=True)

    return run


@pytest.mark.parametrize("library", ["torch", "gymnasium"])
def test_training_says_what_it_needs(without: Any, tmp_path: Path, library: str) -> None:
    for command in (["train", "dilemma"], ["train-any-map"])[: 1 + (library == "torch")]:
        done = without([library], "ddqn-planner", *command, "--out", str(tmp_path / "run"))
        expected = f"ddqn-planner: No module named '{library}'; pip install torch gymnasium\n"
        assert (done.stderr, done.returncode) == (expected, 2)


@pytest.mark.parametrize("node", ["map_server_node", "planner_node", "trainer_node"])
def test_a_node_without_ros_says_in_one_line_how_to_get_it(without: Any, node: str) -> None:
    done = without(["rclpy"], node)
    remedy = "install ROS 2 Jazzy and source it, or in the repository: pip install '.[ros]'"
    assert re.fullmatch(rf"{node}: No module named '\w+'; {re.escape(remedy)}\n", done.stderr)
    assert done.returncode == 1


def test_bad_input_ends_in_2(capsys: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save_map(GridMap(np.zeros((2, 2))), "bare.yaml")
    for command, named in (
        ("plan no_such_map.yaml", "no_such_map.yaml"),
        ("plan bare.yaml", "bare.yaml names no start and goal; give --start X Y"),
        ("plan dilemma --model no_such_model", "no_such_model"),
        ("plan dilemma --robot-radius -1", r"robot_radius is -1\.0"),
        ("plan dilemma --clearance-weight 2", r"clearance_weight is 2\.0"),
        ("plan dilemma --tolerance nan", "--tolerance is nan; give metres"),
        ("plan dilemma --tolerance -1", r"--tolerance is -1\.0; give metres"),
        ("plan dilemma --start-clearing-radius -1", r"--start-clearing-radius is -1\.0; give met"),
        ("train dilemma --gamma 2", r"gamma is 2\.0"),
        ("train dilemma --start 1 19", r"start \(1, 19\)"),
    ):
        assert main(command.split()) == 2
        assert re.search(named, error := capsys.readouterr().err)
        assert "Traceback" not in error


def test_a_trained_model_plans(capsys: Any, small_map: str, tmp_path: Path) -> None:
    train = ["train", small_map, "--out", str(tmp_path / "run"), "--network", "propagation"]
    train += ["--steps", "1000", "--learning-rate", "0.003", "--target-interval", "50"]
    assert main(train) == 0
    assert "of 16 starts" in capsys.readouterr().out
    model = str(tmp_path / "run" / "model.safetensors")
    assert main(["plan", small_map, "--model", model]) == 0
    assert "length" in capsys.readouterr().out


def test_each_hyper_parameter_can_be_given(small: Scenario, small_map: str, tmp_path: Path) -> None:
    given: dict[str, Any] = {}
    for each in PARAMETERS:
        low, default = each.metadata.get("range", [0])[0], each.default
        other = each.metadata.get("choices", (0, 0))[1]
        other = other or (default + 1 if default == low else (low + default) / 2)
        given[each.name] = type(default)(other)
    given["steps"] = 4
    arguments = [f"--{name.replace('_', '-')}={value}" for name, value in given.items()]
    out = str(tmp_path / "run")
    assert main(["train", small_map, "--out", out, "--seed", "5", *arguments]) == 0
    trainer = Trainer.load_checkpoint(tmp_path / "run" / "checkpoint.safetensors", [small])
    assert trainer.parameters == HyperParameters(**given)
    assert not given.items() & {entry.name: entry.default for entry in PARAMETERS}.items()
    assert trainer.seed == load_model(tmp_path / "run" / "model.safetensors")[1].seed == 5


def test_the_model_for_any_map_is_trained_with_parameters_of_its_own(tmp_path: Path) -> None:
    command = ["train-any-map", "--out", str(tmp_path), "--maps", "3", "--seed", "4"]
    assert main([*command, "--steps", "128"]) == 0
    scenarios = random_scenarios(seed=4, maps=3)
    trainer = Trainer.load_checkpoint(tmp_path / "checkpoint.safetensors", scenarios)
    assert (trainer.parameters, trainer.seed) == (replace(ANY_MAP, steps=128), 4)


@pytest.mark.slow
def test_an_interrupted_training_is_saved_and_resumed(small_map: str, tmp_path: Path) -> None:
    command = [executable("ddqn-planner"), "train", small_map, "--out", str(tmp_path / "run")]
    command += ["--filters", "4", "--steps", "1000000"]
    curves, steps = tmp_path / "run" / "episodes.csv", 0
    for number in (signal.SIGINT, signal.SIGTERM):
        rows = curves.read_text().count("\n") if curves.exists() else 0
        child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        deadline = time.monotonic() + PATIENCE
        while not curves.exists() or curves.read_text().count("\n") < rows + 5:
            assert time.monotonic() < deadline
            assert child.poll() is None
            time.sleep(0.05)
        os.kill(child.pid, number)
        printed, _ = child.communicate(timeout=PATIENCE)
        assert child.returncode == 0
        assert f"from step {steps} to" in printed
        assert "run the same command to resume" in printed
        before, steps = steps, load_model(tmp_path / "run" / "model.safetensors")[1].steps
        assert steps > before
