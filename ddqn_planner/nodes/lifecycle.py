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
"""By kind of entity, the node's attribute that holds them; its waitables are apart."""

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
    success_number: int  # of the transition that ends it: success, failure, error


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
    """Make the message of a state."""
    return State(id=STATES[label], label=label)


def _description(
    number: int, label: str, start: str, goal: str
) -> TransitionDescription:
    """Make the message of a transition from a start state to a goal state."""
    return TransitionDescription(
        transition=Transition(id=number, label=label),
        start_state=_state(start),
        goal_state=_state(goal),
    )


def _describe(change: Change) -> TransitionDescription:
    """Make the message of a transition that can be requested.

    It leads to the state in which the node works; another transition ends that.
    """
    return _description(
        change.number, change.label, change.start, change.transition_state
    )


def _transition_graph() -> Iterator[TransitionDescription]:
    """Yield ROS's transitions, also those of a node that fails, as tools draw them.

    First those that can be requested, then those that end the work on them.
    """
    results = ("success", "failure", "error")
    for change in CHANGES:
        yield _describe(change)
    # By the state in which the node works: the number of the transition of success, and
    # the states in which the work can end, in the order of the results.
    ends: dict[str, tuple[int, list[str]]] = {}
    for change in CHANGES:
        failure = change.goal if change.label == "shutdown" else change.start
        goals = [change.goal, failure, "errorprocessing"]
        ends[change.transition_state] = (change.success_number, goals)
    ends["errorprocessing"] = (60, ["unconfigured", "finalized", "finalized"])
    for state, (success_number, goals) in ends.items():
        for offset, (result, goal) in enumerate(zip(results, goals, strict=True)):
            number = success_number + offset
            yield _description(number, f"transition_{result}", state, goal)


