"""Why a node does not receive what is published on its topics, or receives too much."""

from collections.abc import Iterator
from typing import NamedTuple

from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

# What happens if several nodes publish a topic of a type that one node should publish.
EFFECTS_OF_SEVERAL_PUBLISHERS: dict[object, str] = {
    Odometry: "the robot's place may jump from one's to the other's",
    OccupancyGrid: "each message replaces the last one of the other",
}


class Misfit(NamedTuple):
    """A policy by which a publisher offers less than a subscription requests."""

    policy: str
    offered: str
    requested: str


MISFITS = (
    Misfit("durability", "volatile", "transient_local"),
    Misfit("reliability", "best_effort", "reliable"),
)


def topic_problems(node: Node) -> Iterator[str]:
    """Yield a sentence for each problem of the topics that a node subscribes to."""
    for subscription in node.subscriptions:
        yield from _problems_of(subscription, node)


def _problems_of(subscription: Subscription, node: Node) -> Iterator[str]:
    """Yield a sentence for each problem of the publishers of a subscription's topic."""
    topic = subscription.topic_name
    misfits_by_publisher: list[tuple[str, list[Misfit]]] = []
    for publisher in node.get_publishers_info_by_topic(topic):
        name = f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}"
        misfits = _misfits(publisher.qos_profile, subscription.qos_profile)
        misfits_by_publisher.append((name, misfits))
    received_names = [name for name, misfits in misfits_by_publisher if not misfits]
    effect = EFFECTS_OF_SEVERAL_PUBLISHERS.get(subscription.msg_type)
    if effect and len(received_names) > 1:
        names = ", ".join(sorted(received_names))
        yield (
            f"{topic} has {len(received_names)} publishers ({names}), so {effect}; "
            "let one publish, or remap the others"
        )
    for name, misfits in misfits_by_publisher:
        for policy, offered, requested in misfits:
            parameter = f"qos_overrides.{topic}.subscription.{policy}"
            yield (
                f"nothing of {name} is received on {topic}: its {policy} is {offered}, "
                f"and {requested} is asked for; let it publish so, or start this node "
                f"with the parameter {parameter}:={offered}"
            )


def _misfits(offered: QoSProfile, requested: QoSProfile) -> list[Misfit]:
    """Return the policies for which a subscription receives nothing of a publisher.

    `offered` is the publisher's quality of service and `requested` the subscription's;
    the list is empty if they fit.
    """
    return [
        misfit
        for misfit in MISFITS
        if _policy(offered, misfit.policy) == misfit.offered
        and _policy(requested, misfit.policy) == misfit.requested
    ]


def _policy(quality: QoSProfile, name: str) -> str:
    """Return the value of a policy as users write it, such as "best_effort"."""
    return str(getattr(quality, name).name).lower()
