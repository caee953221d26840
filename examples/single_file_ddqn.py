"""The paper's method in one file, from top to bottom: Double DQN on a grid map.

The environment gives the map, the moves and the ends of episodes. All that the paper
adds is in this file: initial cells (improvement 1), the reward (improvement 2), the
network, the replay buffer, and the update of Double DQN. Run it, then change it:

    python examples/single_file_ddqn.py
    python examples/single_file_ddqn.py --p-r 0 --alpha 0 --beta 0   # neither of them

"The paper" is arXiv 2107.11245; sections and tables below are the paper's.
"""

import argparse
import math
import time
from dataclasses import dataclass, fields

import gymnasium
import numpy as np
import torch
from torch import nn

from ddqn_planner.training import (
    EpisodeEnd,
    HyperParameters,
    Scenario,
    paper_scenario,
)

ACTIONS = 8
MAX_EPISODE_STEPS = 200


@dataclass
class Arguments:
    """The arguments of the program, with their defaults."""

    seed: int = 0
    steps: int = 30_000
    p_r: float = 0.5  # improvement 1: probability of a random initial cell
    alpha: float = 0.6  # improvement 2: weight α of the progress to the goal
    beta: float = 0.4  # improvement 2: weight β of the detour from the start
    gamma: float = 0.95  # discount γ, Table 1
    learning_rate: float = 0.01
    learning_rate_decay: float = 0.05  # the last learning rate over the first
    batch_size: int = 32  # Table 1
    replay_capacity: int = 50_000
    learning_starts: int = 500  # steps before the first update
    target_interval: int = 500  # updates per copy of the network (N)
    epsilon_end: float = 0.1  # ε falls from 1 to this ...
    epsilon_steps: int = 10_000  # ... within these steps
    evaluation_interval: int = 2_500  # steps


