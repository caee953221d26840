"""Map files: ROS maps (YAML and an image) and MovingAI maps are read."""

import difflib
import os
import re
import reprlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.files import as_path, kind_of, read_file
from ddqn_planner.grid.arguments import (
    OCCUPIED,
    UNKNOWN,
    Cell,
    as_number,
    cell_inside,
    numbers,
)
from ddqn_planner.grid.grid_map import GridMap
from ddqn_planner.grid.map_yaml import as_float, as_truth, read_yaml
from ddqn_planner.resources import find_map

MAX_CELLS = 2**26  # a larger map is refused before its cells are read
MAX_YAML_BYTES = 2**16

KEYS = {
    "image",
    "resolution",
    "origin",
    "negate",
    "occupied_thresh",
    "free_thresh",
    "mode",
}

# In other layouts Pillow drops bits, or map_server takes the fourth byte of a pixel as
# its opacity.
LAYOUTS = {"1", "1;I", "L", "L;2", "L;4", "LA", "I;16B", "P", "P;1", "P;2", "P;4"}
LAYOUTS |= {"RGB", "RGBA", "BGR", "BGRA", "CMYK;I"}
"""Pillow's names of the pixel layouts in files that it reads as map_server does."""

_shortener = reprlib.Repr()
_shortener.maxlevel = (
    2  # YAML aliases can nest lists that are huge when they are printed
)
_short = _shortener.repr


class MapFileError(ValueError):
    """A map file cannot be read."""


class MapNotFoundError(MapFileError):
    """There is no such map file (result 1 of ``nav_msgs/LoadMap``)."""


class MapDataError(MapFileError):
    """The image, or the rows of cells, cannot be read (result 2)."""


class MapMetadataError(MapFileError):
    """The description of the map is malformed (result 3)."""


@dataclass(frozen=True, eq=False)
class MapFile:
    """The content of a map file; a value out of its range is a ValueError."""

    # Percent 0..100, or -1 where unknown. Row 0 is the bottom row of a ROS map's image,
    # but the first row of a MovingAI file, so that x and y of its scenario files are
    # valid.
    values: NDArray[np.int8]
    resolution: float = 1.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start: Cell | None = None
    goal: Cell | None = None
    forbidden: NDArray[np.uint8] | None = None
    files: tuple[Path, ...] = ()  # from which it was read

    def __post_init__(self) -> None:
        values = numbers(
            "the array of values", self.values, between=(UNKNOWN, OCCUPIED)
        )
        values = values.astype(np.int8)
        values.flags.writeable = False
        grid = GridMap(
            values == OCCUPIED, self.resolution, self.origin, forbidden=self.forbidden
        )
        checked = {
            name: getattr(grid, name) for name in ("resolution", "origin", "forbidden")
        }
        for name in ("start", "goal"):
            if (cell := getattr(self, name)) is not None:
                checked[name] = cell_inside(cell, values.shape, name)
        vars(self).update(checked, values=values)  # the dataclass is frozen

    def grid(
        self,
        occupied_threshold: int = 65,
        allow_unknown: bool = False,
        use_map_costs: bool = False,
    ) -> GridMap:
        """Return the grid map; for parameters see `GridMap.from_occupancy_values`."""
        options = (occupied_threshold, allow_unknown, use_map_costs, self.forbidden)
        return GridMap.from_occupancy_values(
            self.values, self.resolution, self.origin, *options
        )


def load_map(
    path: str | Path,
    occupied_threshold: int = 65,
    allow_unknown: bool = False,
    use_map_costs: bool = False,
) -> GridMap:
    """Read a ROS map (.yaml or .yml) or a map of the MovingAI benchmark (.map).

    A ROS map is read as Nav2's map_server 1.3.7 and later reads it, with these
    differences:

    - Images that Pillow reads differently from map_server are refused: colours of 16
      bits, PPM and PGM whose greatest value is not 255 (or 65535 for grey), BMP of 16
      or 32 bits without an alpha channel, and PNG with a transparent colour outside a
      palette.
    - The YAML may hold
      ``ddqn_planner: {start: [x, y], goal: [x, y], directions: FILE}``: the cells of a
      scenario, and an image of the same size in 8-bit grey (PGM or PNG), whose values
      are those of `GridMap.forbidden`: 0, black, where all moves are legal. map_server
      ignores it.

    Parameters
    ----------
    path : str or Path
        A file, whose leading ``~`` stands for the home folder, or the name of a shipped
        map.
    occupied_threshold, allow_unknown, use_map_costs
        As for `GridMap.from_occupancy_values`.

    Raises
    ------
    MapNotFoundError
        If there is no such file.
    MapMetadataError
        If the file is no map, or its description is wrong.
    MapDataError
        If the cells of the map cannot be read.
    """
    try:
        file = find_map(path) if isinstance(path, str) else as_path(path)
    except (FileNotFoundError, ValueError) as error:
        raise MapNotFoundError(str(error)) from None
    return read_map_file(file).grid(occupied_threshold, allow_unknown, use_map_costs)


