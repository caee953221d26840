from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from PIL import Image
from reproduce import EXPERIMENTS, main

PROGRAM = Path(__file__).parents[1] / "reproduce.py"

PATIENCE = 300
"""Seconds to wait for what should come at once: a loaded machine is slow, not wrong."""


@pytest.mark.slow(seconds=40)
@pytest.mark.filterwarnings("ignore:All-NaN")  # of one seed that learns nothing
def test_reproduce_runs_every_experiment_and_writes_its_report(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    reading = ["--noise", "on_path", "--hidden-units", "0"]

    def reproduce(experiment: str, seeds: int) -> str:
        command = [
            "--backend",
            "sequential",
            "--quick",
            "--experiment",
            experiment,
            "--seeds",
            str(seeds),
        ]
        assert main([*command, "--out", str(tmp_path), *reading]) == 0
        report = (folder / "report.md").read_text()
        assert report in capsys.readouterr().out
        for name in EXPERIMENTS if experiment == "all" else [experiment]:
            options = f"--experiment {name} --seeds {seeds} {' '.join(reading)} --quick"
            assert f"`python experiments/reproduce.py {options}`" in report
        return report

    folder = tmp_path / "quick"
    report = reproduce("all", seeds=1)
    for picture in re.findall(r"!\[.*?\]\((.*?)\)", report):
        with Image.open(folder / picture) as image:
            assert min(image.size) > 300
            assert len(image.convert("RGB").getcolors(image.width * image.height)) > 20
    assert "| propagation | 286 |" in report
    trained = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("evaluations.csv")}
    assert len(trained) == 8 + 2 + 2
    # Only the second seed of both profiles is new.
    assert "| propagation | 286 |" in reproduce("goal-2", seeds=2)
    assert trained == {path: path.stat().st_mtime_ns for path in trained}
    assert len([*tmp_path.rglob("evaluations.csv")]) == len(trained) + 2


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_experiments_end_with_all_their_processes(tmp_path: Path, number: int) -> None:
    command = [sys.executable, PROGRAM, "--experiment", "goal-1", "--out", tmp_path]
    child = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + PATIENCE
    while not [*tmp_path.rglob("evaluations.csv")]:
        assert time.monotonic() < deadline
        assert child.poll() is None
        time.sleep(0.05)
    os.kill(child.pid, number)
    # To the end of what every process may print: so all of them have ended.
    _, printed = child.communicate(timeout=PATIENCE)
    assert child.returncode == 130
    assert "run the same command to resume" in printed


def test_reproduce_refuses_less_than_one_seed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--seeds", "0"]) == 2
    assert "--seeds is 0; give at least 1" in capsys.readouterr().err


@pytest.mark.slow(seconds=15)
def test_reproduce_may_be_asked_for_one_reading_of_goal_3(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["--backend", "sequential", "--quick", "--seeds", "1", "--out", str(tmp_path)]
    assert main([*command, "--experiment", "goal-3", "--hidden-units", "3"]) == 0
    report = capsys.readouterr().out
    options = "--seeds 1 --hidden-units 3 --quick"
    assert f"`python experiments/reproduce.py --experiment goal-3 {options}`" in report
    for noise in ("on_path", "near_path"):
        assert f"| {noise} | paper, 3 hidden units |" in report
    assert "| paper |" not in report


def test_reproduce_refuses_a_hidden_layer_that_cannot_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["--experiment", "goal-3", "--hidden-units", "-1"]
    assert main([*command, "--out", str(tmp_path)]) == 2
    assert "hidden_units is -1" in capsys.readouterr().err
