"""Images of maps, read as map_server's GraphicsMagick reads them (with 16 bits per channel).

And images of forbidden directions, whose grey values are read as they are.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

IMAGE_FORMATS = ("PPM", "PNG", "BMP", "JPEG")
DIRECTION_FORMATS = ("PPM", "PNG")

RAW_MODES = {"1", "1;I", "L", "L;2", "L;4", "LA", "I;16B", "P", "P;1", "P;2", "P;4"}
RAW_MODES |= {"RGB", "RGBA", "BGR", "BGRA", "CMYK;I"}
"""Pillow's names of the pixel layouts in files that it reads as map_server does. In other layouts
Pillow drops bits, or map_server takes the fourth byte of a pixel as its opacity."""


def read_grey(path: Path, max_pixels: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return the grey values of an image, top row first, and which pixels are not opaque.

    Colours are converted to their Rec. 601 luma. An image that has more pixels, or that map_server
    would read differently, is a ValueError; Pillow's decoders may raise any other exception on
    broken bytes.
    """
    with Image.open(path, formats=IMAGE_FORMATS) as image:
        _check_layout(image, max_pixels)
        grey = _grey(image)
        if "A" not in image.getbands() and "transparency" not in image.info:
            return grey, np.zeros(grey.shape, dtype=np.bool_)
        return grey, np.asarray(image.convert("RGBA").getchannel("A")) < 255


def read_directions(path: Path, max_pixels: int) -> NDArray[np.uint8]:
    """Return the values 0..255 of a lossless image of 8-bit grey, top row first.

    Any other image is a ValueError; Pillow's decoders may raise any other exception on broken
    bytes.
    """
    with Image.open(path, formats=DIRECTION_FORMATS) as image:
        raw_mode = _check_layout(image, max_pixels)
        if raw_mode != "L":
            raise ValueError(f"its pixels are stored as {raw_mode}; save 8 bits of grey, no alpha")
        return np.asarray(image)


def _check_layout(image: Any, max_pixels: int) -> str:
    if image.width * image.height > max_pixels:
        raise ValueError(f"{image.width} x {image.height} pixels")
    codec, *_, arguments = image.tile[0]
    raw_mode, *rest = [arguments] if isinstance(arguments, str) else arguments
    # The last argument of a PPM is its greatest value, unless that is the greatest of its bytes.
    scaled = codec.startswith("ppm") and rest not in ([], [255])
    if image.mode == "I" and rest == [65535]:
        scaled = False
    if scaled or raw_mode not in RAW_MODES or codec == "bmp_rle":
        raise ValueError(f"its pixels are stored as {codec} {arguments}; save an 8-bit PNG")
    if "transparency" in image.info and image.mode != "P":
        raise ValueError("one of its colours is transparent; save it with an alpha channel")
    return str(raw_mode)


def _grey(image: Image.Image) -> NDArray[np.uint8]:
    if image.mode.startswith("I"):
        return (np.asarray(image) // 257).astype(np.uint8)
    if image.mode in ("1", "L", "LA"):
        return np.asarray(image.convert("L"))
    colours = image.convert("RGBA" if image.mode == "P" else "RGB")
    red, green, blue = np.moveaxis(np.asarray(colours, dtype=np.int32), 2, 0)[:3]
    luma = (257 * (299 * red + 587 * green + 114 * blue) + 500) // 1000  # 0..65535, rounded
    grey: NDArray[np.uint8] = (luma // 257).astype(np.uint8)
    return grey
