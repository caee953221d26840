"""The curve of a training as a file, ``curve.csv``: a later process continues it."""

from pathlib import Path
from typing import Final

from ddqn_planner.files import Appender, read_rows, write_atomically
from ddqn_planner.training.training_record import CurvePoint

CURVE: Final = "curve.csv"  # in the folder of a training


class CurveFile(Appender):
    """Appends the points of a curve to a file.

    Attributes
    ----------
    earlier : list of CurvePoint
        The points that the file had when it was opened, up to the training's step.
    """

    def __init__(self, path: Path, step: int) -> None:
        """Open the file at `path`, or make it, for a training at a step.

        Later points are removed: they are newer than the checkpoint from which the
        training continues. A training at step 0 is a new one, and has no points.
        """
        self.earlier: list[CurvePoint] = []
        if step and path.exists():
            points = map(_point, read_rows(path))
            self.earlier = [point for point in points if point and point.step <= step]
        header = ",".join(CurvePoint._fields)
        rows = [f"{header}\r\n".encode(), *map(_row, self.earlier)]
        write_atomically(path, b"".join(rows))
        self._last_step = self.earlier[-1].step if self.earlier else -1
        super().__init__(path)

    def add(self, point: CurvePoint) -> None:
        """Append a point; one that the file has already is ignored."""
        if point.step > self._last_step:
            self._last_step = point.step
            self.append(_row(point))


def _row(point: CurvePoint) -> bytes:
    """Return the row of a point; NaN and infinity are ``nan`` and ``inf``."""
    return f"{','.join(map(str, point))}\r\n".encode()


def _point(row: bytes) -> CurvePoint | None:
    """Return the point of a row; None for the header, and for a row that is broken."""
    values = row.decode(errors="replace").removesuffix("\r\n").split(",")
    try:
        step, seconds, starts, solved, *rest = values
        return CurvePoint(
            int(step), float(seconds), int(starts), int(solved), *map(float, rest)
        )
    except (TypeError, ValueError):
        return None
