"""Why a node does not receive what is published on its topics, or receives too much.

Or why another node may receive what is sent to it.
"""

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
# The name of a publisher's node that is not discovered yet, or not there any more.
UNKNOWN_NAME = "_NODE_NAME_UNKNOWN_"
KILLED = "a node that was killed counts for some 20 s more"


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
    """Yield a sentence for each problem of the topics that a node subscribes to.

    And one if other nodes have the node's name, and so its services.
    """
    yield from _problem_of_name(node)
    for subscription in node.subscriptions:
        yield from _problems_of(subscription, node)


def _problem_of_name(node: Node) -> Iterator[str]:
    """Yield a sentence if other nodes have the node's name."""
    name = node.get_name(), node.get_namespace()
    nodes = node.get_node_names_and_namespaces().count(name)
    if nodes > 1:
        yield (
            f"{nodes} nodes are called {node.get_fully_qualified_name()}, so another "
            "one may answer its requests; end the others, or start them with another "
            f"name (-r __node:=NAME) or namespace (-r __ns:=/NAME); {KILLED}"
        )


def _problems_of(subscription: Subscription, node: Node) -> Iterator[str]:
    """Yield a sentence for each problem of the publishers of a subscription's topic."""
    topic = subscription.topic_name
    misfits_by_publisher: list[tuple[str, list[Misfit]]] = []
    for publisher in node.get_publishers_info_by_topic(topic):
        if publisher.node_name == UNKNOWN_NAME:
            continue
        name = f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}"
        misfits = _misfits(publisher.qos_profile, subscription.qos_profile)
        misfits_by_publisher.append((name, misfits))
    received_names = [name for name, misfits in misfits_by_publisher if not misfits]
    effect = EFFECTS_OF_SEVERAL_PUBLISHERS.get(subscription.msg_type)
    if effect and len(received_names) > 1:
        names = ", ".join(sorted(received_names))
        has_namesakes = len({*received_names}) < len(received_names)
        hint = f"; {KILLED}" if has_namesakes else ""
        yield (
            f"{topic} has {len(received_names)} publishers ({names}), so {effect}; "
            f"let one publish, or remap the others{hint}"
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
