"""The planner node's model: loaded by a worker, or set while the node runs."""

from __future__ import annotations

import gc

import numpy as np
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_msgs.msg import String

from ddqn_planner.grid import GridMap, MoveRule
from ddqn_planner.model import find_model
from ddqn_planner.model.certificate import NO_CERTIFICATE
from ddqn_planner.nodes.report import Report
from ddqn_planner.nodes.runtime import BaseNode, Worker
from ddqn_planner.planning import Planner


def load(model: str) -> tuple[Planner, str]:
    """Return the planner of a model, and the model's file."""
    path = find_model(model)
    return Planner.load(path), str(path)


def load_and_warm_up(model: str) -> tuple[Planner, str]:
    """Load a model, and the libraries and compiled functions that most plans need."""
    planner, path = load(model)
    sizes = planner.metadata.sizes
    shape = sizes.get("height", 3), sizes.get("width", 3)
    planner.plan(GridMap(np.zeros(shape, dtype=np.bool_)), (0, 0), (shape[1] - 1, shape[0] - 1))
    gc.freeze()  # a collection of all that would stop the node for 45 ms
    return planner, path


def move_rule(rule: str, planner: Planner) -> MoveRule:
    """Return a rule by its name, or the rule of the model if the name is empty."""
    return MoveRule(rule or planner.metadata.move_rule)


class ModelSource:
    """Has the planner with the last model that could be loaded, and its file."""

    def __init__(self, node: BaseNode, report: Report, worker: Worker) -> None:
        self.planner: Planner | None = None
        self.file = ""
        self._node, self.report, self._worker = node, report, worker
        # The first model, while it is being loaded.
        self.loading: Future | None = None

    def load(self) -> None:
        """Begin to load the first model."""
        self.loading = self._worker.call(load_and_warm_up, self._node.value("model"))

    async def first(self) -> None:
        """Wait for the first model, and use it unless another one was set since."""
        loading = self.loading
        try:
            loaded = await loading if loading is not None else None
        except Exception as error:
            if self.loading is loading:
                self.loading = None
                reason = f"{str(error) or repr(error)}; or set the parameter 'model'"
                self.report.refuse("model", reason)
            return
        if loaded is not None and self.loading is loading:
            self.use(*loaded)

    def use(self, planner: Planner, file: str) -> None:
        """Plan with it from now on."""
        self.planner, self.file, self.loading = planner, file, None
        planner.cache_bytes = self._node.value("field_cache_bytes")
        self.report.accept("model")
        self.report.change()
        self._node.get_logger().info(f"planning with the model {file}")

    def set(self, name: str) -> str:
        """Set the node's parameter, which loads the model; return why it was refused."""
        (result,) = self._node.set_parameters([Parameter("model", value=name)])
        reason: str = result.reason
        return reason

    def on_saved(self, message: String) -> None:
        """Use a model that the trainer saved."""
        if reason := self.set(message.data):
            self.report.refuse("model", f"the trainer's model was refused: {reason}")

    def on_reload(self) -> tuple[bool, str]:
        """Load the file of the model again."""
        if reason := self.set(self._node.value("model")):
            self._node.get_logger().error(f"the model was not loaded again: {reason}")
        return not reason, reason or f"loaded {self.file}"

    def describe(self, rule: str) -> dict[str, str]:
        """Return what the diagnostics say of it, with the value of the parameter ``move_rule``."""
        description = {"model": self._node.value("model")}
        if self.planner is None:
            return description
        metadata = self.planner.metadata
        certificate = self.planner.network.certificate(metadata.move_rule)
        return description | {
            "model file": self.file,
            "move rule": move_rule(rule, self.planner).value,
            "model move rule": metadata.move_rule.value,
            "model sizes": ", ".join(f"{key} {size}" for key, size in metadata.sizes.items()),
            "model training steps": str(metadata.steps),
            "model certificate": str(certificate or NO_CERTIFICATE),
        }

    def forget(self) -> None:
        """Free the model and its fields, with what `load_and_warm_up` kept from collection."""
        self.planner, self.file, self.loading = None, "", None
        gc.unfreeze()
        gc.collect()
