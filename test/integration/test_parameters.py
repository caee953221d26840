"""The nodes and RViz as docs/nodes.md tells of them; no request for parameters ends a
node.
"""

import importlib.util
import json
import re
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import yaml
from client import Client, wait_for
from rcl_interfaces import srv
from rcl_interfaces.msg import Parameter, ParameterDescriptor, ParameterValue

from ddqn_planner.nodes.driving import NAVIGATION
from ddqn_planner.nodes.poses import has_tf

ROOT = Path(__file__).resolve().parents[2]
DOCS = (ROOT / "docs" / "nodes.md").read_text(encoding="utf-8")
NODES = ["map_server", "planner", "trainer"]
NAMES = ["", "no_such", "a.b", "/", "ü" * 300]
TYPES = {1: "bool", 2: "integer", 3: "double", 4: "string", 9: "string_array"}
OF_EVERY_NODE = {
    "/rosout",
    "/parameter_events",
    "use_sim_time",
    "start_type_description_service",
}
OF_DRIVING = {
    "~/experience",
    "~/experience/send",
    "~/experience_saved",
    "~/slowness",
    "~/forget",
    "odom",
    NAVIGATION,
}
"""What the trainer has only where it learns from driving."""


@dataclass
class Running:
    """A node that runs, and its client."""

    name: str
    client: Client
    node: Any

    def call(self, kind: str, **request: Any) -> Any:
        service = getattr(srv, kind.title().replace("_", ""))
        return self.client.call(
            service, f"{self.name}/{kind}", service.Request(**request)
        )

    def topics(self) -> set[tuple[str, str, str]]:
        """What the client has discovered of the node."""
        return {
            (kind, re.sub(f"^{self.name}/", "~/", name), message)
            for kind, name, message in self.client.entities(self.name)
            if name not in OF_EVERY_NODE
            and "parameter" not in name
            and "type_desc" not in name
            # An action's parts have no rows of their own.
            if kind == "subscribes" or "/_action/" not in name
        }


@pytest.fixture(scope="module", params=NODES)
def running(
    request: pytest.FixtureRequest, run_node: Any, make_client: Any
) -> Iterator[Running]:
    name, namespace = request.param, f"/described/{request.param}"
    parameters = {"follow_trainer": True} if name == "planner" else {}
    with run_node(f"{name}_node", parameters, namespace=namespace) as node:
        yield Running(name, make_client(namespace), node)


def rows_of(node: str) -> list[list[str]]:
    """The cells of the tables below a node's heading."""
    (section,) = (
        part for part in DOCS.split("\n## ") if part.startswith(f"{node}_node")
    )
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
    names = [
        name for name in names if name not in OF_EVERY_NODE and "qos_over" not in name
    ]
    described = running.call("describe_parameters", names=names)
    found = {}
    for entry in described.descriptors:
        assert entry.description
        value = running.client.get_parameter(running.name, entry.name)
        text = (
            repr(value).replace("''", "")
            if isinstance(value, str)
            else json.dumps(value)
        )
        found[entry.name] = [TYPES[entry.type], f"`{text}`", range_of(entry)]
    if running.name == "planner":
        found["follow_trainer"][1] = "`false`"
    assert found == documented_parameters(running.name)


def test_topics_are_as_documented(
    running: Running,
    run_node: Any,
    make_client: Callable[[str], Client],
    tmp_path: Path,
) -> None:
    documented, more = documented_topics(running.name), set()
    if running.name == "trainer":
        parameters = {
            "learn_from": "driving",
            "output_folder": str(tmp_path / "drives"),
        }
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
        (
            Parameter(name="no_such", value=ParameterValue(type=1)),
            "does not know.*no_such",
        ),
    ):
        (result,) = running.call("set_parameters", parameters=[bad]).results
        for refused in (
            result,
            running.call("set_parameters_atomically", parameters=[bad]).result,
        ):
            assert not refused.successful
            assert re.search(reason, refused.reason)
    good = Parameter(name="use_sim_time", value=ParameterValue(type=1))
    results = running.call("set_parameters", parameters=[unknown_type, good]).results
    assert [result.successful for result in results] == [False, True]
    assert running.call("set_parameters").results == []
    assert running.call("set_parameters_atomically").result.successful
    running.call("list_parameters", prefixes=NAMES, depth=2**64 - 1)
    for kind in ("describe_parameters", "get_parameter_types", "get_parameters"):
        running.call(kind, names=NAMES)
    names = running.call("list_parameters").result.names
    values = running.call("get_parameters", names=names).values
    assert len(values) == len(names) > 3
    assert "Traceback" not in running.node.log


@pytest.mark.parametrize(("name", "option"), [*product(NODES, ["--help", "-h"])])
def test_help_says_of_each_parameter_what_the_docs_say_and_starts_no_node(
    name: str, option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any
) -> None:
    # With such a domain, such parameters and in such a folder no node starts.
    arguments = [
        option,
        "--ros-args",
        "-p",
        "model:=no_such",
        "-p",
        "map_file:=no_such",
    ]
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
FLIGHTY = {"qos_overrides./map.subscription.durability": "flighty"}
BY_TF = {"learn_from": "driving", "pose_source": "tf"}
NEEDS_TF = (
    "is 'tf', which needs tf2_ros, and that is not installed: "
    "apt install ros-[a-z]*-tf2"
)


