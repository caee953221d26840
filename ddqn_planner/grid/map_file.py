"""Map files: ROS map YAML with its image, read as Nav2's map_server does, and MovingAI ``.map``."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from ddqn_planner.files import write_atomically
from ddqn_planner.grid.grid_map import Cell, GridMap

SCENARIO_KEY = "ddqn_planner"
"""Key of a map YAML, unknown to map_server, under which start and goal stand."""

MAX_YAML_BYTES = 2**20
MAX_CELLS = 2**26
"""A larger image is refused before it is decoded: 8192 x 8192 cells."""

OCCUPIED, FREE, UNKNOWN = 100, 0, -1
MODES = ("trinary", "scale", "raw")


class MapFileError(ValueError):
    """A map file cannot be read; the message names the file, the value and the remedy."""


class MapNotFoundError(MapFileError):
    """There is no such map file."""


class MapMetadataError(MapFileError):
    """The YAML, or the header of a ``.map``, is wrong."""


class MapDataError(MapFileError):
    """The image, or the rows of a ``.map``, are wrong."""


@dataclass(frozen=True, eq=False)
class MapFile:
    """What a map file says.

    Parameters
    ----------
    values : (H, W) int8
        Occupancy in percent, 0..100, or -1 where unknown; row y = 0 is the first row of
        ``OccupancyGrid.data``: the bottom row of a ROS map's image, the top row of a ``.map``.
    resolution : float
        Metres a cell, > 0.
    origin : (float, float, float)
        See `GridMap`.
    start, goal : (x, y) or None
        The scenario that the file names, if it does.
    """

    values: NDArray[np.int8]
    resolution: float = 1.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start: Cell | None = None
    goal: Cell | None = None

    def grid(self, occupied_threshold: int = 65, allow_unknown: bool = False) -> GridMap:
        """Return the grid map; see `GridMap.from_occupancy_values`."""
        return GridMap.from_occupancy_values(
            self.values, self.resolution, self.origin, occupied_threshold, allow_unknown
        )


def load_map(
    path: str | Path, occupied_threshold: int = 65, allow_unknown: bool = False
) -> GridMap:
    """Read a map file as a grid map; see `read_map_file` and `GridMap.from_occupancy_values`."""
    return read_map_file(path).grid(occupied_threshold, allow_unknown)


def read_map_file(path: str | Path) -> MapFile:
    """Read a map file.

    Parameters
    ----------
    path : str or Path
        ``.yaml`` or ``.yml``: a ROS map, by the rules of nav2_map_server since 1.3.7; the image
        in PGM, PNG or another format that Pillow knows. ``.map``: a MovingAI map; its row y = 0
        is the first row of the file, as in the benchmark's scenarios.

    Raises
    ------
    MapFileError
        `MapNotFoundError`, `MapMetadataError` or `MapDataError`.
    """
    path = Path(path)
    readers = {".yaml": _read_yaml, ".yml": _read_yaml, ".map": _read_moving_ai}
    if path.suffix.lower() not in readers:
        raise MapMetadataError(
            f"{path}: the ending {path.suffix!r} is unknown; give a .yaml, .yml or .map file"
        )
    return readers[path.suffix.lower()](path)


def save_map(map_file: MapFile | GridMap, path: str | Path) -> None:
    """Write a ROS map: a YAML file, and beside it a PGM image of the same name.

    Parameters
    ----------
    map_file : MapFile or GridMap
    path : str or Path
        Of the YAML file.

    Raises
    ------
    OSError
        If a file cannot be written; the old map is then untouched.
    """
    path = Path(path)
    if isinstance(map_file, GridMap):
        values = np.where(map_file.occupancy, OCCUPIED, FREE).astype(np.int8)
        map_file = MapFile(values, map_file.resolution, map_file.origin)
    values = map_file.values
    trinary = bool(np.isin(values, (FREE, OCCUPIED, UNKNOWN)).all())
    grey = np.where(values < 0, 255, values)
    if trinary:
        grey = np.select([values == OCCUPIED, values == FREE], [0, 254], 205)
    image = io.BytesIO()
    Image.fromarray(grey[::-1].astype(np.uint8), mode="L").save(image, "PPM")
    description: dict[str, Any] = {
        "image": f"{path.stem}.pgm",
        "mode": "trinary" if trinary else "raw",
        "resolution": map_file.resolution,
        "origin": list(map_file.origin),
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    scenario = {"start": map_file.start, "goal": map_file.goal}
    if named := {name: list(cell) for name, cell in scenario.items() if cell is not None}:
        description[SCENARIO_KEY] = named
    write_atomically(path.with_suffix(".pgm"), image.getvalue())
    write_atomically(path, yaml.safe_dump(description, sort_keys=False).encode())


def _read_text(path: Path, max_bytes: int) -> str:
    try:
        with path.open("rb") as file:
            content = file.read(max_bytes + 1)
        if len(content) > max_bytes:
            raise MapMetadataError(f"{path}: is larger than {max_bytes} bytes; is it a map file?")
        return content.decode()
    except FileNotFoundError:
        raise MapNotFoundError(f"{path}: there is no such file; check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        raise MapMetadataError(f"{path}: cannot be read ({error}); give a text file") from None


def _read_yaml(path: Path) -> MapFile:
    try:
        entries = yaml.safe_load(_read_text(path, MAX_YAML_BYTES))
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        if isinstance(error, MapFileError):
            raise
        raise MapMetadataError(f"{path}: is no YAML ({error}); correct it") from None
    if not isinstance(entries, dict):
        raise MapMetadataError(f"{path}: holds {type(entries).__name__}, not keys and values")
    yaml_keys = _Keys(path, entries)
    mode = yaml_keys.get("mode", "trinary", lambda v: v in MODES, f"one of {', '.join(MODES)}")
    resolution = yaml_keys.number("resolution", lambda v: v > 0, "metres a cell, above 0")
    origin = yaml_keys.get("origin", None, _three_numbers, "three finite numbers x, y, yaw")
    negate = yaml_keys.get("negate", None, lambda v: v in (0, 1), "0 or 1")
    occupied = yaml_keys.number("occupied_thresh", lambda v: 0 <= v <= 1, "0 to 1")
    free = yaml_keys.number("free_thresh", lambda v: 0 <= v <= occupied, "0 to occupied_thresh")
    image = yaml_keys.get("image", None, lambda v: isinstance(v, str) and v, "the image's path")
    grey, opaque = _read_image(path.parent / image)
    values = _occupancy(grey, opaque, mode, bool(negate), occupied, free)[::-1].copy()
    start, goal = _scenario(path, entries.get(SCENARIO_KEY), values.shape)
    return MapFile(values, resolution, (origin[0], origin[1], origin[2]), start, goal)


class _Keys:
    """The keys of a map YAML, each checked when it is asked for."""

    def __init__(self, path: Path, entries: dict[Any, Any]) -> None:
        self.path = path
        self.entries = entries

    def get(self, key: str, default: Any, valid: Any, expected: str) -> Any:
        value = self.entries.get(key, default)
        if value is None:
            raise MapMetadataError(f"{self.path}: has no {key!r}; add it: {expected}")
        try:
            correct = valid(value)
        except TypeError:
            correct = False
        if not correct:
            raise MapMetadataError(f"{self.path}: {key} is {value!r}; it must be {expected}")
        return value

    def number(self, key: str, valid: Any, expected: str) -> float:
        return float(self.get(key, None, lambda v: _is_number(v) and valid(v), expected))


def _is_number(value: object) -> bool:
    return type(value) in (int, float) and math.isfinite(value)  # type: ignore[arg-type]


def _three_numbers(value: object) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(map(_is_number, value))


def _read_image(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return the grey values and where the image is opaque, (H, W) each, the top row first."""
    try:
        with Image.open(path) as image:
            if image.width * image.height > MAX_CELLS:
                raise MapDataError(
                    f"{path}: has {image.width} x {image.height} pixels; at most {MAX_CELLS} in "
                    "all are read: crop it, or make the resolution coarser"
                )
            alpha = "A" in image.getbands() or "transparency" in image.info
            opaque = np.asarray(image.convert("RGBA"))[..., 3] == 255 if alpha else np.True_
            grey = np.asarray(image.convert("L"))
    except FileNotFoundError:
        raise MapDataError(f"{path}: there is no such image; correct 'image' in the YAML") from None
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError, ValueError) as error:
        if isinstance(error, MapFileError):
            raise
        raise MapDataError(f"{path}: is no whole image ({error}); save it again") from None
    return grey, np.broadcast_to(opaque, grey.shape)


