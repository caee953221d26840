"""Map files: ROS maps (YAML and an image) and MovingAI maps are read."""

import difflib
import os
import re
import reprlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.files import as_path, is_missing, kind_of, read_file
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

if TYPE_CHECKING:
    from PIL.Image import Image

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

SCENARIO_KEYS = {"start", "goal", "directions"}

# In other layouts Pillow drops bits, or map_server takes the fourth byte of a pixel as
# its opacity.
LAYOUTS = {"1", "1;I", "L", "L;2", "L;4", "LA", "I;16B", "P", "P;1", "P;2", "P;4"}
LAYOUTS |= {"RGB", "RGBA", "BGR", "BGRA", "CMYK;I"}
"""Pillow's names of the pixel layouts in files that it reads as map_server does."""

_shortener = reprlib.Repr()
# YAML aliases can nest lists that are huge when they are printed.
_shortener.maxlevel = 2
_short = _shortener.repr


class MapFileError(ValueError):
    """A map file cannot be read."""


class MapNotFoundError(MapFileError, FileNotFoundError):
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
        """Check all values, and replace the arrays by read-only copies."""
        values = numbers(
            "the array of values", self.values, between=(UNKNOWN, OCCUPIED)
        )
        values = values.astype(np.int8)
        values.flags.writeable = False
        # A grid map checks the place and the one-way zones.
        grid = GridMap(
            values == OCCUPIED, self.resolution, self.origin, forbidden=self.forbidden
        )
        self._set("values", values)
        self._set("resolution", grid.resolution)
        self._set("origin", grid.origin)
        self._set("forbidden", grid.forbidden)
        if self.start is not None:
            self._set("start", cell_inside(self.start, values.shape, "start"))
        if self.goal is not None:
            self._set("goal", cell_inside(self.goal, values.shape, "goal"))

    def _set(self, name: str, value: object) -> None:
        """Set an attribute of this frozen object."""
        object.__setattr__(self, name, value)

    def grid(
        self,
        occupied_threshold: int = 65,
        allow_unknown: bool = False,
        use_map_costs: bool = False,
    ) -> GridMap:
        """Return the grid map; for parameters see `GridMap.from_occupancy_values`."""
        return GridMap.from_occupancy_values(
            self.values,
            self.resolution,
            self.origin,
            occupied_threshold=occupied_threshold,
            allow_unknown=allow_unknown,
            use_map_costs=use_map_costs,
            forbidden=self.forbidden,
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
        From which percent on a cell is occupied, whether unknown cells are free, and
        whether the values of free cells are costs; see `GridMap.from_occupancy_values`.

    Raises
    ------
    MapNotFoundError
        If there is no such file.
    MapMetadataError
        If the file is no map, or its description is wrong.
    MapDataError
        If the cells of the map cannot be read.
    """
    map_file = read_map_file(map_path(path))
    return map_file.grid(occupied_threshold, allow_unknown, use_map_costs)


def map_path(path: str | Path) -> Path:
    """Return the path of a map file, or of a shipped map by its name: see `load_map`.

    A MapNotFoundError says why there can be no such file.
    """
    try:
        return find_map(path) if isinstance(path, str) else as_path(path)
    except (FileNotFoundError, ValueError) as error:
        raise MapNotFoundError(str(error)) from None


def read_map_file(path: str | Path, only_below: bool = False) -> MapFile:
    """Read all that a map file holds; see `load_map` for the path and the errors.

    With `only_below` the images must lie in the folder of the YAML file or below it: so
    a path that others choose, as in a service's request, cannot show any other file of
    this machine.
    """
    try:
        path = as_path(path)
    except ValueError as error:
        raise MapNotFoundError(str(error)) from None
    kind = kind_of(path)
    if kind:
        raise MapNotFoundError(f"{str(path)!r} is {kind}; give the path of a map file")
    if is_missing(path):
        raise MapNotFoundError(f"{str(path)!r}: no such file; give the path of a map")
    if path.suffix.lower() not in (".yaml", ".yml", ".map"):
        raise MapMetadataError(
            f"{path}: ends in {path.suffix!r}; give a .yaml, .yml or .map file"
        )
    try:
        if path.suffix.lower() == ".map":
            return _read_moving_ai(path)
        return _read_ros(path, only_below)
    except MapFileError:
        raise
    except ValueError as error:
        raise MapMetadataError(f"{path}: {error}") from error


def _read_bytes(path: Path, limit: int, error_class: type[MapFileError]) -> bytes:
    """Return a file's content, at most `limit` bytes; else raise the error class."""
    try:
        return read_file(path, limit)
    except OSError as error:
        raise error_class(
            f"{path}: cannot be read ({error.strerror}); check its rights"
        ) from error
    except ValueError as error:
        raise error_class(str(error)) from None


def _read_moving_ai(path: Path) -> MapFile:
    """Read a map of the MovingAI benchmark: four lines of header, then the rows.

    A row has a character for each cell; the first row has y = 0.
    """
    # A row of one cell takes up to three bytes: the cell, \r and \n.
    content = _read_bytes(path, 3 * MAX_CELLS, MapDataError)
    pattern = rb"type octile\s+height (\d{1,8})\s+width (\d{1,8})\s+map[ \t]*\r?\n"
    header = re.match(pattern, content)
    if header is None:
        lines = "'type octile', 'height H', 'width W', 'map'"
        raise ValueError(
            f"begins with {content[:40]!r}; the first four lines must be {lines}"
        )
    height = int(header[1])
    width = int(header[2])
    if not 1 <= height * width <= MAX_CELLS:
        raise ValueError(
            f"height is {height}, width is {width}; give 1 to {MAX_CELLS} cells"
        )
    body = content[header.end() :].replace(b"\r\n", b"\n")
    text = body.rstrip(b"\n") + b"\n"  # each row ends with one line break
    rows = text.count(b"\n")
    characters = np.frombuffer(text, dtype=np.uint8)
    has_size = rows == height and characters.size == height * (width + 1)
    ends_of_rows = characters[width :: width + 1]
    if not has_size or (ends_of_rows != ord("\n")).any():
        remedy = f"give {height} rows of {width}, as its header says"
        raise MapDataError(
            f"{path}: has {rows} rows, {characters.size - rows} cells; {remedy}"
        )
    cells = characters.reshape(height, width + 1)[:, :-1]  # without line breaks
    is_free = np.isin(cells, list(b".GS"))  # ground, twice, and swamp
    return MapFile(np.where(is_free, np.int8(0), np.int8(OCCUPIED)), files=(path,))


def _read_ros(path: Path, only_below: bool) -> MapFile:
    """Read a ROS map from the YAML file `path`, which names its images.

    With `only_below`, images outside the YAML file's folder are refused.
    """
    document = read_yaml(_read_bytes(path, MAX_YAML_BYTES, MapMetadataError))
    if not isinstance(document, dict):
        raise ValueError(
            "not a YAML mapping; give 'key: value' lines: image, resolution, ..."
        )
    image = _image_path(path, document, "image", only_below)
    pixels = _read_image(image, ("PPM", "PNG", "BMP", "JPEG"), LAYOUTS)
    with_default = {"mode": "trinary", **document}
    mode = _choice(with_default, "mode", ("trinary", "scale", "raw"))
    percent_of_grey = _percent_of_grey(document, mode)  # (256,)
    values = percent_of_grey[pixels.grey]  # (H, W): the first row is the top one
    if mode != "raw":
        values[pixels.is_clear] = UNKNOWN
    resolution = _numbers(document, "resolution")
    origin = _numbers(document, "origin")
    scenario = document.get("ddqn_planner", {})
    if not isinstance(scenario, dict) or not scenario.keys() <= SCENARIO_KEYS:
        keys = "{start: , goal: , directions: }"
        raise ValueError(f"ddqn_planner is {_short(scenario)}; give some of {keys}")
    files = [path, image]
    forbidden = None
    if "directions" in scenario:
        directions = _image_path(path, scenario, "directions", only_below)
        files.append(directions)
        forbidden = _read_directions(directions, scenario["directions"], values.shape)
    return MapFile(
        values[::-1],  # y = 0 is the bottom row
        resolution,
        origin,
        start=_numbers(scenario, "start") if "start" in scenario else None,
        goal=_numbers(scenario, "goal") if "goal" in scenario else None,
        forbidden=forbidden,
        files=tuple(files),
    )


def _read_directions(
    file: Path, name: str, shape: tuple[int, ...]
) -> NDArray[np.uint8]:
    """Return the one-way zones of an image file: (H, W) uint8, y = 0 first.

    `name` is the file's name in the YAML file, for errors; `shape` is the map's shape
    (H, W), which the image must have.
    """
    forbidden = _read_image(file, ("PPM", "PNG"), {"L"}).grey
    if forbidden.shape != shape:
        height, width = forbidden.shape
        map_height, map_width = shape
        raise MapDataError(
            f"{name!r}: has {width} x {height} pixels; give {map_width} x "
            f"{map_height}, as the map's image"
        )
    return forbidden[::-1]


def _image_path(
    path: Path, document: dict[str, Any], key: str, only_below: bool
) -> Path:
    """Return the path of an image that a YAML file names.

    Parameters
    ----------
    path : Path
        The YAML file: relative names begin in its folder.
    document : dict
        The part of its content with the key.
    key : str
        The key of the image's path.
    only_below : bool
        Whether the image must lie in the folder of the YAML file, or below.
    """
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
    kind = kind_of(file)
    if kind:
        raise MapDataError(
            f"{str(file)!r} is {kind}; give an image as {key!r} in the YAML file"
        )
    if not os.path.isfile(file):
        remedy = _remedy_for_missing_image(path, key, name)
        raise MapDataError(f"{str(file)!r}: no such image; {remedy}")
    return file


def _remedy_for_missing_image(path: Path, key: str, name: str) -> str:
    """Return what to do if there is no image of the name that a YAML file gives."""
    # The name is often the absolute path of the computer on which the map was saved.
    file_name = re.split(r"[/\\]", name)[-1]
    names_folder = file_name not in ("", name)
    if names_folder and os.path.isfile(path.parent / file_name):
        remedy = f"write '{key}: {file_name}' there"
        return f"{file_name!r} lies beside the YAML file: {remedy}"
    return f"check {key!r} in the YAML file"


def _is_below(file: Path, yaml_file: Path) -> bool:
    """Return whether a file lies in the folder of a YAML file, or below it."""
    # In a linked colcon workspace the YAML file is itself a link: the link's folder and
    # the folder of the linked file are allowed.
    folders = yaml_file.parent.resolve(), yaml_file.resolve().parent
    return any(file.resolve().is_relative_to(folder) for folder in folders)


class Pixels(NamedTuple):
    """The pixels of an image."""

    grey: NDArray[np.uint8]  # (H, W): 0 is black
    is_clear: NDArray[np.bool_]  # (H, W): True where not opaque


def _read_image(file: Path, formats: tuple[str, ...], layouts: set[str]) -> Pixels:
    """Read an image; a MapDataError if it is none of these formats and layouts.

    Parameters
    ----------
    file : Path
    formats : tuple of str
        Pillow's names of file formats.
    layouts : set of str
        Pillow's names of pixel layouts, see `LAYOUTS`.
    """
    # 17 ms, and a planner that is sent its maps reads no image.
    import PIL.Image

    too_large = PIL.Image.DecompressionBombWarning, PIL.Image.DecompressionBombError
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", PIL.Image.DecompressionBombWarning)
            image = PIL.Image.open(file, formats=formats)
        with image:
            _check_layout(image, layouts)
            return _pixels(image)
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
    """Raise a ValueError for an image that is too large, or of another layout.

    `image` is Pillow's, opened but not decoded; `layouts` are the names of right ones.
    """
    if image.width * image.height > MAX_CELLS:
        raise ValueError(f"{image.width} x {image.height} pixels")
    # How Pillow will decode the image: first the decoder's name, last its arguments,
    # which are the layout alone or begin with the layout.
    codec, *_, arguments = image.tile[0]
    layout, *options = [arguments] if isinstance(arguments, str) else arguments
    # The only option of a PPM is its greatest value; none where that is 255 or 65535.
    greatest = 65535 if image.mode == "I" else 255
    if codec.startswith("ppm") and options not in ([], [greatest]):
        # Versions of map_server disagree on the meaning of other greatest values.
        right = "255, or 65535 for grey"
        raise ValueError(
            f"its greatest value is {options[0]}; give {right}, or an 8-bit grey PNG"
        )
    if layout not in layouts or codec == "bmp_rle":
        raise ValueError(
            f"its pixels are stored as {codec} {arguments}; save an 8-bit grey PNG"
        )
    if "transparency" in image.info and image.mode != "P":
        raise ValueError(
            "one of its colours is transparent; save it with an alpha channel"
        )


def _pixels(image: "Image") -> Pixels:
    """Return the pixels of an image, grey as map_server sees them."""
    is_clear = np.zeros((image.height, image.width), dtype=np.bool_)
    if "A" in image.getbands() or "transparency" in image.info:
        opacity = np.asarray(image.convert("RGBA").getchannel("A"))
        is_clear = opacity < 255
    return Pixels(_grey(image).astype(np.uint8, copy=False), is_clear)


def _grey(image: "Image") -> NDArray[np.integer[Any]]:
    """Return the grey values that map_server gives to a Pillow image: (H, W), 0 to 255.

    map_server computes the luma of Rec. 601 with 16 bits, and cuts it to 8 bits. Values
    of 16 bits are 257 times those of 8 bits.
    """
    if image.mode.startswith("I"):
        return np.asarray(image) // 257
    if image.mode in ("1", "L", "LA"):
        return np.asarray(image.convert("L"))
    colours = image.convert("RGBA" if image.mode == "P" else "RGB")
    pixels = np.asarray(colours, dtype=np.int32)  # (H, W, 3)
    red = pixels[..., 0]
    green = pixels[..., 1]
    blue = pixels[..., 2]
    # The luma of 16 bits; times 1000, so that the weights are whole numbers.
    luma_times_1000 = 257 * (299 * red + 587 * green + 114 * blue)
    rounded_luma: NDArray[np.int32] = (luma_times_1000 + 500) // 1000
    return rounded_luma // 257


def _value(document: dict[str, Any], key: str) -> Any:
    """Return the value of a key; a ValueError names a key that looks like it."""
    if key in document:
        return document[key]
    remedy = f"add '{key}: ...'"
    similar_keys = difflib.get_close_matches(key, document.keys() - KEYS, 1)
    if similar_keys:
        remedy = f"write '{key}:' instead of '{similar_keys[0]}:'"
    raise ValueError(f"{key} is missing; {remedy}")


def _choice(document: dict[str, Any], key: str, choices: Sequence[str]) -> str:
    """Return the value of a key in lower case; a ValueError unless it is a choice."""
    value = _value(document, key)
    if not isinstance(value, str) or value.lower() not in choices:
        raise ValueError(f"{key} is {_short(value)}; give one of {', '.join(choices)}")
    return value.lower()


def _numbers(document: dict[str, Any], key: str) -> Any:
    """Return the value of a key: a number, or a list of numbers of any length."""
    value = _value(document, key)
    try:
        if isinstance(value, list):
            return [as_float(number) for number in value]
        return as_float(value)
    except ValueError:
        raise ValueError(f"{key} is {_short(value)}; give numbers") from None


def _percent_of_grey(document: dict[str, Any], mode: str) -> NDArray[np.int8]:
    """Return the occupancy of each grey value by map_server's rules: (256,) int8.

    Parameters
    ----------
    document : dict
        The content of the YAML file, with thresholds.
    mode : str
        How map_server derives occupancy: ``raw`` takes the grey values themselves, for
        0 to 100; ``trinary`` knows 0, 100 and unknown; ``scale`` also has percent
        between the thresholds.
    """
    free_thresh = as_number("free_thresh", _numbers(document, "free_thresh"), 0, 1)
    occupied_thresh = as_number(
        "occupied_thresh", _numbers(document, "occupied_thresh"), 0, 1
    )
    if free_thresh > occupied_thresh:
        raise ValueError(
            f"free_thresh is {free_thresh}; give at most {occupied_thresh}"
        )
    is_negated = _truth(document, "negate")
    grey = np.arange(256)  # (256,), as all that follow
    if mode == "raw":
        return np.where(grey <= 100, grey, UNKNOWN).astype(np.int8)
    # map_server computes in single precision, and a grey value may equal a threshold.
    free = np.float32(free_thresh)
    occupied = np.float32(occupied_thresh)
    # 0 to 1: free to occupied.
    darkness: NDArray[np.float32] = grey.astype(np.float32) / np.float32(255)
    if not is_negated:
        darkness = np.float32(1) - darkness
    percent = np.full(256, float(UNKNOWN))
    if mode == "scale":
        is_between: NDArray[np.bool_] = (free < darkness) & (darkness < occupied)
        # map_server subtracts the thresholds in double precision, and rounds 0.5 up.
        range_of_scale = np.float32(occupied_thresh - free_thresh)
        share: NDArray[np.float32] = (darkness[is_between] - free) / range_of_scale
        scaled = share * np.float32(100)
        rounded_down = np.floor(scaled)
        is_rounded_up = scaled - rounded_down >= 0.5
        percent[is_between] = rounded_down + is_rounded_up
    percent[darkness >= occupied] = 100
    percent[darkness <= free] = 0
    return percent.astype(np.int8)


def _truth(document: dict[str, Any], key: str) -> bool:
    """Return the truth value of a key; a ValueError if it is neither true nor false."""
    value = _value(document, key)
    try:
        return as_truth(value)
    except ValueError:
        problem = f"{key} is {_short(value)}"
        raise ValueError(f"{problem}; give 0 or 1, or true or false") from None
