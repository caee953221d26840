"""Makes maps/office.yaml and maps/office.png, the map of the demo that no model was trained on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from ddqn_planner.grid import OCCUPIED, MapFile, save_map
from ddqn_planner.grid.generators import generate_map

SEED = 4
COARSE = (64, 96)
SCALE = 6
"""Cells of the map for one of the plan: walls of 0.3 m, corridors of 1.2 m."""

START, GOAL = (15, 15), (550, 330)


def office_map() -> MapFile:
    """Return an office building of 28.8 m x 19.2 m in cells of 0.05 m."""
    plan = generate_map("office", COARSE, np.random.default_rng(SEED))
    occupancy = np.kron(plan, np.ones((SCALE, SCALE), dtype=np.bool_))
    return MapFile(OCCUPIED * occupancy, 0.05, start=START, goal=GOAL)


def main() -> None:
    """Write both files."""
    yaml_file = Path(__file__).resolve().parent.parent / "maps" / "office.yaml"
    save_map(office_map(), yaml_file)
    # As PNG the image takes a hundredth of the place.
    image = yaml_file.with_suffix(".pgm")
    Image.open(image).save(image.with_suffix(".png"), optimize=True)
    image.unlink()
    text = yaml_file.read_text(encoding="utf-8").replace("office.pgm", "office.png")
    yaml_file.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
