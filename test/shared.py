"""What the tests of the library and those of the experiments have in common."""

import os
import signal

# Read by the first import of NumPy and of torch, as in the nodes. On busy cores the
# threads of OpenBLAS wait for one another: a proof of a model took 0.3 s instead of
# 0.03.
os.environ["OMP_NUM_THREADS"] = "1"

import hypothesis
import numpy as np
import pytest

from ddqn_planner.grid import GridMap, MoveRule
from ddqn_planner.training.environment import Scenario, paper_scenario

# A shell starts what it runs in the background with SIGINT ignored; the processes that
# the tests start would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)
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
