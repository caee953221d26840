"""Writes map files, for the nodes and programs that read them."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from ddqn_planner.files import as_path, write_atomically
from ddqn_planner.grid import GridMap, MapFile, MapFileError


def save_map(grid: GridMap | MapFile, path: str | Path) -> None:
    """Write a ROS map: YAML and PGM, and another pair for directions.

    `GridMap.obstacles` is left out.
    """
    path = as_path(path)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise MapFileError(
            f"{path}: ends in {path.suffix!r}; give a path that ends in .yaml"
        )
    if isinstance(grid, GridMap):
        cost = 0 if grid.cost is None else grid.cost
        percent = np.where(grid.occupancy, 100, cost).astype(np.int8)
        grid = MapFile(percent, grid.resolution, grid.origin, forbidden=grid.forbidden)
    values = grid.values
    if np.isin(values, (-1, 0, 100)).all():
        mode, grey = "trinary", np.select([values == 0, values == 100], [254, 0], 205)
    else:
        mode, grey = "raw", values
    image = path.with_suffix(".pgm")
    write_atomically(image, _pgm(grey))  # raw -1 becomes 255
    metadata: dict[str, Any] = {
        "image": image.name,
        "mode": mode,
        "resolution": grid.resolution,
        "origin": list(grid.origin),
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,  # grey 205 would be free at 0.25
    }
    cells = {"start": grid.start, "goal": grid.goal}
    ours: dict[str, Any] = {
        name: list(cell) for name, cell in cells.items() if cell is not None
    }
    if grid.forbidden is not None:
        ours["directions"] = f"{path.stem}_directions.pgm"
        write_atomically(path.with_name(ours["directions"]), _pgm(grid.forbidden))
    if ours:
        metadata["ddqn_planner"] = ours
    text = yaml.safe_dump(
        metadata, sort_keys=False, allow_unicode=True, default_flow_style=None
    )
    write_atomically(path, text.encode())


def _pgm(values: NDArray[Any]) -> bytes:
    top_row_first = values[::-1].astype(np.uint8).tobytes()
    return b"P5\n%d %d\n255\n" % values.shape[::-1] + top_row_first
