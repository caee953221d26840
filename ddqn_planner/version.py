"""The version of the package."""

import re
from pathlib import Path
from typing import Final

NAME: Final = "ddqn_planner"


def _version() -> str:
    """Return the version; "unknown" if the package is neither installed nor complete.

    In a source tree package.xml tells it: the metadata of an editable installation is
    as old as the installation.
    """
    source = Path(__file__).resolve().parents[1] / "package.xml"
    if source.is_file():
        text = source.read_text(encoding="utf-8")
        version = re.search(r"<version>\s*(\S+?)\s*</version>", text)
        if f"<name>{NAME}</name>" in text and version:
            return version[1]
    from importlib import metadata  # slow to import

    try:
        return metadata.version(NAME)
    except metadata.PackageNotFoundError:
        return "unknown"


__version__: Final = _version()
