"""Networks with chosen weights, without a training."""

from functools import cache
from pathlib import Path

import numpy as np

from ddqn_planner.grid import MoveRule
from ddqn_planner.model import (
    NETWORKS,
    ModelMetadata,
    QNetwork,
    RobotNetwork,
)
from ddqn_planner.planning import Planner
from ddqn_planner.robot.footprint import read_footprint
from ddqn_planner.robot.motions import make_motions


def random_network(
    name: str, seed: int = 0, scale: float = 0.5, **sizes: int
) -> QNetwork:
    random = np.random.default_rng(seed)
    shapes = NETWORKS[name].shapes(sizes)
    tensors = {key: random.normal(0, scale, shape) for key, shape in shapes.items()}
    return NETWORKS[name](
        sizes, {key: t.astype(np.float32) for key, t in tensors.items()}
    )


def turning_network(size: int) -> QNetwork:
    """A network that always goes to -x, or where it cannot, to +x: it turns round for
    ever.
    """
    network = random_network(
        "paper", height=size, width=size, filters=1, hidden_units=0
    )
    network.tensors["fully_connected.weight"][:] = 0
    network.tensors["fully_connected.bias"][:] = [1, 0, 0, 0, 2, 0, 0, 0]
    return network


def turning_planner(size: int = 6) -> Planner:
    """A planner with this network: its greedy steps are trapped."""
    network = turning_network(size)
    metadata = ModelMetadata(
        "paper", network.sizes, MoveRule.ROBOT_SAFE, 0.9, "", 1, 0, ""
    )
    return Planner(network, metadata)


ANY_MAP = Planner.load("any_map")


def new_planner() -> Planner:
    """The shipped planner for any map, which knows no field."""
    return Planner(ANY_MAP.network, ANY_MAP.metadata)


BODY = 0.3, 0.2, 0.2  # metres that `robot_model` reaches ahead, behind and to each side


def robot_model(
    path: Path,
    motion: str,
    cell: float,
    body: tuple[float, float, float] = BODY,
) -> None:
    """Write the model of a small robot that has learned its body exactly."""
    robot_planner(motion, cell, body).save(path)


def robot_planner(
    motion: str, cell: float, body: tuple[float, float, float] = BODY
) -> Planner:
    """The planner of such a robot, which knows no field and no map."""
    network = _robot_network(motion, cell, body)
    rule = MoveRule.ROBOT_SAFE
    metadata = ModelMetadata("robot", network.sizes, rule, 1.0, "", 0, 0, "")
    return Planner(network, metadata)


@cache
def _robot_network(
    motion: str, cell: float, body: tuple[float, float, float]
) -> RobotNetwork:
    front, back, side = body
    corners = [(front, side), (-back, side), (-back, -side), (front, -side)]
    untrained = RobotNetwork.untrained(
        read_footprint(corners), make_motions(motion, 0.4, cell)
    )
    swept = untrained.swept_by_unit.astype(np.float32)
    learned = {"weight": 2 * swept, "threshold": np.ones(len(swept), np.float32)}
    return RobotNetwork(untrained.sizes, {**untrained.tensors, **learned})
