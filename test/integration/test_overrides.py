"""What users set at the start, in their own way, for another node, or for none."""

import math
import re
from array import array
from pathlib import Path
from typing import Any

import pytest
import yaml
from client import TIMEOUT, wait_for
from hypothesis import given
from hypothesis import strategies as st
from nav_msgs.srv import GetMap, LoadMap
from rclpy.qos import HistoryPolicy, QoSProfile

from ddqn_planner.nodes import map_server_node, trainer_node
from ddqn_planner.nodes.declared import Declared, read_all
from ddqn_planner.nodes.overrides import (
    nearest,
    unread_names,
    unread_sections,
    wrong_argument,
)
from ddqn_planner.nodes.parameters import PLANNER_PARAMETERS
from ddqn_planner.nodes.quality import overriding_options

ROBOTS = trainer_node.PARAMETERS["robots"]
PARAMETERS = trainer_node.PARAMETERS | map_server_node.PARAMETERS | PLANNER_PARAMETERS

MEANT = [
    ("robot_radius", 1, 1.0),
    ("robot_radius", 100, 100.0),
    ("clearance_weight", 1.0000005, 1.0),
    ("occupied_threshold", 65.0, 65),
    ("mode", " Greedy ", "greedy"),
    ("map_type", "COSTMAP", "costmap"),
    ("move_rule", " ", ""),
    ("model", "~/My Model", "~/My Model"),
    ("robots", [], [""]),
    ("robots", None, [""]),  # what ROS makes of []
    ("robots", b"", [""]),
    ("robots", "", [""]),
    ("robots", ["", " ", "/"], [""]),
    ("robots", ["/r1", "r2/"], ["r1", "r2"]),
    ("robots", ["r1", "/r1", "/fleet/r1/"], ["r1", "fleet/r1"]),
    ("robots", "r1", ["r1"]),
    ("models", [" car", "", "/a/b/", "car "], ["car", "/a/b/"]),
]


@pytest.mark.parametrize(("name", "value", "meaning"), MEANT)
def test_a_value_in_another_form_means_the_same(
    name: str, value: Any, meaning: Any
) -> None:
    read = PARAMETERS[name].read(name, value)
    assert (type(read), read) == (type(meaning), meaning)


WRONG = [
    ("robot_radius", "0.3", "is '0.3', a text .*no quotes.*; give a number, 0 to 100"),
    ("robot_radius", True, "is True, a truth value; give a number, 0 to 100"),
    ("robot_radius", [0.3], r"is \[0.3\], a list; give a number"),
    ("robot_radius", None, "is no value, an empty list or blanks; give a number"),
    ("robot_radius", array("d", [0.3]), r"is \[0.3\], a list; give a number"),
    ("robot_radius", -0.1, "is -0.1; give 0 to 100"),
    ("clearance_weight", 1.1, "is 1.1; give 0 to 1"),
    ("map_timeout", math.inf, "is inf; give 0 to 3600"),
    ("map_timeout", math.nan, "is nan; give 0 to 3600"),
    ("occupied_threshold", 65.5, "is 65.5, a number; give a whole number, 1 to 100"),
    ("occupied_threshold", math.inf, "is inf, a number; give a whole number"),
    ("occupied_threshold", 0, "is 0; give 1 to 100"),
    ("allow_unknown", 1, "is 1, a whole number; give true or false"),
    ("allow_unknown", "true", "is 'true', a text .*no quotes.*; give true or false"),
    ("model", 5, "is 5, a whole number .with quotes, '5', it is a text.; give a text"),
    ("planner_id", True, "is True, a truth value .with quotes"),
    ("mode", "best", "is 'best'; give one of greedy, astar_fallback"),
    ("robot_frame", " ", "is ' '; name the robot's frame"),
    ("robots", [1, 2], r"is \[1, 2\], a list; give a list of namespaces"),
    ("robots", 3, "is 3, a whole number; give a list of namespaces"),
    ("models", 3, "is 3, a whole number; give a list of models that know a body"),
    *(
        ("robots", [bad], f"holds '{bad}', which is no name")
        for bad in ("r 1", "1r", "a//b", "~", "ü")
    ),
]


@pytest.mark.parametrize(("name", "value", "reason"), WRONG)
def test_a_wrong_value_is_named_with_a_remedy(
    name: str, value: Any, reason: str
) -> None:
    with pytest.raises(ValueError, match=f"^{name} {reason}"):
        PARAMETERS[name].read(name, value)


