"""The networks as torch would write them down."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional


def layer(weights: Mapping[str, Tensor], name: str, inputs: Tensor) -> Tensor:
    return functional.linear(inputs, weights[f"{name}.weight"], weights[f"{name}.bias"])


def papers_layers(weights: Mapping[str, Tensor], observations: Tensor) -> Tensor:
    """The paper's network in torch: Q(s, a), (B, 8), of observations (B, H, W)."""
    kernel, bias = weights["convolution.weight"], weights["convolution.bias"]
    features = functional.conv2d(
        observations.unsqueeze(1), kernel, bias, stride=2, padding=1
    )
    features = features.relu().flatten(1)
    if "hidden.weight" in weights:
        features = layer(weights, "hidden", features).relu()
    return layer(weights, "fully_connected", features)


def propagation_layers(weights: Mapping[str, Tensor], features: Tensor) -> list[Tensor]:
    """A propagation network in torch: p(s, a) and, where it learns them, cost
    multipliers.
    """
    hidden = layer(
        weights, "hidden", layer(weights, "convolution", features).relu()
    ).relu()
    answers = [layer(weights, "moves", hidden).sigmoid()]
    if "prices.weight" in weights:
        answers.append(1 + layer(weights, "prices", features).relu())
    return answers


def in_torch(tensors: Mapping[str, Any]) -> dict[str, Tensor]:
    return {name: torch.tensor(tensor) for name, tensor in tensors.items()}
