"""A node that a lifecycle manager, or the node itself, configures, activates, and stops.

rclpy's `LifecycleNodeMixin` ends the process on a transition that its state does not have, and
drops the exceptions of transitions. Here both are logged, and the answer is that it failed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

from ddqn_planner.nodes.runtime import BaseNode, Parameters

SUCCESS = TransitionCallbackReturn.SUCCESS

HEARTBEAT_PERIOD, HEARTBEAT_TIMEOUT = 0.1, 4.0
"""Seconds, as Nav2's nodes and lifecycle manager have them."""


class ManagedNode(LifecycleNodeMixin, BaseNode):
    """Node that destroys what `configure` created if that fails, and at ``cleanup``."""

    def __init__(self, name: str, parameters: Parameters) -> None:
        BaseNode.__init__(self, name, parameters)
        # Reentrant: the state can be asked for while a transition waits.
        LifecycleNodeMixin.__init__(self, callback_group=ReentrantCallbackGroup())
        self.answer_with(ChangeState, self._on_change_state)
        self._is_changing = False
        self._error: Exception | None = None
        self._bond: Any = None

    @property
    def state(self) -> str:
        """The name of the state: unconfigured, inactive, active or finalized."""
        label: str = self._state_machine.current_state[1]
        return label

    def start(self) -> None:
        """Configure and activate the node; it raises what they raise."""
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() is not SUCCESS and self._error is not None:
                raise self._error

    def destroy_node(self) -> None:
        """Free all that the node has, and destroy it, so that it leaves the graph at once."""
        last_state = LifecycleState(self.state, 0)
        # First, as a lifecycle manager calls them when the bond breaks, and waits without end.
        self._state_machine.destroy_when_not_in_use()
        for service in [*self.services]:
            self.destroy_service(service)
        if self.context.ok():
            self.on_shutdown(last_state)
        super().destroy_node()

    # What a node does in its transitions

    async def prepare(self, transition: str) -> bool:
        """Do what takes long before a transition that was asked for; False to refuse it."""
        return True

    def configure(self) -> None:
        """Create what the node needs."""

    def activate(self) -> None:
        """Begin to answer requests."""

    def deactivate(self) -> None:
        """Stop."""

    def cleanup(self) -> None:
        """Free what `configure` created, also if it failed."""

    # rclpy calls these

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure the node, or leave nothing behind."""
        self._kept = {*self._entities()}
        result = self._attempt("configure", self.configure)
        if result is not SUCCESS:
            self._attempt("cleanup", self._clean_up)
        return result

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Activate the node."""
        return self._attempt("activate", self.activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop the node, and end the bond."""
        self._break_bond()
        return self._attempt("deactivate", self.deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Undo `configure`."""
        return self._attempt("cleanup", self._clean_up)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop the node and free all that it has, whatever its state is."""
        if state.label == "active":
            self.on_deactivate(state)
        if state.label in ("active", "inactive"):
            self.on_cleanup(state)
        return SUCCESS

    def _attempt(self, what: str, function: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            function()
        except Exception as error:
            self._error = error
            self.get_logger().error(f"{what} failed: {str(error) or repr(error)}")
            return TransitionCallbackReturn.FAILURE
        return SUCCESS

    async def _on_change_state(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
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
                result = getattr(self, f"trigger_{label}")()
                response.success = result is SUCCESS
                if response.success and label == "activate":
                    self._form_bond()
        except Exception as error:  # the node must survive
            self.get_logger().error(f"{label} failed: {str(error) or repr(error)}")
        finally:
            self._is_changing = False
        return response

    # The bond, by which a lifecycle manager sees that the process lives

    def _form_bond(self) -> None:
        try:
            from bondpy.bondpy import Bond
        except ImportError:
            self.get_logger().info(
                "no bond: bondpy is not installed; apt install ros-jazzy-bondpy, or set "
                "bond_timeout to 0.0 in the lifecycle manager"
            )
            return
        self._bond = Bond(self, "bond", self.get_name())
        self._bond.heartbeat_period = HEARTBEAT_PERIOD
        self._bond.heartbeat_timeout = HEARTBEAT_TIMEOUT
        self._bond.start()

    def _break_bond(self) -> None:
        if self._bond is not None:
            self._bond.break_bond()
            # Else a publisher that ends at once takes its last message with it.
            self._bond.pub.wait_for_all_acked(Duration(seconds=0.2))
            self._bond.shutdown()
            # It has destroyed these, and the node still has them in its lists.
            self.destroy_subscription(self._bond.sub)
            self.destroy_publisher(self._bond.pub)
            self._bond = None

    # Entities

    def _clean_up(self) -> None:
        destroyers = (
            self.destroy_publisher,
            self.destroy_subscription,
            self.destroy_client,
            self.destroy_service,
            self.destroy_timer,
            self.destroy_guard_condition,
        )
        for entity in self._entities():
            # Each destroys what it knows. The rest are servers of actions; the handlers of events
            # are waitables until their publisher or subscription is destroyed.
            is_new = entity not in self._kept and not any(destroy(entity) for destroy in destroyers)
            if is_new and entity in {*self.waitables}:
                entity.destroy()
        self.cleanup()

    def _entities(self) -> list[Any]:
        """Return what the node has created."""
        waited_for = *self.publishers, *self.subscriptions, *self.clients, *self.services
        return [*waited_for, *self.timers, *self.guards, *self.waitables]