def test_all_wrong_values_are_named_at_once() -> None:
    with pytest.raises(
        ValueError, match=r"^robot_radius is -1.0; .* / mode is 'x'; give"
    ):
        read_all(PARAMETERS, {"robot_radius": -1, "tolerance": 1, "mode": "x"})


SCALARS = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary()
)
VALUES = SCALARS | st.lists(st.integers()) | st.lists(st.text()) | st.lists(st.floats())


@given(st.sampled_from(sorted(PARAMETERS)), VALUES)
def test_any_value_is_one_of_the_type_and_range_or_refused(
    name: str, value: Any
) -> None:
    declared: Declared = PARAMETERS[name]
    try:
        read = declared.read(name, value)
    except ValueError as error:
        assert re.search(r"; (give|name) ", str(error))  # noqa: PT017
        return
    assert type(read) is type(declared.default)
    assert declared.read(name, read) == read
    if isinstance(declared.allowed, tuple):
        assert declared.allowed[0] <= read <= declared.allowed[1]


def test_each_default_is_what_it_says() -> None:
    for name, declared in PARAMETERS.items():
        assert declared.read(name, declared.default) == declared.default


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("robot_raduis", "robot_radius"),
        ("Robot_Radius", "robot_radius"),
        ("robot-radius", "robot_radius"),
        ("robotRadius", "robot_radius"),
        ("GridBased.tolerance", "tolerance"),
        ("xyz", ""),
    ],
)
def test_the_nearest_name_is_found(name: str, found: str) -> None:
    assert nearest(name, PLANNER_PARAMETERS) == found
    told = unread_names(
        [name, "tolerance", "qos_overrides./map"], PLANNER_PARAMETERS, "/planner"
    )
    assert told.startswith(f"/planner does not know, and does not read: {name}")
    assert (f"(the nearest is {found})" in told) == bool(found)


RADIUS = {"ros__parameters": {"robot_radius": 0.3}}
NAV2 = {
    "ros__parameters": {
        "planner_plugins": ["GridBased"],
        "GridBased": {"tolerance": 0.5},
    }
}
CLOCK = {"ros__parameters": {"use_sim_time": True}}
SECTIONS: list[tuple[Any, str, str]] = [
    ({"planner": RADIUS}, "/planner", ""),
    ({"/planner": RADIUS}, "/planner", ""),
    ({"/**": RADIUS}, "/r1/planner", ""),
    ({"/*/planner": RADIUS}, "/r1/planner", ""),
    ({"/**/planner": RADIUS}, "/planner", ""),
    ({"/**/planner": RADIUS}, "/a/b/planner", ""),
    ({"/r1/**": RADIUS}, "/r1/planner", ""),
    ({"r1": {"planner": RADIUS}}, "/r1/planner", ""),
    ({"/r1": {"planner": RADIUS}}, "/r1/planner", ""),
    ({"planner": RADIUS, "planner_server": NAV2, "amcl": CLOCK}, "/planner", ""),
    ({"/**": CLOCK, "planner_server": NAV2, "/r1/planner": RADIUS}, "/planner", ""),
    ({}, "/planner", ""),
    (
        {"planner_node": RADIUS},
        "/planner",
        "sets nothing of /planner: it is for /planner_node; write planner: instead",
    ),
    (
        {"amcl": CLOCK, "planner_server": NAV2},
        "/planner",
        "it is for /amcl, /planner_server; write planner: instead of planner_server:",
    ),
    (
        {"planner": RADIUS},
        "/r1/planner",
        "write /r1/planner: or /[*][*]/planner: instead of /planner:",
    ),
    ({"/*/planner": RADIUS}, "/planner", "instead of /[*]/planner:"),
    ({"/r2/planner": RADIUS}, "/r1/planner", "it is for /r2/planner"),
    ({"plannerx": RADIUS}, "/planner", "instead of plannerx:"),
    ({"xplanner": RADIUS}, "/planner", "instead of xplanner:"),
    (
        {"amcl": CLOCK},
        "/planner",
        "it is for /amcl; add a section /planner: or /[*][*]:",
    ),
    (
        {f"n{i}": CLOCK for i in range(9)},
        "/planner",
        "it is for /n0, /n1, /n2, /n3, /n4, ...; add",
    ),
    (
        {"/**": CLOCK, "planner_node": RADIUS},
        "/planner",
        "the section /planner_node is not for /planner; write planner:",
    ),
    (
        {"/**": CLOCK, "planner": RADIUS},
        "/r1/planner",
        "the section /planner is not for /r1/planner; write /r1/planner: or",
    ),
]


