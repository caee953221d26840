"""A node with a lifecycle, which a manager or the node itself moves through."""

from collections.abc import Iterator
from typing import Any, NamedTuple
from uuid import uuid4

from lifecycle_msgs.msg import State, Transition, TransitionDescription, TransitionEvent
from lifecycle_msgs.srv import (
    ChangeState,
    GetAvailableStates,
    GetAvailableTransitions,
    GetState,
)
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.timer import Timer

from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.clocks import STEADY
from ddqn_planner.nodes.declared import Parameters
from ddqn_planner.nodes.ros_packages import apt_install

BEAT_PERIOD = 0.5  # seconds
BEAT_TIMEOUT = 4.0  # seconds, as Nav2's lifecycle manager has it

ENTITIES = {
    "publisher": "publishers",
    "subscription": "subscriptions",
    "guard_condition": "guards",
    "timer": "timers",
    "client": "clients",
    "service": "services",
}
"""Attributes of a node with its entities, by kind; waitables come on top."""

STATES = {
    "unknown": 0,
    "unconfigured": 1,
    "inactive": 2,
    "active": 3,
    "finalized": 4,
    "configuring": 10,
    "cleaningup": 11,
    "shuttingdown": 12,
    "activating": 13,
    "deactivating": 14,
    "errorprocessing": 15,
}
"""The numbers of ROS's states, which lifecycle_msgs/msg/State lists."""


class Change(NamedTuple):
    """A transition that can be requested, with ROS's numbers."""

    number: int
    label: str
    start: str
    transition_state: str  # while the node works
    goal: str
    success_number: int  # of its success; failure and error have the next two


CHANGES = (
    Change(1, "configure", "unconfigured", "configuring", "inactive", 10),
    Change(2, "cleanup", "inactive", "cleaningup", "unconfigured", 20),
    Change(3, "activate", "inactive", "activating", "active", 30),
    Change(4, "deactivate", "active", "deactivating", "inactive", 40),
    Change(5, "shutdown", "unconfigured", "shuttingdown", "finalized", 50),
    Change(6, "shutdown", "inactive", "shuttingdown", "finalized", 50),
    Change(7, "shutdown", "active", "shuttingdown", "finalized", 50),
)


def _state(label: str) -> State:
    return State(id=STATES[label], label=label)


def _description(
    number: int, label: str, start: str, goal: str
) -> TransitionDescription:
    transition = Transition(id=number, label=label)
    ends = {"start_state": _state(start), "goal_state": _state(goal)}
    return TransitionDescription(transition=transition, **ends)


def _describe(change: Change) -> TransitionDescription:
    return _description(
        change.number, change.label, change.start, change.transition_state
    )


class Ends(NamedTuple):
    """The states in which the work of a transition state can end."""

    success: str
    failure: str
    error: str


def _transition_graph() -> Iterator[TransitionDescription]:
    """Yield ROS's transitions, also those of a node that fails, as tools draw them."""
    numbers: dict[str, int] = {}  # of the success, by transition state
    ends: dict[str, Ends] = {}
    for change in CHANGES:
        state = change.transition_state
        yield _describe(change)
        failure = change.goal if change.label == "shutdown" else change.start
        numbers[state] = change.success_number
        ends[state] = Ends(change.goal, failure, "errorprocessing")
    numbers["errorprocessing"] = 60
    ends["errorprocessing"] = Ends("unconfigured", "finalized", "finalized")
    for state, number in numbers.items():
        for offset, end in enumerate(Ends._fields):
            goal: str = getattr(ends[state], end)
            yield _description(number + offset, f"transition_{end}", state, goal)