def parsed_arguments() -> Arguments:
    """Return the arguments from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    for field in fields(Arguments):
        option = "--" + field.name.replace("_", "-")
        parser.add_argument(option, type=field.type, default=field.default)
    return Arguments(**vars(parser.parse_args()))


class PaperReward:
    """Improvement 2 (section 4.2): progress to the goal, detours from the start."""

    def __init__(self, scenario: Scenario, alpha: float, beta: float) -> None:
        """Make the reward of a map; α = β = 0 leaves only collisions and the goal."""
        self.start = scenario.start
        self.goal = scenario.goal
        self.alpha = alpha
        self.beta = beta

    def __call__(
        self,
        cell: tuple[int, int],
        action: int,
        next_cell: tuple[int, int],
        outcome: EpisodeEnd | None,
    ) -> float:
        """Return R_t of a move; d_re is the distance to the end, d_rs to the start."""
        if outcome is EpisodeEnd.COLLIDED:
            return -10.0  # Table 1
        if outcome is EpisodeEnd.REACHED_GOAL:
            return 10.0  # Table 1
        progress = math.dist(cell, self.goal) - math.dist(next_cell, self.goal)
        departure = math.dist(next_cell, self.start) - math.dist(cell, self.start)
        detour = departure - math.dist(cell, next_cell)
        return self.alpha * progress + self.beta * detour


class QNetwork(nn.Module):
    """The paper's network: one convolution, and one linear layer."""

    def __init__(self, height: int, width: int, filters: int = 16) -> None:
        """Make the network of a map of height x width cells."""
        super().__init__()
        self.convolution = nn.Conv2d(1, filters, kernel_size=3, stride=2, padding=1)
        features = filters * math.ceil(height / 2) * math.ceil(width / 2)
        self.linear = nn.Linear(features, ACTIONS)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Return Q(s, a), (B, 8), of observations (B, H, W)."""
        features = torch.relu(self.convolution(observation.unsqueeze(1)))
        q: torch.Tensor = self.linear(features.flatten(1))
        return q


class ReplayBuffer:
    """The last transitions (s, a, r, s', terminated), in a ring."""

    def __init__(self, capacity: int, shape: tuple[int, ...]) -> None:
        """Make room for `capacity` transitions with observations of a shape."""
        self.observation = torch.zeros(capacity, *shape)
        self.action = torch.zeros(capacity, dtype=torch.int64)
        self.reward = torch.zeros(capacity)
        self.next_observation = torch.zeros(capacity, *shape)
        self.terminated = torch.zeros(capacity)
        self.added = 0

    def add(
        self,
        observation: np.ndarray,
        action: int,
        reward: float,
        next_observation: np.ndarray,
        terminated: bool,
    ) -> None:
        """Add a transition; it replaces the oldest one when the ring is full."""
        index = self.added % len(self.action)
        self.observation[index] = torch.from_numpy(observation)
        self.action[index] = action
        self.reward[index] = reward
        self.next_observation[index] = torch.from_numpy(next_observation)
        self.terminated[index] = terminated
        self.added += 1

    def sample(self, count: int, random: np.random.Generator) -> torch.Tensor:
        """Draw the indices of `count` transitions."""
        stored = min(self.added, len(self.action))
        return torch.from_numpy(random.integers(stored, size=count))


def double_dqn_loss(
    online: QNetwork,
    target: QNetwork,
    replay: ReplayBuffer,
    batch: torch.Tensor,
    gamma: float,
) -> torch.Tensor:
    """Return the mean squared temporal-difference error of a batch of transitions.

    The network `online` (θ) selects the next action, and its older copy `target` (θ⁻)
    evaluates that action: van Hasselt et al. 2016, equation 4. A plain DQN would do
    both with `target`, and overestimate.
    """
    with torch.no_grad():
        next_observation = replay.next_observation[batch]
        next_action = online(next_observation).argmax(dim=1, keepdim=True)
        next_value = target(next_observation).gather(1, next_action).squeeze(1)
        discount = gamma * (1 - replay.terminated[batch])
        y = replay.reward[batch] + discount * next_value
    q = online(replay.observation[batch])
    q_of_action = q.gather(1, replay.action[batch].unsqueeze(1)).squeeze(1)
    return nn.functional.mse_loss(q_of_action, y)


def evaluate(network: QNetwork, scenario: Scenario) -> tuple[int, int, bool]:
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
    for _ in range(MAX_EPISODE_STEPS):
        with torch.no_grad():
            action = network(torch.from_numpy(observation)).argmax(dim=1).numpy()
        observation, _, terminated, truncated, info = robots.step(action)
        # Only the first episode of each robot counts.
        has_arrived |= (info["outcome"] == "reached_goal") & ~has_ended
        has_ended |= terminated | truncated
        if has_ended.all():
            break
    robots.close()
    solves_start = bool(has_arrived[starts.index(scenario.start)])
    return len(starts), int(has_arrived.sum()), solves_start


def main() -> None:
    """Train, and print every few thousand steps how many starts are solved."""
    arguments = parsed_arguments()
    random = np.random.default_rng(arguments.seed)
    torch.manual_seed(arguments.seed)
    torch.set_num_threads(1)  # the network is too small for more

    scenario = paper_scenario()
    environment = gymnasium.make(
        "ddqn_planner/Grid-v0",
        scenario=scenario,
        parameters=HyperParameters(p_r=0, max_episode_steps=MAX_EPISODE_STEPS),
        reward=PaperReward(scenario, arguments.alpha, arguments.beta),
    )
    free_cells = [cell for cell in scenario.grid.free_cells() if cell != scenario.goal]

    def reset() -> np.ndarray:
        """Start an episode: improvement 1 (section 4.1), in a random cell if p_r."""
        start = scenario.start
        if random.random() < arguments.p_r:
            start = free_cells[random.integers(len(free_cells))]
        observation: np.ndarray = environment.reset(options={"start": start})[0]
        return observation

    shape = scenario.grid.occupancy.shape
    online = QNetwork(*shape)
    target = QNetwork(*shape)
    target.load_state_dict(online.state_dict())
    optimizer = torch.optim.Adam(online.parameters(), arguments.learning_rate)
    decay = arguments.learning_rate_decay ** (1 / arguments.steps)
    replay = ReplayBuffer(arguments.replay_capacity, shape)

    began = time.monotonic()
    observation = reset()
    for step in range(1, arguments.steps + 1):
        # 1. Act: at random with probability ε, else by the greatest Q.
        declined = min(1.0, step / arguments.epsilon_steps)
        epsilon = 1 + declined * (arguments.epsilon_end - 1)
        if random.random() < epsilon:
            action = int(random.integers(ACTIONS))
        else:
            with torch.no_grad():
                action = int(online(torch.from_numpy(observation)[None]).argmax())
        next_observation, reward, terminated, truncated, _ = environment.step(action)
        # 2. Remember. A truncated episode could have gone on: it counts as not ended.
        replay.add(observation, action, float(reward), next_observation, terminated)
        observation = reset() if terminated or truncated else next_observation
        # 3. Learn from a batch of remembered transitions.
        if step > arguments.learning_starts:
            batch = replay.sample(arguments.batch_size, random)
            loss = double_dqn_loss(online, target, replay, batch, arguments.gamma)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            for group in optimizer.param_groups:
                group["lr"] = arguments.learning_rate * decay**step
            optimizer.step()
        # 4. Now and then, the target network becomes a copy of the online network.
        if step % arguments.target_interval == 0:
            target.load_state_dict(online.state_dict())
        if step % arguments.evaluation_interval == 0:
            count, solved, solves_start = evaluate(online, scenario)
            print(
                f"step {step}: {solved} of {count} starts solved, the scenario's "
                f"{'too' if solves_start else 'not'}; ε {epsilon:.2f}, "
                f"{step / (time.monotonic() - began):.0f} steps/s",
                flush=True,
            )
    environment.close()


if __name__ == "__main__":
    main()
