"""`make faults`, `load`, `soak` and the driving demo, at a small scale."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image
from processes import claim_ros_domain, running_node

pytest.importorskip("rclpy")
from client import Client
from load import load_bursts, load_goals, load_requests
from soak import Work, growth, soak

ROOT = Path(__file__).resolve().parents[2]
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(ROOT / "test" / "fastdds.xml")
_claim = claim_ros_domain()


def run(script: Path, argument: str, folder: Path) -> str:
    """Run a script, which takes a ROS domain of its own; return what it printed."""
    command = [sys.executable, str(script), argument]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_killed_nodes_leave_nothing_broken_and_work_again(tmp_path: Path) -> None:
    printed = run(ROOT / "experiments" / "faults.py", "3", tmp_path)
    killed_once = re.findall(r"^\| (\w+)_node \| \w+ \| 1 \|", printed, re.MULTILINE)
    assert killed_once == ["planner", "map_server", "trainer"], printed


def test_every_answer_is_right_while_the_map_changes_and_goals_are_planned_in_order(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with running_node("planner_node") as planner:
        failed = [load_requests(planner.pid, requests=200, clients=4), load_goals(200)]
        failed += load_bursts((20, 50), (20,), 2)
        assert planner.poll() is None
    printed = "".join(capfd.readouterr())
    assert not any(failed), printed
    assert "Traceback" not in printed


def test_mixed_work_with_bad_input_is_answered_and_sampled(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with (
        running_node("map_server_node") as server,
        running_node("planner_node") as planner,
        Client() as client,
    ):
        work = Work(client)
        work.bad_input()
        children = {"map_server_node": server, "planner_node": planner}
        samples = soak(children, work, minutes=0.05)
    assert work.done["lost"] == 0
    assert work.done.total() > 0
    assert all(memory and min(memory) > 0 for memory in samples.values())
    assert "Traceback" not in "".join(capfd.readouterr())


def test_growth_leaves_out_the_warm_up() -> None:
    assert growth([1.0, 50.0, *7 * [100.0], 104.0]) == (
        100.0,
        104.0,
        pytest.approx(0.04),
    )


def test_a_robot_learns_by_driving_and_what_it_learned_is_drawn(tmp_path: Path) -> None:
    printed = run(ROOT / "examples" / "demo_driving.py", "3", tmp_path)
    # No route is better than the best possible one.
    routes = re.findall(
        r"mission +\d: drove +\d+\.\d s; its route takes 1\.\d\d of", printed
    )
    assert len(routes) == 3
    with Image.open(tmp_path / "demo_driving.gif") as film:
        assert film.n_frames == 3
    for name in ("demo_driving.png", "demo_driving_curve.png"):
        with Image.open(tmp_path / name) as picture:
            assert min(picture.size) >= 300
            assert len(picture.convert("RGB").getcolors(10**7) or []) > 50


def test_a_robot_that_is_trained_is_filmed(tmp_path: Path) -> None:
    printed = run(ROOT / "examples" / "demo_training.py", "30", tmp_path)
    shares = re.findall(r"step +(\d+): +\d+% of the starts", printed)
    assert shares == [str(step) for step in range(1, 31)]
    with Image.open(tmp_path / "demo_training.gif") as film:
        assert film.n_frames == 31
