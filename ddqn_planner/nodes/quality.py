"""Qualities of service of topics and services."""

from rcl_interfaces.msg import SetParametersResult
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

# Late subscribers receive the last message too: for maps, plans, saved models.
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

# For changes of what a latched message told: none is lost while a node is busy.
CHANGING = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)

# The middleware drops requests that do not fit into the queue, and the node cannot see
# the loss: ROS's default of ten lost half of 20 requests. Fast DDS keeps 5,000 messages
# by default.
SERVICE_QUALITY = QoSProfile(depth=5000)

GREATEST_DEPTH = 2**31 - 1  # of a queue in DDS
# The policies of a subscription that parameters may set.
OVERRIDABLE = [
    QoSPolicyKind[name] for name in ("HISTORY", "DEPTH", "DURABILITY", "RELIABILITY")
]


def overriding_options(topic: str) -> QoSOverridingOptions:
    """Let parameters override policies of the subscription to a topic.

    The values of these parameters are checked: a ValueError says what to give.
    """

    def check_depth(quality: QoSProfile) -> SetParametersResult:
        """Accept a quality of service, or raise a ValueError for its depth."""
        if not 0 <= quality.depth <= GREATEST_DEPTH:
            parameter = f"qos_overrides.{topic}.subscription.depth"
            remedy = f"give 0 to {GREATEST_DEPTH}"
            raise ValueError(f"{parameter} is {quality.depth}; {remedy}")
        return SetParametersResult(successful=True)

    return QoSOverridingOptions(OVERRIDABLE, callback=check_depth)
