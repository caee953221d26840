"""Models of new footprints, which the trainer makes for the planner on request."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from std_msgs.msg import UInt8MultiArray

from ddqn_planner.model import RobotNetwork, model_bytes, model_of
from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.clocks import STEADY
from ddqn_planner.nodes.conversions import bytes_message, bytes_of
from ddqn_planner.nodes.diagnostics import Diagnostics
from ddqn_planner.nodes.model_source import LoadedModel, ModelSource
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.nodes.worker import Worker
from ddqn_planner.robot.cover import TOLERANCE, excess
from ddqn_planner.robot.footprint import Corners, in_words

REQUESTS = "trainer/untrained_body"
ANSWERS = "trainer/body"
LOOK_PERIOD = 1.0  # seconds between two looks at whether a footprint needs a model
# Seconds until a footprint without a model is asked for again: the trainer may have
# been started again, or its answer lost.
PATIENCE = 10.0
LEARNED = {"weight", "threshold"}
"""The tensors of a network that its training changes."""


class TrainedBodies:
    """Asks the trainer for models of new footprints, and adds what it has trained.

    A request is a model of the robot with the footprint, without a training. So the
    trainer needs neither files nor parameters of the robot.
    """

    def __init__(
        self,
        node: BaseNode,
        diagnostics: Diagnostics,
        worker: Worker,
        models: ModelSource,
        on_change: Callable[[], None],
    ) -> None:
        """Listen to the trainer.

        Parameters
        ----------
        node
            The planner's node.
        diagnostics
            Where a footprint that cannot be trained, and a wrong model, are reported.
        worker
            Makes and reads models.
        models
            Says which footprint needs a model, and takes the model.
        on_change
            Called when the planner has changed.
        """
        self._node = node
        self._diagnostics = diagnostics
        self._worker = worker
        self._models = models
        self._on_change = on_change
        self._last_footprint: Corners | None = None  # at the last look
        self._asked_for: Corners | None = None
        self._asked_at = 0.0  # in seconds of the steady clock
        group = MutuallyExclusiveCallbackGroup()  # the callbacks wait for the worker
        self._requests = node.create_publisher(UInt8MultiArray, REQUESTS, LATCHED)
        node.create_subscription(
            UInt8MultiArray, ANSWERS, self._on_answer, LATCHED, callback_group=group
        )
        node.create_timer(LOOK_PERIOD, self._ask, group, clock=STEADY)

    async def _ask(self) -> None:
        """Ask for a model of the footprint, if no model has nearly this body.

        It is asked for once if another model covers it, and again until one does. A
        footprint that still changes, as that of an arm that moves, is not asked for.
        """
        nearest = self._models.unfit
        footprint = self._models.footprint
        is_steady = footprint is self._last_footprint
        self._last_footprint = footprint
        if nearest is None or footprint is None or not is_steady:
            return
        now = time.monotonic()
        if footprint is self._asked_for:
            is_covered = self._models.planner is not None
            if is_covered or now < self._asked_at + PATIENCE:
                return
        else:
            words = f"the trainer is asked for a model of {in_words(footprint)}"
            self._node.get_logger().info(words)
        self._asked_for = footprint
        self._asked_at = now
        with self._diagnostics.receiving("the footprint to be trained"):
            data = await self._worker.call(untrained_model, nearest, footprint)
            self._requests.publish(bytes_message("model", data))

    async def _on_answer(self, message: UInt8MultiArray) -> None:
        """Use a model of the trainer, if it is one that this robot needs."""
        with self._diagnostics.receiving(ANSWERS):
            data = bytes_of("model", message)
            if self._models.unfit is None:
                return
            model: LoadedModel = await self._worker.call(read_answer, data)
            nearest = self._models.unfit
            footprint = self._models.footprint
            if nearest is None or footprint is None:
                return
            if not has_same_motions(model, nearest):
                return  # it is another robot's
            is_covered = excess(footprint, model.body) <= TOLERANCE
            if is_covered and self._models.use_trained(model):
                self._on_change()


def untrained_model(model: LoadedModel, footprint: Corners) -> bytes:
    """Return the content of a model with another footprint (K, 2), without a training.

    A ValueError if the body is too large for the model's motions.
    """
    assert isinstance(model.network, RobotNetwork)
    network = model.network.of_footprint(footprint)
    return model_bytes(network, replace(model.metadata, sizes=network.sizes, steps=0))


def read_answer(data: bytes) -> LoadedModel:
    """Return the trainer's model of a body; a ValueError if it is none."""
    model = LoadedModel(*model_of(data), ANSWERS)
    if not model.has_body:
        raise ValueError("the model knows no body; let one trainer publish here")
    model.check()
    return model


def has_same_motions(model: LoadedModel, other: LoadedModel) -> bool:
    """Return whether two robots differ in nothing but their bodies."""
    names = model.network.tensors.keys() - LEARNED - {"footprint"}
    return all(
        np.array_equal(model.network.tensors[name], other.network.tensors[name])
        for name in names
    )
