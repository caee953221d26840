"""The nodes as docs/nodes.md tells of them, and their parameters: no request ends a node."""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from client import Client, wait_for
from rcl_interfaces import srv
from rcl_interfaces.msg import Parameter, ParameterDescriptor, ParameterType, ParameterValue

from ddqn_planner.nodes import map_server_node
from ddqn_planner.nodes.driving import NAVIGATION

DOCS = (Path(__file__).resolve().parents[2] / "docs" / "nodes.md").read_text(encoding="utf-8")
NODES = ["map_server", "planner", "trainer"]
NAMES = ["", "no_such", "a.b", "/", "ü" * 300]
TYPES = {
    ParameterType.PARAMETER_BOOL: "bool",
    ParameterType.PARAMETER_INTEGER: "integer",
    ParameterType.PARAMETER_DOUBLE: "double",
    ParameterType.PARAMETER_STRING: "string",
}
OF_EVERY_NODE = {"/rosout", "/parameter_events", "use_sim_time", "start_type_description_service"}
OF_DRIVING = {"~/experience_saved", "~/slowness", "~/forget", "odom", NAVIGATION}
"""What the trainer has only where it learns from driving."""


@dataclass
class Running:
    """A node that runs, and its client."""

    name: str
    client: Client
    node: Any

    def call(self, kind: str, **request: Any) -> Any:
        service = getattr(srv, kind.title().replace("_", ""))
        return self.client.call(service, f"{self.name}/{kind}", service.Request(**request))

    def topics(self) -> set[tuple[str, str, str]]:
        """What the client has discovered of the node."""
        return {
            (kind, re.sub(f"^{self.name}/", "~/", name), message)
            for kind, name, message in self.client.entities(self.name)
            if name not in OF_EVERY_NODE and "parameter" not in name and "type_desc" not in name
            # An action's parts have no rows of their own.
            if kind == "subscribes" or "/_action/" not in name
        }


@pytest.fixture(scope="module", params=NODES)
def running(request: pytest.FixtureRequest, run_node: Any, make_client: Any) -> Iterator[Running]:
    name, namespace = request.param, f"/described/{request.param}"
    parameters = {"follow_trainer": True} if name == "planner" else {}
    with run_node(f"{name}_node", parameters, namespace=namespace) as node:
        yield Running(name, make_client(namespace), node)


def rows_of(node: str) -> list[list[str]]:
    """The cells of the tables below a node's heading."""
    (section,) = (part for part in DOCS.split("\n## ") if part.startswith(f"{node}_node"))
    rows = (line for line in section.splitlines() if line.startswith("| "))
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]


def documented_parameters(node: str) -> dict[str, list[str]]:
    """The type, default and range of each parameter."""
    rows = {row[0].strip("`"): row[1:4] for row in rows_of(node) if len(row) == 5}
    del rows["parameter"]
    return rows


def documented_topics(node: str) -> set[tuple[str, str, str]]:
    """The topics and services in the tables below a node's heading."""
    documented = set()
    for row in rows_of(node):
        if row[0] not in ("publishes", "subscribes", "service"):
            continue
        package, _, message = row[2].split(",")[0].partition("/")
        if importlib.util.find_spec(package):  # some may be missing
            folder = "srv" if row[0] == "service" else "msg"
            documented.add((row[0], row[1].strip("`"), f"{package}/{folder}/{message}"))
    if node == "planner":  # by another start_source
        documented.remove(("subscribes", "odom", "nav_msgs/msg/Odometry"))
    return documented


def range_of(entry: ParameterDescriptor) -> str:
    parts = [f"{r.from_value:g} to {r.to_value:g}" for r in entry.floating_point_range]
    parts += [f"{r.from_value} to {r.to_value}" for r in entry.integer_range]
    parts += [entry.additional_constraints, "read-only" * entry.read_only]
    return "; ".join(filter(None, parts))


def test_each_parameter_is_documented_as_it_is(running: Running) -> None:
    names = running.call("list_parameters").result.names
    names = [name for name in names if name not in OF_EVERY_NODE and "qos_over" not in name]
    described = running.call("describe_parameters", names=names)
    found = {}
    for entry in described.descriptors:
        assert entry.description
        value = running.client.get_parameter(running.name, entry.name)
        text = str(value).lower() if isinstance(value, bool) else repr(value)
        default = f"`{text}`".replace("''", "")
        found[entry.name] = [TYPES[entry.type], default, range_of(entry)]
    if running.name == "planner":
        found["follow_trainer"][1] = "`false`"
    assert found == documented_parameters(running.name)


