"""Runs a launch file on stand-ins of Nav2's packages, and tells what it starts.

With ROS's own `launch` where that is installed, which is not on PyPI; else with
stand-ins of it.
"""

import importlib.util
import itertools
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple
from unittest.mock import patch

import yaml

HAS_LAUNCH = importlib.util.find_spec("launch_ros") is not None

RECORDER = """#!{python}
import json, os, sys

pairs = zip(sys.argv, sys.argv[1:])
files = [word for before, word in pairs if before == "--params-file"]
contents = [open(file).read().replace("!!python/tuple", "") for file in files]
name = os.path.join("{records}", str(os.getpid()) + ".json")
with open(name, "w") as record:
    json.dump({{"words": sys.argv, "contents": contents}}, record)
"""
"""An executable that writes down how it was started."""

INCLUDED = """
from launch import LaunchDescription
from launch.actions import OpaqueFunction
from launch_ros.actions import Node

def started(context):
    values = dict(context.launch_configurations)
    names = {"namespace", "map", "use_sim_time", "params_file", "autostart"}
    names |= {"use_respawn", "keepout_mask", "speed_mask", "use_composition"}
    parameters = {name: values[name] for name in names if name in values}
    return [Node(package="nav2_bringup", executable="NAME", parameters=[parameters])]

def generate_launch_description():
    return LaunchDescription([OpaqueFunction(function=started)])
"""
"""A launch file that starts one executable, which writes down the arguments of the
file.
"""

LAUNCH = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

arguments = [word.split(":=", 1) for word in sys.argv[2:]]
source = PythonLaunchDescriptionSource(sys.argv[1])
included = IncludeLaunchDescription(source, launch_arguments=arguments)
service = LaunchService(noninteractive=True)
service.include_launch_description(LaunchDescription([included]))
sys.exit(service.run())
"""
"""What `ros2 launch` does."""


class Started(NamedTuple):
    """A process that was started: of which node, where, and with what."""

    executable: str
    namespace: str
    parameters: dict[str, Any]
    remaps: dict[str, str]
    files: dict[str, Any]  # the parameter files: what each node in them takes
    arguments: list[str]
    respawn: bool | None  # None: not told


class Workspace:
    """A folder in which ROS finds the packages that it is asked for."""

    def __init__(self, folder: Path) -> None:
        self.prefix = folder / "install"
        self.records = folder / "records"
        self.records.mkdir()

    def add(self, package: str, *executables: str) -> Path:
        """Add a package whose executables write down how they are started; return its
        share.
        """
        marker = self.prefix / "share/ament_index/resource_index/packages" / package
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.touch()
        programs = self.prefix / "lib" / package
        programs.mkdir(parents=True, exist_ok=True)
        for name in executables:
            program = programs / name
            program.write_text(
                RECORDER.format(python=sys.executable, records=self.records)
            )
            program.chmod(0o755)
        share = self.prefix / "share" / package
        share.mkdir(parents=True, exist_ok=True)
        return share

    def add_launch_file(self, name: str) -> None:
        """Add a launch file to Nav2's bringup."""
        folder = self.add("nav2_bringup", name) / "launch"
        folder.mkdir(exist_ok=True)
        (folder / name).write_text(INCLUDED.replace("NAME", name))

    def launch(self, file: Path, **arguments: str) -> dict[str, Started]:
        """Run a launch file, and return what was started by the names of nodes."""
        if HAS_LAUNCH:
            return self._really_launch(file, arguments)
        return _launch_stand_ins(file, arguments, self.prefix)

    def _really_launch(
        self, file: Path, arguments: Mapping[str, str]
    ) -> dict[str, Started]:
        for record in self.records.iterdir():
            record.unlink()
        paths = [str(self.prefix), os.environ.get("AMENT_PREFIX_PATH", "")]
        environment = {
            **os.environ,
            "AMENT_PREFIX_PATH": os.pathsep.join(filter(None, paths)),
        }
        words = [f"{name}:={value}" for name, value in arguments.items()]
        command = [sys.executable, "-c", LAUNCH, str(file), *words]
        run = subprocess.run(
            command, env=environment, capture_output=True, text=True, check=False
        )
        if run.returncode:
            raise RuntimeError(run.stdout + run.stderr)
        started = {}
        for record in self.records.iterdir():
            name, process = _read_record(json.loads(record.read_text()))
            started[name] = process
        return started


def _read_record(record: Any) -> tuple[str, Started]:
    """Return a node's name, and how it was started."""
    path, *words = record["words"]
    pairs = list(itertools.pairwise(words))
    rules = [word.split(":=") for before, word in pairs if before == "-r"]
    remaps = {source: target for source, target in rules if not source.startswith("__")}
    special = {source: target for source, target in rules if source.startswith("__")}
    name = special["__node"] if "__node" in special else Path(path).name
    namespace = special.get("__ns", "/")
    parameters = {}
    for before, word in pairs:
        if before == "-p":
            key, value = word.split(":=")
            parameters[key] = yaml.safe_load(value)
    files = _together(yaml.safe_load(content) for content in record["contents"])
    parameters.update(_parameters_of(name, namespace, files))
    return name, Started(
        Path(path).name, namespace, parameters, remaps, files, words, None
    )


