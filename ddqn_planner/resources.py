"""Finds the maps and models that come with the package, however it was installed."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

PACKAGE = "ddqn_planner"


def share_directories() -> Iterator[Path]:
    """Yield the folders that may hold ``maps/`` and ``models/``, the likeliest first.

    They are: the ament index (a colcon workspace that was sourced), ``share/ddqn_planner`` of this
    Python environment (pip install), and the source tree (an editable install, or none).
    """
    try:
        from ament_index_python.packages import get_package_share_directory

        yield Path(get_package_share_directory(PACKAGE))
    except (ImportError, LookupError, OSError):
        pass  # no ROS here, or ROS from PyPI, which has no ament prefix
    yield Path(sys.prefix) / "share" / PACKAGE
    yield Path(__file__).resolve().parent.parent


def find_resource(folder: str, name: str) -> Path:
    """Return the path of a file that comes with the package.

    Parameters
    ----------
    folder : str
        ``"maps"`` or ``"models"``.
    name : str
        Name of the file, with its ending.

    Raises
    ------
    FileNotFoundError
        If no installed copy is found; the message names the folders that were looked in and the
        files that are there.
    """
    looked_in = [share / folder for share in share_directories()]
    for directory in looked_in:
        if os.path.isfile(directory / name):
            return directory / name
    known = sorted({path.name for directory in looked_in for path in directory.glob("*.*")})
    raise FileNotFoundError(
        f"no {name!r} in {', '.join(map(str, looked_in))}; there are: {', '.join(known) or 'none'}"
    )


def find_map(name: str) -> Path:
    """Return the file of a map that is given by path, URL or the name of a shipped one.

    Parameters
    ----------
    name : str
        A path, a ``file://`` or ``package://`` URL, or the name of a map that comes with this
        package, with or without its ending. A file in the working directory goes first.

    Returns
    -------
    Path
        It need not exist: whoever reads it will say so.

    Raises
    ------
    FileNotFoundError
        If there is no shipped map of that name, or no such package, or a URL leads out of it.
    """
    path = Path(name.removeprefix("file://"))
    if name.startswith("package://"):
        return _package_path(name.removeprefix("package://"))
    if path.name != name or os.path.exists(path):
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
