"""What RViz shows of a Q field: its value as a map, its policy as arrows."""

from __future__ import annotations

from nav_msgs.msg import OccupancyGrid
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.conversions import unknown_value_message, value_message
from ddqn_planner.nodes.markers import no_policy_message, policy_message
from ddqn_planner.nodes.runtime import LATCHED, STEADY, Worker
from ddqn_planner.planning import QField

LOOK_PERIOD = 0.1
"""Seconds between two looks whether somebody subscribes to the policy."""


class FieldDisplay:
    """Publishes ``~/value`` and, while somebody subscribes, ``~/policy``.

    Parameters
    ----------
    node : Node
    worker : Worker
        Computes both messages.
    """

    def __init__(self, node: Node, worker: Worker) -> None:
        self._worker = worker
        self._logger = node.get_logger()
        self._shown: tuple[QField, GridMap, Header] | None = None
        self._shows_again = False
        self._published_policy: QField | None = None
        self._value_publisher = node.create_publisher(OccupancyGrid, "~/value", LATCHED)
        self._policy_publisher = node.create_publisher(MarkerArray, "~/policy", LATCHED)
        group = MutuallyExclusiveCallbackGroup()
        node.create_timer(LOOK_PERIOD, self._show_policy, group, clock=STEADY)

    def show_again(self) -> None:
        """Publish the next field even if it is shown already."""
        self._shows_again = True

    async def show(self, field: QField, grid: GridMap, header: Header) -> None:
        """Publish a field's value unless it is shown already."""
        if self._shows_again or self._shown is None or self._shown[:2] != (field, grid):
            value = await self._worker.call(value_message, field, grid, header)
            self._value_publisher.publish(value)
            self._shown, self._shows_again = (field, grid, header), False

    def clear(self, now: Header) -> None:
        """Publish an unknown value and no policy: those that are shown are of another goal."""
        if self._shown is None:
            return
        _, grid, header = self._shown
        self._shown = None
        header = Header(stamp=now.stamp, frame_id=header.frame_id)
        self._value_publisher.publish(unknown_value_message(grid, header))
        if self._published_policy is not None:
            self._published_policy = None
            self._policy_publisher.publish(no_policy_message(header))

    async def _show_policy(self) -> None:
        """Publish the policy of the field that is shown, if somebody subscribes to it."""
        shown = self._shown
        if shown is None or not self._policy_publisher.get_subscription_count():
            return
        field, grid, header = shown
        if self._published_policy is field:
            return
        self._published_policy = field
        try:
            policy = await self._worker.call(policy_message, field, grid, header)
        except Exception as error:  # as when no memory is left
            self._logger.error(f"the policy cannot be shown ({error!r}); give a smaller map")
            return
        if self._shown is shown:
            self._policy_publisher.publish(policy)
