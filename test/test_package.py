import ast
import datetime
import json
import os
import re
import runpy
import shutil
import signal
import subprocess
import sys
import sysconfig
from pathlib import Path
from xml.etree import ElementTree
from zipfile import ZipFile

import numpy as np
import pytest
import safetensors.numpy
from limits import files_no_longer_than
from safetensors import safe_open

import ddqn_planner
from ddqn_planner.cli import main
from ddqn_planner.files import WorkFolder, write_atomically
from ddqn_planner.model.model_file import METADATA_KEY
from ddqn_planner.resources import find_map

ROOT = Path(__file__).resolve().parent.parent
MANIFEST = ElementTree.parse(ROOT / "package.xml")
VERSION = MANIFEST.findtext("version", "")
REPOSITORY = MANIFEST.findtext("url[@type='repository']", "")
ROOMS = ["grid", "robot", "model", "planning", "experience", "training", "nodes"]
TRAINING = {"torch", "gymnasium"}
PIP = [sys.executable, "-m", "pip", "--quiet"]


@pytest.mark.parametrize("room", ROOMS)
def test_imports_run_downwards(room: str) -> None:
    others = [*ROOMS[ROOMS.index(room) + 1 :], "commands", "cli"]
    above = [f"ddqn_planner.{name}" for name in others]
    for path in (ROOT / "ddqn_planner" / room).glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            for module in modules:
                assert not module.startswith(tuple(above)), f"{path} imports {module}"
                assert room == "nodes" or not module.startswith("rclpy"), (
                    f"{path}: {module}"
                )


@pytest.fixture(scope="module")
def wheel(source_copy: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    build = [
        "wheel",
        "--no-deps",
        "--no-build-isolation",
        "--wheel-dir",
        folder,
        source_copy,
    ]
    subprocess.run([*PIP, *build], check=True)
    (path,) = folder.glob("*.whl")
    return path


@pytest.mark.slow
def test_the_wheel_asks_for_torch_only_to_train(wheel: Path) -> None:
    with ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("/METADATA"))
        text = archive.read(name).decode()
    needed = set(re.findall(r"^Requires-Dist: (\w+)[^;\n]*(.*)$", text, re.M))
    assert {(library, "") for library in ("numba", "numpy", "safetensors")} <= needed
    of_training = {entry for entry in needed if entry[0] in TRAINING}
    assert of_training == {(library, '; extra == "train"') for library in TRAINING}


def test_a_release_gives_its_version_to_all(tmp_path: Path) -> None:
    copy = tmp_path / "ddqn_planner"
    for folder in ("models", "tools"):
        shutil.copytree(ROOT / folder, copy / folder)
    for name in ("package.xml", "CITATION.cff"):
        shutil.copy(ROOT / name, copy)
    changes = (ROOT / "CHANGELOG.md").read_text()
    changes = re.sub(r"(?s)## \[Unreleased\]\n.*?(?=## \[)", "", changes)
    newest = f"## [{VERSION}]"
    changes = changes.replace(newest, f"## [Unreleased]\n\n- It flies.\n\n{newest}", 1)
    (copy / "CHANGELOG.md").write_text(changes)

    runpy.run_path(str(copy / "tools/release.py"))["main"](["12.0.3"])

    today = datetime.date.today().isoformat()
    assert "<version>12.0.3</version>" in (copy / "package.xml").read_text()
    citation = (copy / "CITATION.cff").read_text()
    assert f"\nversion: 12.0.3\ndate-released: {today}\n" in citation
    changes = (copy / "CHANGELOG.md").read_text()
    assert f"## [12.0.3] - {today}\n\n- It flies.\n\n{newest}" in changes
    assert f"\n[12.0.3]: {REPOSITORY}/compare/v{VERSION}...v12.0.3\n" in changes
    for path in (ROOT / "models").iterdir():
        model = copy / "models" / path.name
        assert version_of(model) == "12.0.3"
        tensors = safetensors.numpy.load_file(path)
        same = safetensors.numpy.load_file(model)
        assert same.keys() == tensors.keys()
        assert all(np.array_equal(same[name], tensors[name]) for name in tensors)


@pytest.mark.slow
def test_few_pages_of_the_docs_have_no_picture() -> None:
    pages = runpy.run_path(str(ROOT / "tools" / "pages.py"))["pages_without_picture"]()
    assert "install.md" in pages
    assert "training.md" not in pages
    assert len(pages) <= 5