# Not on rclpy's LifecycleNode: its answer to a transition that the state does not have
# ends the process, its callbacks cannot say why they fail, and its services outlive the
# node.
class ManagedNode(BaseNode):
    """Node that destroys what `configure` created if that fails, and at ``cleanup``."""

    def __init__(self, name: str, parameters: Parameters) -> None:
        # First, as a node that cannot start is destroyed, too.
        self.state = "unconfigured"  # or inactive, active or finalized
        self._is_changing = False
        self._is_destroyed = False
        self._beats: Timer | None = None
        super().__init__(name, parameters)
        self._events = self.create_publisher(TransitionEvent, "~/transition_event", 10)
        # The state can be asked for while a transition waits.
        group = ReentrantCallbackGroup()
        for service_type, name, callback in (
            (ChangeState, "change_state", self._on_change_state),
            (GetState, "get_state", self._on_get_state),
            (GetAvailableStates, "get_available_states", self._on_get_states),
            (
                GetAvailableTransitions,
                "get_available_transitions",
                self._on_get_transitions,
            ),
            (GetAvailableTransitions, "get_transition_graph", self._on_get_graph),
        ):
            self.create_service(
                service_type, f"~/{name}", callback, callback_group=group
            )

    def change(self, label: str) -> None:
        """Do a transition; if that raises an error, the state stays."""
        change = {change.label: change for change in self._changes()}[label]
        do_change = getattr(self, label)
        try:
            do_change()
        except Exception:
            if label == "configure":
                self.cleanup()
            raise
        self.state = change.goal
        self._publish_event(change.start, change.transition_state)
        self._publish_event(change.transition_state, change.goal)
        if label == "configure":
            super().tell_unread_qualities()

    def _publish_event(self, start: str, goal: str) -> None:
        event = TransitionEvent(start_state=_state(start), goal_state=_state(goal))
        self._events.publish(event)

    def _changes(self) -> list[Change]:
        """Return the transitions that the state has."""
        return [change for change in CHANGES if change.start == self.state]

    def destroy_node(self) -> None:
        """Free everything of the node, and destroy it, so that it leaves the graph."""
        # Newer releases destroy a context's nodes when it is shut down.
        if self._is_destroyed:
            return
        self._is_destroyed = True
        # First, as a lifecycle manager calls them when the bond breaks, and waits
        # without end.
        for service in list(self.services):
            self.destroy_service(service)
        if self.context.ok():
            self.shutdown()
        super().destroy_node()

    def tell_unread_qualities(self) -> None:
        """Do nothing: a node without subscriptions logs them once it is configured."""

    async def prepare(self, transition: str) -> bool:
        """Do what takes long before a requested transition; return False to refuse."""
        return True

    def configure(self) -> None:
        """Create what the node needs, after this."""
        self._entities_before = {
            entity for name in ENTITIES.values() for entity in getattr(self, name)
        }
        self._waitables_before = {*self.waitables}

    def activate(self) -> None:
        """Begin to answer requests."""

    def deactivate(self) -> None:
        """Stop, and end the bond."""
        if self._beats is not None:
            self.destroy_timer(self._beats)
            self._beats = None
            self._bond.active = False
            self._beat()
            # A publisher that ends at once would take its last message with it.
            self._heart.wait_for_all_acked(Duration(seconds=0.2))
            self.destroy_publisher(self._heart)

    def cleanup(self) -> None:
        """Destroy what was created since `configure`, also if that failed."""
        for kind, name in ENTITIES.items():
            destroy = getattr(self, f"destroy_{kind}")
            for entity in {*getattr(self, name)} - self._entities_before:
                destroy(entity)
        # Handlers of events have ended with their publisher or subscription. Only
        # action servers are left.
        servers: set[Any] = {*self.waitables} - self._waitables_before
        for server in servers:
            server.destroy()

    def shutdown(self) -> None:
        """Stop the node and free all that it has."""
        is_active = self.state == "active"
        if is_active:
            self.deactivate()
        if is_active or self.state == "inactive":
            self.cleanup()

    def _on_get_state(self, _: Any, response: Any) -> Any:
        response.current_state = _state(self.state)
        return response

    def _on_get_states(self, _: Any, response: Any) -> Any:
        response.available_states = [_state(label) for label in STATES]
        return response

    def _on_get_transitions(self, _: Any, response: Any) -> Any:
        response.available_transitions = [
            _describe(change) for change in self._changes()
        ]
        return response

    def _on_get_graph(self, _: Any, response: Any) -> Any:
        response.available_transitions = [*_transition_graph()]
        return response

    async def _on_change_state(self, request: Any, response: Any) -> Any:
        labels = {change.number: change.label for change in self._changes()}
        number: int = request.transition.id
        requested_label: str = request.transition.label
        label = requested_label or labels.get(number, "")
        is_refused = self._is_changing or self.is_stopping
        if is_refused or label not in labels.values():
            transition = f"transition {number}"
            if requested_label:
                transition = repr(requested_label)
            choices = ", ".join(labels.values()) or "none"
            self.get_logger().error(
                f"{transition} refused: the node has {choices} {self._circumstance()}"
            )
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

    def _circumstance(self) -> str:
        """Return in words when a transition was refused."""
        if self.is_stopping:
            return "as it is being stopped"
        if self._is_changing:
            return "while it changes its state"
        return f"when {self.state}"

    def _form_bond(self) -> None:
        """Let a lifecycle manager see that the process lives."""
        try:
            from bond.msg import Status
        except ImportError:
            remedy = f"{apt_install('bond')}, or set bond_timeout to 0.0 in its manager"
            self.get_logger().info(f"no bond: bond is not installed; {remedy}")
            return
        # As bondpy does, without a subscription: the topic has the bonds of all nodes,
        # each ten times per second.
        self._bond = Status(id=self.get_name(), instance_id=str(uuid4()), active=True)
        self._bond.heartbeat_period = BEAT_PERIOD
        self._bond.heartbeat_timeout = BEAT_TIMEOUT
        self._heart = self.create_publisher(Status, "bond", 1)
        self._beat()
        self._beats = self.create_timer(BEAT_PERIOD, self._beat, clock=STEADY)

    def _beat(self) -> None:
        self._bond.header = self.header()
        self._heart.publish(self._bond)
