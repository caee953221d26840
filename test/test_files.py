"""What people call files, wherever a file is named: of a home folder, with blanks, or
of none.
"""

import errno
import os
import pwd
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ddqn_planner import Experience, Planner, load_map
from ddqn_planner.experience.drives import DriveFolder
from ddqn_planner.files import FileWriteError, as_path
from ddqn_planner.model import load_model, save_model
from ddqn_planner.model.model_file import find_model
from ddqn_planner.resources import find_map
from ddqn_planner.robot.motions import read_lattice
from ddqn_planner.training.environment import paper_scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.run import TrainingRun


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A home folder, and another one to work in, which stays empty."""
    home, work = tmp_path / "home", tmp_path / "work"
    home.mkdir()
    work.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.chdir(work)
    yield home
    assert list(work.iterdir()) == []


def of_user() -> pwd.struct_passwd:
    return pwd.getpwuid(os.getuid())


def test_a_tilde_is_a_home_folder_as_a_shell_reads_it(home: Path) -> None:
    me = of_user()
    for name, expected in (
        ("~", home),
        ("~/", home),
        ("~/x", home / "x"),
        ("~//a b/", home / "a b"),
        (Path("~/x"), home / "x"),
        ("file://~/x", home / "x"),
        (f"~{me.pw_name}/x", Path(me.pw_dir, "x")),
        ("runs/~/x", Path("runs/~/x")),
        ("./~/x", Path("~/x").absolute()),  # a second look finds no home in it
        ("a b", Path("a b")),
        ("file:///tmp/x", Path("/tmp/x")),
        ("x$", Path("x$")),
    ):
        assert as_path(name) == expected
        assert as_path(as_path(name)) == expected


@pytest.mark.parametrize("value", [None, ""])
def test_without_the_variable_the_home_is_that_of_the_users_list(
    value: str | None, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("HOME")
    if value is not None:
        monkeypatch.setenv("HOME", value)
    assert as_path("~/x") == Path(of_user().pw_dir, "x")

    def nobody(_: object) -> None:
        raise KeyError

    monkeypatch.setattr(pwd, "getpwuid", nobody)
    with pytest.raises(
        ValueError, match="no home folder of this user is known; give the full"
    ):
        as_path("~/x")


def test_a_full_disk_is_named_with_its_remedy(tmp_path: Path) -> None:
    for number in (errno.ENOSPC, errno.EDQUOT):
        error = FileWriteError(tmp_path / "x", OSError(number, os.strerror(number)))
        assert str(error).endswith("; make room there, or give another path")


NO_PATHS = {
    "": "path is ''; give a path",
    "  ": "path is '  '; give a path",
    "~nobody_there/x": "path is '~nobody_there/x', "
    "but no home folder of a user 'nobody_there'",
    "~\ud800": "half a character",
    "a\0b": "NUL character",
    "file://": "give a path",
    "http://host/x": "address of something else",
    "package://maps/x.yaml": "address of something else",
    "$HOME/x": "give its value instead of '[$]HOME', or ~",
    "a/${HOME}/x": "give its value instead of '[$]{HOME}'",
    "$(find-pkg-share x)/y": "variable that nothing has replaced",
    "x" * 256: "too long; give at most 255",
    "xx/" * 2000: "too long",
}


@pytest.mark.parametrize("name", NO_PATHS)
def test_what_names_no_file_is_an_error_with_a_remedy(name: str, home: Path) -> None:
    with pytest.raises(ValueError, match=f"(?s){NO_PATHS[name]}"):
        as_path(name)


def test_a_file_of_such_a_name_can_be_named(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("~map.yaml", "$HOME", "~$map.yaml"):
        with pytest.raises(ValueError, match=r"no home folder|a variable"):
            as_path(name)
        (tmp_path / name).touch()
        assert as_path(name).read_bytes() == b""
    assert as_path("$HOME/x") == Path("$HOME/x")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.text(max_size=20)
    | st.sampled_from(["~", "~/", "./~", "$", "${", "file://", "a://"])
)
def test_any_text_is_a_path_or_a_value_error(home: Path, text: str) -> None:
    with suppress(ValueError):
        path = as_path(text)
        assert not str(path).startswith("~")
        os.path.lexists(path)  # no error


MAP = """
image: m.pgm
resolution: 1
origin: [0, 0, 0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.2
"""


def learned() -> Experience:
    experience = Experience(0.5)
    experience.record(np.arange(9.0), np.stack([np.arange(9) / 2, np.ones(9)], axis=1))
    return experience


def test_each_public_call_that_names_a_file_knows_the_home_folder(home: Path) -> None:
    learned().save("~/new/e.npz")
    assert Experience.load("~/new/e.npz").evidence.places
    network, metadata = load_model("any_map")
    save_model("~/m.safetensors", network, metadata)
    assert find_model("~/m.safetensors") == home / "m.safetensors"
    assert Planner.load(Path("~/m.safetensors")).metadata == metadata
    (home / "m.yaml").write_text(MAP)
    (home / "m.pgm").write_bytes(b"P5 2 1 255\n\xfe\x00")
    for name in ("~/m.yaml", "file://~/m.yaml"):
        assert load_map(find_map(name)).occupancy.tolist() == [[False, True]]
    assert load_map("~/m.yaml").width == 2
    (home / "n.yaml").write_text(MAP.replace("m.pgm", "~/m.pgm"))
    assert load_map("~/n.yaml").width == 2
    with DriveFolder("~/drives", 0.5, 0.5, "~/new/e.npz") as folder:
        assert folder.experience.evidence.places
    scenario = paper_scenario()
    with TrainingRun("~/run", [scenario], HyperParameters(steps=1), 0) as run:
        assert run.folder == home / "run"
    with pytest.raises(ValueError, match=f"{home}/l.json: it cannot be read .No such"):
        read_lattice("~/l.json")
    assert {path.name for path in home.iterdir()} == {
        *("new", "m.safetensors", "m.yaml", "n.yaml", "m.pgm", "drives", "run")
    }


def test_each_option_that_names_a_file_knows_the_home_folder(
    home: Path, console: Callable[..., Any]
) -> None:
    pictured = "--csv ~/out/p.csv --picture ~/p.png --model ~/m.safetensors"
    network, metadata = load_model("any_map")
    save_model("~/m.safetensors", network, metadata)
    (home / "d.csv").write_text(
        "seconds,x,y\n" + "".join(f"{t},{t / 2},1\n" for t in range(20))
    )
    (home / "m.yaml").write_text(MAP)
    (home / "m.pgm").write_bytes(b"P5 20 3 255\n" + b"\xfe" * 60)
    console(f"plan ~/m.yaml --start 0 0 --goal 9 2 {pictured}")
    console("learn ~/d.csv --map ~/m.yaml --out ~/e.npz")
    console("learn ~/d.csv --map ~/m.yaml --experience ~/e.npz --out ~/f.npz")
    console("certify ~/m.safetensors")
    # The network that needs the least compiling.
    train = "train ~/m.yaml --start 0 0 --goal 9 2 --network propagation --steps 20"
    ran = console(f"{train} --out ~/run").out
    assert f"{home}/run/model.safetensors\n" in ran
    names = ("out/p.csv", "p.png", "e.npz", "f.npz", "run/checkpoint.safetensors")
    assert all((home / name).is_file() for name in names)
    for command in ("train dilemma --out", "learn ~/d.csv --map ~/m.yaml --experience"):
        with pytest.raises(SystemExit) as ended:
            console(f"{command} ~nobody_there/x")
        assert ended.value.code == 2
    for wrong in ("certify ~nobody_there/m", "plan ~nobody_there/m.yaml"):
        assert "no home folder of a user 'nobody_there'" in console(wrong, status=2).err


def test_a_file_in_a_folder_that_may_not_be_read_is_not_called_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(real: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function of the system that may not look below `tmp_path`."""

        def call(path: Any, *arguments: Any, **options: Any) -> Any:
            if isinstance(path, int) or not str(path).startswith(str(tmp_path)):
                return real(path, *arguments, **options)
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

        return call

    monkeypatch.setattr(os, "stat", refused(os.stat))
    monkeypatch.setattr(os, "open", refused(os.open))
    for read in (load_map, Planner.load):
        for name in ("any.yaml", "any.safetensors"):
            with pytest.raises(ValueError, match=r"Permission denied.*rights|ends in"):
                read(tmp_path / name)
