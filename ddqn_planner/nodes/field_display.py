"""What RViz shows of a Q field: its value as a map, its policy as arrows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from nav_msgs.msg import OccupancyGrid
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.exceptions import InvalidHandle
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
    """A Q field, perhaps not computed yet, or none without a planner; and its messages' header."""

    planner: Planner | None
    grid: GridMap
    goal: Cell
    move_rule: MoveRule
    header: Header


@dataclass
class Layer:
    """A topic, the function that makes its messages, and whether the last one shows a field."""

    name: str
    publisher: Publisher
    message: Callable[..., Any]
    is_due: bool = False
    has_field: bool = False


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
            for layer in self._layers:
                layer.is_due = True

    def clear(self, now: Header) -> None:
        """Show no field: the one that is shown is of another goal."""
        if self._shown is not None:
            header = Header(stamp=now.stamp, frame_id=self._shown.header.frame_id)
            self.show(self._shown._replace(planner=None, header=header))

    async def _on_look(self) -> None:
        for layer in self._layers:
            shown = self._shown
            if shown is None or not layer.is_due:
                continue
            has_field = shown.planner is not None
            # A field that is latched is cleared even if nobody subscribes now.
            if not (layer.publisher.get_subscription_count() if has_field else layer.has_field):
                continue
            layer.is_due, layer.has_field = False, has_field
            try:
                layer.publisher.publish(await self._worker.call(_message, layer, shown))
            except InvalidHandle:  # cleaned up meanwhile
                return
            except Exception as error:  # as when no memory is left: the node must survive
                reason = f"({error!r}); give a smaller map"
                self._logger.error(f"the {layer.name} cannot be shown {reason}")


def _message(layer: Layer, shown: Shown) -> Any:
    planner, grid, goal, move_rule, header = shown
    field = planner and planner.q_field(grid, goal, move_rule)
    return layer.message(field, grid, header)
