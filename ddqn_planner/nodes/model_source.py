"""The planner with the last model that could be loaded."""

import gc
import threading
from typing import Any

from rclpy.task import Future

from ddqn_planner.model import find_model
from ddqn_planner.model.certificate import NO_CERTIFICATE
from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.diagnostics import PlannerDiagnostics
from ddqn_planner.nodes.worker import Worker
from ddqn_planner.planning import Planner
from ddqn_planner.warm_up import warm_up

# Seconds until the rest is compiled: what waits for the model is planned first.
REST_AFTER = 1.0


def read_model(model: str) -> tuple[Planner, str]:
    """Return a model's planner and file."""
    path = find_model(model)
    return Planner.load(path), str(path)


class ModelSource:
    """Has the planner with the last model that could be loaded, and its file."""

    def __init__(
        self, node: BaseNode, diagnostics: PlannerDiagnostics, worker: Worker
    ) -> None:
        self.planner: Planner | None = None
        self.file = ""
        self.layout: Any = None  # of the message that the model came in
        self._node, self.diagnostics, self._worker = node, diagnostics, worker
        # The first model, while it is being loaded.
        self.loading: Future | None = None

    def load(self) -> None:
        """Begin to load the first model, and to compile what many requests need."""

        def read() -> tuple[Planner | None, str]:
            try:
                planner, file = read_model(self._node.value("model"))
                compiling = warm_up(planner, self._node.value("follow_trainer"))
                # To compile and to plan makes hardly any garbage.
                gc.set_threshold(20_000)
                next(compiling)
            except Exception as error:
                return (
                    None,
                    f"{str(error) or repr(error)}; or set the parameter 'model'",
                )
            gc.freeze()  # a collection of all that would stop the node for 45 ms
            rest = threading.Timer(REST_AFTER, next, [compiling])
            rest.daemon = True  # no end of the process waits for it
            rest.start()
            return planner, file

        self.loading = self._worker.call(read)

    async def first(self) -> None:
        """Wait for the first model, and use it unless another one was set since."""
        if (loading := self.loading) is None:
            return
        planner, said = await loading
        if self.loading is loading and planner is not None:
            self.use(planner, said)
        elif self.loading is loading:
            self.loading = None
            self.diagnostics.refuse("model", said)

    def use(self, planner: Planner, file: str, layout: Any = None) -> None:
        """Plan with it from now on."""
        self.planner, self.file, self.layout, self.loading = planner, file, layout, None
        self.diagnostics.ok("model")
        self.diagnostics.change()
        self._node.get_logger().info(f"planning with the model {file}")

    def on_reload(self) -> tuple[bool, str]:
        """Load the file of the model again."""
        parameter = self._node.get_parameter("model")  # to set it loads the model
        if reason := str(self._node.set_parameters([parameter])[0].reason):
            self._node.get_logger().error(f"the model was not loaded again: {reason}")
        return not reason, reason or f"loaded {self.file}"

    def describe(self, rule: str) -> dict[str, str]:
        """Return what the diagnostics say of it, with the value of the parameter ``move_rule``."""
        description = {"model": self._node.value("model")}
        if self.planner is None:
            return description
        metadata, network = self.planner.metadata, self.planner.network
        if body := self.planner.pose_planner:
            description["model footprint (m)"] = str(body.footprint.tolist())
        return description | {
            "model file": self.file,
            "move rule": rule or metadata.move_rule.value,
            "model move rule": metadata.move_rule.value,
            "model sizes": ", ".join(
                f"{key} {size}" for key, size in metadata.sizes.items()
            ),
            "model training steps": str(metadata.steps),
            "model certificate": str(
                network.certificate(metadata.move_rule) or NO_CERTIFICATE
            ),
        }

    def forget(self) -> None:
        """Free the model and its fields, with what `read` kept from collection."""
        self.planner, self.file, self.loading = None, "", None
        gc.unfreeze()
        gc.collect()
