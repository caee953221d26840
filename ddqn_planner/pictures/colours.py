"""The colours of maps, paths and value fields, the same in every picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import ImageColor

OBSTACLE_COLOUR = "#22223b"
PATH_COLOUR = "#d1495b"
EPISODE_COLOUR = "#edae49"
DIRECTION_COLOUR = "#6c757d"

VALUE_COLOURS = ("#f4f1de", "#cfe8dc", "#93cfc8", "#4fa3b5")
"""From the worst value to the best: light to dark, so that the order shows without colours too.
The darkest is far from the colour of obstacles."""

MAX_SIDE_WITH_LINES = 64
"""Cells of the longest side of a map that is drawn with lines between its cells."""


def mixed_colours(colours: tuple[str, ...], levels: int) -> NDArray[np.uint8]:
    """Return (levels, 3) uint8, RGB: from the first colour over all others to the last."""
    rgb = np.array([ImageColor.getrgb(colour)[:3] for colour in colours])
    places, wanted = np.linspace(0, 1, len(rgb)), np.linspace(0, 1, levels)
    mixed = np.stack([np.interp(wanted, places, channel) for channel in rgb.T], axis=1)
    rounded: NDArray[np.uint8] = np.rint(mixed).astype(np.uint8)
    return rounded


def value_ramp(levels: int) -> NDArray[np.uint8]:
    """Return (levels, 3) uint8, RGB: the colours of values from the worst to the best."""
    return mixed_colours(VALUE_COLOURS, levels)
