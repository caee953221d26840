"""Starts the whole of Nav2, with this package's planner in place of its own.

``ros2 launch ddqn_planner navigation.launch.py map:=/path/to/map.yaml``; docs/nav2.md
explains it.
"""

import os
import tempfile

import yaml
from ament_index_python.packages import (
    PackageNotFoundError,
    get_package_prefix,
    get_package_share_directory,
)
from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    LogInfo,
    OpaqueFunction,
    SetEnvironmentVariable,
)
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch_ros.actions import Node, PushROSNamespace, SetParameter
from launch_ros.descriptions import ParameterFile

PLANNER = "ddqn_planner"
MANAGER = "lifecycle_manager_navigation"

ARGUMENTS = {
    "namespace": ("", "Namespace of all nodes, such as robot1"),
    "use_sim_time": ("false", "Take the time from /clock"),
    "params_file": (
        "",
        "Parameters of all nodes; empty: nav2_params.yaml of nav2_bringup",
    ),
    "model": (
        "",
        "A shipped model or a file; empty: that of params_file, else any_map",
    ),
    "planner_id": (
        "",
        "The planner's name in behavior trees; empty: that of params_file",
    ),
    "server_timeout": ("200", "Least default_server_timeout of bt_navigator, ms"),
    "map": ("", "The map's YAML file; empty: that of params_file"),
    "slam": ("false", "Make the map with slam_toolbox"),
    "use_localization": ("true", "Start map_server and amcl, or SLAM"),
    "keepout_mask": ("", "The YAML file of a keepout mask; empty: no keepout zones"),
    "speed_mask": ("", "The YAML file of a speed mask; empty: no speed zones"),
    "graph": ("", "The graph of route_server; empty: that of params_file"),
    "autostart": ("true", "Let the lifecycle manager activate all nodes"),
    "use_respawn": ("false", "Start a node again when it ends"),
    "log_level": ("info", "Level of all logs"),
    "rviz": ("false", "Start RViz"),
    "rviz_config": ("", "RViz's configuration; empty: that of this package"),
}
"""The arguments, each with its default and its description."""

# Those that Nav2's own launch files have, too.
COMMON_ARGUMENTS = (
    "use_sim_time",
    "params_file",
    "autostart",
    "use_respawn",
    "log_level",
)
SWITCHES = (
    "use_sim_time",
    "slam",
    "use_localization",
    "autostart",
    "use_respawn",
    "rviz",
)
FILES = ("params_file", "map", "keepout_mask", "speed_mask", "graph", "rviz_config")

# As Nav2's own launch files do: a robot in a namespace has transforms of its own.
TRANSFORMS = [("/tf", "tf"), ("/tf_static", "tf_static")]
NAV_VELOCITY = ("cmd_vel", "cmd_vel_nav")

# Each action of planner_server is five hidden names, which Jazzy remaps one by one.
ACTIONS = ("compute_path_to_pose", "compute_path_through_poses")
ACTION_PARTS = ("send_goal", "cancel_goal", "get_result", "feedback", "status")
MOVED_AWAY = [
    *(f"{action}/_action/{part}" for action in ACTIONS for part in ACTION_PARTS),
    "is_path_valid",
]
MOVED_TO = "planner_server"
OUT_OF_THE_WAY = [(name, f"{MOVED_TO}/{name}") for name in MOVED_AWAY]

# Nav2's nodes in the order in which they are activated: package, executable, name,
# remaps. planner_server runs the global costmap. bt_navigator needs the actions of the
# planner.
SERVERS = (
    ("nav2_controller", "controller_server", "controller_server", [NAV_VELOCITY]),
    ("nav2_smoother", "smoother_server", "smoother_server", []),
    ("nav2_planner", "planner_server", "planner_server", OUT_OF_THE_WAY),
    ("ddqn_planner", "planner_node", PLANNER, []),
    ("nav2_route", "route_server", "route_server", []),
    ("nav2_behaviors", "behavior_server", "behavior_server", [NAV_VELOCITY]),
    (
        "nav2_velocity_smoother",
        "velocity_smoother",
        "velocity_smoother",
        [NAV_VELOCITY],
    ),
    ("nav2_collision_monitor", "collision_monitor", "collision_monitor", []),
    ("nav2_bt_navigator", "bt_navigator", "bt_navigator", []),
    ("nav2_waypoint_follower", "waypoint_follower", "waypoint_follower", []),
    ("opennav_docking", "opennav_docking", "docking_server", []),
    ("opennav_following", "opennav_following", "following_server", []),
)
# Releases of Nav2 differ in these. They do not start without parameters of their own.
OPTIONAL = ("route_server", "collision_monitor", "docking_server", "following_server")