@pytest.mark.parametrize(("sections", "node", "warning"), SECTIONS)
def test_a_file_for_other_nodes_alone_is_told(
    sections: Any, node: str, warning: str, tmp_path: Path
) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(yaml.safe_dump(sections, sort_keys=False))
    told = unread_sections(
        ["node", "--ros-args", "--params-file", str(file)], PARAMETERS, node
    )
    assert len(told) == bool(warning)
    assert all(re.search(warning, each) and str(file) in each for each in told)
    # What is no argument of ROS is not read by ROS.
    assert unread_sections(["node", "--params-file", str(file)], PARAMETERS, node) == []


@pytest.mark.parametrize(
    ("rule", "warning"),
    [
        ("robot_radius:=0.3", ""),
        ("planner:robot_radius:=0.3", ""),
        ("model:='planner_node:x'", ""),
        (
            "planner_node:robot_radius:=0.3",
            "-p planner_node:robot_radius:=0.3 sets nothing of /pl",
        ),
    ],
)
@pytest.mark.parametrize("option", ["-p", "--param"])
def test_a_setting_for_another_node_is_told(
    option: str, rule: str, warning: str
) -> None:
    arguments = ["node", "--ros-args", option, rule, "-r", "__ns:=/", "--"]
    told = unread_sections(arguments, PARAMETERS, "/planner")
    assert len(told) == bool(warning)
    assert all(warning in each for each in told)


@given(
    st.recursive(SCALARS, lambda tree: st.dictionaries(st.text(), tree), max_leaves=9)
)
def test_any_file_is_read_or_left_out(tmp_path_factory: Any, tree: Any) -> None:
    file = tmp_path_factory.mktemp("any") / "any.yaml"
    file.write_text(yaml.safe_dump(tree))
    unread_sections(["--ros-args", "--params-file", str(file)], PARAMETERS, "/planner")


UNREADABLE = [
    ("-p", "robot_radius=0.3", "no ':='; write -p NAME:=VALUE"),
    (
        "-p",
        "model:=",
        "-p model:= has no value; give one, and for an empty text: -p \"model:=''\"",
    ),
    ("-p", "/planner:robot_radius:=0.3", "write -p planner:robot_radius:=0.3"),
    ("-p", "mode:=[greedy", "-p mode:=\\[greedy: the value is no YAML .line 1: "),
    ("planner:\n  ros__parameters:\n\tmode: greedy\n", "no YAML .line 3: .*correct it"),
    (
        "planner:\n  ros_parameters:\n    mode: greedy\n",
        "no ros__parameters, but ros_parameters;",
    ),
    ("", "is empty; write NODE:"),
    (None, "cannot be read .No such file or directory.; check the path"),
]


@pytest.mark.parametrize("case", UNREADABLE)
def test_an_argument_that_ros_cannot_read_is_named(case: Any, tmp_path: Path) -> None:
    *arguments, remedy = case
    if len(arguments) == 1:
        file = tmp_path / "parameters.yaml"
        if arguments[0] is not None:
            file.write_text(arguments[0])
        arguments = ["--params-file", str(file)]
    assert re.search(remedy, wrong_argument(["node", "--ros-args", *arguments]))
    assert wrong_argument(["node", *arguments]) == ""  # not for ROS


