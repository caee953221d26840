"""Starts the planner on Nav2's global costmap, for a lifecycle manager; see docs/nav2.md."""

from launch import LaunchDescription
from launch_ros.actions import Node

PARAMETERS = {
    "autostart": False,  # the lifecycle manager configures and activates it
    "map_type": "costmap",  # 99 and 100 are closed, 1 to 98 cost more
    "allow_unknown": True,  # as NavFn's default
    "start_source": "tf",  # for requests without a start
    "robot_frame": "base_link",
    "planner_id": "GridBased",  # the name in Nav2's behavior trees
}


def generate_launch_description():
    """Return the planner's description."""
    return LaunchDescription(
        [
            Node(
                package="ddqn_planner",
                executable="planner_node",
                name="ddqn_planner",
                parameters=[PARAMETERS],
                remappings=[("map", "/global_costmap/costmap"), ("goal_pose", "unused/goal_pose")],
            )
        ]
    )
