"""What `ros2 launch ddqn_planner navigation.launch.py` starts."""

from pathlib import Path
from typing import Any

import pytest
import yaml
from integration.launched import HAS_LAUNCH, Started, Workspace

ROOT = Path(__file__).resolve().parents[2]
LAUNCH_FILE = ROOT / "launch" / "navigation.launch.py"
TRANSFORMS = {"/tf": "tf", "/tf_static": "tf_static"}

SERVERS = {
    "controller_server": ("nav2_controller", "controller_server"),
    "smoother_server": ("nav2_smoother", "smoother_server"),
    "planner_server": ("nav2_planner", "planner_server"),
    "ddqn_planner": ("ddqn_planner", "planner_node"),
    "route_server": ("nav2_route", "route_server"),
    "behavior_server": ("nav2_behaviors", "behavior_server"),
    "velocity_smoother": ("nav2_velocity_smoother", "velocity_smoother"),
    "collision_monitor": ("nav2_collision_monitor", "collision_monitor"),
    "bt_navigator": ("nav2_bt_navigator", "bt_navigator"),
    "waypoint_follower": ("nav2_waypoint_follower", "waypoint_follower"),
    "docking_server": ("opennav_docking", "opennav_docking"),
}
"""Nav2's nodes on Jazzy with the planner, in the order of its bringup."""

PARAMETERS = """
bt_navigator:
  ros__parameters:
    default_server_timeout: 20
    plugin: $(find-pkg-share nav2_bringup)/launch
global_costmap:
  global_costmap:
    ros__parameters:
      robot_base_frame: base_footprint
      update_frequency: 5.0
      publish_frequency: 1.0
      filters: [{enabled: KEEPOUT_ZONE_ENABLED}, {enabled: SPEED_ZONE_ENABLED}]
route_server: {ros__parameters: {graph_filepath: street.geojson}}
collision_monitor: {ros__parameters: {source_timeout: 1.0}}
docking_server: {ros__parameters: {dock_plugins: [dock]}}
"""


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    workspace = Workspace(tmp_path)
    for package, executable in SERVERS.values():
        workspace.add(package, executable)
    workspace.add("nav2_lifecycle_manager", "lifecycle_manager")
    workspace.add("rviz2", "rviz2")
    for name in ("localization_launch.py", "slam_launch.py"):
        workspace.add_launch_file(name)
    folder = workspace.add("nav2_bringup") / "params"
    folder.mkdir()
    (folder / "nav2_params.yaml").write_text(PARAMETERS)
    return workspace


def launch(workspace: Workspace, **arguments: str) -> dict[str, Started]:
    return workspace.launch(LAUNCH_FILE, **arguments)


def node_names(started: dict[str, Started]) -> list[str]:
    return list(started["lifecycle_manager_navigation"].parameters["node_names"])


def written(folder: Path, nodes: dict[str, Any]) -> str:
    """Return a parameter file of these nodes."""
    path = folder / "parameters.yaml"
    document = {
        name: {"ros__parameters": parameters} for name, parameters in nodes.items()
    }
    path.write_text(yaml.safe_dump(document))
    return str(path)


def test_all_of_nav2_is_started_and_the_planner_activated_before_bt_navigator(
    workspace: Workspace,
) -> None:
    started = launch(workspace)
    manager = "lifecycle_manager_navigation"
    assert set(started) == {*SERVERS, manager, "localization_launch.py"}
    assert node_names(started) == list(SERVERS)
    assert started[manager].parameters["autostart"] is True
    for name, (_, executable) in SERVERS.items():
        assert started[name].executable == executable
        assert started[name].namespace == "/"
        assert started[name].remaps.items() >= TRANSFORMS.items()
        assert started[name].parameters["use_sim_time"] is False
        assert started[name].arguments[:3] == ["--ros-args", "--log-level", "info"]
    localization = started["localization_launch.py"].parameters
    assert localization["use_composition"] == "False"
    assert localization["map"] == ""


def test_the_planner_takes_the_place_of_planner_servers_actions(
    workspace: Workspace,
) -> None:
    started = launch(workspace)
    moved = {
        f"{name}:{target}" for name, target in started["planner_server"].remaps.items()
    }
    for action in ("compute_path_to_pose", "compute_path_through_poses"):
        for part in ("send_goal", "cancel_goal", "get_result", "feedback", "status"):
            name = f"{action}/_action/{part}"
            assert f"{name}:planner_server/{name}" in moved
    assert "is_path_valid:planner_server/is_path_valid" in moved
    assert len(moved) == 2 * 5 + 1 + len(TRANSFORMS)
    planner = started["ddqn_planner"]
    assert planner.remaps["map"] == "global_costmap/costmap"
    assert planner.remaps["goal_pose"] == "ddqn_planner/goal_pose"
    assert planner.parameters == {
        "use_sim_time": False,
        "autostart": False,
        "map_type": "costmap",
        "allow_unknown": True,
        "start_source": "tf",
        "robot_frame": "base_footprint",
        "other_planners": "planner_server",
    }


