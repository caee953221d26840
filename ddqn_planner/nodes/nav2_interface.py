"""Nav2's planning actions and its service, for a node where nav2_msgs is installed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.action.server import ActionServer
from rclpy.callback_groups import ReentrantCallbackGroup

from ddqn_planner.nodes.path_action import PathAction, Plan
from ddqn_planner.nodes.runtime import SERVICE_QUALITY, BaseNode

QUEUES: dict[str, Any] = {
    f"{service}_service_qos_profile": SERVICE_QUALITY for service in ("goal", "cancel", "result")
}
"""Those of an action's services: without them, goals are lost like requests."""

RESULT_TIMEOUT = 5
"""Seconds for which a result is kept. Each status message names all goals whose results are kept:
rclpy's 900 would slow down clients, and fill the memory."""


def serve_nav2(
    node: BaseNode, is_active: Callable[[], bool], plan: Plan, on_is_path_valid: Callable[..., Any]
) -> None:
    """Create Nav2's actions and service, or log what is missing."""
    try:
        from nav2_msgs.action import ComputePathThroughPoses, ComputePathToPose
        from nav2_msgs.srv import IsPathValid
    except ImportError as error:
        node.get_logger().info(
            f"no actions for Nav2 ({error}); to have them: apt install ros-jazzy-nav2-msgs"
        )
        return
    # Reentrant: the newest goal must be able to preempt another one.
    group = ReentrantCallbackGroup()
    for name, kind in (
        ("compute_path_to_pose", ComputePathToPose),
        ("compute_path_through_poses", ComputePathThroughPoses),
    ):
        action = PathAction(kind.Result, kind.Result.UNKNOWN, is_active, plan)
        ActionServer(
            node,
            kind,
            name,
            action.execute,
            callback_group=group,
            goal_callback=action.accept,
            handle_accepted_callback=action.begin,
            cancel_callback=action.cancel,
            result_timeout=RESULT_TIMEOUT,
            **QUEUES,
        )
    node.create_service(IsPathValid, "is_path_valid", on_is_path_valid, callback_group=group)