def read_map_file(path: str | Path, only_below: bool = False) -> MapFile:
    """Read all that a map file holds; see `load_map` for the path and the errors.

    With `only_below` its images must lie in the folder of the YAML file or below it, so
    that a path from elsewhere, as in a service's request, cannot show any file of this
    machine.
    """
    try:
        path = as_path(path)
    except ValueError as error:
        raise MapNotFoundError(str(error)) from None
    if kind := kind_of(path):
        raise MapNotFoundError(f"{str(path)!r} is {kind}; give the path of a map file")
    if not os.path.isfile(path):
        raise MapNotFoundError(f"{str(path)!r}: no such file; give the path of a map")
    if path.suffix.lower() not in (".yaml", ".yml", ".map"):
        raise MapMetadataError(
            f"{path}: ends in {path.suffix!r}; give a .yaml, .yml or .map file"
        )
    try:
        is_moving_ai = path.suffix.lower() == ".map"
        return _read_moving_ai(path) if is_moving_ai else _read_ros(path, only_below)
    except MapFileError:
        raise
    except ValueError as error:
        raise MapMetadataError(f"{path}: {error}") from error


def _read_bytes(path: Path, limit: int, error_class: type[MapFileError]) -> bytes:
    try:
        return read_file(path, limit)
    except OSError as error:
        raise error_class(
            f"{path}: cannot be read ({error.strerror}); check its rights"
        ) from error
    except ValueError as error:
        raise error_class(str(error)) from None


def _read_moving_ai(path: Path) -> MapFile:
    # A row of one cell takes up to three bytes: the cell, \r and \n.
    content = _read_bytes(path, 3 * MAX_CELLS, MapDataError)
    pattern = rb"type octile\s+height (\d{1,8})\s+width (\d{1,8})\s+map[ \t]*\r?\n"
    header = re.match(pattern, content)
    if header is None:
        lines = "'type octile', 'height H', 'width W', 'map'"
        raise ValueError(
            f"begins with {content[:40]!r}; the first four lines must be {lines}"
        )
    height, width = int(header[1]), int(header[2])
    if not 1 <= height * width <= MAX_CELLS:
        raise ValueError(
            f"height is {height}, width is {width}; give 1 to {MAX_CELLS} cells"
        )
    rows = content[header.end() :].replace(b"\r\n", b"\n").rstrip(b"\n") + b"\n"
    count, cells = rows.count(b"\n"), np.frombuffer(rows, dtype=np.uint8)
    ends = cells[width :: width + 1]
    if (
        cells.size != height * (width + 1)
        or count != height
        or (ends != ord("\n")).any()
    ):
        right = f"{height} rows of {width}, as its header says"
        raise MapDataError(
            f"{path}: has {count} rows, {cells.size - count} cells; give {right}"
        )
    free = np.isin(cells.reshape(height, width + 1)[:, :-1], list(b".GS"))
    return MapFile(np.where(free, np.int8(0), np.int8(OCCUPIED)), files=(path,))