def _occupancy(
    grey: NDArray[np.uint8],
    opaque: NDArray[np.bool_],
    mode: str,
    negate: bool,
    occupied: float,
    free: float,
) -> NDArray[np.int8]:
    """Return the occupancy of grey values by the rules of nav2_map_server."""
    if mode == "raw":
        return np.where(grey <= OCCUPIED, grey, UNKNOWN).astype(np.int8)
    probability = grey / 255 if negate else 1 - grey / 255
    values = np.full(grey.shape, UNKNOWN, dtype=np.int8)
    if mode == "scale":
        between = (probability > free) & (probability < occupied)
        values[between] = np.rint((probability[between] - free) / (occupied - free) * 100)
    values[probability >= occupied] = OCCUPIED
    values[probability <= free] = FREE
    values[~opaque] = UNKNOWN
    return values


def _scenario(path: Path, entry: object, shape: tuple[int, ...]) -> tuple[Cell | None, Cell | None]:
    cells: list[Cell | None] = []
    for name in ("start", "goal"):
        cell = entry.get(name) if isinstance(entry, dict) else None
        if cell is not None:
            integers = isinstance(cell, list) and [type(value) for value in cell] == [int, int]
            if not (integers and 0 <= cell[0] < shape[1] and 0 <= cell[1] < shape[0]):
                raise MapMetadataError(
                    f"{path}: {SCENARIO_KEY}: {name} is {cell!r}; it must be a cell [x, y] of the "
                    f"{shape[1]} x {shape[0]} map"
                )
            cell = (cell[0], cell[1])
        cells.append(cell)
    return cells[0], cells[1]


def _read_moving_ai(path: Path) -> MapFile:
    lines = _read_text(path, MAX_CELLS + MAX_YAML_BYTES).splitlines()
    try:
        (_, kind), (_, height), (_, width) = (line.split() for line in lines[:3])
        rows = lines[4 : 4 + int(height)]
        if (kind, lines[3].strip()) != ("octile", "map") or int(height) < 1 or int(width) < 1:
            raise ValueError(" / ".join(lines[:4]))
    except (ValueError, IndexError) as error:
        raise MapMetadataError(
            f"{path}: its header is wrong ({error}); it must be the lines 'type octile', "
            "'height H', 'width W' and 'map'"
        ) from None
    if len(rows) < int(height) or any(len(row) != int(width) for row in rows):
        raise MapDataError(f"{path}: has not {height} rows of {width} characters; save it again")
    free = np.isin(np.array([list(row) for row in rows]), list(".GS"))
    return MapFile(np.where(free, FREE, OCCUPIED).astype(np.int8))
