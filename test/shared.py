"""What the tests of the library and those of the experiments have in common."""

import signal

import hypothesis
import numpy as np
import pytest
import torch

from ddqn_planner.grid import GridMap, MoveRule
from ddqn_planner.training.environment import Scenario, paper_scenario

# A shell starts what it runs in the background with SIGINT ignored; the processes that
# the tests start would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)
torch.set_num_threads(1)
# A loaded machine is slow, not wrong.
hypothesis.settings.register_profile("default", deadline=None, max_examples=25)
hypothesis.settings.register_profile("fuzz", deadline=None, max_examples=1000)
hypothesis.settings.load_profile("default")


@pytest.fixture(scope="session")
def paper() -> Scenario:
    return paper_scenario()


@pytest.fixture(scope="session")
def small() -> Scenario:
    """A 5x4 map with a wall that is open at its top."""
    occupancy = np.zeros((4, 5), dtype=bool)
    occupancy[:3, 2] = True
    return Scenario(GridMap(occupancy), (0, 0), (4, 0), MoveRule.ROBOT_SAFE)