def test_bt_navigator_waits_for_python_and_the_costmap_is_published_as_it_changes(
    workspace: Workspace, tmp_path: Path
) -> None:
    costmap = "/global_costmap/global_costmap"
    started = launch(workspace)
    assert started["bt_navigator"].parameters["default_server_timeout"] == 200
    assert started["planner_server"].files[costmap]["publish_frequency"] == 5.0
    # Kilted's words for what is switched on by an argument.
    filters = started["planner_server"].files[costmap]["filters"]
    assert [layer["enabled"] for layer in filters] == [False, False]
    # What is more than enough stays; what is not told is 20 ms and 1 Hz.
    files: list[tuple[int, dict[str, Any]]] = [
        (500, {"bt_navigator": {"default_server_timeout": 500}, costmap: {}}),
        (
            200,
            {
                "/**": {"default_server_timeout": 20},
                costmap: {"publish_frequency": 5.0},
            },
        ),
        (200, {"/**/bt_navigator": {"default_server_timeout": 20}}),
        (200, {"other": {"default_server_timeout": 500}}),
    ]
    for timeout, file in files:
        started = launch(workspace, params_file=written(tmp_path, file))
        assert started["bt_navigator"].parameters["default_server_timeout"] == timeout
        assert started["planner_server"].files[costmap]["publish_frequency"] == 5.0
    started = launch(workspace, server_timeout="300")
    assert started["bt_navigator"].parameters["default_server_timeout"] == 300


def test_a_namespace_holds_every_node_its_parameters_and_its_transforms(
    workspace: Workspace, tmp_path: Path
) -> None:
    nodes: dict[str, Any] = {"bt_navigator": {"a": 1}, "/**": {"b": 3}}
    nodes |= {"/robot2/bt_navigator": {"a": 2}, "robot1/amcl": {"c": 4}}
    nodes["ddqn_planner"] = {"clearance_weight": 1.0}
    file = written(tmp_path, nodes)
    for namespace in ("robot1", "/robot1", "robot1/"):
        started = launch(workspace, namespace=namespace, params_file=file)
        servers = started.keys() - {"localization_launch.py"}
        assert {started[name].namespace for name in servers} == {"/robot1"}
        assert all(
            started[name].remaps.items() >= TRANSFORMS.items()
            for name in node_names(started)
        )
        assert started["localization_launch.py"].parameters["namespace"] == "/robot1"
        assert started["localization_launch.py"].namespace == "/robot1"
        navigator = started["bt_navigator"]
        assert (
            navigator.parameters.items()
            >= {"a": 1, "b": 3, "default_server_timeout": 200}.items()
        )
        assert navigator.files["/robot1/amcl"] == {"c": 4}
        planner = started["ddqn_planner"]
        assert planner.remaps["map"] == "global_costmap/costmap"
        assert planner.parameters["clearance_weight"] == 1.0
        assert planner.files.keys() == {"/robot1/ddqn_planner"}


def test_arguments_reach_the_planner_and_go_before_the_parameter_file(
    workspace: Workspace, tmp_path: Path
) -> None:
    section = {
        "model": "car",
        "planner_id": "ours",
        "map_type": "map",
        "autostart": True,
    }
    file = written(tmp_path, {"ddqn_planner": section})
    planner = launch(workspace, params_file=file)["ddqn_planner"].parameters
    assert (
        planner.items()
        >= {**section, "autostart": False, "robot_frame": "base_link"}.items()
    )
    arguments = {"model": "dilemma", "planner_id": "ddqn", "use_sim_time": "True"}
    started = launch(
        workspace, params_file=file, autostart="0", log_level="debug", **arguments
    )
    planner = started["ddqn_planner"].parameters
    assert (
        planner.items()
        >= {**arguments, "use_sim_time": True, "autostart": False}.items()
    )
    assert started["lifecycle_manager_navigation"].parameters["autostart"] is False
    assert started["localization_launch.py"].parameters["use_sim_time"] == "True"
    for name in SERVERS.keys() & started.keys():
        assert started[name].arguments[:3] == ["--ros-args", "--log-level", "debug"]


def test_nodes_that_a_release_or_a_robot_lacks_are_left_out(
    workspace: Workspace, tmp_path: Path
) -> None:
    velocities = "cmd_vel_smoothed"
    started = launch(workspace)
    assert velocities not in started["velocity_smoother"].remaps
    # Without a collision monitor the smoothed velocities are those that the robot
    # drives.
    started = launch(
        workspace, params_file=written(tmp_path, {"route_server": {"x": 1}})
    )
    assert set(SERVERS) - set(node_names(started)) == {
        "collision_monitor",
        "docking_server",
    }
    assert started.keys() >= set(node_names(started))
    assert started["velocity_smoother"].remaps[velocities] == "cmd_vel"
    # As in Lyrical.
    file = written(tmp_path, {"following_server": {"x": 1}})
    assert "following_server" not in launch(workspace, params_file=file)
    workspace.add("opennav_following", "opennav_following")
    assert node_names(launch(workspace, params_file=file))[-1] == "following_server"


