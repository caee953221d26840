"""Makes maps/office.yaml and maps/office.png, the map of the demo that no model was trained on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
from PIL import Image

from ddqn_planner.grid import OCCUPIED, MapFile
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
    return MapFile(np.where(occupancy, np.int8(OCCUPIED), np.int8(0)), 0.05, start=START, goal=GOAL)


def main() -> None:
    """Write both files."""
    map_file, folder = office_map(), Path(__file__).resolve().parent.parent / "maps"
    grey = np.where(map_file.values == OCCUPIED, 0, 254).astype(np.uint8)
    Image.fromarray(grey[::-1]).save(folder / "office.png", optimize=True)
    metadata = {
        "image": "office.png",
        "mode": "trinary",
        "resolution": map_file.resolution,
        "origin": list(map_file.origin),
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
        "ddqn_planner": {"start": list(START), "goal": list(GOAL)},
    }
    text = yaml.safe_dump(metadata, sort_keys=False, default_flow_style=None)
    (folder / "office.yaml").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
