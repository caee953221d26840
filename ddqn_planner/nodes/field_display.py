"""What RViz shows of a Q field: its value as a map, its policy as arrows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from nav_msgs.msg import OccupancyGrid
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.nodes.conversions import value_message
from ddqn_planner.nodes.markers import policy_message
from ddqn_planner.nodes.runtime import LATCHED, STEADY, Worker
from ddqn_planner.planning import Planner

LOOK_PERIOD = 0.1
"""Seconds between two looks whether there is something new to show, and somebody subscribes."""


class Shown(NamedTuple):
    """A Q field, perhaps not computed yet; without a goal, none. All messages have the header."""

    planner: Planner
    grid: GridMap
    goal: Cell | None
    move_rule: MoveRule
    header: Header


@dataclass
class Layer:
    """A topic that shows the field, the function that makes its messages, and what it shows."""

    name: str
    publisher: Publisher
    message: Callable[..., Any]
    shown: Shown | None = None


class FieldDisplay:
    """Publishes ``~/value`` and ``~/policy``, and computes nothing for one without subscribers."""

    def __init__(self, node: Node) -> None:
        self._logger = node.get_logger()
        # Its own thread: neither requests nor maps wait for a field that is only shown.
        self._worker = Worker(node)
        self._shown: Shown | None = None
        self._shows_again = False
        self._layers = [
            Layer(name, node.create_publisher(message_type, f"~/{name}", LATCHED), message)
            for name, message_type, message in (
                ("value", OccupancyGrid, value_message),
                ("policy", MarkerArray, policy_message),
            )
        ]
        group = MutuallyExclusiveCallbackGroup()
        node.create_timer(LOOK_PERIOD, self._on_look, group, clock=STEADY)

    def show_again(self) -> None:
        """Publish the next field even if it is shown already."""
        self._shows_again = True

    def show(self, shown: Shown) -> None:
        """Show a field from now on."""
        if self._shows_again or self._shown is None or self._shown[:-1] != shown[:-1]:
            self._shown, self._shows_again = shown, False

    def clear(self, now: Header) -> None:
        """Show no field: the one that is shown is of another goal."""
        if self._shown is not None and self._shown.goal is not None:
            header = Header(stamp=now.stamp, frame_id=self._shown.header.frame_id)
            self._shown = self._shown._replace(goal=None, header=header)

    async def _on_look(self) -> None:
        for layer in self._layers:
            shown = self._shown
            if shown is None or shown is layer.shown:
                continue
            # The last message is latched, so it is replaced even if nobody subscribes now.
            if not (layer.publisher.get_subscription_count() if shown.goal else layer.shown):
                continue
            layer.shown = shown
            try:
                layer.publisher.publish(await self._worker.call(_message, layer, shown))
            except Exception as error:  # as when no memory is left: the node must survive
                reason = f"({error!r}); give a smaller map"
                self._logger.error(f"the {layer.name} cannot be shown {reason}")


def _message(layer: Layer, shown: Shown) -> Any:
    field = shown.goal and shown.planner.q_field(shown.grid, shown.goal, shown.move_rule)
    return layer.message(field, shown.grid, shown.header)
