"""A node that a lifecycle manager, or the node itself, configures, activates, and stops."""

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

BEAT_PERIOD, BEAT_TIMEOUT = (
    0.5,
    4.0,
)  # seconds; the timeout as Nav2's lifecycle manager has it

ENTITIES = {
    "publisher": "publishers",
    "subscription": "subscriptions",
    "guard_condition": "guards",
    "timer": "timers",
    "client": "clients",
    "service": "services",
}
"""What a node can create, and where it has them; beside waitables."""

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
    """A transition that can be asked for, with ROS's numbers."""

    number: int
    label: str
    start: str
    during: str  # the state while the node works
    goal: str
    ends: int  # the number of its success; failure and error have the next two


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


def _transition_graph() -> Iterator[TransitionDescription]:
    """Yield ROS's transitions, also those of a node that fails, as tools draw them."""
    ends = {}
    for change in CHANGES:
        yield _description(change.number, change.label, change.start, change.during)
        failed = change.goal if change.label == "shutdown" else change.start
        ends[change.ends] = change.during, change.goal, failed, "errorprocessing"
    ends[60] = "errorprocessing", "unconfigured", "finalized", "finalized"
    for first, (during, *goals) in ends.items():
        labels = "transition_success", "transition_failure", "transition_error"
        for offset, (label, goal) in enumerate(zip(labels, goals, strict=True)):
            yield _description(first + offset, label, during, goal)


# Not on rclpy's LifecycleNode: its answer to a transition that the state does not have ends the
# process, what its transitions call cannot say why it fails, and its services outlive the node.
class ManagedNode(BaseNode):
    """Node that destroys what `configure` created if that fails, and at ``cleanup``."""

    def __init__(self, name: str, parameters: Parameters) -> None:
        # First, as a node that cannot start is destroyed, too.
        self.state = "unconfigured"  # or inactive, active or finalized
        self._is_changing = self._is_destroyed = False
        self._beats: Timer | None = None
        super().__init__(name, parameters)
        self._events = self.create_publisher(TransitionEvent, "~/transition_event", 10)
        group = (
            ReentrantCallbackGroup()
        )  # the state can be asked for while a transition waits
        for kind, service, callback in (
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
            self.create_service(kind, f"~/{service}", callback, callback_group=group)

    def change(self, label: str) -> None:
        """Do a transition; if that raises an error, the state stays."""
        (change,) = [it for it in self._changes() if it.label == label]
        try:
            getattr(self, label)()
        except Exception:
            if label == "configure":
                self.cleanup()
            raise
        self.state = change.goal
        for start, goal in (
            (change.start, change.during),
            (change.during, change.goal),
        ):
            event = TransitionEvent(start_state=_state(start), goal_state=_state(goal))
            self._events.publish(event)
        if label == "configure":
            super().tell_unread_qualities()

    def _changes(self) -> list[Change]:
        """Return the transitions that the state has."""
        return [change for change in CHANGES if change.start == self.state]

    def destroy_node(self) -> None:
        """Free all that the node has, and destroy it, so that it leaves the graph at once."""
        if (
            self._is_destroyed
        ):  # newer releases destroy a context's nodes when it is shut down
            return
        self._is_destroyed = True
        # First, as a lifecycle manager calls them when the bond breaks, and waits without end.
        for service in [*self.services]:
            self.destroy_service(service)
        if self.context.ok():
            self.shutdown()
        super().destroy_node()

    def tell_unread_qualities(self) -> None:
        """Log them as soon as the node is configured: before, it has no subscriptions."""

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
            _description(change.number, change.label, change.start, change.during)
            for change in self._changes()
        ]
        return response

    def _on_get_graph(self, _: Any, response: Any) -> Any:
        response.available_transitions = [*_transition_graph()]
        return response

    async def _on_change_state(self, request: Any, response: Any) -> Any:
        asked = request.transition
        known = {change.number: change.label for change in self._changes()}
        label = asked.label or known.get(asked.id, "")
        if self._is_changing or self.is_stopping or label not in known.values():
            what = repr(asked.label) if asked.label else f"transition {asked.id}"
            choices = ", ".join(known.values()) or "none"
            when = (
                "while it changes its state"
                if self._is_changing
                else f"when {self.state}"
            )
            when = "as it is being stopped" if self.is_stopping else when
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
            remedy = f"{apt_install('bond')}, or set bond_timeout to 0.0 in its manager"
            self.get_logger().info(f"no bond: bond is not installed; {remedy}")
            return
        # As bondpy does, but deaf: the topic has the bonds of all nodes, each ten times a second.
        self._bond = Status(id=self.get_name(), instance_id=str(uuid4()), active=True)
        self._bond.heartbeat_period, self._bond.heartbeat_timeout = (
            BEAT_PERIOD,
            BEAT_TIMEOUT,
        )
        self._heart = self.create_publisher(Status, "bond", 1)
        self._beat()
        self._beats = self.create_timer(BEAT_PERIOD, self._beat, clock=STEADY)

    def _beat(self) -> None:
        self._bond.header = self.header()
        self._heart.publish(self._bond)
