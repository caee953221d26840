"""Primitives that are quarter turns of each other share a unit of a network."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.robot.motions import Motions, turn_between

Poses = NDArray[np.float64]  # (N, 3): x and y in cells, yaw in radians

# Cells or radians: two primitives differ by more; a lattice is written less exactly.
SAME = 1e-6


class Units(NamedTuple):
    """The units of P primitives."""

    unit: NDArray[np.int64]  # (P,) the unit of each primitive
    turns: NDArray[np.int64]  # (P,) by how many quarter turns it differs from its unit
    motions: Motions  # whose poses are those of the units


def units_of(motions: Motions) -> Units:
    """Return the units of primitives: quarter turns of each other share a unit.

    The poses of a unit are those of its first primitive, turned back by quarter turns
    until its first heading lies in the first quarter.
    """
    turns = motions.start // (motions.headings // 4)  # (P,): quarter turns, 0 to 3
    unit_of_primitive: list[int] = []
    poses_of_units: list[Poses] = []
    for quarter_turns, poses in zip(turns.tolist(), motions.poses, strict=True):
        turned_poses = _turned_back(poses, quarter_turns)
        unit = _first_same(poses_of_units, turned_poses)
        if unit is None:
            unit = len(poses_of_units)
            poses_of_units.append(turned_poses)
        unit_of_primitive.append(unit)
    unit_motions = replace(motions, poses=tuple(poses_of_units))
    return Units(np.array(unit_of_primitive), turns, unit_motions)


def _turned_back(poses: Poses, quarter_turns: int) -> Poses:
    """Return poses (N, 3) turned clockwise around the origin by some quarter turns."""
    x = poses[:, 0]
    y = poses[:, 1]
    yaw = poses[:, 2]
    for _ in range(quarter_turns):
        turned_x = y
        y = -x
        x = turned_x
    return np.column_stack([x, y, yaw - quarter_turns * math.pi / 2])


def _first_same(poses_of_units: list[Poses], poses: Poses) -> int | None:
    """Return the index of the first unit whose poses are the same, or None."""
    for unit, unit_poses in enumerate(poses_of_units):
        if _are_same(poses, unit_poses):
            return unit
    return None


def _are_same(first_poses: Poses, second_poses: Poses) -> bool:
    """Return whether poses (N, 3) are the same except for rounding and whole turns."""
    if len(first_poses) != len(second_poses):
        return False
    difference = first_poses - second_poses
    difference[:, 2] = turn_between(0, difference[:, 2])
    return bool(np.abs(difference).max() < SAME)
