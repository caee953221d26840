"""The shipped RViz configuration against the topics that the node docs name."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
MESSAGES = {
    "rviz_default_plugins/Map": "nav_msgs/OccupancyGrid",
    "rviz_default_plugins/MarkerArray": "visualization_msgs/MarkerArray",
    "rviz_default_plugins/Path": "nav_msgs/Path",
    "rviz_default_plugins/SetGoal": "geometry_msgs/PoseStamped",
    "rviz_default_plugins/SetInitialPose": "geometry_msgs/PoseWithCovarianceStamped",
}


@pytest.fixture(scope="module")
def manager() -> dict[str, Any]:
    path = ROOT / "rviz" / "ddqn_planner.rviz"
    manager: dict[str, Any] = yaml.safe_load(path.read_text())["Visualization Manager"]
    return manager


@pytest.fixture(scope="module")
def documented() -> dict[str, dict[str, str]]:
    """{"publishes" or "subscribes": {topic: type, and whether it is latched}}"""
    found: dict[str, dict[str, str]] = {"publishes": {}, "subscribes": {}}
    node = ""
    for line in (ROOT / "docs" / "nodes.md").read_text().splitlines():
        if heading := re.match(r"## \w+ \(`(\w+)`\)", line):
            node = heading[1]
        if row := re.match(r"\| (publishes|subscribes) \| `(\S+)` \| ([^|]+) \|", line):
            topic = "/" + row[2].replace("~", node).lstrip("/")
            found[row[1]][topic] = row[3]
    return found


def expect(entry: dict[str, Any], topics: dict[str, str]) -> None:
    """See that display or tool and docs agree on topic, type and quality of service."""
    topic = entry["Topic"]
    message_type, _, latched = topics[topic["Value"]].partition(", ")
    assert MESSAGES[entry["Class"]] == message_type
    durability = "Transient Local" if latched == "latched" else "Volatile"
    assert topic["Durability Policy"] == durability
    assert topic["Reliability Policy"] == "Reliable"


def test_each_display_shows_a_topic_that_is_published(
    manager: dict[str, Any], documented: dict[str, dict[str, str]]
) -> None:
    displays = {display["Topic"]["Value"]: display for display in manager["Displays"]}
    topics = {"/map", "/plan", "/planner/value", "/planner/policy", "/trainer/episode"}
    assert set(displays) == topics
    for display in displays.values():
        expect(display, documented["publishes"])
        assert display["Enabled"]
    assert displays["/map"]["Draw Behind"]
    value = displays["/planner/value"]
    assert value["Color Scheme"] == "costmap"
    assert not value["Draw Behind"]
    assert 0 < value["Alpha"] < 1


def test_each_tool_sets_a_topic_that_is_heard(
    manager: dict[str, Any], documented: dict[str, dict[str, str]]
) -> None:
    tools = {tool["Topic"]["Value"]: tool for tool in manager["Tools"] if "Topic" in tool}
    assert set(tools) == {"/initialpose", "/goal_pose"}
    for tool in tools.values():
        expect(tool, documented["subscribes"])


def test_the_map_is_seen_from_above(manager: dict[str, Any]) -> None:
    assert manager["Global Options"]["Fixed Frame"] == "map"
    assert manager["Views"]["Current"]["Class"] == "rviz_default_plugins/TopDownOrtho"