PLANNER_DEFAULTS = {
    "map_type": "costmap",
    "allow_unknown": True,  # as NavFn's default
    "start_source": "tf",  # for requests without a start
    "other_planners": MOVED_TO,  # there Nav2's planners answer, by their own names
}
PLANNER_REMAPS = [
    ("map", "global_costmap/costmap"),
    ("published_footprint", "global_costmap/published_footprint"),
    # bt_navigator plans for RViz's goals.
    ("goal_pose", f"{PLANNER}/goal_pose"),
]
# The topics of rviz/ddqn_planner.rviz, which RViz does not put into a namespace by
# itself.
RVIZ_TOPICS = {
    "/map": "map",
    "/map_updates": "map_updates",
    "/plan": "plan",
    "/planner/value": f"{PLANNER}/value",
    "/planner/value_updates": f"{PLANNER}/value_updates",
    "/trainer/episode": "trainer/episode",
    "/trainer/episode_markers": "trainer/episode_markers",
    "/initialpose": "initialpose",
    "/goal_pose": "goal_pose",
}


def is_true(name, value):
    """Return the truth value of an argument."""
    truth = {
        "true": True,
        "1": True,
        "yes": True,
        "false": False,
        "0": False,
        "no": False,
    }
    if value.lower() not in truth:
        raise RuntimeError(
            f"{name}:={value} is neither true nor false; give one of them"
        )
    return truth[value.lower()]


def milliseconds(name, value):
    """Return an argument that is a time in whole milliseconds."""
    if not value.isascii() or not value.isdigit() or int(value) == 0:
        raise RuntimeError(
            f"{name}:={value} is no time; give whole milliseconds, such as 200"
        )
    return int(value)


def absolute_namespace(namespace):
    """Return an argument as the beginning of full names: /robot1, or nothing."""
    name = namespace.strip("/")
    return f"/{name}" if name else ""


def read_parameter_file(path):
    """Return the content of a parameter file."""
    try:
        with open(path, encoding="utf-8") as file:
            document = yaml.safe_load(file) or {}
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise RuntimeError(f"params_file:={path} cannot be read: {error}") from error
    if not isinstance(document, dict):
        raise RuntimeError(
            f"params_file:={path} has no nodes; give a parameter file of ROS 2"
        )
    return document


def sections(document, path=()):
    """Yield the keys that lead to each node of a parameter file, and its parameters."""
    for key, value in document.items():
        if key == "ros__parameters":
            yield path, value or {}
        elif isinstance(value, dict):
            yield from sections(value, (*path, str(key)))


def nodes_of(document, namespace):
    """Return the parameters by the node's full name.

    A relative name is in the namespace.
    """
    nodes = {}
    for path, parameters in sections(document):
        name = "/".join(path)
        if not name.startswith("/"):
            name = f"/{name}"
            if not name.startswith(f"{namespace}/"):
                name = namespace + name
        nodes.setdefault(name, {}).update(parameters)
    return nodes


def parameters_of(nodes, namespace, name):
    """Return the parameters that a node takes; its full name goes before wildcards."""
    parameters = {}
    for key in ("/**", f"/**/{name}", f"{namespace}/{name}"):
        parameters.update(nodes.get(key, {}))
    return parameters


def raise_parameter(nodes, namespace, node, name, minimum):
    """Let a parameter be at least as large as the minimum.

    A substitution, which is a string, stays.
    """
    value = parameters_of(nodes, namespace, node).get(name, minimum)
    if isinstance(value, str) or isinstance(minimum, str):
        return
    parameters = nodes.setdefault(f"{namespace}/{node}", {})
    parameters[name] = max(value, minimum)


