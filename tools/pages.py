"""Prints which pages of the docs have no picture, and how many.

.venv/bin/python tools/pages.py
"""

import re
from pathlib import Path

DOCS = Path(__file__).resolve().parent.parent / "docs"
PICTURE = re.compile(r"!\[[^\]]*\]\(")
INCLUDED = re.compile(r"^```\{include\} (.+)$", re.MULTILINE)


def text_of(page: Path) -> str:
    """Return the text of a page, with that of the files that it includes."""
    text = page.read_text(encoding="utf-8")
    files = [DOCS / name for name in INCLUDED.findall(text)]
    return "".join([text, *(file.read_text(encoding="utf-8") for file in files)])


def pages_without_picture() -> list[str]:
    """Return the names of the pages that have no picture, in their order."""
    pages = sorted(DOCS.glob("*.md"))
    return [page.name for page in pages if not PICTURE.search(text_of(page))]


def main() -> None:
    """Print the names, one a line, and their number."""
    names = pages_without_picture()
    print(*names, sep="\n")
    count = len([*DOCS.glob("*.md")])
    print(f"{len(names)} of {count} pages have no picture")


if __name__ == "__main__":
    main()
