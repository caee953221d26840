"""The help of a node's executable."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

from rclpy.node import Node
from rclpy.parameter import Parameter

from ddqn_planner.nodes.declared import Declared, Parameters

HELP = """\
usage: {program} [--ros-args [-p PARAMETER:=VALUE] [--params-file FILE]
                 [-r NAME:=NEW_NAME] ...]

{summary}

Set parameters at the start with -p or in a file. Those that are not read-only can also
be set while the node runs, with `ros2 param set NODE PARAMETER VALUE`. Each topic that
the node reads also has qos_overrides.TOPIC.subscription.POLICY, where POLICY is
history, depth, durability or reliability.
"""


def print_help(make_node: Callable[[], Node], parameters: Parameters) -> int:
    """Print what a node does, and its parameters; return the exit code 0.

    The docstring of `make_node`, the node's class, says what the node does.
    """
    summary = (make_node.__doc__ or "").replace("``", "")
    print(HELP.format(program=Path(sys.argv[0]).name, summary=summary))
    for name, declared in parameters.items():
        print(f"  {name}: {_form(declared)}\n      {declared.description}")
    return 0


def _form(declared: Declared) -> str:
    """Return a parameter's type, its default and its limits in words."""
    default = declared.default
    kind = Parameter.Type.from_parameter_value(default).name.lower()
    value = repr(default) if isinstance(default, str) else json.dumps(default)
    words = [f"{kind}, default {value}"]
    if declared.limits:
        words.append(declared.limits)
    if declared.read_only:
        words.append("read-only")
    return "; ".join(words)
