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


def report(figure: str, value: float, unit: str, bound: float, at_most: bool = True) -> bool:
    """Print a figure beside its bound, unless that is infinite; return whether it is missed."""
    missed = value > bound if at_most else value < bound
    sign, verdict = "at most" if at_most else "at least", "MISSED" if missed else "ok"
    beside = "" if bound == float("inf") else f"{sign:8} {bound:6.1f}  {verdict}"
    print(f"{figure:62} {value:8.2f} {unit:3} {beside}", flush=True)
    return missed