def test_the_page_on_pypi_has_full_addresses(wheel: Path) -> None:
    with ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("/METADATA"))
        text = archive.read(name).decode()
    assert f"\nVersion: {VERSION}\n" in text
    assert not re.search("<this\\b", text)  # a clone command names the repository
    targets = re.findall(r"\]\(([^)\s]+)|\b(?:src|href)=\"([^\"]+)", text)
    for address in (markdown or html for markdown, html in targets):
        assert address.startswith("https://"), address
        if address.startswith(REPOSITORY):
            kind = "raw" if address.endswith((".gif", ".png", ".svg")) else "blob"
            root = f"{REPOSITORY}/{kind}/v{VERSION}/"
            assert address.startswith(root), address
            path = address.removeprefix(root).partition("#")[0]
            assert (ROOT / path).is_file(), address


def version_of(model: Path) -> str:
    """Return the version in a model file's metadata; to load a robot takes longer."""
    with safe_open(model, "numpy") as file:
        description = json.loads(file.metadata()[METADATA_KEY])
    return str(description["package_version"])


def test_one_version_everywhere(capsys: pytest.CaptureFixture[str]) -> None:
    changes = (ROOT / "CHANGELOG.md").read_text()
    release = r"^## \[(.+)\] - (\d{4}-\d\d-\d\d)$"
    newest, date = re.findall(release, changes, re.M)[0]
    assert newest == VERSION
    assert f"v{VERSION}\n" in changes  # the address of its tag
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {VERSION}\ndate-released: {date}\n" in citation
    assert ddqn_planner.__version__ == VERSION
    with pytest.raises(SystemExit, match="0"):
        main(["--version"])
    assert capsys.readouterr().out == f"ddqn-planner {VERSION}\n"
    for path in (ROOT / "models").iterdir():
        assert version_of(path) == VERSION, path


PRINT_VERSION = "import ddqn_planner; print(ddqn_planner.__version__)"


def test_the_version_is_that_of_the_source_else_of_the_installation(
    tmp_path: Path,
) -> None:
    package = tmp_path / "ddqn_planner"
    package.symlink_to(ROOT / "ddqn_planner")

    def version_in(folder: Path) -> str:
        # Isolated from the environment's installation.
        script = f"import sys; sys.path.insert(0, {str(folder)!r}); {PRINT_VERSION}"
        command = [sys.executable, "-S", "-c", script]
        # Not in the folder of the tests, which may have metadata, too.
        return subprocess.check_output(command, text=True, cwd=folder).strip()

    assert version_in(tmp_path) == VERSION
    # A copy, as installed: the package.xml beside it is of another package.
    package.unlink()
    package.mkdir()
    for path in (ROOT / "ddqn_planner").glob("*.py"):
        shutil.copy(path, package)
    (tmp_path / "package.xml").write_text("<package><name>other</name></package>")
    assert version_in(tmp_path) == "unknown"
    metadata = tmp_path / "ddqn_planner-1.2.3.dist-info" / "METADATA"
    metadata.parent.mkdir()
    metadata.write_text("Metadata-Version: 2.1\nName: ddqn_planner\nVersion: 1.2.3\n")
    assert version_in(tmp_path) == "1.2.3"


WHERE = """
import ddqn_planner
from ddqn_planner.model import find_model
from ddqn_planner.resources import find_map
print(ddqn_planner.__file__, find_map("dilemma"), find_model("dilemma"))
"""


IMPORT_EXAMPLE = """
import sys
sys.path.insert(0, sys.argv[1])
import demo_training
print(demo_training.__file__)
"""


