"""Stable-Baselines3's DQN on the grid environment, with and without the improvements.

    pip install stable-baselines3
    python examples/sb3_dqn.py                   # both improvements of the paper
    python examples/sb3_dqn.py --plain           # neither of them: a plain DQN

Both are parameters of the environment, so that any learner can use them.
"""

import argparse
import sys
import time

import gymnasium
import numpy as np
import torch

from ddqn_planner.resources import with_remedy
from ddqn_planner.training import HyperParameters, Scenario, paper_scenario

try:
    from stable_baselines3 import DQN
    from stable_baselines3.common.callbacks import BaseCallback
except ImportError as error:
    sys.exit(with_remedy(error))

PLAIN = HyperParameters(p_r=0, alpha=0, beta=0)
IMPROVED = HyperParameters()


def evaluate(model: DQN, scenario: Scenario) -> tuple[int, int, bool]:
    """Let one robot per free cell follow the greedy policy, all at once.

    Returns how many robots there are, how many arrive, and whether that of the
    scenario's start does.
    """
    starts = [cell for cell in scenario.grid.free_cells() if cell != scenario.goal]
    robots = gymnasium.make_vec(
        "ddqn_planner/Grid-v0", num_envs=len(starts), scenario=scenario
    )
    observation, _ = robots.reset(options={"start": starts})
    has_ended = np.zeros(len(starts), bool)
    has_arrived = np.zeros(len(starts), bool)
    while not has_ended.all():
        action, _ = model.predict(observation, deterministic=True)
        observation, _, terminated, truncated, info = robots.step(action)
        # Only the first episode of each robot counts.
        has_arrived |= (info["outcome"] == "reached_goal") & ~has_ended
        has_ended |= terminated | truncated
    solves_start = bool(has_arrived[starts.index(scenario.start)])
    return len(starts), int(has_arrived.sum()), solves_start


class Report(BaseCallback):  # type: ignore[misc]
    """Prints how many starts are solved, every few thousand steps."""

    def __init__(self, scenario: Scenario, interval: int) -> None:
        """Make a callback that reports once in `interval` steps."""
        super().__init__()
        self.scenario = scenario
        self.interval = interval
        self.began = time.monotonic()

    def _on_step(self) -> bool:
        """Report if it is time; return that the training continues."""
        if self.num_timesteps % self.interval == 0:
            count, solved, solves_start = evaluate(self.model, self.scenario)
            print(
                f"step {self.num_timesteps}: {solved} of {count} starts solved, the "
                f"scenario's {'too' if solves_start else 'not'}; "
                f"{time.monotonic() - self.began:.0f} s",
                flush=True,
            )
        return True


def main() -> None:
    """Train, and report."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=50_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--interval", type=int, default=5_000, help="of reports, steps")
    parser.add_argument("--plain", action="store_true", help="without improvements")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # the network is too small for more

    scenario = paper_scenario()
    environment = gymnasium.make(
        "ddqn_planner/Grid-v0",
        scenario=scenario,
        parameters=PLAIN if arguments.plain else IMPROVED,
    )
    model = DQN(
        "MlpPolicy",  # flattens the map
        environment,
        learning_rate=lambda remaining: 1e-3 * 0.05 ** (1 - remaining),
        buffer_size=50_000,
        learning_starts=500,
        batch_size=64,
        gamma=0.95,
        train_freq=1,
        target_update_interval=500,
        exploration_fraction=0.2,
        exploration_final_eps=0.1,
        policy_kwargs={"net_arch": [256]},
        seed=arguments.seed,
        device="cpu",
    )
    model.learn(arguments.steps, callback=Report(scenario, arguments.interval))


if __name__ == "__main__":
    main()