def _read_ros(path: Path, only_below: bool) -> MapFile:
    document = read_yaml(_read_bytes(path, MAX_YAML_BYTES, MapMetadataError))
    if not isinstance(document, dict):
        raise ValueError(
            "not a YAML mapping; give 'key: value' lines: image, resolution, ..."
        )
    image = _image_path(path, document, "image", only_below)
    grey, clear = _read_image(image, ("PPM", "PNG", "BMP", "JPEG"), LAYOUTS)
    mode = _choice({"mode": "trinary", **document}, "mode", ("trinary", "scale", "raw"))
    values = _percent_of_grey(document, mode)[grey]
    if mode != "raw":
        values[clear] = UNKNOWN
    resolution, origin = _numbers(document, "resolution"), _numbers(document, "origin")
    ours = document.get("ddqn_planner", {})
    if not isinstance(ours, dict) or not ours.keys() <= {"start", "goal", "directions"}:
        keys = "{start: , goal: , directions: }"
        raise ValueError(f"ddqn_planner is {_short(ours)}; give some of {keys}")
    forbidden, files = None, [path, image]
    if "directions" in ours:
        directions = _image_path(path, ours, "directions", only_below)
        forbidden, _ = _read_image(directions, ("PPM", "PNG"), {"L"})
        name = ours.pop("directions")
        files.append(directions)
        if forbidden.shape != values.shape:
            has, right = (f"{w} x {h}" for h, w in (forbidden.shape, values.shape))
            raise MapDataError(
                f"{name!r}: has {has} pixels; give {right}, as the map's image"
            )
        forbidden = forbidden[::-1]
    cells = {name: _numbers(ours, name) for name in ours}
    place = values[::-1], resolution, origin
    return MapFile(*place, **cells, forbidden=forbidden, files=tuple(files))


def _image_path(
    path: Path, document: dict[str, Any], key: str, only_below: bool
) -> Path:
    """Return the path of an image that a YAML file names."""
    name = _value(document, key)
    if not isinstance(name, str) or not name:
        raise ValueError(f"{key} is {_short(name)}; give the path of an image")
    file = path.parent / name
    if name.startswith("~") and not os.path.lexists(file):
        file = as_path(name, key)
    if only_below and not _is_below(file, path):
        problem = f"{key} is {name!r}, outside of the folder of the YAML"
        reason = "a service reads no other files"
        raise ValueError(f"{problem}, and {reason}; put it beside")
    if kind := kind_of(file):
        raise MapDataError(
            f"{str(file)!r} is {kind}; give an image as {key!r} in the YAML file"
        )
    if not os.path.isfile(file):
        # Often the absolute path of the computer on which the map was saved.
        beside = re.split(r"[/\\]", name)[-1]
        remedy = f"check {key!r} in the YAML file"
        if beside != name and beside and os.path.isfile(path.parent / beside):
            remedy = (
                f"{beside!r} lies beside the YAML file: write '{key}: {beside}' there"
            )
        raise MapDataError(f"{str(file)!r}: no such image; {remedy}")
    return file


def _is_below(file: Path, path: Path) -> bool:
    # In a linked colcon workspace the YAML file is itself a link: allow the folder of
    # either.
    folders = path.parent.resolve(), path.resolve().parent
    return any(file.resolve().is_relative_to(folder) for folder in folders)


