"""Experience that is loaded again as it grows: only what is new is spread over the map."""

from __future__ import annotations

import numpy as np

from ddqn_planner.experience.experience import Experience


def take_over(newer: Experience, older: Experience) -> None:
    """Let newer experience take over what an older one has spread over its map.

    Both are of one robot: the newer one has the older one's places, and more. If not, it begins
    anew.
    """
    spread = older._spread
    known, table = older.evidence.places, newer.evidence.table
    places = list(newer.evidence.number)
    same = ("nominal_speed", "robot_width", "half_life")
    if (
        spread is None
        or places[:known] != list(older.evidence.number)
        or any(getattr(newer, name) != getattr(older, name) for name in same)
    ):
        return
    changed = np.ones(len(table), dtype=np.bool_)
    changed[:known] = (table[:known] != older.evidence.table).any(axis=1)
    changed[older.evidence.changed_since(spread.version)] = True
    newer.evidence.version = older.evidence.version + 1
    newer.evidence._changed = np.where(changed, newer.evidence.version, 0)
    newer._spread, older._spread = spread, None
