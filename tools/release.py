"""Gives the repository the version of a release, everywhere and with today's date.

.venv/bin/python tools/release.py 0.6.0
"""

import argparse
import datetime
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import safetensors.numpy

from ddqn_planner.files import write_atomically
from ddqn_planner.model.model_file import METADATA_KEY

ROOT: Final = Path(__file__).resolve().parent.parent
UNRELEASED: Final = "## [Unreleased]\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the version to the manifest, the changelog, the citation and the models."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("version", help="such as 0.6.0")
    version = parser.parse_args(arguments).version
    if not re.fullmatch(r"\d+\.\d+\.\d+", version):
        parser.error(f"the version is {version!r}; give three numbers, such as 0.6.0")
    changes = (ROOT / "CHANGELOG.md").read_text()
    if UNRELEASED not in changes:
        parser.error(f"CHANGELOG.md has no heading {UNRELEASED.strip()!r}; write one")

    date = datetime.date.today().isoformat()
    replace("package.xml", r"<version>(.+)</version>", version)
    replace("CITATION.cff", r"^version: (.+)$", version)
    replace("CITATION.cff", r"^date-released: (.+)$", date)
    write_changelog(changes, version, date)
    for path in (ROOT / "models").glob("*.safetensors"):
        write_atomically(path, with_version(path.read_bytes(), version))


def replace(name: str, pattern: str, value: str) -> None:
    """Replace in a file the first text that the pattern's group matches."""
    path = ROOT / name
    text = path.read_text()
    match = re.search(pattern, text, re.MULTILINE)
    if match is None:
        raise ValueError(f"{path} has nothing like {pattern!r}; write it by hand")
    path.write_text(text[: match.start(1)] + value + text[match.end(1) :])


def write_changelog(changes: str, version: str, date: str) -> None:
    """Date the unreleased changes, and add what the version's heading links to.

    `changes` is the present text. Its first link is that of the newest release.
    """
    newest_link = re.search(r"^\[(.+)\]: (.+)/(?:compare|releases)/.+$", changes, re.M)
    if newest_link is None:
        raise ValueError("CHANGELOG.md has no link of a release at its end; write one")
    before, repository = newest_link.groups()
    link = f"[{version}]: {repository}/compare/v{before}...v{version}\n"
    start = newest_link.start()
    changes = changes[:start] + link + changes[start:]
    heading = f"## [{version}] - {date}\n"
    (ROOT / "CHANGELOG.md").write_text(changes.replace(UNRELEASED, heading, 1))


def with_version(model: bytes, version: str) -> bytes:
    """Return a model file with another version of the package, and the same tensors.

    To load and save the model would not do: a network may simplify its tensors.
    """
    header_length = int.from_bytes(model[:8], "little")
    header = json.loads(model[8 : 8 + header_length])
    description = json.loads(header["__metadata__"][METADATA_KEY])
    description["package_version"] = version
    metadata = {METADATA_KEY: json.dumps(description)}
    return bytes(safetensors.numpy.save(safetensors.numpy.load(model), metadata))


if __name__ == "__main__":
    main()
