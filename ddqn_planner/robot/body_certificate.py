"""Proves which cells forbid a robot's primitives, whatever cells are occupied."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Shapes: P = primitives, U = units of the network, S x S cells with the robot in the
# middle.

ROUNDING = 2.0**-23  # relative error of a sum in float32, per term
SMALLEST_THRESHOLD = 1e-30  # so that a threshold of 0 has a margin, too


@dataclass(frozen=True)
class BodyCertificate:
    """What is proved about a robot's network, for all patterns of occupied cells."""

    primitives: int
    cells: int  # that they sweep, all together
    weak: int  # swept cells that do not forbid their primitive by themselves
    forbidden: int  # primitives that are forbidden by cells which they do not sweep
    # The least distance of a logit from 0 on its right side, as a share of the unit's
    # threshold. It is 0 or less if the network is wrong.
    margin: float
    # Primitives that cost less than the way that the robot drives on them: the lower
    # bounds of a search, and so `PosePlan.bound`, rely on costs.
    cheap: int = 0

    @property
    def proved(self) -> bool:
        """Whether a primitive is forbidden just where it sweeps an occupied cell.

        Besides, none may cost less than its way.
        """
        return self.weak == self.forbidden == self.cheap == 0

    def __str__(self) -> str:
        if self.proved:
            cells = (
                f"all {self.cells:,} cells that {self.primitives:,} primitives sweep"
            )
            proved = f"{cells} forbid them, and no others do"
            return f"proved: {proved}, margin {self.margin:.2f}"
        weak = f"{self.weak:,} of {self.cells:,} swept cells"
        forbidden = f"{self.forbidden:,} of {self.primitives:,}"
        problem = (
            f"not proved: {weak} do not forbid their primitive, "
            f"{forbidden} are forbidden by other cells"
        )
        if self.cheap:
            cheap = f"{self.cheap:,} of {self.primitives:,}"
            problem += f", {cheap} cost less than the way that the robot drives"
        return problem


def certify_body(
    weight_USS: NDArray[np.float32],
    threshold_U: NDArray[np.float32],
    swept_USS: NDArray[np.bool_],
    unit_P: NDArray[np.int64],
) -> BodyCertificate:
    """Prove which cells forbid each primitive, for all patterns of occupied cells.

    A primitive should be forbidden just where a cell is occupied that the body sweeps.
    Shapes: U = units of the network, which P primitives share, S x S cells with the
    robot in the middle.

    Parameters
    ----------
    weight_USS : (U, S, S) float32
        The weight of each cell where it is occupied. Weights below 0 count as 0.
    threshold_U : (U,) float32
        A unit forbids its primitives where the sum of the weights is greater.
    swept_USS : (U, S, S) bool
        The cells that the body sweeps on a primitive of each unit.
    unit_P : (P,) int64
        The unit of each primitive.
    """
    # No weight is negative, so more occupied cells never make a primitive possible.
    # Therefore two cases prove all patterns: the weight of each swept cell alone must
    # exceed the threshold, and the weights of all other cells together must stay below
    # it. In float32, too, a sum is not less than its terms, and its relative error is
    # bounded.
    weight_USS = np.maximum(weight_USS.astype(np.float64), 0)
    threshold_U = threshold_U.astype(np.float64)
    primitives_U = np.bincount(unit_P)  # the number of primitives of each unit

    # 1. By how much each swept cell alone exceeds the threshold. Weak cells do not.
    excess_USS = weight_USS - threshold_U[:, None, None]
    weak_U = (swept_USS & (excess_USS <= 0)).sum(axis=(1, 2))
    least_excess_U = excess_USS.min(axis=(1, 2), where=swept_USS, initial=np.inf)

    # 2. By how much all other cells together stay below the threshold.
    sum_U = weight_USS.sum(axis=(1, 2), where=~swept_USS)
    greatest_sum_U = sum_U * (1 + weight_USS[0].size * ROUNDING)
    slack_U = threshold_U - greatest_sum_U

    margin_U = np.minimum(slack_U, least_excess_U)
    margin_U /= np.maximum(np.abs(threshold_U), SMALLEST_THRESHOLD)
    return BodyCertificate(
        primitives=len(unit_P),
        cells=int(primitives_U @ swept_USS.sum(axis=(1, 2))),
        weak=int(primitives_U @ weak_U),
        forbidden=int(primitives_U @ (slack_U <= 0)),
        margin=float(margin_U.min()),
    )
