"""Plans robot paths on grid maps with a Double DQN."""

from typing import TYPE_CHECKING

from ddqn_planner.gymnasium_registration import register_environment
from ddqn_planner.public_names import imported_at_first_use

if TYPE_CHECKING:
    from ddqn_planner.experience import Experience, ExperienceFileError
    from ddqn_planner.files import FileWriteError
    from ddqn_planner.grid import (
        GridMap,
        MapDataError,
        MapFileError,
        MapMetadataError,
        MapNotFoundError,
        MoveRule,
        inflate,
        load_map,
    )
    from ddqn_planner.model import ModelFileError
    from ddqn_planner.planning import (
        Plan,
        PlanMethod,
        Planner,
        PlanStatus,
        PosePlan,
        QField,
        simplify,
    )
    from ddqn_planner.training.checkpoint import CheckpointError
    from ddqn_planner.training.one_map import train
    from ddqn_planner.training.robot import train_robot
    from ddqn_planner.version import __version__

__all__ = [
    "CheckpointError",
    "Experience",
    "ExperienceFileError",
    "FileWriteError",
    "GridMap",
    "MapDataError",
    "MapFileError",
    "MapMetadataError",
    "MapNotFoundError",
    "ModelFileError",
    "MoveRule",
    "Plan",
    "PlanMethod",
    "PlanStatus",
    "Planner",
    "PosePlan",
    "QField",
    "__version__",
    "inflate",
    "load_map",
    "simplify",
    "train",
    "train_robot",
]

_MODULES = {
    "CheckpointError": "training.checkpoint",
    "Experience": "experience",
    "ExperienceFileError": "experience",
    "FileWriteError": "files",
    "GridMap": "grid",
    "MapDataError": "grid",
    "MapFileError": "grid",
    "MapMetadataError": "grid",
    "MapNotFoundError": "grid",
    "ModelFileError": "model",
    "MoveRule": "grid",
    "Plan": "planning",
    "PlanMethod": "planning",
    "PlanStatus": "planning",
    "Planner": "planning",
    "PosePlan": "planning",
    "QField": "planning",
    "__version__": "version",
    "inflate": "grid",
    "load_map": "grid",
    "simplify": "planning",
    "train": "training.one_map",
    "train_robot": "training.robot",
}
__getattr__, __dir__ = imported_at_first_use(__name__, _MODULES)

register_environment()