def with_zones(value, zones):
    """Return parameters in which the placeholders of Nav2's zones are true or false."""
    if isinstance(value, dict):
        return {key: with_zones(entry, zones) for key, entry in value.items()}
    if isinstance(value, list):
        return [with_zones(entry, zones) for entry in value]
    if isinstance(value, str):
        return zones.get(value, value)
    return value


def saved(nodes):
    """Return a parameter file; Nav2's files may hold launch's substitutions."""
    document = {
        name: {"ros__parameters": parameters} for name, parameters in nodes.items()
    }
    options = {"prefix": "ddqn_planner_", "suffix": ".yaml", "delete": False}
    with tempfile.NamedTemporaryFile("w", encoding="utf-8", **options) as file:
        yaml.safe_dump(document, file, sort_keys=False)
    return ParameterFile(file.name, allow_substs=True)


def nav2_parameters(arguments, namespace):
    """Return the parameters of the file with what the arguments change in them."""
    document = read_parameter_file(arguments["params_file"])
    # From Kilted on, Nav2's own file has these words in place of true and false.
    zones = {
        "KEEPOUT_ZONE_ENABLED": bool(arguments["keepout_mask"]),
        "SPEED_ZONE_ENABLED": bool(arguments["speed_mask"]),
    }
    nodes = nodes_of(with_zones(document, zones), namespace)
    timeout = milliseconds("server_timeout", arguments["server_timeout"])
    raise_parameter(nodes, namespace, "bt_navigator", "default_server_timeout", timeout)
    # The planner sees of the costmap what is published.
    costmap = f"{namespace}/global_costmap"
    costmap_parameters = parameters_of(nodes, costmap, "global_costmap")
    frequency = costmap_parameters.get("update_frequency", 5.0)
    raise_parameter(nodes, costmap, "global_costmap", "publish_frequency", frequency)
    if arguments["graph"]:
        route = nodes.setdefault(f"{namespace}/route_server", {})
        route["graph_filepath"] = arguments["graph"]
    return nodes


def planner_parameters(nodes, arguments, namespace):
    """Return planner_node's parameters.

    They are defaults for Nav2, its section of the file, and the arguments.
    """
    costmap = parameters_of(nodes, f"{namespace}/global_costmap", "global_costmap")
    defaults = {
        "robot_frame": costmap.get("robot_base_frame", "base_link"),
        **PLANNER_DEFAULTS,
    }
    parameters = {**defaults, **parameters_of(nodes, namespace, PLANNER)}
    for name in ("model", "planner_id"):
        if arguments[name]:
            parameters[name] = arguments[name]
    return {**parameters, "autostart": False}  # the lifecycle manager activates it


def is_installed(package):
    """Return whether ROS finds a package."""
    try:
        get_package_prefix(package)
    except PackageNotFoundError:
        return False
    return True


def servers_of(nodes, namespace):
    """Return the servers to start.

    An optional one needs its package and its parameters.
    """
    servers = []
    for server in SERVERS:
        package, _, name, _ = server
        if name in OPTIONAL:
            has_parameters = bool(parameters_of(nodes, namespace, name))
            if not has_parameters or not is_installed(package):
                continue
        servers.append(server)
    return servers


def nav2_nodes(arguments, namespace):
    """Return Nav2's nodes with the planner, and the manager of their lifecycle."""
    nodes = nav2_parameters(arguments, namespace)
    parameter_file = saved(nodes)
    parameters = planner_parameters(nodes, arguments, namespace)
    planner_file = saved({f"{namespace}/{PLANNER}": parameters})
    servers = servers_of(nodes, namespace)
    names = [name for _, _, name, _ in servers]
    options = {
        "namespace": namespace or "/",
        "arguments": ["--ros-args", "--log-level", arguments["log_level"]],
        "output": "screen",
    }
    actions = []
    for package, executable, name, remaps in servers:
        remappings = [*TRANSFORMS, *remaps]
        parameters = [parameter_file]
        respawn_delay = 2.0
        if name == PLANNER:
            remappings += PLANNER_REMAPS
            parameters = [planner_file]
            respawn_delay = 1.0  # it is back before the manager gives up
        if name == "velocity_smoother" and "collision_monitor" not in names:
            # Else nothing would pass the velocities on.
            remappings.append(("cmd_vel_smoothed", "cmd_vel"))
        node = Node(
            package=package,
            executable=executable,
            name=name,
            parameters=parameters,
            remappings=remappings,
            respawn=arguments["use_respawn"],
            respawn_delay=respawn_delay,
            **options,
        )
        actions.append(node)
    managed = {"autostart": arguments["autostart"], "node_names": names}
    manager = Node(
        package="nav2_lifecycle_manager",
        executable="lifecycle_manager",
        name=MANAGER,
        parameters=[parameter_file, managed],
        **options,
    )
    not_started = ", ".join(name for name in OPTIONAL if name not in names)
    if not_started:
        reason = "no package, or no parameters in params_file"
        actions.append(LogInfo(msg=f"not started: {not_started} ({reason})"))
    return [*actions, manager]


