"""The target as printed: θ alone selects and evaluates the actions."""

from ddqn_planner.training.double_dqn import NextQ, Q
from ddqn_planner.training.trainer import Trainer


class PrintedTrainer(Trainer):
    """Trains by the printed target, which leaves out the target network θ⁻."""

    def next_q(self, online_BA: Q, target_BA: Q) -> NextQ:
        """Return Q by θ for both."""
        return NextQ(selection=online_BA, evaluation=online_BA)