def test_arguments_that_ros_reads_are_not_wrong(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(yaml.safe_dump({"planner": RADIUS}))
    settings = [
        "-p",
        "robot_radius:=0.3",
        "-p",
        "planner:mode:=greedy",
        "-p",
        "model:=''",
    ]
    assert (
        wrong_argument(["node", "--ros-args", "--params-file", str(file), *settings])
        == ""
    )


def test_a_queue_may_have_the_depth_0_which_leaves_it_to_the_middleware() -> None:
    check = overriding_options("/map").callback
    assert check is not None
    for depth in (0, 1, 2**31 - 1):
        quality = QoSProfile(history=HistoryPolicy.KEEP_ALL, depth=depth)
        assert check(quality).successful


@pytest.mark.parametrize(
    ("name", "setting", "reason"),
    [
        ("planner_node", "model:=", "cannot start: -p model:= has no value"),
        (
            "planner_node",
            "qos_overrides./map.subscription.depth:=-3",
            "depth is -3; give 0 to 2147483647",
        ),
        (
            "map_server_node",
            "topic_name:=my map",
            "cannot start: topic_name is 'my map' (",
        ),
        ("map_server_node", "topic_name:=''", "cannot start: topic_name is '' ("),
        ("map_server_node", "topic_name:='/'", "cannot start: topic_name is '/' ("),
    ],
)
def test_a_node_that_cannot_start_names_the_setting(
    run_node: Any, name: str, setting: str, reason: str
) -> None:
    with run_node(name, settings=["--ros-args", "-p", setting], exit_code=1) as node:
        assert node.process.wait(TIMEOUT) == 1
    assert reason in node.log
    assert node.log.count("FATAL") == 1


def test_a_planner_tells_what_it_does_not_read_and_takes_what_is_meant(
    run_node: Any, make_client: Any, tmp_path: Path
) -> None:
    file = tmp_path / "wrong.yaml"
    file.write_text(yaml.safe_dump({"planner_node": RADIUS}))
    quality = "qos_overrides./told/{}.subscription.durability:=volatile"
    settings = ["--params-file", str(file), "-p", "robot_raduis:=0.3"]
    settings += [
        "-p",
        quality.format("mpa"),
        "-p",
        quality.format("map"),
        "--",
        "tolerance:=3",
    ]
    parameters = {"robot_radius": 1, "mode": " Greedy", "use_sim_time": False}
    with run_node(
        "planner_node", parameters, namespace="/told", settings=settings
    ) as node:
        client = make_client("/told")
        client.get_parameter("planner", "mode")
        for warning in (
            "does not read: robot_raduis .the nearest is robot_radius.; --help",
            "wrong.yaml sets nothing of /told/planner: "
            "it is for /planner_node; write told/pl",
            f"no subscription for {quality.format('mpa').partition(':')[0]} now; "
            f"the nearest is {quality.format('map').partition(':')[0]}",
            "tolerance:=3 is not read; give settings after --ros-args",
        ):
            node.wait_for_log(warning)
        assert client.get_parameter("planner", "robot_radius") == 1.0
        assert client.get_parameter("planner", "mode") == "greedy"
        for name, value, meaning in (
            ("robot_radius", 2, 2.0),
            ("occupied_threshold", 50.0, 50),
        ):
            (result,) = client.set_parameters("planner", **{name: value})
            assert result.successful
            assert client.get_parameter("planner", name) == meaning
        for name, value, reason in (
            ("robot_raduis", 0.1, "robot_raduis (the nearest is robot_radius)"),
            (
                "follow_trainer",
                True,
                "read-only; set it at the start, with -p follow_trainer:=",
            ),
            ("robot_radius", "0.1", "a number and a truth value have no quotes"),
            ("model", 3, "with quotes"),
        ):
            (result,) = client.set_parameters("planner", **{name: value})
            assert not result.successful
            assert reason in result.reason
        assert client.get_parameter("planner", "robot_radius") == 2.0
        # The middleware of a newer release has warnings of its own.
        assert len(re.findall(r"WARN.*planner\]: ", node.log)) == 4


def test_a_map_server_without_a_map_waits_for_one(
    run_node: Any, make_client: Any
) -> None:
    with run_node("map_server_node", {"yaml_filename": ""}, namespace="/none") as node:
        client = make_client("/none")
        assert not client.call(GetMap, "map_server/map").map.data
        node.wait_for_log("yaml_filename is '': no map is loaded; call load_map first")
        answer = client.call(
            LoadMap, "map_server/load_map", LoadMap.Request(map_url="")
        )
        assert answer.result == LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST
        node.wait_for_log(
            "cannot load '', no map is served: the map is ''; give a path"
        )
        answer = client.call(
            LoadMap, "map_server/load_map", LoadMap.Request(map_url="/")
        )
        assert answer.result == LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST
        node.wait_for_log("'/' is a folder; give the path of a map file")
        answer = client.call(
            LoadMap, "map_server/load_map", LoadMap.Request(map_url="dilemma")
        )
        assert answer.result == LoadMap.Response.RESULT_SUCCESS
        assert node.log.count("ERROR") == 2


@pytest.mark.parametrize(
    ("robots", "spaces"), [([], [""]), (["/r1", "r2/", "r1"], ["r1/", "r2/"])]
)
def test_robots_are_heard_in_their_namespaces(
    robots: list[str],
    spaces: list[str],
    run_node: Any,
    make_client: Any,
    tmp_path: Path,
) -> None:
    parameters = {
        "learn_from": "driving",
        "robots": robots,
        "output_folder": str(tmp_path / "d"),
    }
    space = f"/fleet_of_{len(robots)}"
    with run_node("trainer_node", parameters, namespace=space):
        client = make_client(space)
        expected = {f"{robot}odom" for robot in spaces}

        def heard() -> set[str]:
            entities = client.entities("trainer")
            return {name for _, name, _ in entities if name.endswith("odom")}

        wait_for("topics of robots", lambda: heard() == expected)