@contextmanager
def signals_given_back() -> Iterator[None]:
    """Give signals back to pytest after a node has listened to them."""
    handlers = {
        number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        signal.set_wakeup_fd(-1)
        for number, handler in handlers.items():
            signal.signal(number, handler)


@pytest.mark.parametrize(
    "case",
    [
        ("map_server", {}, ["-p", "model"], {}, "model"),
        ("map_server", {}, ["--params-file", "/no/such.yaml"], {}, "such.yaml"),
        ("map_server", {}, [], {"ROS_DOMAIN_ID": "abc"}, "ROS_DOMAIN_ID"),
        (
            "map_server",
            {},
            ["--enclave", "/a"],
            SECURITY,
            "SECURITY|security|keystore|enclave",
        ),
        ("map_server", {"frame_id": ""}, [], {}, "name the map's frame"),
        ("map_server", {"topic_name": "a b"}, [], {}, "topic name"),
        (
            "map_server",
            {"seed": -1},
            [],
            {},
            "seed is -1; give 0 to 9223372036854775807",
        ),
        ("planner", FLIGHTY, [], {}, r"cannot subscribe to /map \(.*`flighty`"),
        ("planner", {"start_source": "tf"}, [], {}, NEEDS_TF),
        ("trainer", BY_TF, [], {}, NEEDS_TF),
        (
            "trainer",
            {"network": "perceptron"},
            [],
            {},
            "'perceptron'; give one of paper, prop",
        ),
        (
            "trainer",
            {"environments": 8, "replay_capacity": 4},
            [],
            {},
            "is 8; .* at most .* 4",
        ),
        ("trainer", {"map_file": "no_such_map.yaml"}, [], {}, "no_such_map"),
        (
            "trainer",
            {"robots": ["r 1"]},
            [],
            {},
            "robots holds 'r 1', which is no namespace; give",
        ),
        (
            "trainer",
            {"output_folder": "~nobody_there/x"},
            [],
            {},
            "no home folder of a user 'nob",
        ),
        (
            "planner",
            {"robot_radius": "0.3", "mode": 1},
            [],
            {},
            "is '0.3', a text .* / mode is 1,",
        ),
        ("planner", {"use_sim_time": "true"}, [], {}, "use_sim_time"),
    ],
)
def test_what_a_node_cannot_start_with_is_said_and_ends_with_1(
    case: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any
) -> None:
    name, parameters, arguments, environment, reason = case
    if reason is NEEDS_TF and has_tf():
        pytest.skip("tf2_ros is installed")
    file = tmp_path / "parameters.yaml"
    file.write_text(yaml.safe_dump({"/**": {"ros__parameters": parameters}}))
    given = ["--params-file", str(file)] if parameters else []
    monkeypatch.setattr(sys, "argv", ["node", "--ros-args", *given, *arguments])
    for variable, value in environment.items():
        monkeypatch.setenv(variable, value)
    with signals_given_back():
        assert import_module(f"ddqn_planner.nodes.{name}_node").main() == 1
    log = capfd.readouterr().err
    assert re.search(f"cannot start: .*({reason})", log)
    assert "Traceback" not in log


CLASSES = {  # of rviz_default_plugins
    "nav_msgs/OccupancyGrid": "Map",
    "geometry_msgs/PoseStamped": "SetGoal",
    "geometry_msgs/PoseWithCovarianceStamped": "SetInitialPose",
}
SHOWN = {
    "/map",
    "/plan",
    "/planner/value",
    "/trainer/episode",
    "/trainer/episode_markers",
}
SET = {"/initialpose", "/goal_pose"}


def test_each_display_and_tool_has_a_topic_of_the_nodes() -> None:
    documented = {
        (row[0], "/" + row[1].strip("`").replace("~", node).lstrip("/")): row[2]
        for node in NODES
        for row in rows_of(node)
        if len(row) > 2
    }
    text = (ROOT / "rviz" / "ddqn_planner.rviz").read_text()
    manager: dict[str, Any] = yaml.safe_load(text)["Visualization Manager"]
    displays = {display["Topic"]["Value"]: display for display in manager["Displays"]}
    tools = {
        tool["Topic"]["Value"]: tool for tool in manager["Tools"] if "Topic" in tool
    }
    assert (set(displays), set(tools)) == (SHOWN, SET)
    for name, entry in (displays | tools).items():
        way = "publishes" if name in displays else "subscribes"
        message_type, _, latched = documented[way, name].partition(", ")
        name = CLASSES.get(message_type, message_type.rpartition("/")[2])
        assert entry["Class"] == f"rviz_default_plugins/{name}"
        durability = "Transient Local" if latched == "latched" else "Volatile"
        assert entry["Topic"]["Durability Policy"] == durability
        assert entry["Topic"]["Reliability Policy"] == "Reliable"
    assert all(display["Enabled"] for display in displays.values())
    assert displays["/map"]["Draw Behind"]
    value = displays["/planner/value"]
    assert (value["Color Scheme"], value["Draw Behind"], value["Alpha"] < 1) == (
        "costmap",
        0,
        True,
    )
    assert manager["Global Options"]["Fixed Frame"] == "map"
    assert manager["Views"]["Current"]["Class"] == "rviz_default_plugins/TopDownOrtho"
