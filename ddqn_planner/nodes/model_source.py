"""The planner with the last model that could be loaded."""

import gc
import threading
from typing import NamedTuple

from rclpy.task import Future
from std_msgs.msg import MultiArrayLayout

from ddqn_planner.model import find_model
from ddqn_planner.model.certificate import NO_CERTIFICATE
from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.diagnostics import PlannerDiagnostics
from ddqn_planner.nodes.worker import Worker
from ddqn_planner.planning import Planner
from ddqn_planner.warm_up import warm_up

# Seconds from the loading of a model to the compilation of what few requests need: what
# waits for the model is planned first.
REST_AFTER = 1.0
# Python collects garbage after this number of new objects, not after 700: to compile
# and to plan makes hardly any garbage.
NEW_OBJECTS = 20_000


class ModelOfFile(NamedTuple):
    """A planner with a model, and the model's file."""

    planner: Planner
    file: str


class FirstModel(NamedTuple):
    """The node's first model, or why it could not be loaded."""

    model: ModelOfFile | None
    problem: str = ""


def read_model(name: str) -> ModelOfFile:
    """Read a model, by a shipped model's name or by the path of its file."""
    path = find_model(name)
    return ModelOfFile(Planner.load(path), str(path))


class ModelSource:
    """Has the planner with the last model that could be loaded, and its file."""

    def __init__(
        self, node: BaseNode, diagnostics: PlannerDiagnostics, worker: Worker
    ) -> None:
        """Begin without a model.

        Parameters
        ----------
        node
            The planner's node, with its parameters.
        diagnostics
            Where a model that cannot be loaded is reported.
        worker
            Its thread loads the first model.
        """
        self.planner: Planner | None = None
        self.file = ""
        # Of the trainer's message that the model came in; it holds the digest.
        self.layout: MultiArrayLayout | None = None
        self._node = node
        self._diagnostics = diagnostics
        self._worker = worker
        self.loading: Future | None = None
        """Of the `FirstModel`, until `wait_until_loaded` uses or refuses it."""

    def load(self) -> None:
        """Begin to load the first model, and to compile what many requests need."""
        self.loading = self._worker.call(self._load_and_compile)

    def _load_and_compile(self) -> FirstModel:
        """Load the model that the parameters name, in the worker's thread."""
        try:
            model = read_model(self._node.value("model"))
            compiling = warm_up(model.planner, self._node.value("follow_trainer"))
            gc.set_threshold(NEW_OBJECTS)
            next(compiling)
        except Exception as error:
            problem = str(error) or repr(error)
            return FirstModel(None, f"{problem}; or set the parameter 'model'")
        # A collection of all objects that exist now would stop the node for 45 ms.
        gc.freeze()
        rest = threading.Timer(REST_AFTER, next, [compiling])
        rest.daemon = True  # the end of the process does not wait for it
        rest.start()
        return FirstModel(model)

    async def wait_until_loaded(self) -> None:
        """Wait for the first model if that is still being loaded, and plan with it.

        A model that cannot be loaded is refused. If another model was set while this
        function waited, the first one is dropped.
        """
        loading = self.loading
        if loading is None:
            return
        first: FirstModel = await loading
        if self.loading is not loading:
            return
        if first.model is None:
            self.loading = None
            self._diagnostics.refuse("model", first.problem)
        else:
            self.use(first.model.planner, first.model.file)

    def use(
        self, planner: Planner, file: str, layout: MultiArrayLayout | None = None
    ) -> None:
        """Plan with a model of a file, or of a message of this layout, from now on."""
        self.planner = planner
        self.file = file
        self.layout = layout
        self.loading = None
        self._diagnostics.ok("model")
        self._diagnostics.change()
        self._node.get_logger().info(f"planning with the model {file}")

    def describe(self, rule: str) -> dict[str, str]:
        """Return the diagnostics' values about the model.

        Parameters
        ----------
        rule
            The parameter ``move_rule``; empty for the model's own.
        """
        values: dict[str, str] = {"model": self._node.value("model")}
        if self.planner is None:
            return values
        metadata = self.planner.metadata
        pose_planner = self.planner.pose_planner
        if pose_planner is not None:
            values["model footprint (m)"] = str(pose_planner.footprint.tolist())
        sizes = [f"{name} {size}" for name, size in metadata.sizes.items()]
        certificate = self.planner.network.certificate(metadata.move_rule)
        return values | {
            "model file": self.file,
            "move rule": rule or metadata.move_rule.value,
            "model move rule": metadata.move_rule.value,
            "model sizes": ", ".join(sizes),
            "model training steps": str(metadata.steps),
            "model certificate": str(certificate or NO_CERTIFICATE),
        }

    def forget(self) -> None:
        """Free the model and its fields, also objects frozen by `_load_and_compile`."""
        self.planner = None
        self.file = ""
        self.loading = None
        gc.unfreeze()
        gc.collect()
