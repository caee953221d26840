import gc
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

# Read by the first import of a message type.
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"

# Read by the first node. Tests have several nodes in one process, and Fast DDS 2.14 was
# seen to deadlock when one of them ended while it told the others by a call instead of
# a message.
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(
    Path(__file__).with_name("fastdds.xml")
)

from shared import paper as paper
from shared import small as small

from ddqn_planner.cli import main

ROOT = Path(__file__).resolve().parent.parent
NOBODY = 65534
NOT_SOURCE = (
    ".*",
    "__pycache__",
    "*.egg-info",
    "build",
    "dist",
    "install",
    "log",
    "runs",
)
# Their tests take long, and share nothing.
ANY_WORKER = {"test_cli.py", "test_demo.py", "test_plan_command.py"}
# The files that take longest come first: so the workers end at the same time.
LONGEST_FILES = (
    "test_lifecycle.py",
    "test_poses.py",
    "test_driving.py",
    "test_update.py",
    "test_planner_robot.py",
    "test_imports.py",
    "test_robot_model.py",
    "test_environment.py",
    "test_trainer_node.py",
    "test_field.py",
    "test_package.py",
    "test_planner_node.py",
    "test_colcon.py",
    "test_motions.py",
    "test_robot.py",
    "test_planner_fuzz.py",
    "test_any_map.py",
    "test_training_record.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files that take longest first; in each file, the slow tests last."""

    def order(item: pytest.Item) -> tuple[int, bool, int]:
        rank = len(LONGEST_FILES)
        if item.path.name in LONGEST_FILES:
            rank = LONGEST_FILES.index(item.path.name)
        slow = item.get_closest_marker("slow")
        seconds = slow.kwargs.get("seconds", 0) if slow else 0
        return rank, slow is not None, -seconds

    items.sort(key=order)


def pytest_collection_finish() -> None:
    """Let garbage collections skip what the imported modules hold: 0.3 s each."""
    gc.freeze()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give the tests of a file to one worker, where they share nodes and models."""
    from xdist.scheduler import LoadScopeScheduling

    class Scheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition("::")[0]
            return nodeid if Path(file).name in ANY_WORKER else file

    return Scheduling(config, log)


@pytest.fixture
def console(capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """Run `ddqn-planner` with words and other arguments; return what it writes to out
    and err.
    """

    def run(words: str, *others: object, status: int = 0) -> Any:
        assert main([*words.split(), *map(str, others)]) == status
        return capsys.readouterr()

    return run


@pytest.fixture
def plain_folder() -> Iterator[Path]:
    """A folder of a user who is not root, and may not read everything, for the time of
    a test.
    """
    folder = Path(tempfile.mkdtemp())
    user = os.geteuid()
    if user == 0:
        folder.chmod(0o777)
        os.seteuid(NOBODY)
    try:
        yield folder
    finally:
        os.seteuid(user)
        shutil.rmtree(folder)


@pytest.fixture
def often_switched() -> Iterator[None]:
    """Let threads take turns 500 times as often: what is not safe fails in most
    runs.
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(before)


@pytest.fixture(scope="session")
def source_copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Copy the source: a build leaves its folders beside it."""
    copy = tmp_path_factory.mktemp("workspace") / "src" / "ddqn_planner"
    ignore = shutil.ignore_patterns(*NOT_SOURCE)
    return Path(shutil.copytree(ROOT, copy, symlinks=True, ignore=ignore))
