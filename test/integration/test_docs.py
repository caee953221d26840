"""docs/nodes.md against the running nodes: each topic, service and parameter, and no other."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from client import wait_for
from rcl_interfaces.msg import ParameterDescriptor, ParameterType
from rcl_interfaces.srv import DescribeParameters, ListParameters

DOCS = (Path(__file__).resolve().parents[2] / "docs" / "nodes.md").read_text(encoding="utf-8")
NODES = ["map_server", "planner", "trainer"]
TYPES = {
    ParameterType.PARAMETER_BOOL: "bool",
    ParameterType.PARAMETER_INTEGER: "integer",
    ParameterType.PARAMETER_DOUBLE: "double",
    ParameterType.PARAMETER_STRING: "string",
}
OF_EVERY_NODE = {
    "/rosout",
    "/parameter_events",
    "use_sim_time",
    "start_type_description_service",
}


DRIVING = {
    "odom",
    "navigate_to_pose/_action/status",
    "~/experience_saved",
    "~/slowness",
    "~/forget",
}
"""What the trainer has only where it learns from driving."""


def rows_of(node: str) -> list[list[str]]:
    """The cells of the tables below a node's heading."""
    section = re.split(r"^## ", DOCS, flags=re.MULTILINE)
    (text,) = (part for part in section if part.startswith(f"{node}_node"))
    return [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in text.splitlines()
        if line.startswith("| ")
    ]


def described(client: Any, node: str) -> dict[str, list[str]]:
    """What a running node says of each parameter: its type, default and range."""
    names = client.call(ListParameters, f"{node}/list_parameters").result.names
    names = [name for name in names if name not in OF_EVERY_NODE and "qos_over" not in name]
    request = DescribeParameters.Request(names=names)
    answer = client.call(DescribeParameters, f"{node}/describe_parameters", request)
    return {
        entry.name: [
            TYPES[entry.type],
            written(client.get_parameter(node, entry.name)),
            range_of(entry),
        ]
        for entry in answer.descriptors
    }


def written(value: Any) -> str:
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return f"`{text}`".replace("''", "")


def range_of(entry: ParameterDescriptor) -> str:
    parts = [f"{r.from_value:g} to {r.to_value:g}" for r in entry.floating_point_range]
    parts += [f"{r.from_value} to {r.to_value}" for r in entry.integer_range]
    parts += [entry.additional_constraints] if entry.additional_constraints else []
    return "; ".join([*parts, *(["read-only"] if entry.read_only else [])])


@pytest.mark.parametrize("node", NODES)
def test_each_topic_service_and_parameter_is_described_as_it_is(
    run_node: Any, make_client: Callable[[str], Any], node: str, tmp_path: Path
) -> None:
    client, namespace = make_client("/described"), "/described"
    documented = documented_topics(node)
    parameters = {"follow_trainer": True} if node == "planner" else {}
    driving: set[tuple[str, str, str]] = set()
    if node == "trainer":
        driving = topics_of_driving(
            run_node, make_client("/described/driving"), documented, tmp_path
        )
    with run_node(f"{node}_node", parameters, namespace=namespace):
        found = described(client, node)
        if node == "planner":
            found["follow_trainer"][1] = "`false`"
        # The client may discover the last of them late.
        with suppress(TimeoutError):
            wait_for("documented topics", lambda: driving | topics_of(client, node) == documented)
        assert documented == driving | topics_of(client, node)
    of_parameters = {row[0].strip("`"): row[1:4] for row in rows_of(node) if len(row) == 5}
    del of_parameters["parameter"]
    assert of_parameters == found


def topics_of_driving(
    run_node: Any, client: Any, documented: set[tuple[str, str, str]], folder: Path
) -> set[tuple[str, str, str]]:
    """What a trainer has that learns from driving."""
    parameters = {"learn_from": "driving", "output_folder": str(folder / "drives")}
    expected = {row for row in documented if row[1] in DRIVING}
    with run_node("trainer_node", parameters, namespace=client.node.get_namespace()):
        client.call(ListParameters, "trainer/list_parameters")
        wait_for("topics of driving", lambda: topics_of(client, "trainer") >= expected)
        return topics_of(client, "trainer")


def topics_of(client: Any, node: str) -> set[tuple[str, str, str]]:
    """What a client has discovered of a node."""
    return {
        (kind, re.sub(f"^{node}/", "~/", name), message)
        for kind, name, message in client.entities(node)
        if name not in OF_EVERY_NODE and "parameter" not in name and "type_desc" not in name
        # An action's parts have no rows of their own.
        if kind == "subscribes" or "/_action/" not in name
    }


def documented_topics(node: str) -> set[tuple[str, str, str]]:
    """The topics and services in the tables below a node's heading."""
    documented = {
        (row[0], row[1].strip("`"), re.sub(r"/(?=\w+$)", "/msg/", row[2].split(",")[0]))
        for row in rows_of(node)
        if row[0] in ("publishes", "subscribes", "service")
        and importlib.util.find_spec(row[2].split("/")[0])  # some packages may be missing
    }
    documented = {
        (kind, topic, message.replace("/msg/", "/srv/") if kind == "service" else message)
        for kind, topic, message in documented
    }
    if node == "planner":
        documented.remove(
            ("subscribes", "odom", "nav_msgs/msg/Odometry")
        )  # by another start_source
    return documented
