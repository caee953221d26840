"""Measure the vector environment beside Gymnasium's, in steps of robots per second.

python experiments/gymnasium_speed.py [--robots N] [--steps N]
"""

import argparse
import statistics
import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv

from ddqn_planner.gymnasium_registration import ENVIRONMENT

ROUNDS = 5


def steps_per_second(environment: VectorEnv[Any, Any, Any], steps: int) -> float:
    """Return how many steps of robots an environment makes per second of this thread.

    `steps` counts those of all robots together. Actions are random.
    """
    random = np.random.default_rng(0)
    environment.reset(seed=0)
    count = environment.num_envs
    actions = random.integers(8, size=(max(1, steps // count), count))
    began = time.process_time()
    for action in actions:
        environment.step(action)
    return actions.size / (time.process_time() - began)


def main() -> None:
    """Print the medians of some rounds, in which both environments take turns."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--robots", type=int, default=64)
    parser.add_argument("--steps", type=int, default=20_000, help="in each round")
    arguments = parser.parse_args()
    environments = [
        gymnasium.make_vec(ENVIRONMENT, arguments.robots, mode)
        for mode in ("vector_entry_point", "sync")
    ]
    rates = []
    for _ in range(ROUNDS):
        rates.append([steps_per_second(item, arguments.steps) for item in environments])
    ours, theirs = (statistics.median(column) for column in zip(*rates, strict=True))
    ratio = statistics.median(first / second for first, second in rates)
    print(
        f"{arguments.robots} robots: {ours:,.0f} steps/s, SyncVectorEnv "
        f"{theirs:,.0f} steps/s; ratio {ratio:.1f}"
    )


if __name__ == "__main__":
    main()