def test_the_map_is_served_made_or_left_to_others(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", "/home/somebody")
    started = launch(workspace, map="~/map.yaml")
    assert (
        started["localization_launch.py"].parameters["map"] == "/home/somebody/map.yaml"
    )
    started = launch(workspace, slam="true")
    assert "slam_launch.py" in started
    assert "localization_launch.py" not in started
    started = launch(workspace, use_localization="False", slam="true")
    assert not {"localization_launch.py", "slam_launch.py"} & started.keys()
    with pytest.raises(RuntimeError, match=r"no keepout_zone_launch\.py"):
        launch(workspace, keepout_mask="mask.yaml")
    for zone, states in (("keepout", [True, False]), ("speed", [False, True])):
        workspace.add_launch_file(f"{zone}_zone_launch.py")
        started = launch(workspace, **{f"{zone}_mask": "mask.yaml"})
        assert (
            started[f"{zone}_zone_launch.py"].parameters[f"{zone}_mask"] == "mask.yaml"
        )
        filters = started["planner_server"].files["/global_costmap/global_costmap"][
            "filters"
        ]
        assert [layer["enabled"] for layer in filters] == states
    assert (
        launch(workspace, graph="g")["route_server"].parameters["graph_filepath"] == "g"
    )
    assert (
        launch(workspace)["route_server"].parameters["graph_filepath"]
        == "street.geojson"
    )


def topics_of(value: Any) -> set[str]:
    """Return the topics in a configuration of RViz."""
    if isinstance(value, list):
        return {topic for entry in value for topic in topics_of(entry)}
    if not isinstance(value, dict):
        return set()
    below = {topic for entry in value.values() for topic in topics_of(entry)}
    return below | {value["Value"]} if "Reliability Policy" in value else below


def test_rviz_shows_the_planner_of_its_namespace(workspace: Workspace) -> None:
    assert "rviz2" not in launch(workspace)
    workspace.add("ddqn_planner", "planner_node")
    rviz = launch(workspace, rviz="true", namespace="robot1")["rviz2"]
    assert rviz.namespace == "/robot1"
    assert rviz.arguments[:2] == [
        "-d",
        str(workspace.prefix / "share/ddqn_planner/rviz/ddqn_planner.rviz"),
    ]
    topics = topics_of(
        yaml.safe_load((ROOT / "rviz" / "ddqn_planner.rviz").read_text())
    )
    assert len(topics) == 9
    assert rviz.remaps.keys() == topics | {"/tf", "/tf_static"}
    for topic, target in rviz.remaps.items():
        assert target == topic[1:].replace("planner/", "ddqn_planner/")
    rviz = launch(workspace, rviz="true", rviz_config="my.rviz")["rviz2"]
    assert rviz.arguments[:2] == ["-d", "my.rviz"]


@pytest.mark.parametrize(
    ("argument", "value", "reason"),
    [
        ("use_sim_time", "maybe", "use_sim_time:=maybe is neither true nor false"),
        ("rviz", "", "rviz:= is neither true nor false"),
        (
            "server_timeout",
            "0.2",
            "server_timeout:=0.2 is no time; give whole milliseconds",
        ),
        ("server_timeout", "0", "server_timeout:=0 is no time"),
        ("params_file", "/no/such.yaml", "params_file:=/no/such.yaml cannot be read"),
        ("params_file", "a: [", "cannot be read"),
        ("params_file", "- a", "has no nodes"),
        ("params_file", "\xff", "cannot be read"),
    ],
)
def test_a_wrong_argument_is_named(
    workspace: Workspace, tmp_path: Path, argument: str, value: str, reason: str
) -> None:
    if argument == "params_file" and not value.startswith("/"):
        path = tmp_path / "wrong.yaml"
        path.write_bytes(value.encode("latin-1"))
        value = str(path)
    with pytest.raises(RuntimeError, match=reason):
        launch(workspace, **{argument: value})


def test_an_empty_parameter_file_is_enough(
    workspace: Workspace, tmp_path: Path
) -> None:
    empty = tmp_path / "empty.yaml"
    empty.touch()
    # Of real processes each would be started again and again.
    started = launch(workspace, params_file=str(empty), use_respawn=str(not HAS_LAUNCH))
    left_out = {"route_server", "collision_monitor", "docking_server"}
    assert set(node_names(started)) == SERVERS.keys() - left_out
    if not HAS_LAUNCH:
        assert all(started[name].respawn for name in node_names(started))
