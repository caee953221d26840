"""Loads models for the planner node, the first one with all that a first plan needs."""

from __future__ import annotations

import gc

import numpy as np

from ddqn_planner.grid import GridMap
from ddqn_planner.model import find_model
from ddqn_planner.planning import Planner


def load(model: str) -> tuple[Planner, str]:
    """Return the planner of a model, and the model's file."""
    path = find_model(model)
    return Planner.load(path), str(path)


def load_and_warm_up(model: str) -> tuple[Planner, str]:
    """Load a model, and the libraries and compiled functions that most plans need.

    The garbage collector leaves out what is there then: a collection would stop the node for 45 ms.
    """
    planner, path = load(model)
    sizes = planner.metadata.sizes
    shape = sizes.get("height", 3), sizes.get("width", 3)
    grid = GridMap(np.zeros(shape, dtype=np.bool_))
    planner.plan(grid, (0, 0), (shape[1] - 1, shape[0] - 1))
    gc.freeze()
    return planner, path
