import os
import re
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from map_files import save_map
from processes import executable

from ddqn_planner.grid import GridMap, MapFile, MoveRule
from ddqn_planner.model import load_model
from ddqn_planner.resources import ROS, with_remedy
from ddqn_planner.training.any_map import ANY_MAP, random_scenarios
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.robot import RobotTrainer
from ddqn_planner.training.trainer import Trainer

PARAMETERS: Any = fields(HyperParameters)
OF_PAPER_ALONE = {"weight_decay", "weight_averaging", "priority"}
PATIENCE = 300
"""Seconds to wait for what should come at once: a loaded machine is slow, not wrong."""


@pytest.fixture
def small_map(small: Scenario, tmp_path: Path) -> str:
    path = tmp_path / "small.yaml"
    percent = small.grid.occupancy.astype("int8") * 100
    save_map(MapFile(percent, start=small.start, goal=small.goal), path)
    return str(path)


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
    """Run an executable of the package as if neither ROS nor some libraries were
    installed.
    """

    def run(
        libraries: Sequence[str], *command: str
    ) -> subprocess.CompletedProcess[str]:
        (tmp_path / "sitecustomize.py").write_text(ABSENT.format(libraries=libraries))
        path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
        environment, program = (
            {**os.environ, "PYTHONPATH": path},
            executable(command[0]),
        )
        arguments = [program, *command[1:]]
        return subprocess.run(
            arguments, env=environment, capture_output=True, text=True
        )

    return run


def test_training_says_what_it_needs(without: Any, tmp_path: Path) -> None:
    for command in (["train", "dilemma"], ["train-any-map"]):
        done = without(
            ["torch", "gymnasium"],
            "ddqn-planner",
            *command,
            "--out",
            str(tmp_path / "run"),
        )
        expected = "ddqn-planner: No module named 'torch'; pip install torch\n"
        assert (done.stderr, done.returncode) == (expected, 2)


@pytest.mark.parametrize("node", ["map_server_node", "planner_node", "trainer_node"])
def test_a_node_without_ros_says_in_one_line_how_to_get_it(
    without: Any, node: str
) -> None:
    done = without(["rclpy"], node)
    remedy = (
        "install ROS 2 Jazzy and source it, or in the repository: pip install '.[ros]'"
    )
    assert re.fullmatch(
        rf"{node}: No module named '\w+'; {re.escape(remedy)}\n", done.stderr
    )
    assert done.returncode == 1


def test_bad_input_ends_in_2(
    console: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
        (
            "plan dilemma --start-clearing-radius -1",
            r"--start-clearing-radius is -1\.0; give met",
        ),
        ("plan dilemma --model car", r"0\.05 m, and the map's have 0\.5 m; give a map"),
        ("train dilemma --gamma 2", r"gamma is 2\.0"),
        ("train dilemma --start 1 19", r"start \(1, 19\)"),
    ):
        assert re.search(named, error := console(command, status=2).err)
        assert "Traceback" not in error


def test_a_trained_model_plans(console: Any, small_map: str, tmp_path: Path) -> None:
    train = (
        "train --network propagation --steps 1000 --learning-rate 0.003 "
        "--target-interval 50"
    )
    assert " of 16\n" in console(train, small_map, "--out", tmp_path / "run").out
    model = tmp_path / "run" / "model.safetensors"
    assert "length" in console("plan", small_map, "--model", model).out


@pytest.mark.parametrize(
    ("network", "defaults"),
    [("paper", {"network"}), ("propagation", OF_PAPER_ALONE)],
)
def test_each_hyper_parameter_can_be_given(
    console: Any,
    small: Scenario,
    small_map: str,
    tmp_path: Path,
    network: str,
    defaults: set[str],
) -> None:
    parameters = [entry for entry in PARAMETERS if entry.name not in defaults]
    given: dict[str, Any] = {"network": network}
    for each in parameters:
        low, default = each.metadata.get("range", [0])[0], each.default
        other = each.metadata.get("choices", (0, 0))[1]
        other = other or (default + 1 if default == low else (low + default) / 2)
        given[each.name] = type(default)(other)
    given["steps"] = 4
    arguments = [f"--{name.replace('_', '-')}={value}" for name, value in given.items()]
    console("train --seed 5", small_map, "--out", tmp_path / "run", *arguments)
    scenario = replace(small, move_rule=MoveRule.CORNER_CUTTING)
    trainer = Trainer([scenario], HyperParameters(**given), seed=5)
    trainer.restore(
        tmp_path / "run" / "checkpoint.safetensors"
    )  # of these parameters alone
    assert trainer.steps == 4
    assert (
        not given.items() & {entry.name: entry.default for entry in parameters}.items()
    )
    assert load_model(tmp_path / "run" / "model.safetensors")[1].seed == 5


