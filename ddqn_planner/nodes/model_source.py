"""The planner with the model that fits the robot: the last one that could be loaded."""

import gc
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from rclpy.task import Future
from std_msgs.msg import MultiArrayLayout

from ddqn_planner.model import (
    ModelFileError,
    ModelMetadata,
    QNetwork,
    RobotNetwork,
    find_model,
    load_model,
)
from ddqn_planner.model.certificate import NO_CERTIFICATE
from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.diagnostics import PlannerDiagnostics
from ddqn_planner.nodes.worker import Worker
from ddqn_planner.planning import Planner
from ddqn_planner.robot.cover import best_cover, excess
from ddqn_planner.robot.footprint import Corners, in_words
from ddqn_planner.warm_up import warm_up

# Seconds from the loading of a model to the compilation of what few requests need: what
# waits for the model is planned first.
REST_AFTER = 1.0
# Python collects garbage after this number of new objects, not after 700: to compile
# and to plan makes hardly any garbage.
NEW_OBJECTS = 20_000
# Metres by which a model may be larger than the footprint that it is used for, or a
# cell: more is told.
ROOM = 0.05
TRAIN = (
    "train one with ddqn-planner train-robot and name it in the parameter models "
    "(a costmap's footprint contains its footprint_padding)"
)
WAIT_OR_TRAIN = f"wait for that of a trainer, if one runs, or {TRAIN}"
MOST_TRAINED = 8  # models of the trainer that are kept, for footprints that come again


class LoadedModel(NamedTuple):
    """A model, and where it came from."""

    network: QNetwork
    metadata: ModelMetadata
    source: str  # its file, or the topic of its message

    @property
    def has_body(self) -> bool:
        """Whether it is a model of a robot with a body."""
        return isinstance(self.network, RobotNetwork)

    @property
    def body(self) -> Corners:
        """The corners of its body, (K, 2) metres."""
        assert isinstance(self.network, RobotNetwork)
        return self.network.footprint

    def check(self) -> None:
        """Raise a ModelFileError if a body is not proved."""
        if isinstance(self.network, RobotNetwork):
            self.network.swept()


class FirstModels(NamedTuple):
    """The node's first models, and why others could not be loaded."""

    model: LoadedModel | None
    bodies: list[LoadedModel]
    problem: str = ""  # of the model
    problem_of_bodies: str = ""


def read_model(name: str) -> LoadedModel:
    """Read a model, by a shipped model's name or by the path of its file."""
    path = find_model(name)
    model = LoadedModel(*load_model(path), str(path))
    model.check()
    return model


def read_bodies(names: Sequence[str]) -> list[LoadedModel]:
    """Read models that know a body, see `read_model`; an empty name is none.

    A ModelFileError says which of them cannot be used.
    """
    models = [read_model(name) for name in names if name]
    for model in models:
        if not model.has_body:
            remedy = "give models of ddqn-planner train-robot"
            raise ModelFileError(f"the model {model.source} knows no body; {remedy}")
    return models