# Not on rclpy's LifecycleNode: its answer to a transition that the state does not have
# ends the process, its callbacks cannot say why they fail, and its services outlive the
# node.
class ManagedNode(BaseNode):
    """Node with a lifecycle; see `Change` for its transitions.

    What `configure` creates is destroyed at ``cleanup``, or if `configure` fails.
    """

    def __init__(self, name: str, parameters: Parameters) -> None:
        """Make an unconfigured node with these parameters, and its services."""
        # First, as a node that cannot start is destroyed, too.
        self.state = "unconfigured"  # or inactive, active or finalized
        self._is_changing = False
        self._is_destroyed = False
        self._heartbeat_timer: Timer | None = None
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
        """Do a transition that the present state has, and tell subscribers.

        `label` is the transition's label, as "configure": the method of this name is
        called. If it raises an error, the state stays.
        """
        changes = {change.label: change for change in self._changes()}
        change = changes[label]
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
            super().warn_of_unread_qualities()

    def _publish_event(self, start: str, goal: str) -> None:
        """Tell subscribers that the node went from a start state to a goal state."""
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

    def warn_of_unread_qualities(self) -> None:
        """Do nothing: `change` warns when the node has subscriptions."""

    async def prepare(self, transition: str) -> bool:
        """Do what takes long before a requested transition; return False to refuse."""
        return True

    def configure(self) -> None:
        """Note which entities the node has; an override calls this method first.

        What the override then creates is destroyed by `cleanup`.
        """
        self._entities_before = {
            entity for name in ENTITIES.values() for entity in getattr(self, name)
        }
        self._waitables_before = {*self.waitables}

    def activate(self) -> None:
        """Begin to answer requests."""

    def deactivate(self) -> None:
        """Stop answering requests, and end the bond with the lifecycle manager."""
        if self._heartbeat_timer is None:  # there is no bond
            return
        self.destroy_timer(self._heartbeat_timer)
        self._heartbeat_timer = None
        self._heartbeat.active = False
        self._publish_heartbeat()
        # A publisher that ends at once would take its last message with it.
        self._heartbeat_publisher.wait_for_all_acked(Duration(seconds=0.2))
        self.destroy_publisher(self._heartbeat_publisher)

    def cleanup(self) -> None:
        """Destroy all entities created since `configure`, also if that failed."""
        for kind, name in ENTITIES.items():
            destroy = getattr(self, f"destroy_{kind}")
            for entity in {*getattr(self, name)} - self._entities_before:
                destroy(entity)
        # Of waitables, the handlers of events were destroyed with their publisher or
        # subscription. Only action servers are left.
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

    def _on_get_state(
        self, _: GetState.Request, response: GetState.Response
    ) -> GetState.Response:
        """Answer ``~/get_state`` with the present state."""
        response.current_state = _state(self.state)
        return response

    def _on_get_states(
        self, _: GetAvailableStates.Request, response: GetAvailableStates.Response
    ) -> GetAvailableStates.Response:
        """Answer ``~/get_available_states`` with all states of ROS."""
        response.available_states = [_state(label) for label in STATES]
        return response

    def _on_get_transitions(
        self,
        _: GetAvailableTransitions.Request,
        response: GetAvailableTransitions.Response,
    ) -> GetAvailableTransitions.Response:
        """Answer ``~/get_available_transitions`` with those of the present state."""
        response.available_transitions = [
            _describe(change) for change in self._changes()
        ]
        return response

    def _on_get_graph(
        self,
        _: GetAvailableTransitions.Request,
        response: GetAvailableTransitions.Response,
    ) -> GetAvailableTransitions.Response:
        response.available_transitions = [*_transition_graph()]
        return response

    async def _on_change_state(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        """Answer ``~/change_state``: do the transition that the request names.

        A transition is refused if it does not begin at the present state, and while the
        node changes its state or stops.
        """
        label = self._label_of(request.transition)
        if not label or self._is_changing or self.is_stopping:
            self._log_refusal(request.transition)
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

    def _label_of(self, transition: Transition) -> str:
        """Return the label of a transition that the present state has; else empty.

        A request has the label of the transition, or an empty label and its number.
        """
        for change in self._changes():
            is_named = change.label == transition.label
            is_numbered = not transition.label and change.number == transition.id
            if is_named or is_numbered:
                return change.label
        return ""

    def _log_refusal(self, transition: Transition) -> None:
        """Log that a requested transition is refused, and which ones the node has."""
        requested = f"transition {transition.id}"
        if transition.label:
            requested = repr(transition.label)
        choices = ", ".join(change.label for change in self._changes()) or "none"
        self.get_logger().error(
            f"{requested} refused: the node has {choices} {self._circumstance()}"
        )

    def _circumstance(self) -> str:
        """Return why a transition is refused, as the end of a sentence."""
        if self.is_stopping:
            return "as it is being stopped"
        if self._is_changing:
            return "while it changes its state"
        return f"when {self.state}"

    def _form_bond(self) -> None:
        """Publish from now on that the process lives, for a lifecycle manager.

        Without the package bond, log that instead.
        """
        try:
            from bond.msg import Status
        except ImportError:
            remedy = f"{apt_install('bond')}, or set bond_timeout to 0.0 in its manager"
            self.get_logger().info(f"no bond: bond is not installed; {remedy}")
            return
        # As bondpy does, but without a subscription to the topic, which has the
        # heartbeats of all nodes' bonds, each ten times per second.
        self._heartbeat = Status(
            id=self.get_name(), instance_id=str(uuid4()), active=True
        )
        self._heartbeat.heartbeat_period = BEAT_PERIOD
        self._heartbeat.heartbeat_timeout = BEAT_TIMEOUT
        self._heartbeat_publisher = self.create_publisher(Status, "bond", 1)
        self._publish_heartbeat()
        self._heartbeat_timer = self.create_timer(
            BEAT_PERIOD, self._publish_heartbeat, clock=STEADY
        )

    def _publish_heartbeat(self) -> None:
        """Tell the lifecycle manager that the process lives, or that the bond ends."""
        self._heartbeat.header = self.header()
        self._heartbeat_publisher.publish(self._heartbeat)
