"""The network that knows a robot's body: which primitives occupied cells forbid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import MoveRule
from ddqn_planner.model.networks import ModelFileError, QNetwork
from ddqn_planner.robot.body_certificate import BodyCertificate, certify_body
from ddqn_planner.robot.footprint import read_footprint, swept_cells
from ddqn_planner.robot.motions import (
    HEADINGS,
    HEADINGS_OF_LATTICES,
    MIN_COST,
    Motions,
    is_too_cheap,
    turn_between,
)
from ddqn_planner.robot.units import units_of

Float64: TypeAlias = NDArray[np.float64]

# Shapes: P = primitives, U = units of the network, S x S cells with the robot in the
# middle, N = poses of all primitives, M = corners of the footprint.


class RobotNetwork(QNetwork):
    """Whether a primitive succeeds among occupied cells.

    p(s, a) = sigmoid(b - sum of the weights of occupied cells).
    """

    # Weights are at least 0: a weight below counts as 0. One unit serves all primitives
    # that are quarter turns of each other. Motions and footprint are not learned.
    name = "robot"
    size_names = ("units", "side", "primitives", "poses", "corners", "headings")
    former_sizes: ClassVar = {"headings": HEADINGS}
    former_tensors: ClassVar = {"cusp": np.zeros(1)}  # they cost nothing
    max_size = 2**16
    doubles = frozenset(
        {"primitive", "pose", "angle", "footprint", "resolution", "cusp"}
    )

    @classmethod
    def shapes(cls, sizes: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
        """Return the shape of each tensor."""
        units = sizes["units"]
        side = sizes["side"]
        return {
            "weight": (units, side, side),
            "threshold": (units,),
            "primitive": (sizes["primitives"], len(COLUMNS)),
            "pose": (sizes["poses"], 3),
            "footprint": (sizes["corners"], 2),
            "angle": (sizes["headings"],),
            "resolution": (1,),
            "cusp": (1,),
        }

    @classmethod
    def untrained(cls, footprint: Float64, motions: Motions) -> RobotNetwork:
        """Return the network of a robot, without a training: all weights are 0.

        Shapes: U units, S x S cells, P primitives, N poses of all primitives.

        Parameters
        ----------
        footprint : (K, 2) float64
            The corners of the body, metres from the robot's origin.
        motions : Motions
            Its P primitives.

        Raises
        ------
        ValueError
            If the footprint or the motions are those of no robot.
        """
        swept_USS = swept_cells(footprint, units_of(motions).motions)
        units, side, _ = swept_USS.shape
        pose_N3 = np.concatenate(motions.poses)
        pose_count_P = [len(poses) for poses in motions.poses]
        column = _Primitives(
            start=motions.start,
            end=motions.end,
            dx=motions.offset[:, 0],
            dy=motions.offset[:, 1],
            cost=motions.cost,
            pose_count=np.array(pose_count_P),
        )
        tensors: dict[str, NDArray[Any]] = {
            "weight": np.zeros((units, side, side), np.float32),
            "threshold": np.zeros(units, np.float32),
            "primitive": np.column_stack(column).astype(np.float64),
            "pose": pose_N3,
            "footprint": footprint,
            "angle": motions.angles,
            "resolution": np.array([motions.resolution]),
            "cusp": np.array([motions.cusp]),
        }
        sizes = {
            "units": units,
            "side": side,
            "primitives": len(motions.poses),
            "poses": len(pose_N3),
            "corners": len(footprint),
            "headings": motions.headings,
        }
        return cls(sizes, tensors)

    def of_footprint(self, footprint: Float64) -> RobotNetwork:
        """Return the network of the same robot with another body, without a training.

        The corners (K, 2) are those of `untrained`.
        """
        return RobotNetwork.untrained(footprint, self.motions)

    def __init__(
        self, sizes: Mapping[str, int], tensors: Mapping[str, NDArray[Any]]
    ) -> None:
        """Read footprint and motions from the tensors; a ValueError if they are wrong.

        `sizes` has a number for each of `size_names`, and `tensors` an array for each
        name in `shapes`.
        """
        super().__init__(sizes, tensors)
        self.footprint = read_footprint(tensors["footprint"].tolist())
        self.motions = _motions_of(tensors)
        self.unit, self.turns, unit_motions = units_of(self.motions)
        # (U, S, S): the cells that the body sweeps on one primitive of each unit
        self.swept_by_unit = swept_cells(self.footprint, unit_motions)
        units, side, _ = self.swept_by_unit.shape
        wrong_sizes = {
            name: size
            for name, size in (("units", units), ("side", side))
            if size != sizes[name]
        }
        if wrong_sizes:
            raise ValueError(
                f"its body and motions need {wrong_sizes}, not {dict(sizes)}; train it "
                "again"
            )

    def supports(self, shape: tuple[int, int]) -> bool:
        """Say whether the network can plan cells on maps: never, as it plans poses."""
        return False

    def of_primitives(self, array_USS: NDArray[Any]) -> NDArray[Any]:
        """Return an array (S, S) of cells for each primitive: (P, S, S).

        It is that of the primitive's unit in `array_USS`, turned by the quarter turns
        by which the primitive differs from its unit.
        """
        # For 0 to 3 quarter turns, the arrays of all units.
        turned = [np.rot90(array_USS, -turns, axes=(1, 2)) for turns in range(4)]
        turned_4USS = np.stack(turned)
        return turned_4USS[self.turns, self.unit]

    def certificate(self, move_rule: MoveRule | None = None) -> BodyCertificate:
        """Return the proof of its primitives, for all patterns of occupied cells.

        The move rule does not matter: it is one of cells.
        """
        of_body = certify_body(
            weight_USS=self.tensors["weight"],
            threshold_U=self.tensors["threshold"],
            swept_USS=self.swept_by_unit,
            unit_P=self.unit,
        )
        costs: list[float] = self.motions.cost.tolist()
        cheap = sum(map(is_too_cheap, costs, self.motions.poses))
        return replace(of_body, cheap=cheap)

    def swept(self) -> NDArray[np.bool_]:
        """Return the cells that forbid each primitive, as proved: (P, S, S) bool.

        A ModelFileError if nothing is proved.
        """
        certificate = self.certificate()
        if not certificate.proved:
            remedy = "give a model that ddqn-planner train-robot has proved"
            raise ModelFileError(f"the robot's body is {certificate}; {remedy}")
        # A cell forbids the primitives of a unit if its weight alone exceeds the unit's
        # threshold.
        threshold_U11 = self.tensors["threshold"][:, None, None]
        forbids_USS = self.tensors["weight"] > threshold_U11
        return self.of_primitives(forbids_USS)


class _Primitives(NamedTuple):
    """The columns of the tensor `primitive`: (P,) each."""

    start: NDArray[Any]  # the first heading
    end: NDArray[Any]  # the last heading
    dx: NDArray[Any]  # cells from begin to end
    dy: NDArray[Any]
    cost: NDArray[Any]
    pose_count: NDArray[Any]


COLUMNS: Final = _Primitives._fields


def _motions_of(tensors: Mapping[str, NDArray[Any]]) -> Motions:
    """Return the motions in a network's tensors; a ValueError if they are damaged.

    These are the tensors `primitive` (P, 6), `pose` (N, 3) with the poses of all
    primitives, `angle` (H,) and `resolution` (1,), see `Motions`. All columns of
    `primitive` except the cost should be whole numbers.
    """
    column = _Primitives(*tensors["primitive"].T)  # (P,) float64 each
    # The same as integers.
    start = column.start.astype(np.int64)
    end = column.end.astype(np.int64)
    offset = np.column_stack([column.dx, column.dy]).astype(np.int64)  # (P, 2)
    pose_count = column.pose_count.astype(np.int64)
    pose_N3 = tensors["pose"]
    angles = tensors["angle"]
    is_damaged = (
        len(angles) not in HEADINGS_OF_LATTICES
        or not _are_headings(start, len(angles))
        or not _are_headings(end, len(angles))
        or not np.array_equal(column.start, start)
        or not np.array_equal(column.end, end)
        or not np.array_equal(np.column_stack([column.dx, column.dy]), offset)
        or not np.array_equal(column.pose_count, pose_count)
        or not (pose_count >= 1).all()
        or pose_count.sum() != len(pose_N3)
        or not ((column.cost > 0) & (column.cost < np.inf)).all()
        or not tensors["resolution"] > 0
        or not _is_cost_of_cusps(float(tensors["cusp"][0]))
    )
    if is_damaged:
        raise ValueError("its primitives are damaged; train the robot again")
    # The rows of `pose_N3` of each primitive: from its first row to before its end row.
    end_row = np.cumsum(pose_count)
    first_row = end_row - pose_count
    _check_ends(pose_N3[first_row], np.zeros_like(offset), start, angles)
    _check_ends(pose_N3[end_row - 1], offset, end, angles)
    return Motions(
        resolution=float(tensors["resolution"][0]),
        angles=angles,
        start=start,
        end=end,
        offset=offset,
        cost=column.cost.astype(np.float32),
        poses=tuple(np.split(pose_N3, end_row[:-1])),
        cusp=float(tensors["cusp"][0]),
    )


def _is_cost_of_cusps(cusp: float) -> bool:
    """Return whether a cusp may cost so many cells: none, or enough to be seen."""
    return cusp == 0 or MIN_COST <= cusp < np.inf


def _are_headings(numbers: NDArray[np.int64], headings: int) -> bool:
    """Return whether all numbers are some of so many headings."""
    return bool(((numbers >= 0) & (numbers < headings)).all())


def _check_ends(
    pose_P3: Float64,
    cell_P2: NDArray[np.int64],
    heading_P: NDArray[np.int64],
    angles: Float64,
) -> None:
    """Raise a ValueError unless poses lie in the centres of cells, with headings.

    Parameters
    ----------
    pose_P3 : (P, 3)
        The first pose of each primitive, or the last: cells, cells, radians.
    cell_P2 : (P, 2)
        The cell in whose centre the pose should lie.
    heading_P : (P,)
        The number of the heading that the pose should have. All should occur.
    angles : (H,)
        The yaw of each heading, radians.
    """
    cells_off = np.abs(pose_P3[:, :2] - cell_P2).max()
    radians_off = np.abs(turn_between(pose_P3[:, 2], angles[heading_P])).max()
    has_all_headings = len(np.unique(heading_P)) == len(angles)
    if cells_off > 0.01 or radians_off > 0.01 or not has_all_headings:
        raise ValueError(
            "its primitives do not begin and end where they say; train it again"
        )
