"""The trainer's models of footprints that planners ask for."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from std_msgs.msg import UInt8MultiArray

from ddqn_planner.model import RobotNetwork, model_bytes, model_of
from ddqn_planner.nodes.conversions import bytes_message, bytes_of
from ddqn_planner.nodes.learning_node import LearningNode
from ddqn_planner.nodes.quality import CHANGING, LATCHED
from ddqn_planner.nodes.worker import Worker
from ddqn_planner.robot.footprint import in_words

if TYPE_CHECKING:
    from ddqn_planner.training.robot import RobotTrainer

MOST_WAITING = 8  # requests at once
MOST_ANSWERS = 16  # that are kept for planners that ask again
END_PATIENCE = 0.5  # seconds that the end of the node waits for a training


class Order(NamedTuple):
    """A model to be trained."""

    model: bytes  # its content before the training
    padding: float  # metres by which its footprint is to be larger
    seed: int


class BodyTraining:
    """Trains the models that planners ask for, one after another, and publishes them.

    A request is a model without a training. Its footprint is padded by the parameter
    ``body_padding``, as room for a controller.
    """

    def __init__(self, node: LearningNode) -> None:
        """Listen to planners; `node` is the trainer's."""
        self._node = node
        self._worker = Worker(node)
        self._waiting: list[Order] = []  # the first one is being trained
        # The contents of trained models; that of a training that failed is empty.
        self._answers: dict[Order, bytes] = {}
        self._trainer: RobotTrainer | None = None  # of the training of now
        self._is_closed = False
        self._publisher = node.create_publisher(UInt8MultiArray, "~/body", LATCHED)
        node.create_subscription(
            UInt8MultiArray, "~/untrained_body", self._on_request, CHANGING
        )

    def _on_request(self, message: UInt8MultiArray) -> None:
        """Train the model of a request, or send it again if it is trained."""
        with self._node.diagnostics.receiving("untrained_body"):
            order = Order(
                bytes_of("model", message),
                padding=self._node.value("body_padding"),
                seed=self._node.value("seed"),
            )
            if order in self._answers:
                self._send(self._answers[order])
                return
            if order in self._waiting:
                return
            if len(self._waiting) == MOST_WAITING:
                remedy = "ask again later"
                raise ValueError(f"{MOST_WAITING} footprints wait already; {remedy}")
            self._waiting.append(order)
            self._worker.call(self._train, order)

    def _train(self, order: Order) -> None:
        """Train a model in the worker's thread, and publish it."""
        answer = b""
        try:
            answer = self._trained(order)
        except Exception as error:  # the node must survive any error
            self._node.fail("a footprint cannot be trained", error)
        finally:
            self._trainer = None
            self._waiting.remove(order)
        while len(self._answers) >= MOST_ANSWERS:
            del self._answers[next(iter(self._answers))]
        self._answers[order] = answer
        self._send(answer)

    def _trained(self, order: Order) -> bytes:
        """Return the content of a model that is trained until its body is proved.

        Empty if the node ends before. A ValueError says why it cannot be trained.
        """
        from ddqn_planner.training.robot import ROBOT, RobotTrainer

        network, _ = model_of(order.model)
        if not isinstance(network, RobotNetwork):
            raise ValueError("the model knows no body; ask with that of a robot")
        logger = self._node.get_logger()
        logger.info(f"training the footprint {in_words(network.footprint)}")
        trainer = RobotTrainer(
            network.footprint.tolist(), network.motions, order.seed, order.padding
        )
        self._trainer = trainer
        certificate = trainer.network.certificate()
        for certificate in trainer.run(ROBOT.steps):  # noqa: B007
            if self._is_closed:
                return b""
        if not certificate.proved:
            raise ValueError(f"the model is {certificate}; set another seed")
        logger.info(f"the footprint is trained, {certificate}")
        return model_bytes(trainer.network, trainer.metadata())

    def _send(self, model: bytes) -> None:
        """Publish the content of a model, if there is one."""
        if model:
            self._publisher.publish(bytes_message("model", model))

    def describe(self) -> dict[str, str]:
        """Return the lines of the diagnostics about a training that runs."""
        trainer = self._trainer
        if trainer is None:
            return {}
        waiting = len(self._waiting) - 1
        steps = f"{trainer.steps} transitions; {waiting} more wait"
        return {"training of a footprint": steps}

    def close(self) -> None:
        """Give up the training, if one runs."""
        self._is_closed = True
        self._worker.close(END_PATIENCE)
