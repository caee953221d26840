"""What a node says of other nodes that share its name or its topics."""

from types import SimpleNamespace
from typing import Any

from nav_msgs.msg import OccupancyGrid

from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.nodes.topic_problems import UNKNOWN_NAME, topic_problems


def problems(nodes: list[str], publishers: list[str]) -> str:
    """Return what a planner says beside nodes and publishers of its map."""
    map_subscription = SimpleNamespace(
        topic_name="/map", msg_type=OccupancyGrid, qos_profile=LATCHED
    )
    infos = [
        SimpleNamespace(node_namespace="/", node_name=name, qos_profile=LATCHED)
        for name in publishers
    ]
    node: Any = SimpleNamespace(
        subscriptions=[map_subscription],
        get_name=lambda: "planner",
        get_namespace=lambda: "/",
        get_fully_qualified_name=lambda: "/planner",
        get_node_names_and_namespaces=lambda: [(name, "/") for name in nodes],
        get_publishers_info_by_topic=lambda _: infos,
    )
    return "; ".join(topic_problems(node))


def test_a_second_node_of_the_same_name_is_told_with_the_remedy() -> None:
    assert not problems(["planner", "planner2", "map_server"], ["map_server"])
    told = problems(["planner", "planner", "map_server"], ["map_server"])
    assert "2 nodes are called /planner" in told
    assert "-r __node:=NAME" in told
    assert "killed" in told


def test_a_map_server_that_was_killed_and_started_again_is_told_as_such() -> None:
    assert not problems(["planner"], ["map_server", UNKNOWN_NAME])
    others = problems(["planner"], ["map_server", "slam"])
    assert "/map has 2 publishers (/map_server, /slam)" in others
    assert "killed" not in others
    assert "killed" in problems(["planner"], ["map_server", "map_server"])
