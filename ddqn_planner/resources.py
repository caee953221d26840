"""Finds the shipped maps and models, and says what to install where a library is missing."""

import difflib
import os
from pathlib import Path
from typing import Final

from ddqn_planner.files import as_path

PACKAGE: Final = "ddqn_planner"
ROS: Final = (
    "install ROS 2 Jazzy and source it, or in the repository: pip install '.[ros]'"
)

# What to give to pip, by module.
PACKAGES: Final = {
    "gymnasium": "torch gymnasium",
    "matplotlib": "matplotlib",
    "mcap": "mcap-ros2-support",
    "mcap_ros2": "mcap-ros2-support",
    "numba": "numba",
    "safetensors": "safetensors",
    "torch": "torch gymnasium",
}


def with_remedy(error: Exception) -> str:
    """Return what an error says, and what to install if it is a missing library."""
    library = (getattr(error, "name", None) or "").partition(".")[0]
    if library == "rclpy" or library.endswith(("_interfaces", "_msgs", "_srvs")):
        return f"{error}; {ROS}"
    return (
        f"{error}; pip install {PACKAGES[library]}"
        if library in PACKAGES
        else str(error)
    )


def find_resource(folder: str, name: str) -> Path:
    """Return the path of a file of ``"maps"`` or ``"models"``; a FileNotFoundError lists all."""
    # They lie beside the code, however it was installed; those in share/ are for ROS tools.
    directory = Path(__file__).parent / folder
    if os.path.isfile(directory / name):
        return directory / name
    known = ", ".join(sorted(path.name for path in directory.glob("*.*")))
    raise FileNotFoundError(f"no {name!r} in {directory}; there are: {known or 'none'}")


def find_map(name: str) -> Path:
    """Return the file of a path, of a ``file://`` or ``package://`` URL, or of a shipped map.

    A FileNotFoundError says why there can be none.
    """
    if name.startswith("package://"):
        return _package_path(name)
    try:
        path = as_path(name, "the map")
    except ValueError as error:
        raise FileNotFoundError(str(error)) from None
    # What is no folder in the working directory has priority. Whoever reads a file reports that it
    # is missing, or no regular file.
    if path.name != name or (os.path.exists(path) and not os.path.isdir(path)):
        return path
    try:
        return find_resource("maps", name if path.suffix else f"{name}.yaml")
    except FileNotFoundError:
        maps = sorted(
            file.stem for file in (Path(__file__).parent / "maps").glob("*.yaml")
        )
        near = difflib.get_close_matches(path.stem, maps, 1)
        problem = f"there is no map file {name!r}, and no shipped map of that name"
        hint = f"did you mean {near[0]!r}? " if near else ""
        remedy = f"{hint}give a path, or one of {', '.join(maps)}"
        raise FileNotFoundError(f"{problem}; {remedy}") from None


def _package_path(url: str) -> Path:
    package, _, rest = url.removeprefix("package://").partition("/")
    if rest.startswith("/") or ".." in Path(rest).parts:
        raise FileNotFoundError(f"{url!r} leads out of its package; give a path in it")
    if package == PACKAGE:
        return find_resource(str(Path(rest).parent), Path(rest).name)
    try:
        from ament_index_python.packages import get_package_share_directory

        return Path(get_package_share_directory(package)) / rest
    except (ImportError, LookupError, OSError, ValueError) as error:
        raise FileNotFoundError(
            f"{url!r}: no such package ({error}); give a path"
        ) from None
