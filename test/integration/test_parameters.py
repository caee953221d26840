"""The parameters of all nodes: no request ends a node."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from processes import executable
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)

DOCS = (Path(__file__).resolve().parents[2] / "docs" / "nodes.md").read_text(encoding="utf-8")
NAMES = ["", "no_such", "a.b", "/", "ü" * 300]


@pytest.mark.parametrize("name", ["map_server", "planner", "trainer"])
def test_no_request_for_parameters_ends_a_node(
    run_node: Any, make_client: Callable[[str], Any], name: str
) -> None:
    client = make_client(f"/asked/{name}")
    with run_node(f"{name}_node", {}, namespace=f"/asked/{name}") as node:

        def call(service: Any, kind: str, **request: Any) -> Any:
            return client.call(service, f"{name}/{kind}", service.Request(**request))

        unknown_type = ParameterMessage(name="use_sim_time", value=ParameterValue(type=77))
        no_name = ParameterMessage(value=ParameterValue(type=1, bool_value=True))
        unset = ParameterMessage(name="use_sim_time")
        for bad, reason in (
            (unknown_type, "77.*ParameterType"),
            (no_name, "no name; give one"),
            (unset, "."),
        ):
            (result,) = call(SetParameters, "set_parameters", parameters=[bad]).results
            together = call(
                SetParametersAtomically, "set_parameters_atomically", parameters=[bad]
            ).result
            for refused in (result, together):
                assert not refused.successful
                assert re.search(reason, refused.reason)
        assert call(SetParameters, "set_parameters").results == []
        assert call(SetParametersAtomically, "set_parameters_atomically").result.successful
        call(ListParameters, "list_parameters", prefixes=NAMES, depth=2**64 - 1)
        for kind, service in (
            ("describe_parameters", DescribeParameters),
            ("get_parameters", GetParameters),
            ("get_parameter_types", GetParameterTypes),
        ):
            call(service, kind, names=NAMES)
        names = call(ListParameters, "list_parameters").result.names
        assert len(call(GetParameters, "get_parameters", names=names).values) == len(names) > 3
        assert "Traceback" not in node.log


ROW = re.compile(r"\| `(\w+)` \| (\w+) \| `(.*?)` \|(.*?)\|")


@pytest.mark.parametrize("option", ["--help", "-h"])
@pytest.mark.parametrize("name", ["map_server", "planner", "trainer"])
def test_help_says_of_each_parameter_what_the_docs_say_and_starts_no_node(
    name: str, option: str, tmp_path: Path
) -> None:
    # With such a domain, such parameters and in such a folder no node starts.
    environment = {**os.environ, "ROS_DOMAIN_ID": "abc"}
    arguments = [option, "--ros-args", "-p", "model:=no_such", "-p", "map_file:=no_such"]
    helped = subprocess.run(
        [executable(f"{name}_node"), *arguments],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert helped.returncode == 0, helped.stderr
    assert helped.stderr == ""
    assert list(tmp_path.iterdir()) == []
    assert f"usage: {name}_node" in helped.stdout
    (section,) = (part for part in DOCS.split("\n## ") if part.startswith(f"{name}_node"))
    documented = {}
    for parameter, kind, default, limits in map(re.Match[str].groups, ROW.finditer(section)):
        value = default or "''"
        documented[parameter] = "; ".join(
            filter(None, [f"{kind}, default {value}", limits.strip()])
        )
    printed = re.findall(r"^  (\w+): (.*)\n      (\S.*)", helped.stdout, re.MULTILINE)
    assert {parameter: rest for parameter, rest, _ in printed} == documented
    assert len(printed) == len(documented) > 3


@pytest.mark.parametrize(
    ("arguments", "environment", "reason"),
    [
        (["-p", "model"], {}, "model"),
        (["--params-file", "/no/such.yaml"], {}, "such.yaml"),
        ([], {"ROS_DOMAIN_ID": "abc"}, "ROS_DOMAIN_ID"),
        (
            ["--enclave", "/nobody"],
            {
                "ROS_SECURITY_ENABLE": "true",
                "ROS_SECURITY_STRATEGY": "Enforce",
                "ROS_SECURITY_KEYSTORE": "/no/such/keystore",
            },
            "SECURITY|security|keystore|enclave",
        ),
    ],
)
def test_what_ros_cannot_start_with_is_said_and_ends_with_1(
    arguments: list[str], environment: dict[str, str], reason: str
) -> None:
    command = [executable("map_server_node"), "--ros-args", *arguments]
    ended = subprocess.run(
        command, env={**os.environ, **environment}, capture_output=True, text=True, timeout=600
    )
    assert ended.returncode == 1
    assert re.search(f"cannot start: .*({reason})", ended.stdout + ended.stderr)
    assert "Traceback" not in ended.stderr
