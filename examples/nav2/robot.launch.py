"""Starts Nav2 with the actions of its planner_server out of the way; see docs/nav2.md."""

from launch import LaunchDescription
from launch.actions import GroupAction, IncludeLaunchDescription
from launch.substitutions import PathJoinSubstitution
from launch_ros.actions import SetRemap
from launch_ros.substitutions import FindPackageShare

ACTIONS = ("compute_path_to_pose", "compute_path_through_poses")
PARTS = ("send_goal", "cancel_goal", "get_result", "feedback", "status")
NAMES = [f"{action}/_action/{part}" for action in ACTIONS for part in PARTS] + ["is_path_valid"]


def generate_launch_description():
    """Return Nav2's description with the rules."""
    nav2 = PathJoinSubstitution([FindPackageShare("nav2_bringup"), "launch", "bringup_launch.py"])
    rules = [SetRemap(f"planner_server:{name}", f"unused/{name}") for name in NAMES]
    return LaunchDescription([GroupAction([*rules, IncludeLaunchDescription(nav2)])])
