"""The network that knows a robot's body: which primitives succeed among which occupied cells."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import MoveRule
from ddqn_planner.model.networks import ModelFileError, QNetwork
from ddqn_planner.robot.body_certificate import BodyCertificate, certify_body
from ddqn_planner.robot.footprint import read_footprint, swept_cells
from ddqn_planner.robot.motions import HEADINGS, Motions, turn_between
from ddqn_planner.robot.units import units_of

Float64: TypeAlias = NDArray[np.float64]

# Shapes: P = primitives, U = units of the network, S x S cells with the robot in the middle.


class RobotNetwork(QNetwork):
    """Whether a primitive succeeds: p(s, a) = sigmoid(b - sum of the weights of occupied cells)."""

    # Weights are at least 0: what is below counts as 0. One unit serves all primitives that are
    # quarter turns of each other. What else the tensors hold is given, not learned.
    name = "robot"
    size_names = ("units", "side", "primitives", "poses", "corners")
    max_size = 2**16
    doubles = frozenset({"primitive", "pose", "angle", "footprint", "resolution"})

    @classmethod
    def shapes(cls, sizes: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
        """Return the shape of each tensor."""
        units, side, primitives, poses, corners = (
            sizes[name] for name in cls.size_names
        )
        learned = {"weight": (units, side, side), "threshold": (units,)}
        given = {
            "primitive": (primitives, 6),
            "pose": (poses, 3),
            "footprint": (corners, 2),
        }
        return {**learned, **given, "angle": (HEADINGS,), "resolution": (1,)}

    @classmethod
    def untrained(cls, footprint: Float64, motions: Motions) -> RobotNetwork:
        """Return the network of a robot that knows nothing yet; a ValueError for no robot."""
        swept_USS = swept_cells(footprint, units_of(motions).motions)
        poses = [len(one) for one in motions.poses]
        columns = motions.start, motions.end, *motions.offset.T, motions.cost, poses
        tensors: dict[str, Any] = {
            "weight": np.zeros(swept_USS.shape, np.float32),
            "threshold": np.zeros(len(swept_USS), np.float32),
            "primitive": np.column_stack(columns).astype(np.float64),
            "pose": np.concatenate(motions.poses),
            "footprint": footprint,
            "angle": motions.angles,
            "resolution": np.array([motions.resolution]),
        }
        sizes = *swept_USS.shape[:2], len(poses), sum(poses), len(footprint)
        return cls(dict(zip(cls.size_names, sizes, strict=True)), tensors)

    def __init__(self, sizes: Mapping[str, int], tensors: Mapping[str, Any]) -> None:
        super().__init__(sizes, tensors)
        self.footprint = read_footprint(tensors["footprint"].tolist())
        self.motions = _motions_of(self.tensors)
        self.unit, self.turns, unit_motions = units_of(self.motions)
        # (U, S, S): the cells that the body sweeps on one primitive of each unit
        self.swept_by_unit = swept_cells(self.footprint, unit_motions)
        found = dict(zip(self.size_names, self.swept_by_unit.shape[:2], strict=False))
        if wrong := {name: size for name, size in found.items() if size != sizes[name]}:
            raise ValueError(
                f"its body and motions need {wrong}, not {dict(sizes)}; train it again"
            )

    def supports(self, shape: tuple[int, int]) -> bool:
        """Say whether the network can plan cells on maps of shape (H, W): it plans poses."""
        return False

    def of_primitives(self, array_USS: NDArray[Any]) -> NDArray[Any]:
        """Return what each primitive has of its unit, in the directions of the map: (P, S, S)."""
        turned = [np.rot90(array_USS, -turns, axes=(1, 2)) for turns in range(4)]
        return np.stack(turned)[self.turns, self.unit]

    def certificate(self, move_rule: MoveRule | None = None) -> BodyCertificate:
        """Return what is proved of its primitives, for all patterns of occupied cells."""
        return certify_body(
            weight_USS=self.tensors["weight"],
            threshold_U=self.tensors["threshold"],
            swept_USS=self.swept_by_unit,
            unit_P=self.unit,
        )

    def swept(self) -> NDArray[np.bool_]:
        """Return the cells that forbid each primitive, (P, S, S), as learned and proved."""
        certificate = self.certificate()
        if not certificate.proved:
            remedy = "give a model that ddqn-planner train-robot has proved"
            raise ModelFileError(f"the robot's body is {certificate}; {remedy}")
        learned_USS = self.tensors["weight"] > self.tensors["threshold"][:, None, None]
        return self.of_primitives(learned_USS)


def _motions_of(tensors: Mapping[str, Any]) -> Motions:
    """Return the motions that tensors hold; a ValueError if they are none."""
    *whole, cost, count = tensors["primitive"].T
    start, end, dx, dy, count = (column.astype(np.int64) for column in (*whole, count))
    angle, pose = tensors["angle"], tensors["pose"]
    inside = ((start >= 0) & (start < HEADINGS) & (end >= 0) & (end < HEADINGS)).all()
    is_whole = np.array_equal(
        np.column_stack([*whole, count]), np.c_[start, end, dx, dy, count]
    )
    poses_fit = (count >= 1).all() and count.sum() == len(pose)
    if not (
        inside
        and is_whole
        and poses_fit
        and (cost > 0).all()
        and tensors["resolution"] > 0
    ):
        raise ValueError("its primitives are damaged; train the robot again")
    offset, last = np.column_stack([dx, dy]), np.cumsum(count)
    for places, cells, heading in (
        (last - count, 0 * offset, start),
        (last - 1, offset, end),
    ):
        off = np.abs(pose[places, :2] - cells).max()
        turned = np.abs(turn_between(pose[places, 2], angle[heading])).max()
        if off > 0.01 or turned > 0.01 or len(np.unique(heading)) < HEADINGS:
            raise ValueError(
                "its primitives do not begin and end where they say; train it again"
            )
    poses = tuple(np.split(pose, last[:-1]))
    cost = cost.astype(np.float32)
    return Motions(
        float(tensors["resolution"][0]), angle, start, end, offset, cost, poses
    )
