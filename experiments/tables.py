"""Tables, statistics over seeds, and where they go: a report and docs' pages."""

import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.files import write_atomically

FIGURE = re.compile(r"\]\((.+\.png)\)")


def table(header: str, rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table; " | " divides the names in its header."""
    names = header.split(" | ")
    lines = ["| " + " | ".join(map(str, line)) + " |" for line in (names, *rows)]
    return "\n".join([lines[0], "|---" * len(names) + "|", *lines[1:]])


def write_report(
    out: Path, sections: Mapping[str, str], page: Path | None = None
) -> str:
    """Write ``report.md`` and return it.

    A page gets the sections that it has marks for.
    """
    text = "\n".join(
        f"## {title}\n\n{section}\n" for title, section in sections.items()
    )
    write_atomically(out / "report.md", text.encode())
    if page is not None:
        images = page.parent / "images" / page.stem
        images.mkdir(parents=True, exist_ok=True)
        for figure in FIGURE.findall(text):
            shutil.copyfile(out / figure, images / figure)
        content = page.read_text(encoding="utf-8")
        for title, section in sections.items():
            shown = FIGURE.sub(rf"](images/{page.stem}/\1)", section)
            before, mark, rest = content.partition(f"<!-- {title} -->\n")
            if mark:
                content = (
                    f"{before}{mark}{shown}\n\n{rest[rest.index('<!-- end -->') :]}"
                )
        write_atomically(page, content.encode())
    return text


def median_and_range(values: Sequence[float], digits: int = 0) -> str:
    """Return median, least and greatest as "3 (1 to 4)".

    Infinity is "never"; NaN is left out.
    """
    values = [value for value in values if not np.isnan(value)]
    if not values:
        return "none"
    low, middle, high = (
        "never" if np.isinf(v) else f"{v:,.{digits}f}"
        for v in (min(values), float(np.median(values)), max(values))
    )
    return middle if low == high else f"{middle} ({low} to {high})"


def mean_and_worst(
    ratios: Sequence[Sequence[float] | NDArray[np.float64]],
) -> list[str]:
    """Return two cells: the mean and the greatest ratio of each seed that has one."""
    some = [of_seed for of_seed in ratios if len(of_seed)]
    return [
        median_and_range([float(f(of)) for of in some], 4) for f in (np.mean, np.max)
    ]


def report(
    figure: str, value: float, unit: str, bound: float, at_most: bool = True
) -> bool:
    """Print a figure beside its bound; return whether the bound is missed.

    An infinite bound is not printed.
    """
    missed = value > bound if at_most else value < bound
    sign, verdict = "at most" if at_most else "at least", "MISSED" if missed else "ok"
    beside = "" if bound == float("inf") else f"{sign:8} {bound:6.1f}  {verdict}"
    print(f"{figure:62} {value:8.2f} {unit:3} {beside}", flush=True)
    return missed
