"""Images of maps, read as map_server reads them: with GraphicsMagick, of 16 bits a channel."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

IMAGE_FORMATS = ("PPM", "PNG", "BMP", "JPEG")

RAW_MODES = {"1", "1;I", "L", "L;2", "L;4", "LA", "I;16B", "P", "P;1", "P;2", "P;4"}
RAW_MODES |= {"RGB", "RGBA", "BGR", "BGRA", "CMYK;I"}
"""Of how files store pixels (Pillow's names), those that are read as map_server does. In others
Pillow drops bits, or map_server takes the fourth byte of a pixel as its opacity."""


def read_grey(path: Path, max_pixels: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Read an image of grey values; colours count by their Rec. 601 luma.

    Returns
    -------
    (H, W) uint8
        From the top row on.
    (H, W) bool
        Which pixels are not opaque.

    Raises
    ------
    ValueError
        If the image has more pixels, or would be read otherwise than by map_server.
    Exception
        Whatever broken bytes lead Pillow's decoders to.
    """
    with Image.open(path, formats=IMAGE_FORMATS) as image:
        if image.width * image.height > max_pixels:
            raise ValueError(f"{image.width} x {image.height} pixels")
        _refuse_other_depths(image)
        grey = _grey(image)
        if "A" not in image.getbands() and "transparency" not in image.info:
            return grey, np.zeros(grey.shape, dtype=np.bool_)
        return grey, np.asarray(image.convert("RGBA").getchannel("A")) < 255


def _refuse_other_depths(image: Any) -> None:
    codec, *_, arguments = image.tile[0]
    raw_mode, *rest = [arguments] if isinstance(arguments, str) else arguments
    # Of numbers as text, or of another range than that of their bytes, the greatest is the last.
    scaled = codec.startswith("ppm") and rest not in ([], [255])
    if image.mode == "I" and rest == [65535]:
        scaled = False
    if scaled or raw_mode not in RAW_MODES or codec == "bmp_rle":
        raise ValueError(f"its pixels are stored as {codec} {arguments}; save an 8-bit PNG")
    if "transparency" in image.info and image.mode != "P":
        raise ValueError("one of its colours is transparent; save it with an alpha channel")


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
