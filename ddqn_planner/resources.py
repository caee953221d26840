"""Finds the maps and models that come with the package.

They lie beside its code, however it was installed; in the source tree they are links. The copies in
``share/ddqn_planner`` are only for ROS tools.
"""

from __future__ import annotations

import os
from pathlib import Path

PACKAGE = "ddqn_planner"


def find_resource(folder: str, name: str) -> Path:
    """Return the path of a file of ``"maps"`` or ``"models"``; a FileNotFoundError lists all."""
    directory = Path(__file__).parent / folder
    if os.path.isfile(directory / name):
        return directory / name
    known = ", ".join(sorted(path.name for path in directory.glob("*.*")))
    raise FileNotFoundError(f"no {name!r} in {directory}; there are: {known or 'none'}")


def find_map(name: str) -> Path:
    """Return the file of a map: a path, a ``file://`` or ``package://`` URL, or a shipped map.

    A shipped map may be named without its ending; a file of that name in the working directory has
    priority. A file that is not shipped may be missing: whoever reads it reports that. A
    FileNotFoundError if there is no such shipped map or package, or if a URL leads out of it.
    """
    path = Path(name.removeprefix("file://"))
    if name.startswith("package://"):
        return _package_path(name.removeprefix("package://"))
    if path.name != name or os.path.isfile(path):
        return path
    return find_resource("maps", name if path.suffix else f"{name}.yaml")


def _package_path(name: str) -> Path:
    package, _, rest = name.partition("/")
    if rest.startswith("/") or ".." in Path(rest).parts:
        raise FileNotFoundError(
            f"{'package://' + name!r} leads out of its package; give a path in it, or a plain path"
        )
    if package == PACKAGE:
        return find_resource(str(Path(rest).parent), Path(rest).name)
    try:
        from ament_index_python.packages import get_package_share_directory

        return Path(get_package_share_directory(package)) / rest
    except (ImportError, LookupError, OSError, ValueError) as error:
        raise FileNotFoundError(
            f"{'package://' + name!r}: there is no such package ({error}); give another, or a path"
        ) from None