def nav2_launch_file(name, arguments, namespace, **options):
    """Return the actions of one of Nav2's own launch files."""
    folder = os.path.join(get_package_share_directory("nav2_bringup"), "launch")
    path = os.path.join(folder, name)
    if not os.path.exists(path):
        raise RuntimeError(f"{folder} has no {name}; leave out what needs it")
    launch_arguments = {
        "namespace": namespace,  # absolute, as some releases go into it once more
        "use_composition": "False",
        **options,
    }
    for argument in COMMON_ARGUMENTS:
        launch_arguments[argument] = str(arguments[argument])
    actions = []
    if namespace:
        actions.append(PushROSNamespace(namespace))
    include = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(path), launch_arguments=launch_arguments.items()
    )
    return GroupAction([*actions, include])


def localization(arguments, namespace):
    """Return what makes or serves the map, and the masks on it."""
    actions = []
    if arguments["use_localization"]:
        if arguments["slam"]:
            actions.append(nav2_launch_file("slam_launch.py", arguments, namespace))
        else:
            file = "localization_launch.py"
            options = {"map": arguments["map"]}
            actions.append(nav2_launch_file(file, arguments, namespace, **options))
    for zone in ("keepout", "speed"):
        mask = f"{zone}_mask"
        if arguments[mask]:
            options = {mask: arguments[mask], f"use_{zone}_zones": "True"}
            file = f"{zone}_zone_launch.py"
            actions.append(nav2_launch_file(file, arguments, namespace, **options))
    return actions


def rviz(arguments, namespace):
    """Return RViz, which in a namespace shows the robot of that namespace."""
    share = get_package_share_directory("ddqn_planner")
    config = arguments["rviz_config"]
    if not config:
        config = os.path.join(share, "rviz", "ddqn_planner.rviz")
    return Node(
        package="rviz2",
        executable="rviz2",
        namespace=namespace or "/",
        arguments=["-d", config],
        remappings=TRANSFORMS + list(RVIZ_TOPICS.items()),
        output="screen",
    )


def actions_of(context):
    """Return all that is to be started with these arguments."""
    arguments = {name: context.launch_configurations[name] for name in ARGUMENTS}
    for name in SWITCHES:
        arguments[name] = is_true(name, arguments[name])
    for name in FILES:
        arguments[name] = os.path.expanduser(arguments[name])
    if not arguments["params_file"]:
        share = get_package_share_directory("nav2_bringup")
        arguments["params_file"] = os.path.join(share, "params", "nav2_params.yaml")
    namespace = absolute_namespace(arguments["namespace"])
    actions = [*localization(arguments, namespace), *nav2_nodes(arguments, namespace)]
    if arguments["rviz"]:
        actions.append(rviz(arguments, namespace))
    return [
        GroupAction([SetParameter("use_sim_time", arguments["use_sim_time"]), *actions])
    ]


def generate_launch_description():
    """Return the arguments, and what starts Nav2."""
    actions = [SetEnvironmentVariable("RCUTILS_LOGGING_BUFFERED_STREAM", "1")]
    for name, (default, description) in ARGUMENTS.items():
        argument = DeclareLaunchArgument(
            name, default_value=default, description=description
        )
        actions.append(argument)
    actions.append(OpaqueFunction(function=actions_of))
    return LaunchDescription(actions)
