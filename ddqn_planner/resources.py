"""Finds the shipped maps and models, and names the package of a missing library."""

import difflib
import os
from pathlib import Path
from typing import Final

from ddqn_planner.files import as_path

PACKAGE: Final = "ddqn_planner"
ROS: Final = (
    "install ROS 2 Jazzy and source it, or in the repository: pip install '.[ros]'"
)

# The packages to install with pip, by the module that is missing.
PACKAGES: Final = {
    "gymnasium": "gymnasium",
    "matplotlib": "matplotlib",
    "mcap": "mcap rosbags",
    "numba": "numba",
    "rosbags": "mcap rosbags",
    "safetensors": "safetensors",
    "stable_baselines3": "stable-baselines3",
    "tensorboard": "tensorboard",
    "torch": "torch",
    "zstandard": "mcap rosbags",
}


def with_remedy(error: Exception) -> str:
    """Return the text of an error; if a library is missing, with what to install."""
    module = getattr(error, "name", None) or ""  # of an ImportError
    library = module.partition(".")[0]
    if library == "rclpy" or library.endswith(("_interfaces", "_msgs", "_srvs")):
        return f"{error}; {ROS}"
    if library in PACKAGES:
        return f"{error}; pip install {PACKAGES[library]}"
    return str(error)


def find_resource(folder: str, name: str) -> Path:
    """Return the path of a shipped file; the folder is ``"maps"`` or ``"models"``.

    A FileNotFoundError lists the files of the folder.
    """
    # The folders lie beside the code in each kind of installation. The copies in share/
    # are for ROS tools.
    directory = Path(__file__).parent / folder
    if os.path.isfile(directory / name):
        return directory / name
    files = ", ".join(sorted(path.name for path in directory.glob("*.*")))
    raise FileNotFoundError(f"no {name!r} in {directory}; there are: {files or 'none'}")


def find_map(name: str) -> Path:
    """Return the file of a map.

    `name` is a path, a ``file://`` or ``package://`` URL, or the name of a shipped map.
    A FileNotFoundError says why there can be no such file.
    """
    if name.startswith("package://"):
        return _package_path(name)
    try:
        path = as_path(name, "the map")
    except ValueError as error:
        raise FileNotFoundError(str(error)) from None
    # A file in the working directory has priority over a shipped map. Whether the file
    # is missing, or no regular file, is reported by the function that reads it.
    has_folder = path.name != name
    if has_folder or (os.path.exists(path) and not os.path.isdir(path)):
        return path
    try:
        return find_resource("maps", name if path.suffix else f"{name}.yaml")
    except FileNotFoundError:
        folder = Path(__file__).parent / "maps"
        maps = sorted(file.stem for file in folder.glob("*.yaml"))
        similar = difflib.get_close_matches(path.stem, maps, 1)
        problem = f"there is no map file {name!r}, and no shipped map of that name"
        hint = f"did you mean {similar[0]!r}? " if similar else ""
        remedy = f"{hint}give a path, or one of {', '.join(maps)}"
        raise FileNotFoundError(f"{problem}; {remedy}") from None


def _package_path(url: str) -> Path:
    """Return the file of ``package://PACKAGE/PATH``: in the share folder of a package.

    `url` is the URL. A FileNotFoundError if the package is unknown, or if PATH leads
    out of the package.
    """
    package, _, path = url.removeprefix("package://").partition("/")
    if path.startswith("/") or ".." in Path(path).parts:
        raise FileNotFoundError(f"{url!r} leads out of its package; give a path in it")
    if package == PACKAGE:
        return find_resource(str(Path(path).parent), Path(path).name)
    try:
        from ament_index_python.packages import get_package_share_directory

        return Path(get_package_share_directory(package)) / path
    except (ImportError, LookupError, OSError, ValueError) as error:
        raise FileNotFoundError(
            f"{url!r}: no such package ({error}); give a path"
        ) from None
