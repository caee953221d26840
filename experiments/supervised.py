"""What the paper's network can represent: supervised with the best moves, not by Double DQN.

This is a yardstick and not a planner: the exact oracle gives the first moves of all shortest paths
from every cell of every training map. What the network fails to learn even then is a limit of its
architecture, not of how it learns.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from profiles import MOVE_RULE
from torch import Tensor
from trainings import Training

from ddqn_planner.grid import LENGTHS, legal_moves, neighbours, shortest_distances
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.trainer import Trainer

BATCH_SIZE = 128
LEARNING_RATE = 0.003


def train_supervised(training: Training) -> None:
    """Train a training's network by cross-entropy, for as many updates as it has steps.

    Writes ``model.safetensors``; does nothing if that exists.
    """
    path = training.folder / "model.safetensors"
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(training.scenarios, MOVE_RULE, training.parameters, training.seed)
    best_SCA = np.stack([best_moves(scenario) for scenario in training.scenarios])
    scenario, cell = np.nonzero(best_SCA.any(axis=2))
    random = np.random.default_rng(training.seed)
    optimiser = torch.optim.Adam(trainer.network.parameters(), LEARNING_RATE)
    steps = training.parameters.steps
    decay = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.05, steps)
    for _ in range(steps):
        drawn = random.integers(len(cell), size=BATCH_SIZE)
        states = trainer.encoder.states(scenario[drawn], cell[drawn])
        best_BA = torch.from_numpy(best_SCA[scenario[drawn], cell[drawn]])
        loss = cross_entropy(trainer.network(states), best_BA)
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
        decay.step()
    trainer.save_model(path)


def cross_entropy(q_BA: Tensor, best_BA: Tensor) -> Tensor:
    """Return the mean of -log of the probability that softmax(Q) gives to the best moves."""
    best_B = q_BA.masked_fill(~best_BA, -torch.inf).logsumexp(dim=1)
    return (q_BA.logsumexp(dim=1) - best_B).mean()


def best_moves(scenario: Scenario) -> NDArray[np.bool_]:
    """Return the moves that begin a shortest path: (C, 8) bool, none where there is no path."""
    occupancy = scenario.grid.occupancy
    distance = shortest_distances(scenario.grid, scenario.goal, MOVE_RULE).ravel()
    onward_AC = np.append(distance, np.inf)[neighbours(occupancy.shape)] + LENGTHS[:, None]
    legal_AC = legal_moves(occupancy, MOVE_RULE).reshape(len(LENGTHS), -1)
    through_AC = np.where(legal_AC, onward_AC, np.inf)
    best: NDArray[np.bool_] = (np.isfinite(through_AC) & (through_AC <= distance + 1e-9)).T
    return best
