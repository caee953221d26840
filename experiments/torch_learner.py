"""The paper's network trained by torch, to compare the compiled training with."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from ddqn_planner.training.double_dqn import Transitions, double_dqn_gradient
from ddqn_planner.training.propagation import FUSED
from ddqn_planner.training.trainer import Trainer


class PaperModule(nn.Module):
    """The paper's network, see `PaperQNetwork`."""

    def __init__(
        self, height: int, width: int, filters: int, hidden_units: int
    ) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(1, filters, kernel_size=3, stride=2, padding=1)
        features = filters * ((height + 1) // 2) * ((width + 1) // 2)
        self.hidden = nn.Linear(features, hidden_units) if hidden_units else None
        self.fully_connected = nn.Linear(hidden_units or features, 8)

    def forward(self, observation_BHW: Tensor) -> Tensor:
        """Return Q(s, a): (B, 8)."""
        # On windows the convolution is a matrix product, which is faster on small maps.
        window_BKL = functional.unfold(
            observation_BHW.unsqueeze(1), 3, padding=1, stride=2
        )
        weight_BFK = self.convolution.weight.flatten(1).expand(len(window_BKL), -1, -1)
        bias_F1 = self.convolution.get_parameter("bias").unsqueeze(1)
        feature_BF = torch.baddbmm(bias_F1, weight_BFK, window_BKL).relu_().flatten(1)
        if self.hidden is not None:
            feature_BF = self.hidden(feature_BF).relu_()
        answer: Tensor = self.fully_connected(feature_BF)
        return answer


class TorchLearner:
    """Trains the paper's network with autograd and torch's AdamW."""

    def __init__(self, trainer: Trainer) -> None:
        self.environment = trainer.environment
        self._next_q_of = trainer.next_q
        self._online, self._target = (
            PaperModule(**trainer.network.sizes) for _ in range(2)
        )
        online, target, *moments = trainer.learned
        for module, part in ((self._online, online), (self._target, target)):
            for name, weight in module.named_parameters():
                weight.data.copy_(torch.from_numpy(part[name]))
                part[name] = weight.data.numpy()
        weights = [*self._online.parameters()]
        decay = trainer.parameters.weight_decay
        self._adam = torch.optim.AdamW(weights, weight_decay=decay, fused=FUSED)
        for name, weight in self._online.named_parameters():
            state = {"step": torch.tensor(float(trainer.updates))}
            for key, part in zip(("exp_avg", "exp_avg_sq"), moments, strict=True):
                state[key] = torch.from_numpy(part[name].copy())
                part[name] = state[key].numpy()
            self._adam.state[weight] = state
        trainer.learner = self

    def _observe(self, scenario: NDArray[np.int64], cell: NDArray[np.int64]) -> Tensor:
        return torch.from_numpy(self.environment.observe(scenario, cell))

    def q_values(
        self, scenario: NDArray[np.int64], cell: NDArray[np.int64]
    ) -> NDArray[Any]:
        """Return Q(s, a) of B robots: (B, 8).

        `cell` (B,) are their cells, `scenario` (B,) the numbers of their maps.
        """
        with torch.inference_mode():
            answer: Tensor = self._online(self._observe(scenario, cell))
        return answer.numpy()

    def settle(self) -> None:
        """Do nothing: the modules share the memory of the trainer's weights."""

    def update(self, batch: Transitions, number: int, learning_rate: float) -> None:
        """Make an update, of this number."""
        with torch.no_grad():
            target_BA = self._target(self._observe(batch.scenario, batch.next_cell))
        cells = np.concatenate([batch.cell, batch.next_cell])
        q_2BA = self._online(self._observe(np.tile(batch.scenario, 2), cells))
        p = self.environment.parameters
        q_BA, online_next_BA = np.split(q_2BA.numpy(force=True), 2)
        next_q = self._next_q_of(online_next_BA, target_BA.numpy())
        gradient_BA = torch.from_numpy(double_dqn_gradient(batch, q_BA, next_q))
        self._online.zero_grad()
        torch.autograd.backward(q_2BA[: len(gradient_BA)], gradient_BA)
        self._adam.param_groups[0]["lr"] = learning_rate
        self._adam.step()
        if number % p.target_interval == 0:
            self._target.load_state_dict(self._online.state_dict())