class ModelSource:
    """Has the planner with the model in use, and that model's file.

    Without a footprint this is the last model that could be loaded. With a footprint it
    is the smallest of the models that cover the footprint, and none if none covers it.
    """

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
        self.unfit: LoadedModel | None = None
        """The model that is nearest to the footprint, if its body is another one."""
        self.footprint: Corners | None = None
        """The last footprint that was published."""
        self._node = node
        self._diagnostics = diagnostics
        self._worker = worker
        self._model: LoadedModel | None = None  # of the parameter or the trainer
        # Of the parameter ``models``; None before they are loaded.
        self._bodies: list[LoadedModel] | None = None
        # The trainer's models for footprints.
        self._trained: deque[LoadedModel] = deque(maxlen=MOST_TRAINED)
        self._network_in_use: QNetwork | None = None
        # The network of the last warning that a body is larger than the footprint.
        self._larger_network: QNetwork | None = None
        self.loading: Future | None = None
        """Of the `FirstModels`, until `wait_until_loaded` uses or refuses them."""

    # Loading

    def load(self) -> None:
        """Begin to load the first models, and to compile what many requests need."""
        self.loading = self._worker.call(self._load_and_compile)

    def _load_and_compile(self) -> FirstModels:
        """Load the models that the parameters name, in the worker's thread."""
        bodies, problem_of_bodies = self._load_bodies()
        try:
            model = read_model(self._node.value("model"))
            self._compile(model, bodies)
        except Exception as error:
            problem = f"{str(error) or repr(error)}; or set the parameter 'model'"
            return FirstModels(None, bodies, problem, problem_of_bodies)
        return FirstModels(model, bodies, problem_of_bodies=problem_of_bodies)

    def _load_bodies(self) -> tuple[list[LoadedModel], str]:
        """Return those of the parameter ``models`` that can be read.

        The text says why others cannot; it is empty if all can.
        """
        bodies = []
        problems = []
        for name in self._node.value("models"):
            try:
                bodies += read_bodies([name])
            except Exception as error:
                problems.append(str(error) or repr(error))
        return bodies, " / ".join(problems)

    def _compile(self, model: LoadedModel, bodies: Sequence[LoadedModel]) -> None:
        """Compile what most requests need, and a moment later the rest.

        The model is that of the parameter ``model``, which may know no body, and
        `bodies` are those of ``models``.
        """
        gc.set_threshold(NEW_OBJECTS)
        compilation = self._compilation_for(model)
        next(compilation)
        if bodies and not model.has_body:
            next(self._compilation_for(bodies[0]))
        # A collection of all objects that exist now would stop the node for 45 ms.
        gc.freeze()
        rest = threading.Timer(REST_AFTER, next, [compilation])
        rest.daemon = True  # the end of the process does not wait for it
        rest.start()

    def _compilation_for(self, model: LoadedModel) -> Iterator[None]:
        """Return the two steps of the compilation for a model, see `warm_up`."""
        planner = Planner(model.network, model.metadata)
        return warm_up(planner, self._node.value("follow_trainer"))

    async def wait_until_loaded(self) -> None:
        """Wait for the first models if they are still being loaded, and use them.

        A model that cannot be loaded is refused. Models that were set while this
        function waited stay.
        """
        loading = self.loading
        if loading is None:
            return
        first: FirstModels = await loading
        if self._bodies is None:  # none were set meanwhile
            self._bodies = first.bodies
            if first.problem_of_bodies:
                self._diagnostics.refuse("models", first.problem_of_bodies)
        was_set_meanwhile = self.loading is not loading
        if was_set_meanwhile:
            return
        if first.model is None:
            self.loading = None
            self._diagnostics.refuse("model", first.problem)
        else:
            self.use(first.model)

    # Choosing

    def use(self, model: LoadedModel, layout: MultiArrayLayout | None = None) -> None:
        """Use a model of a file, or of a message of this layout, if it fits."""
        self._model = model
        self.layout = layout
        self.loading = None
        self._choose()

    def use_bodies(self, bodies: list[LoadedModel]) -> None:
        """Let the footprint choose among these models, too."""
        self._bodies = bodies
        self._diagnostics.ok("models")
        self._choose()

    def use_trained(self, model: LoadedModel) -> bool:
        """Let the footprint choose a model of the trainer, too.

        Return whether the planner has changed. A ModelFileError if the body is not
        proved.
        """
        model.check()
        self._trained.append(model)
        return self._choose()

    def use_footprint(self, footprint: Corners) -> bool:
        """Plan for a footprint (K, 2), metres; return whether the planner has changed.

        The planner is None if no model covers the footprint.
        """
        self.footprint = footprint
        return self._choose()

    @property
    def needs_footprint(self) -> bool:
        """Whether a footprint chooses the model: there are several, or a trainer."""
        has_others = bool(self._bodies) or self._node.value("follow_trainer")
        return bool(has_others and self._candidates())

    def _candidates(self) -> list[LoadedModel]:
        """Return the models that know a body, among which a footprint chooses."""
        models = [*(self._bodies or []), *self._trained]
        if self._model is not None:
            models.insert(0, self._model)
        return [model for model in models if model.has_body]

    def _choose(self) -> bool:
        """Use the model that fits best; return whether the planner has changed."""
        model = self._model
        self.unfit = None
        if model is None:
            return False
        if self.footprint is not None and self.needs_footprint:
            candidates = self._candidates()
            bodies = [candidate.body for candidate in candidates]
            cover = best_cover(self.footprint, bodies)
            model = candidates[cover.number]
            if not cover.is_complete:
                return self._refuse_footprint(self.footprint, model, cover.excess)
            self._warn_if_larger(self.footprint, model)
        if model.network is self._network_in_use:
            return False
        # The planner of before is freed with all its fields.
        self._network_in_use = model.network
        self.planner = Planner(model.network, model.metadata)
        self.file = model.source
        self._diagnostics.ok("model")
        self._diagnostics.change()
        self._node.get_logger().info(f"planning with the model {self.file}")
        return True

    def _refuse_footprint(
        self, footprint: Corners, nearest: LoadedModel, metres: float
    ) -> bool:
        """Plan no paths, as no model covers the footprint; say so, with the remedy.

        Parameters
        ----------
        footprint : (K, 2) float64
            Metres.
        nearest : LoadedModel
            The model beyond whose body the footprint reaches least.
        metres : float
            How far it reaches beyond that body.

        Returns
        -------
        bool
            Whether there was a planner before.
        """
        self.unfit = nearest
        had_planner = self.planner is not None
        self._network_in_use = None
        self.planner = None
        self.file = ""
        problem = f"no model covers the footprint {in_words(footprint)}"
        reach = f"it reaches {metres:.2g} m beyond the body of {nearest.source}"
        self._diagnostics.refuse(
            "model", f"{problem}: {reach}; {self._remedy}", log=had_planner
        )
        return had_planner

    def _warn_if_larger(self, footprint: Corners, model: LoadedModel) -> None:
        """Warn if the model for a footprint (K, 2) has a body that is much larger."""
        assert isinstance(model.network, RobotNetwork)
        metres = excess(model.body, footprint)
        if metres <= max(ROOM, model.network.motions.resolution):
            self._larger_network = None
            return
        self.unfit = model
        if model.network is self._larger_network:
            return  # a footprint may change all the time, as that of an arm
        self._larger_network = model.network
        problem = f"no model has the footprint {in_words(footprint)}"
        larger = f"that of {model.source}, which reaches {metres:.2g} m beyond it"
        self._node.get_logger().warning(
            f"{problem}; planning with a larger body, {larger}; {self._remedy}"
        )

    @property
    def _remedy(self) -> str:
        """What to do about a footprint that has no model, in words."""
        return WAIT_OR_TRAIN if self._node.value("follow_trainer") else TRAIN

    # Describing

    def describe(self, rule: str) -> dict[str, str]:
        """Return the diagnostics' values about the model.

        Parameters
        ----------
        rule
            The parameter ``move_rule``; empty for the model's own.
        """
        values: dict[str, str] = {"model": self._node.value("model")}
        if self.footprint is not None:
            values["footprint (m)"] = in_words(self.footprint)
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
        """Free the models and fields, also objects frozen by `_compile`."""
        self.planner = None
        self.file = ""
        self.loading = None
        self.footprint = None
        self.unfit = None
        self._model = None
        self._bodies = None
        self._trained.clear()
        self._network_in_use = None
        self._larger_network = None
        gc.unfreeze()
        gc.collect()