# --user and Debian's Python install beside another share folder than the interpreter's,
# as the last two do.
@pytest.mark.slow
@pytest.mark.parametrize("option", [None, "--target", "--prefix"])
def test_maps_and_models_come_everywhere(
    wheel: Path, tmp_path: Path, option: str | None
) -> None:
    environment = tmp_path / "environment"
    subprocess.run(
        [sys.executable, "-m", "venv", "--without-pip", environment], check=True
    )
    python, folder = environment / "bin" / "python", tmp_path / "elsewhere"
    into = [option, folder] if option else []
    install = ["install", "--no-deps", "--no-compile"]
    folder = folder if option else environment
    subprocess.run([*PIP, "--python", python, *install, *into, wheel], check=True)
    (package,) = folder.glob("**/ddqn_planner/__init__.py")
    # The libraries of this environment; its editable install of the package is not
    # among them.
    path = [str(package.parents[1]), sysconfig.get_path("purelib")]
    environ = {**os.environ, "PYTHONPATH": os.pathsep.join(path)}

    def run(*arguments: str | Path) -> str:
        command = [python, *arguments]
        return subprocess.check_output(command, env=environ, cwd=tmp_path, text=True)

    assert all(Path(path).is_relative_to(folder) for path in run("-c", WHERE).split())
    (program,) = folder.rglob("bin/ddqn-planner")
    assert "4,096" in run(program, "certify")
    for name in ("map_server_node", "planner_node", "trainer_node"):
        assert (program.parent / name).is_file()
    (marker,) = folder.glob(
        "**/resource_index/packages/ddqn_planner"
    )  # where ROS looks
    share = marker.parents[3] / "ddqn_planner"
    for name in ("launch", "rviz"):
        shipped = {path.name: path.read_bytes() for path in (ROOT / name).glob("*.*")}
        assert {
            path.name: path.read_bytes() for path in (share / name).glob("*.*")
        } == shipped
    # An example finds its helpers; it imports torch, for seconds.
    assert (share / "examples" / "demo_training.py").is_file()
    assert (share / "experiments" / "figures.py").is_file()
    if option is None:
        example = run("-c", IMPORT_EXAMPLE, share / "examples")
        assert Path(example.strip()).parent == share / "examples"
    for name in ("maps", "models"):
        shipped = {path.name: path.read_bytes() for path in (ROOT / name).iterdir()}
        copy = package.parent / name
        assert {path.name: path.read_bytes() for path in copy.iterdir()} == shipped
        assert not (share / name).exists()  # a wheel has them once


def test_a_map_is_shipped_or_of_a_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = ROOT / "maps" / "dilemma.yaml"
    for name in ("dilemma", "dilemma.yaml", "package://ddqn_planner/maps/dilemma.yaml"):
        assert find_map(name).resolve() == shipped
    assert find_map("file:///somewhere/map.yaml") == Path("/somewhere/map.yaml")
    with pytest.raises(FileNotFoundError, match=r"no_such.*dilemma, office"):
        find_map("no_such")
    for name in (
        "ddqn_planner/maps/../../x",
        "ddqn_planner//etc/x",
        "no/../x",
        "no//etc/x",
    ):
        with pytest.raises(FileNotFoundError, match="leads out of its package"):
            find_map(f"package://{name}")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    for name in ("", "no_such", "nul\0", "\ud800", "..", "x" * 5000):
        with pytest.raises(FileNotFoundError, match="no such package"):
            find_map(f"package://{name}/map.yaml")
    # A file hides a shipped map, but a folder does not.
    monkeypatch.chdir(tmp_path)
    for name in ("dilemma", "dilemma.yaml"):
        (tmp_path / name).mkdir()
        assert find_map(name).resolve() == shipped
    (tmp_path / "office.yaml").touch()
    assert find_map("office.yaml") == Path("office.yaml")
    assert find_map("office").resolve().parent == shipped.parent


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(
    tmp_path: Path,
) -> None:
    path = tmp_path / "file"
    write_atomically(path, b"old")
    (tmp_path / "other").touch()
    assert path.stat().st_mode == (tmp_path / "other").stat().st_mode
    with files_no_longer_than(1000), pytest.raises(OSError, match="too large"):
        write_atomically(path, b"n" * 2000)
    assert path.read_bytes() == b"old"
    assert sorted(tmp_path.iterdir()) == [path, tmp_path / "other"]


WRITE_FOR_EVER = """
import sys
from pathlib import Path
from ddqn_planner.files import write_atomically

while True:
    write_atomically(Path(sys.argv[1]), b"whole" * 100_000)
    print(flush=True)
"""


def test_a_kill_leaves_a_complete_file_and_a_temporary_that_can_be_removed(
    tmp_path: Path,
) -> None:
    path = tmp_path / "file"
    left = 0
    while not left:
        command = [sys.executable, "-c", WRITE_FOR_EVER, str(path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as writer:
            assert writer.stdout is not None
            for _ in range(5):
                writer.stdout.readline()
            writer.send_signal(signal.SIGKILL)
        assert path.read_bytes() == b"whole" * 100_000
        left = len(list(tmp_path.iterdir())) - 1
    others = [
        tmp_path / name for name in (".another", ".file.swp", "file.0123456789abcdef")
    ]
    for other in others:
        other.touch()
    WorkFolder(tmp_path, ["file"], "files", "writes").close()
    assert sorted(tmp_path.iterdir()) == sorted([*others, path])
