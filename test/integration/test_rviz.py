"""The shipped RViz configuration against the topics that the node docs name."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[2]
MESSAGES = {
    "rviz_default_plugins/Map": "nav_msgs/OccupancyGrid",
    "rviz_default_plugins/MarkerArray": "visualization_msgs/MarkerArray",
    "rviz_default_plugins/Path": "nav_msgs/Path",
    "rviz_default_plugins/SetGoal": "geometry_msgs/PoseStamped",
    "rviz_default_plugins/SetInitialPose": "geometry_msgs/PoseWithCovarianceStamped",
}
SHOWN = {"/map", "/plan", "/planner/value", "/planner/policy", "/trainer/episode"}
SET = {"/initialpose", "/goal_pose"}


def documented() -> dict[tuple[str, str], str]:
    """Return what docs/nodes.md says of topics: {(publishes or subscribes, name): type}."""
    found, node = {}, ""
    for line in (ROOT / "docs" / "nodes.md").read_text().splitlines():
        if heading := re.match(r"## \w+ \(`(\w+)`\)", line):
            node = heading[1]
        if row := re.match(r"\| (publishes|subscribes) \| `(\S+)` \| ([^|]+) \|", line):
            found[row[1], "/" + row[2].replace("~", node).lstrip("/")] = row[3]
    return found


def test_each_display_and_tool_has_a_topic_of_the_nodes() -> None:
    text = (ROOT / "rviz" / "ddqn_planner.rviz").read_text()
    manager: dict[str, Any] = yaml.safe_load(text)["Visualization Manager"]
    displays = {display["Topic"]["Value"]: display for display in manager["Displays"]}
    tools = {tool["Topic"]["Value"]: tool for tool in manager["Tools"] if "Topic" in tool}
    assert (set(displays), set(tools)) == (SHOWN, SET)
    for way, entries in (("publishes", displays), ("subscribes", tools)):
        for name, entry in entries.items():
            message_type, _, latched = documented()[way, name].partition(", ")
            assert MESSAGES[entry["Class"]] == message_type
            durability = "Transient Local" if latched == "latched" else "Volatile"
            assert entry["Topic"]["Durability Policy"] == durability
            assert entry["Topic"]["Reliability Policy"] == "Reliable"
    assert all(display["Enabled"] for display in displays.values())
    assert displays["/map"]["Draw Behind"]
    value = displays["/planner/value"]
    assert (value["Color Scheme"], value["Draw Behind"]) == ("costmap", False)
    assert 0 < value["Alpha"] < 1
    assert manager["Global Options"]["Fixed Frame"] == "map"
    assert manager["Views"]["Current"]["Class"] == "rviz_default_plugins/TopDownOrtho"