def test_a_training_on_no_map_is_refused(console: Any, tmp_path: Path) -> None:
    refused = console("train-any-map --maps 0 --out", tmp_path / "run", status=2).err
    assert "--maps is 0; give at least 1" in refused
    assert not any(tmp_path.iterdir())


def test_a_missing_library_of_ros_is_named_with_its_remedy() -> None:
    for module in ("rclpy", "nav_msgs.msg", "rcl_interfaces"):
        error = ImportError(f"No module named {module!r}", name=module)
        assert with_remedy(error) == f"{error}; {ROS}"


def test_the_model_for_any_map_is_trained_with_parameters_of_its_own(
    console: Any, tmp_path: Path
) -> None:
    console("train-any-map --maps 3 --seed 4 --steps 128 --out", tmp_path)
    scenarios = random_scenarios(seed=4, maps=3)
    trainer = Trainer(scenarios, ANY_MAP, seed=4)
    trainer.restore(tmp_path / "checkpoint.safetensors")  # of these parameters alone
    assert trainer.steps == 128


@pytest.mark.slow
def test_an_interrupted_training_is_saved_and_resumed(
    small_map: str, tmp_path: Path
) -> None:
    command = [
        executable("ddqn-planner"),
        "train",
        small_map,
        "--out",
        str(tmp_path / "run"),
    ]
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
        assert child.returncode == 128 + number
        assert f"from step {steps} to" in printed
        assert "run the same command to resume" in printed
        before, steps = (
            steps,
            load_model(tmp_path / "run" / "model.safetensors")[1].steps,
        )
        assert steps > before


@pytest.mark.parametrize(
    "command",
    [
        "train dilemma",
        "train-any-map",
        "train-robot --footprint 0.2 --motion differential",
    ],
)
def test_a_place_that_cannot_be_written_is_named_before_a_training(
    console: Any, tmp_path: Path, command: str
) -> None:
    file = tmp_path / "file"
    file.touch()
    for out in (file / "below", "/proc/none"):
        error = console(command, "--out", out, status=2).err
        assert re.search("cannot be written .*; give another --out", error)
    wrong = console(command, "--seed", "-1", "--out", tmp_path / "x", status=2).err
    assert "the seed is -1; give a whole number" in wrong


def test_files_that_cannot_be_written_are_named_before_a_plan(
    console: Any, tmp_path: Path
) -> None:
    for option in ("--csv", "--picture"):
        for wrong in (tmp_path, "/dev/null", "/proc/none/x.png"):
            error = console("plan dilemma", option, wrong, status=2).err
            assert re.search(
                f"(no regular file|cannot be written).*; give another {option}", error
            )
    assert not any(tmp_path.iterdir())


def test_an_interrupted_compilation_ends_with_one_line(tmp_path: Path) -> None:
    command = [executable("ddqn-planner"), "warm-up"]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    child = subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, env=environment
    )
    assert child.stderr is not None
    assert "compiles its functions" in child.stderr.readline()
    child.send_signal(signal.SIGINT)
    assert child.wait(PATIENCE) == 130
    assert child.stderr.read() == "ddqn-planner: interrupted\n"
    child.stderr.close()


def test_an_interrupted_training_of_a_robot_says_that_nothing_is_saved(
    console: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settle = RobotTrainer._settle

    def settle_at_ctrl_c(trainer: RobotTrainer) -> None:
        settle(trainer)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(RobotTrainer, "_settle", settle_at_ctrl_c)
    words = "train-robot --footprint 0.1 --motion differential --out"
    error = console(words, tmp_path / "robot.safetensors", status=130).err
    assert "after 0 transitions; nothing is saved" in error
    assert error.endswith("ddqn-planner: interrupted\n")
    assert not any(tmp_path.iterdir())
