"""Prints the installed version of each library and tool that setup.py names.

.venv/bin/python tools/constraints.py > constraints.txt
"""

import platform
import re
from importlib import metadata

PACKAGE = "ddqn_planner"


def direct_dependencies() -> list[str]:
    """Return the names in the package's requirements, those of all extras included."""
    names = set()
    for requirement in metadata.requires(PACKAGE) or []:
        name = re.match(r"[A-Za-z0-9._-]+", requirement)
        if name:
            names.add(name.group())
    return sorted(names, key=str.lower)


def main() -> None:
    """Print one line per dependency; an extra that is not installed is left out."""
    print("# Written by `make constraints` with Python", platform.python_version())
    for name in direct_dependencies():
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
        # torch's CPU build adds a label, as in 2.13.0+cpu; any build will do.
        print(f"{name}=={version.partition('+')[0]}")


if __name__ == "__main__":
    main()