def _together(documents: Iterable[Any]) -> dict[str, Any]:
    """Return the parameters by the keys of parameter files; later ones go before
    earlier ones.
    """
    files: dict[str, Any] = {}
    for document in documents:
        for key, section in document.items():
            files.setdefault(key, {}).update(section["ros__parameters"])
    return files


def _parameters_of(
    name: str, namespace: str, files: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what a node takes of parameter files; its full name goes before a
    wildcard.
    """
    full_name = f"{namespace.rstrip('/')}/{name}"
    return {**files.get("/**", {}), **files.get(full_name, {})}


# Stand-ins of `launch`: what a launch file makes of it, they keep as it is.


def _action(kind: str, *values: Any, **options: Any) -> SimpleNamespace:
    return SimpleNamespace(kind=kind, values=values, options=options)


KINDS = {
    "launch": ["LaunchDescription"],
    "launch.actions": [
        "DeclareLaunchArgument",
        "GroupAction",
        "IncludeLaunchDescription",
        "LogInfo",
        "OpaqueFunction",
        "SetEnvironmentVariable",
    ],
    "launch.launch_description_sources": ["PythonLaunchDescriptionSource"],
    "launch_ros": [],
    "launch_ros.actions": ["Node", "PushROSNamespace", "SetParameter"],
    "launch_ros.descriptions": ["ParameterFile"],
}


def _stand_ins() -> dict[str, ModuleType]:
    modules = {}
    for module, kinds in KINDS.items():
        modules[module] = ModuleType(module)
        for kind in kinds:
            setattr(modules[module], kind, partial(_action, kind))
    return modules


def _flat(
    actions: Any, scope: Mapping[str, str]
) -> Iterator[tuple[Any, Mapping[str, str]]]:
    """Yield actions with what the groups around them have set."""
    scope = dict(scope)
    for action in actions:
        if action.kind == "PushROSNamespace":
            scope["namespace"] = action.values[0]
        elif action.kind == "SetParameter":
            scope[action.values[0]] = action.values[1]
        elif action.kind == "GroupAction":
            yield from _flat(action.values[0], scope)
        else:
            yield action, scope


def _launch_stand_ins(
    file: Path, arguments: Mapping[str, str], prefix: Path
) -> dict[str, Started]:
    spec = importlib.util.spec_from_file_location("launch_file", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    environment = {"AMENT_PREFIX_PATH": str(prefix)}
    with patch.dict(sys.modules, _stand_ins()), patch.dict(os.environ, environment):
        spec.loader.exec_module(module)
        actions = module.generate_launch_description().values[0]
        declared = [
            action for action in actions if action.kind == "DeclareLaunchArgument"
        ]
        values = {
            action.values[0]: action.options["default_value"] for action in declared
        }
        assert set(arguments) <= set(values)
        assert all(action.options["description"] for action in declared)
        context = SimpleNamespace(launch_configurations={**values, **arguments})
        functions = [action for action in actions if action.kind == "OpaqueFunction"]
        started = {}
        for function in functions:
            for action, scope in _flat(function.options["function"](context), {}):
                if action.kind in ("Node", "IncludeLaunchDescription"):
                    name, process = _read_action(action, scope, prefix)
                    assert name not in started
                    started[name] = process
    return started


def _read_action(
    action: Any, scope: Mapping[str, str], prefix: Path
) -> tuple[str, Started]:
    options = action.options
    pushed = scope.get("namespace", "/")
    if action.kind == "IncludeLaunchDescription":
        path = Path(action.values[0].values[0])
        assert path.is_file()
        parameters = dict(options["launch_arguments"])
        return path.name, Started(path.name, pushed, parameters, {}, {}, [], None)
    executable, namespace = options["executable"], options.get("namespace", pushed)
    assert (prefix / "lib" / options["package"] / executable).is_file()
    name = options.get("name", executable)
    documents = []
    for source in options.get("parameters", []):
        if isinstance(source, dict):
            full_name = f"{namespace.rstrip('/')}/{name}"
            documents.append({full_name: {"ros__parameters": source}})
        else:
            assert source.options == {"allow_substs": True}
            documents.append(yaml.safe_load(Path(source.values[0]).read_text()))
    files = _together(documents)
    parameters = {key: value for key, value in scope.items() if key != "namespace"}
    parameters.update(_parameters_of(name, namespace, files))
    remaps = dict(options.get("remappings", []))
    words, respawn = options["arguments"], options.get("respawn")
    return name, Started(
        executable, namespace, parameters, remaps, files, words, respawn
    )
