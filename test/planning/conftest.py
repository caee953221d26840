"""What the tests of planning share."""

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from ddqn_planner.model import RobotNetwork
from ddqn_planner.planning import pose_planner
from ddqn_planner.planning.departure import make_departures
from ddqn_planner.planning.pose_world import Body, body_of
from ddqn_planner.robot.motions import Motions

TABLES: dict[tuple[Motions, bytes], Body] = {}


def body_of_same_robot(motions: Motions, swept: NDArray[np.bool_]) -> Body:
    """Return a robot's tables, which are made once in a process.

    All but those of departures, which planning fills.
    """
    key = motions, swept.tobytes()
    if key not in TABLES:
        TABLES[key] = body_of(motions, swept)
    body = TABLES[key]
    departures = make_departures(len(body.departures.cost), body.directions)
    return body._replace(departures=departures)


def body_of_its_own(network: RobotNetwork) -> Body:
    """Return a network's body with departures that no other planner has filled."""
    return body_of_same_robot(network.motions, network.swept())


@pytest.fixture(scope="module", autouse=True)
def few_tables() -> Iterator[None]:
    """Let planners of one robot share its tables, which take longer than most plans.

    Many tests begin with a planner that knows no field.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pose_planner, "body_of_network", body_of_its_own)
        yield
