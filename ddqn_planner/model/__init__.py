"""Q-networks evaluated by NumPy, what they observe, and the model file."""

from ddqn_planner.model.model_file import (
    NETWORKS,
    ModelFileError,
    ModelMetadata,
    find_model,
    load_model,
    model_bytes,
    model_of,
    save_model,
)
from ddqn_planner.model.networks import (
    AnyMapQNetwork,
    PaperQNetwork,
    PropagationQNetwork,
    QNetwork,
)
from ddqn_planner.model.robot_network import RobotNetwork