def _read_image(
    file: Path, formats: tuple[str, ...], layouts: set[str]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return an image's grey values, and which pixels are not opaque."""
    from PIL import Image  # 17 ms, and a planner that is sent its maps reads no image

    too_large = Image.DecompressionBombWarning, Image.DecompressionBombError
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            image = Image.open(file, formats=formats)
        with image:
            _check_layout(image, layouts)
            return _grey(image)
    except too_large as error:  # Pillow has another limit
        pixels = re.search(r"\d+", str(error))
        problem = f"{pixels[0]} pixels" if pixels else "too many pixels"
        remedy = (
            f"give an image of at most {MAX_CELLS} pixels, as at a coarser resolution"
        )
        raise MapDataError(f"{str(file)!r}: has {problem}; {remedy}") from None
    except (
        Exception
    ) as error:  # Pillow's decoders raise many exceptions on broken bytes
        remedy = f"give a {', '.join(formats)} image of at most {MAX_CELLS} pixels"
        raise MapDataError(
            f"{str(file)!r}: not readable ({error}); {remedy}"
        ) from error


def _check_layout(image: Any, layouts: set[str]) -> None:
    """Raise a ValueError for an image that is too large, or of another layout."""
    if image.width * image.height > MAX_CELLS:
        raise ValueError(f"{image.width} x {image.height} pixels")
    codec, *_, arguments = image.tile[0]
    layout, *rest = [arguments] if isinstance(arguments, str) else arguments
    # The last argument of a PPM is its greatest value, unless that is the greatest of
    # its bytes.
    greatest = 65535 if image.mode == "I" else 255
    if codec.startswith("ppm") and rest not in ([], [greatest]):
        # Versions of map_server disagree on the meaning of other greatest values.
        right = "255, or 65535 for grey"
        raise ValueError(
            f"its greatest value is {rest[0]}; give {right}, or an 8-bit grey PNG"
        )
    if layout not in layouts or codec == "bmp_rle":
        raise ValueError(
            f"its pixels are stored as {codec} {arguments}; save an 8-bit grey PNG"
        )
    if "transparency" in image.info and image.mode != "P":
        raise ValueError(
            "one of its colours is transparent; save it with an alpha channel"
        )


def _grey(image: Any) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return map_server's grey values, and which pixels are not opaque.

    The values are 16-bit Rec. 601 luma.
    """
    if image.mode.startswith("I"):
        grey = np.asarray(image) // 257
    elif image.mode in ("1", "L", "LA"):
        grey = np.asarray(image.convert("L"))
    else:
        colours = image.convert("RGBA" if image.mode == "P" else "RGB")
        red, green, blue = np.moveaxis(np.asarray(colours, dtype=np.int32), 2, 0)[:3]
        # The luma is rounded to 16 bits, and cut to 8.
        grey = (257 * (299 * red + 587 * green + 114 * blue) + 500) // 1000 // 257
    clear = np.zeros(grey.shape, dtype=np.bool_)
    if "A" in image.getbands() or "transparency" in image.info:
        clear = np.asarray(image.convert("RGBA").getchannel("A")) < 255
    return grey.astype(np.uint8, copy=False), clear


def _value(document: dict[str, Any], key: str) -> Any:
    """Return the value of a key; a ValueError names a key that looks like it."""
    if key in document:
        return document[key]
    near = difflib.get_close_matches(key, document.keys() - KEYS, 1)
    remedy = f"write '{key}:' instead of '{near[0]}:'" if near else f"add '{key}: ...'"
    raise ValueError(f"{key} is missing; {remedy}")


def _choice(document: dict[str, Any], key: str, choices: Sequence[str]) -> str:
    value = _value(document, key)
    if not isinstance(value, str) or value.lower() not in choices:
        raise ValueError(f"{key} is {_short(value)}; give one of {', '.join(choices)}")
    return value.lower()


def _numbers(document: dict[str, Any], key: str) -> Any:
    """Return a number or a list of numbers, of any length."""
    value = _value(document, key)
    try:
        return [*map(as_float, value)] if isinstance(value, list) else as_float(value)
    except ValueError:
        raise ValueError(f"{key} is {_short(value)}; give numbers") from None


def _percent_of_grey(document: dict[str, Any], mode: str) -> NDArray[np.int8]:
    """Return (256,) int8: the occupancy of each grey value, by map_server's rules."""
    keys = "free_thresh", "occupied_thresh"
    free_thresh, occupied_thresh = (
        as_number(key, _numbers(document, key), 0, 1) for key in keys
    )
    if free_thresh > occupied_thresh:
        raise ValueError(
            f"free_thresh is {free_thresh}; give at most {occupied_thresh}"
        )
    negate = _value(document, "negate")
    try:
        is_negated = as_truth(negate)
    except ValueError:
        problem = f"negate is {_short(negate)}"
        raise ValueError(f"{problem}; give 0 or 1, or true or false") from None
    grey = np.arange(256)
    if mode == "raw":
        return np.where(grey <= 100, grey, -1).astype(np.int8)
    # map_server computes in single precision, and a grey value may equal a threshold.
    free, occupied = np.float32(free_thresh), np.float32(occupied_thresh)
    p = grey.astype(np.float32) / np.float32(255)
    if not is_negated:
        p = np.float32(1) - p
    percent = np.full(256, -1.0)
    if mode == "scale":
        between = (free < p) & (p < occupied)
        # map_server subtracts the thresholds in double precision.
        scaled = (
            (p[between] - free)
            / np.float32(occupied_thresh - free_thresh)
            * np.float32(100)
        )
        percent[between] = np.floor(scaled) + (scaled - np.floor(scaled) >= 0.5)
    percent[p >= occupied] = 100
    percent[p <= free] = 0
    return percent.astype(np.int8)
