"""Markdown and CSV tables of the benchmarks' and experiments' reports."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ddqn_planner.files import write_csv


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def write_table(path: Path, header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Write a table as CSV, and return it as Markdown; see `write_csv` for errors."""
    write_csv(path, header, rows)
    return table(header, rows)
