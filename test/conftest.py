from __future__ import annotations

import os
from pathlib import Path

import hypothesis
import numpy as np
import pytest

# Read by the first import of a message type.
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"

import torch

from ddqn_planner.grid import GridMap
from ddqn_planner.training.environment import Scenario, paper_scenario

torch.set_num_threads(1)
# A loaded machine is slow, not wrong.
hypothesis.settings.register_profile("default", deadline=None, max_examples=50)
hypothesis.settings.load_profile("default")

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def paper() -> Scenario:
    return paper_scenario()


@pytest.fixture
def small() -> Scenario:
    """A 5x4 map with a wall that is open at its top."""
    occupancy = np.zeros((4, 5), dtype=bool)
    occupancy[:3, 2] = True
    return Scenario(GridMap(occupancy), start=(0, 0), goal=(4, 0))
