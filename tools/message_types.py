"""Writes type stubs of ROS's message packages, which have no types, for mypy.

.venv/bin/python tools/message_types.py typings

A package that is not installed stays without types.
"""

import re
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

from rosidl_parser import definition

# What the code imports. The packages of the fields of their messages are added.
PACKAGES = (
    "action_msgs",
    "diagnostic_msgs",
    "lifecycle_msgs",
    "nav_msgs",
    "rcl_interfaces",
    "rosgraph_msgs",
    "std_srvs",
    "test_msgs",
    "tf2_msgs",
    "visualization_msgs",
)
KINDS = ("msg", "srv", "action")
FLOATS = definition.FLOATING_POINT_TYPES
# All other basic types are integers.
PYTHON_TYPES = {"boolean": "bool", "octet": "bytes", **dict.fromkeys(FLOATS, "float")}
NUMPY_TYPES = {"float": "float32", "double": "float64"}
# Sequences of numbers are arrays; sequences of all else, also of bytes, are lists.
NUMBERS = (*definition.EXPLICIT_INTEGER_TYPES, *FLOATS)
MODULE = re.compile(rf"\b\w+\.(?:{'|'.join(KINDS)})\b")
HEAD = """\
from array import array
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
"""


def type_of_value(idl: definition.AbstractType) -> str:
    """Return the Python type of a field that is no sequence."""
    if isinstance(idl, definition.NamespacedType):
        return ".".join([*idl.namespaces, idl.name])
    if isinstance(idl, definition.BasicType):
        return PYTHON_TYPES.get(idl.typename, "int")
    return "str"


def types_of_field(idl: definition.AbstractType) -> tuple[str, str]:
    """Return the type that a field has, and the type of what can be assigned to it."""
    if not isinstance(idl, definition.AbstractNestedType):
        return type_of_value(idl), type_of_value(idl)
    item = type_of_value(idl.value_type)
    number = getattr(idl.value_type, "typename", "")
    if number not in NUMBERS:
        return f"list[{item}]", f"Sequence[{item}]"
    if isinstance(idl, definition.Array):
        array = f"NDArray[np.{NUMPY_TYPES.get(number, number)}]"
        return array, f"{array} | Sequence[{item}]"
    return f"array[{item}]", f"Sequence[{item}]"


def message_stub(message: type) -> Iterator[str]:
    """Yield the lines of the class of a message."""
    yield f"class {message.__name__}:"
    for name, value in vars(message).items():
        if name.isupper() and isinstance(value, (bytes, float, int, str)):
            yield f"    {name}: {type(value).__name__}"
    options = ["check_fields: bool = ..."]
    names = message.get_fields_and_field_types()
    for name, idl in zip(names, message.SLOT_TYPES, strict=True):
        value_type, assigned_type = types_of_field(idl)
        options.append(f"{name}: {assigned_type} = ...")
        yield "    @property"
        yield f"    def {name}(self) -> {value_type}: ..."
        yield f"    @{name}.setter"
        yield f"    def {name}(self, value: {assigned_type}) -> None: ..."
    yield f"    def __init__(self, *, {', '.join(options)}) -> None: ..."
    yield "    @classmethod"
    yield "    def get_fields_and_field_types(cls) -> dict[str, str]: ..."


def group_stub(group: type, indent: str = "") -> Iterator[str]:
    """Yield the lines of the class of a service or an action, which names messages."""
    yield f"{indent}class {group.__name__}:"
    for name, member in vars(group).items():
        if not isinstance(member, type):
            continue
        if name == "Impl":  # of an action
            yield from group_stub(member, f"{indent}    ")
        else:
            package, kind, _ = member.__module__.split(".")
            yield f"{indent}    {name}: TypeAlias = {package}.{kind}.{member.__name__}"


def module_stub(package: str, kind: str) -> str:
    """Return the stub of a package's messages, services or actions."""
    lines: list[str] = []
    for member in vars(import_module(f"{package}.{kind}")).values():
        if hasattr(member, "get_fields_and_field_types"):
            lines += message_stub(member)
        elif isinstance(member, type):
            lines += group_stub(member)
    classes = "\n".join(lines)
    modules = sorted({*MODULE.findall(classes)})
    imports = "".join(f"import {module}\n" for module in modules)
    return f"{HEAD}{imports}\n{classes}\n"


def main() -> None:
    """Write the stubs of all packages into a folder."""
    folder = Path(sys.argv[1])
    packages = [*PACKAGES]  # grows while its stubs are written
    for package in packages:
        for kind in KINDS:
            try:
                stub = module_stub(package, kind)
            except ModuleNotFoundError:
                continue
            file = folder / package / kind / "__init__.pyi"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(stub, encoding="utf-8")
            (folder / package / "__init__.pyi").touch()
            for module in MODULE.findall(stub):
                name = module.partition(".")[0]
                if name not in packages:
                    packages.append(name)


if __name__ == "__main__":
    main()
