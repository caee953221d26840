"""Q-networks, what they observe, and the model file."""

from ddqn_planner.model.model_file import (
    ModelFileError,
    ModelMetadata,
    find_model,
    load_model,
    new_network,
    package_version,
    save_model,
)
from ddqn_planner.model.networks import PaperQNetwork, QNetwork
from ddqn_planner.model.propagation import AnyMapQNetwork, PropagationQNetwork

__all__ = [
    "AnyMapQNetwork",
    "ModelFileError",
    "ModelMetadata",
    "PaperQNetwork",
    "PropagationQNetwork",
    "QNetwork",
    "find_model",
    "load_model",
    "new_network",
    "package_version",
    "save_model",
]
