"""A node that a lifecycle manager, or the node itself, configures, activates, and stops."""

from typing import Any
from uuid import uuid4

from lifecycle_msgs.srv import ChangeState
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNodeMixin
from rclpy.timer import Timer

from ddqn_planner.nodes.executor import KINDS
from ddqn_planner.nodes.runtime import STEADY, BaseNode, Parameters

BEAT_PERIOD, BEAT_TIMEOUT = 0.5, 4.0  # seconds; the timeout as Nav2's lifecycle manager has it

ENTITIES = {"publisher": "publishers", **KINDS}
"""What a node can create, and where it has them; beside waitables."""


class ManagedNode(LifecycleNodeMixin, BaseNode):
    """Node that destroys what `configure` created if that fails, and at ``cleanup``."""

    def __init__(self, name: str, parameters: Parameters) -> None:
        BaseNode.__init__(self, name, parameters)
        # Reentrant: the state can be asked for while a transition waits.
        LifecycleNodeMixin.__init__(self, callback_group=ReentrantCallbackGroup())
        # rclpy's answer ends the process on a transition that the state does not have, and what its
        # transitions call cannot say why they fail. Here both are logged, and it answers so.
        self.answer_with(ChangeState, self._on_change_state)
        self._is_changing = False
        self._beats: Timer | None = None

    @property
    def state(self) -> str:
        """The name of the state: unconfigured, inactive, active or finalized."""
        return str(self._state_machine.current_state[1])

    def change(self, label: str) -> None:
        """Do a transition; if that raises an error, the state stays."""
        try:
            getattr(self, label)()
        except Exception:
            if label == "configure":
                self.cleanup()
            raise
        getattr(self, f"trigger_{label}")()

    def destroy_node(self) -> None:
        """Free all that the node has, and destroy it, so that it leaves the graph at once."""
        last_state = self.state
        # First, as a lifecycle manager calls them when the bond breaks, and waits without end.
        self._state_machine.destroy_when_not_in_use()
        for service in [*self.services]:
            self.destroy_service(service)
        if self.context.ok():
            self.shutdown(last_state)
        super().destroy_node()

    async def prepare(self, transition: str) -> bool:
        """Do what takes long before a transition that was asked for; False to refuse it."""
        return True

    def configure(self) -> None:
        """Create what the node needs, after this."""
        self._kept = {it for name in ENTITIES.values() for it in getattr(self, name)}
        self._kept |= {*self.waitables}

    def activate(self) -> None:
        """Begin to answer requests."""

    def deactivate(self) -> None:
        """Stop, and end the bond."""
        if self._beats is not None:
            self.destroy_timer(self._beats)
            self._beats, self._bond.active = None, False
            self._beat()
            # Else a publisher that ends at once takes its last message with it.
            self._heart.wait_for_all_acked(Duration(seconds=0.2))
            self.destroy_publisher(self._heart)

    def cleanup(self) -> None:
        """Destroy what was created since `configure`, also if that failed."""
        for kind, name in ENTITIES.items():
            for entity in {*getattr(self, name)} - self._kept:
                getattr(self, f"destroy_{kind}")(entity)
        # Handlers of events have ended with their publisher or subscription: action servers stay.
        servers: set[Any] = {*self.waitables} - self._kept
        for server in servers:
            server.destroy()

    def shutdown(self, state: str = "") -> None:
        """Stop the node and free all that it has, in a state or that of now."""
        state = state or self.state
        if state == "active":
            self.deactivate()
        if state in ("active", "inactive"):
            self.cleanup()

    async def _on_change_state(self, request: Any, response: Any) -> Any:
        asked = request.transition
        known = {number: label for number, label, *_ in self._state_machine.available_transitions}
        label = asked.label or known.get(asked.id, "")
        if self._is_changing or label not in known.values():
            what = repr(asked.label) if asked.label else f"transition {asked.id}"
            choices = ", ".join(known.values()) or "none"
            when = "while it changes its state" if self._is_changing else f"when {self.state}"
            self.get_logger().error(f"{what} refused: the node has {choices} {when}")
            return response
        self._is_changing = True
        try:
            if await self.prepare(label):
                self.change(label)
                response.success = True
                if label == "activate":
                    self._form_bond()
        except Exception as error:  # the node must survive
            self.get_logger().error(f"{label} failed: {str(error) or repr(error)}")
        finally:
            self._is_changing = False
        return response

    def _form_bond(self) -> None:
        """Let a lifecycle manager see that the process lives."""
        try:
            from bond.msg import Status
        except ImportError:
            remedy = "apt install ros-jazzy-bond, or set bond_timeout to 0.0 in its manager"
            self.get_logger().info(f"no bond: bond is not installed; {remedy}")
            return
        # As bondpy does, but deaf: the topic has the bonds of all nodes, each ten times a second.
        self._bond = Status(id=self.get_name(), instance_id=str(uuid4()), active=True)
        self._bond.heartbeat_period, self._bond.heartbeat_timeout = BEAT_PERIOD, BEAT_TIMEOUT
        self._heart = self.create_publisher(Status, "bond", 1)
        self._beat()
        self._beats = self.create_timer(BEAT_PERIOD, self._beat, clock=STEADY)

    def _beat(self) -> None:
        self._bond.header = self.header()
        self._heart.publish(self._bond)