def test_each_topic_and_service_is_documented_as_it_is(
    running: Running, run_node: Any, make_client: Callable[[str], Client], tmp_path: Path
) -> None:
    documented, more = documented_topics(running.name), set()
    if running.name == "trainer":
        parameters = {"learn_from": "driving", "output_folder": str(tmp_path / "drives")}
        with run_node("trainer_node", parameters, namespace="/driving") as node:
            driving = Running("trainer", make_client("/driving"), node)
            driving.call("list_parameters")
            expected = {row for row in documented if row[1] in OF_DRIVING}
            wait_for("topics of driving", lambda: driving.topics() >= expected)
            more = driving.topics()
    # The client may discover the last of them late.
    with suppress(TimeoutError):
        wait_for("documented topics", lambda: more | running.topics() == documented)
    assert documented == more | running.topics()


def test_no_request_for_parameters_ends_a_node(running: Running) -> None:
    unknown_type = Parameter(name="use_sim_time", value=ParameterValue(type=77))
    for bad, reason in (
        (unknown_type, "77.*ParameterType"),
        (Parameter(value=ParameterValue(type=1, bool_value=True)), "no name; give one"),
        (Parameter(name="use_sim_time"), "."),
        (Parameter(name="no_such", value=ParameterValue(type=1)), "undeclared"),
    ):
        (result,) = running.call("set_parameters", parameters=[bad]).results
        for refused in (result, running.call("set_parameters_atomically", parameters=[bad]).result):
            assert not refused.successful
            assert re.search(reason, refused.reason)
    good = Parameter(name="use_sim_time", value=ParameterValue(type=1))
    results = running.call("set_parameters", parameters=[unknown_type, good]).results
    assert [result.successful for result in results] == [False, True]
    assert running.call("set_parameters").results == []
    assert running.call("set_parameters_atomically").result.successful
    running.call("list_parameters", prefixes=NAMES, depth=2**64 - 1)
    running.call("describe_parameters", names=NAMES)
    running.call("get_parameter_types", names=NAMES)
    running.call("get_parameters", names=NAMES)
    names = running.call("list_parameters").result.names
    values = running.call("get_parameters", names=names).values
    assert len(values) == len(names) > 3
    assert "Traceback" not in running.node.log


@pytest.mark.parametrize(("name", "option"), [*product(NODES, ["--help", "-h"])])
def test_help_says_of_each_parameter_what_the_docs_say_and_starts_no_node(
    name: str, option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any
) -> None:
    # With such a domain, such parameters and in such a folder no node starts.
    arguments = [option, "--ros-args", "-p", "model:=no_such", "-p", "map_file:=no_such"]
    monkeypatch.setenv("ROS_DOMAIN_ID", "abc")
    monkeypatch.setattr(sys, "argv", [f"{name}_node", *arguments])
    monkeypatch.chdir(tmp_path)
    assert import_module(f"ddqn_planner.nodes.{name}_node").main() == 0
    helped = capfd.readouterr()
    assert helped.err == ""
    assert list(tmp_path.iterdir()) == []
    assert f"usage: {name}_node" in helped.out
    printed = re.findall(r"^  (\w+): (.*)\n      \S.*", helped.out, re.MULTILINE)
    expected = {}
    for parameter, (kind, default, limits) in documented_parameters(name).items():
        parts = f"{kind}, default {default.strip('`') or repr('')}", limits
        expected[parameter] = "; ".join(filter(None, parts))
    assert dict(printed) == expected


SECURITY = {"ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_STRATEGY": "Enforce"}
SECURITY |= {"ROS_SECURITY_KEYSTORE": "/no/such/keystore"}


def test_what_ros_cannot_start_with_is_said_and_ends_with_1(log_of_refused_start: Any) -> None:
    for arguments, environment, reason in (
        (["-p", "model"], {}, "model"),
        (["--params-file", "/no/such.yaml"], {}, "such.yaml"),
        ([], {"ROS_DOMAIN_ID": "abc"}, "ROS_DOMAIN_ID"),
        (["--enclave", "/nobody"], SECURITY, "SECURITY|security|keystore|enclave"),
    ):
        with pytest.MonkeyPatch.context() as patch:
            for variable, value in environment.items():
                patch.setenv(variable, value)
            log = log_of_refused_start(map_server_node.main, arguments=arguments)
        assert re.search(f"cannot start: .*({reason})", log)
        assert "Traceback" not in log
