"""A node that says what it cannot hear, and forgets places when the clock jumps back."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import copy
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

OVERRIDABLE = [QoSPolicyKind[name] for name in ("HISTORY", "DEPTH", "DURABILITY", "RELIABILITY")]
"""What parameters may change of each subscription."""

JUMP_BACK = JumpThreshold(min_forward=None, min_backward=Duration(seconds=-1))
"""As tf2 has it. Another clock, by ``use_sim_time``, counts as a jump, too."""


def best_effort(depth: int) -> QoSProfile:
    """Return the quality for sensors: reliable publishers and others are received."""
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT)


class ListeningNode(Node):
    """Node whose parameters may override the quality of service of its subscriptions.

    It calls the functions in `after_jump_back` when a bag loops or a simulator is reset.
    """

    def __init__(self, name: str, **options: Any) -> None:
        self._incompatible: set[str] = set()
        self._logged_problems: list[str] = []
        self.after_jump_back: set[Callable[[], None]] = set()
        super().__init__(name, **options)
        self._jumps = self.get_clock().create_jump_callback(JUMP_BACK, post_callback=self._on_jump)

    def _on_jump(self, jump: TimeJump) -> None:
        seconds = jump.delta.nanoseconds / 1e9
        what = f"jumped by {seconds:.6g} s" if seconds else "changed"
        self.get_logger().warning(
            f"the clock {what}: transforms and odometry from before are forgotten"
        )
        for forget in self.after_jump_back:
            forget()

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, **options: Any
    ) -> Subscription:
        """Create a subscription with the quality that parameters may override."""
        name = self.resolve_topic_name(topic)
        options["qos_overriding_options"] = QoSOverridingOptions(OVERRIDABLE)
        options["event_callbacks"] = SubscriptionEventCallbacks(
            incompatible_qos=lambda _: self._incompatible.add(name)
        )
        quality = copy(qos_profile)  # rclpy writes what the parameters say into it
        try:
            return super().create_subscription(msg_type, topic, callback, quality, **options)
        except RuntimeError as error:
            raise RuntimeError(
                f"cannot subscribe to {name} ({error}); give qos_overrides.{name}.subscription "
                "values that ROS knows, or none"
            ) from None

    def topic_problems(self) -> list[str]:
        """Say, and log once, which publishers are not received, and that odometry has several."""
        problems = [*self._topic_problems()]
        for problem in problems:
            if problem not in self._logged_problems:
                self.get_logger().warning(problem)
        self._logged_problems = problems
        return problems

    def _topic_problems(self) -> Iterator[str]:
        for subscription in self.subscriptions:
            topic = subscription.topic_name
            # To count is cheap; to ask who they are is not.
            several = subscription.msg_type is Odometry and self.count_publishers(topic) > 1
            if not several and topic not in self._incompatible:
                continue
            publishers = [
                (f"{each.node_namespace.rstrip('/')}/{each.node_name}", each.qos_profile)
                for each in self.get_publishers_info_by_topic(topic)
            ]
            if several:
                names = ", ".join(sorted(name for name, _ in publishers))
                yield (
                    f"{topic} has {len(publishers)} publishers ({names}), so the robot's place may "
                    "jump from one's to the other's; let one publish, or remap the others"
                )
            for name, offered in publishers:
                yield from _misfits(topic, name, offered, subscription.qos_profile)


def _misfits(topic: str, name: str, offered: QoSProfile, asked: QoSProfile) -> Iterator[str]:
    """Say which policies of a publisher offer less than a subscription asks for."""
    for policy, much, less in (
        ("durability", DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE),
        ("reliability", ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT),
    ):
        if (getattr(offered, policy), getattr(asked, policy)) == (less, much):
            yield (
                f"nothing of {name} is received on {topic}: its {policy} is {less.name.lower()}, "
                f"and {much.name.lower()} is asked for; let it publish so, or start this node with "
                f"the parameter qos_overrides.{topic}.subscription.{policy}:={less.name.lower()}"
            )
