"""How large a map may be for the paper's network: the paper's map, scaled up.

python experiments/map_sizes.py                  # 20 to 200 cells a side, 50,000 steps
python experiments/map_sizes.py 1 2 3 --steps 200000 --network propagation

Each cell becomes a square of so many cells a side as the arguments say. The times are
those of one processor core.
"""

import argparse
import time
from collections.abc import Sequence

import numpy as np
import torch
from tables import table

from ddqn_planner import GridMap
from ddqn_planner.training import (
    HyperParameters,
    Scenario,
    Trainer,
    TrainingRecord,
    paper_scenario,
)
from ddqn_planner.training.training_record import EVALUATIONS

SCALES = (1, 2, 3, 4, 5, 7, 10)
COLUMNS = (
    "map | starts | solved | from the given start | steps per second | MB of weights | "
    "100 evaluations in 50,000 steps"
)


def scaled(scenario: Scenario, scale: int) -> Scenario:
    """Return a scenario in which a square of cells stands for each cell."""
    square = np.ones((scale, scale), dtype=np.bool_)
    grid = GridMap(np.kron(scenario.grid.occupancy, square))
    start_x, start_y = scenario.start
    goal_x, goal_y = scenario.goal
    middle = scale // 2
    start = (start_x * scale + middle, start_y * scale + middle)
    goal = (goal_x * scale + middle, goal_y * scale + middle)
    return Scenario(grid, start, goal, scenario.move_rule)


def row(scale: int, parameters: HyperParameters) -> list[str]:
    """Train on the scaled map, and return the row of the table."""
    scenario = scaled(paper_scenario(), scale)
    trainer = Trainer([scenario], parameters, seed=0)
    record = TrainingRecord(trainer, evaluations=1)
    next(trainer.run(1))  # compiles
    began = time.process_time()
    for progress in trainer.run():
        record.add(progress)
    seconds = time.process_time() - began
    share = evaluation_seconds(trainer) * EVALUATIONS
    share /= seconds / parameters.steps * HyperParameters().steps
    point = record.curve[-1]
    weights = sum(tensor.nbytes for tensor in trainer.network.tensors.values())
    return [
        f"{scenario.grid.width} x {scenario.grid.height}",
        f"{point.starts:,}",
        f"{point.solved_share:.0%}",
        f"{point.start_ratio:.3f}" if np.isfinite(point.start_ratio) else "trapped",
        f"{parameters.steps / seconds:,.0f}",
        f"{weights / 1e6:.2f}",
        f"{share:.1%} of the time",
    ]


def evaluation_seconds(trainer: Trainer) -> float:
    """Return the time of an evaluation, the mean of some."""
    times = 5
    began = time.process_time()
    for _ in range(times):
        TrainingRecord(trainer)
    return (time.process_time() - began) / times


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scales", type=int, nargs="*", default=SCALES)
    parser.add_argument("--steps", type=int, default=HyperParameters().steps)
    parser.add_argument("--network", default="paper")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    parameters = HyperParameters(steps=options.steps, network=options.network)
    print(table(COLUMNS, [row(scale, parameters) for scale in options.scales]))


if __name__ == "__main__":
    main()
