"""Q-networks, what they observe, and the model file."""

from ddqn_planner.model.model_file import (
    ModelFileError,
    ModelMetadata,
    find_model,
    load_model,
    package_version,
    save_model,
)
from ddqn_planner.model.networks import PaperQNetwork, QNetwork

__all__ = [
    "ModelFileError",
    "ModelMetadata",
    "PaperQNetwork",
    "QNetwork",
    "find_model",
    "load_model",
    "package_version",
    "save_model",
]
