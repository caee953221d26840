"""The parameters of all nodes: no request ends a node."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Callable
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
        command, env={**os.environ, **environment}, capture_output=True, text=True, timeout=60
    )
    assert ended.returncode == 1
    assert re.search(f"cannot start: .*({reason})", ended.stdout + ended.stderr)
    assert "Traceback" not in ended.stderr
