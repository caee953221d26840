"""TensorBoard's event files of a training; they need the package tensorboard."""

import math
from pathlib import Path
from typing import Any, Final

from ddqn_planner.training.training_record import CurvePoint

# The names of TensorBoard's charts, by the fields of `CurvePoint`.
CHARTS: Final = {
    "solved_share": "starts/solved_share",
    "mean_ratio": "starts/mean_length_over_optimum",
    "worst_ratio": "starts/worst_length_over_optimum",
    "start_ratio": "starts/given_start_length_over_optimum",
    "reward_per_step": "episodes/reward_per_step",
    "reached_goal": "episodes/reached_goal",
    "collided": "episodes/collided",
    "out_of_steps": "episodes/out_of_steps",
    "epsilon": "parameters/epsilon",
    "learning_rate": "parameters/learning_rate",
}


class EventFiles:
    """Writes the points of a curve as scalars; read them with ``tensorboard``."""

    def __init__(self, folder: Path) -> None:
        """Open a new event file in a folder, which is made if it is missing."""
        from torch.utils.tensorboard import SummaryWriter

        self._writer: Any = SummaryWriter(str(folder))  # which has no types

    def add(self, point: CurvePoint) -> None:
        """Write a point; a figure that is not finite is left out."""
        for name, chart in CHARTS.items():
            value = getattr(point, name)
            if math.isfinite(value):
                self._writer.add_scalar(chart, value, point.step)

    def close(self) -> None:
        """Write what is still in memory, and close the file."""
        self._writer.close()
