"""The environment that the Makefile makes, in stages."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PROGRAM = str(ROOT / "tools" / "environment.py")
OLD_PYTHON = f"""
import runpy, sys
sys.version_info = (3, 8, 10)
sys.argv = [{PROGRAM!r}, sys.argv[1]]
runpy.run_path({PROGRAM!r})
"""


def environ(distribution: str, modules: Path | None = None) -> dict[str, str]:
    """Return an environment in which a ROS is sourced, or none, and modules go before
    Python's.
    """
    environment = {
        key: value for key, value in os.environ.items() if key != "ROS_DISTRO"
    }
    if distribution:
        environment["ROS_DISTRO"] = distribution
    if modules is not None:
        environment["PYTHONPATH"] = str(modules)
    return environment


@pytest.mark.parametrize(
    ("distribution", "missing", "reason"),
    [
        ("humble", "", "ROS 2 humble is sourced; this package is for Jazzy and later"),
        ("jazzy", "rclpy", "ROS_DISTRO is jazzy, but .* cannot import its rclpy"),
        ("kilted", "rclpy", "ROS_DISTRO is kilted, but .* cannot import its rclpy"),
        (
            "",
            "ensurepip",
            r"cannot make virtual environments: apt install python3\.\d+-venv",
        ),
        (
            "",
            "venv",
            r"cannot make virtual environments: apt install python3\.\d+-venv",
        ),
    ],
)
def test_what_keeps_an_environment_from_being_made_is_named(
    tmp_path: Path, distribution: str, missing: str, reason: str
) -> None:
    (tmp_path / f"{missing or 'other'}.py").write_text("raise ImportError")
    folder = tmp_path / "environment"
    command = [sys.executable, PROGRAM, str(folder)]
    run = subprocess.run(
        command,
        env=environ(distribution, tmp_path),
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 1
    assert re.search(reason, run.stderr), run.stderr
    assert not folder.exists()


def test_a_python_that_is_too_old_is_named(tmp_path: Path) -> None:
    command = [sys.executable, "-c", OLD_PYTHON, str(tmp_path / "environment")]
    run = subprocess.run(
        command, env=environ(""), capture_output=True, text=True, check=False
    )
    assert run.returncode == 1
    assert run.stderr.startswith(
        f"{sys.executable} is Python 3.8; 3.10 or later is needed: name"
    )
    assert "make PYTHON=" in run.stderr


@pytest.mark.slow(seconds=8)
def test_an_environment_that_does_not_run_is_made_anew_and_another_one_kept(
    tmp_path: Path,
) -> None:
    folder, kept = tmp_path / "environment", tmp_path / "environment" / "kept"
    (folder / "bin").mkdir(parents=True)
    (folder / "bin" / "python").symlink_to("/no/such/python")
    kept.touch()

    def make(distribution: str) -> str:
        command = [sys.executable, PROGRAM, str(folder)]
        return subprocess.check_output(command, env=environ(distribution), text=True)

    def sees_system() -> bool:
        return (
            "include-system-site-packages = true" in (folder / "pyvenv.cfg").read_text()
        )

    assert make("") == "figures,ros"
    assert not kept.exists()
    assert not sees_system()
    subprocess.run([folder / "bin" / "python", "-m", "pip", "--version"], check=True)
    kept.touch()
    # With a ROS that is sourced, none comes from PyPI: rclpy of this very environment,
    # here.
    pytest.importorskip("rclpy")
    assert make("jazzy") == "figures"
    assert kept.exists()
    assert sees_system()


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_only_what_trains_waits_for_torch(tmp_path: Path) -> None:
    def commands(target: str) -> str:
        command = [
            "make",
            "--dry-run",
            target,
            f"VENV={tmp_path}",
            "TORCH=torch --index-url url",
        ]
        return subprocess.check_output(command, cwd=ROOT, text=True)

    for target in ("demo", "demo-driving"):
        assert "pip install" in commands(target)
        assert "torch" not in commands(target)
    for target in (
        "demo-training",
        "test",
        "lint",
        "types",
        "docs",
        "experiments-test",
        "model",
    ):
        assert (
            "-m pip install --quiet --disable-pip-version-check torch --index-url url"
            in (commands(target))
        )
    for target in ("test", "docs"):
        assert "bags,experiments,lint,test" in commands(target)
    assert '".[docs]"' in commands("docs")
