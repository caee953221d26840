"""What a parameter may be, and what users mean who write it in another way."""

import math
from array import array
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from rcl_interfaces import msg
from rclpy.exceptions import InvalidNamespaceException
from rclpy.validate_namespace import validate_namespace

NAMESPACES: Final = "namespaces"
NOT_EMPTY: Final = "not empty"
ROUNDED: Final = 1e-6  # share by which a number may lie beyond its range, as ROS has it

TYPES: Final[dict[type, str]] = {
    bool: "a truth value",
    int: "a whole number",
    float: "a number",
    str: "a text",
    list: "a list",
    bytes: "a list of bytes",
}


class Declared(NamedTuple):
    """What a user reads of a parameter; a number has a range, a text choices, or words for them."""

    default: Any
    description: str
    allowed: tuple[float, float] | list[str] | str = ""
    read_only: bool = False
    replaced: Mapping[str, str] = {}  # choices of older versions, with today's

    @property
    def limits(self) -> str:
        """Which values are allowed, in words."""
        if isinstance(self.allowed, tuple):
            form = "{} to {}" if isinstance(self.default, int) else "{:g} to {:g}"
            return form.format(*self.allowed)
        return (
            self.allowed if isinstance(self.allowed, str) else f"one of {self.allowed}"
        )

    def descriptor(self) -> msg.ParameterDescriptor:
        """Return what ROS stores of it, and checks: a number's type and range."""
        descriptor = msg.ParameterDescriptor(
            description=self.description, read_only=self.read_only
        )
        if not isinstance(self.allowed, tuple):
            descriptor.additional_constraints = self.limits
            return descriptor
        low, high = map(type(self.default), self.allowed)
        ends = {"from_value": low, "to_value": high}
        if isinstance(self.default, int):
            descriptor.integer_range = [msg.IntegerRange(**ends)]
        else:
            descriptor.floating_point_range = [msg.FloatingPointRange(**ends)]
        return descriptor

    def read(self, name: str, value: Any) -> Any:
        """Return what a value means, in the type of the default; a ValueError says what to give.

        A whole number is a number, and 65.0 is 65. A choice may have capitals and blanks around it.
        """
        default_type = type(self.default)
        if isinstance(value, array):  # ROS makes it of a list of numbers
            value = value.tolist()
        if default_type is list:
            return self._read_names(name, value)
        if default_type is float and type(value) is int:
            value = float(value)
        if default_type is int and type(value) is float and value.is_integer():
            value = int(value)
        if type(value) is not default_type:
            raise ValueError(f"{name} is {self._shown(value)}; give {self._wanted}")
        if isinstance(self.allowed, tuple):
            return self._read_number(name, value, *self.allowed)
        if isinstance(self.allowed, list):
            return self._read_choice(name, value, self.allowed)
        if self.allowed == NOT_EMPTY and not value.strip():
            words = self.description[0].lower() + self.description[1:]
            raise ValueError(f"{name} is {value!r}; name {words}")
        return value

    def _read_choice(self, name: str, value: str, choices: list[str]) -> str:
        choice = value.strip().lower()
        if choice in choices:
            return choice
        if choice in self.replaced:
            raise ValueError(f"{name} {choice} is gone; give {self.replaced[choice]}")
        names = ", ".join(choice or "''" for choice in choices)
        raise ValueError(f"{name} is {value!r}; give one of {names}")

    def _read_number(self, name: str, value: Any, low: float, high: float) -> Any:
        if low <= value <= high:
            return value
        for end in (low, high):
            if math.isclose(value, end, rel_tol=ROUNDED):
                return type(value)(end)
        raise ValueError(f"{name} is {value}; give {self.limits}")

    def _read_names(self, name: str, values: Any) -> list[str]:
        """Return the names of a list, without empty ones; ROS has no type for an empty list."""
        if isinstance(values, str):
            values = [values]
        if not isinstance(values, list) or not all(
            isinstance(value, str) for value in values
        ):
            if values:
                raise ValueError(
                    f"{name} is {self._shown(values)}; give {self._wanted}"
                )
            values = []
        names = [value.strip().strip("/") for value in values]
        names = [*dict.fromkeys(filter(None, names))]
        for space in names:
            try:
                validate_namespace(f"/{space}")
            except InvalidNamespaceException:
                wrong = f"{name} holds {space!r}, which is no namespace"
                raise ValueError(
                    f"{wrong}; give letters, digits and _, such as r1"
                ) from None
        return names or [""]

    @property
    def _wanted(self) -> str:
        kind = type(self.default)
        if kind is bool:
            return "true or false"
        if kind is list:
            return "a list of namespaces, such as [r1, r2]"
        return TYPES[kind] if kind is str else f"{TYPES[kind]}, {self.limits}"

    def _shown(self, value: Any) -> str:
        """Return a value and its type, and how to write it if only quotes are wrong."""
        if value is None:  # also what ROS makes of [] and of blanks
            return "no value, an empty list or blanks"
        words = f"{value!r}, {TYPES.get(type(value), type(value).__name__)}"
        if isinstance(self.default, str) and isinstance(value, (bool, int, float)):
            return f"{words} (with quotes, '{value}', it is a text)"
        if isinstance(value, str) and isinstance(self.default, (bool, int, float)):
            return f"{words} (a number and a truth value have no quotes)"
        return words


Parameters = Mapping[str, Declared]


def read_all(parameters: Parameters, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the values of some parameters mean; a ValueError names all that are wrong."""
    meant, wrong = {}, []
    for name, value in values.items():
        try:
            meant[name] = parameters[name].read(name, value)
        except ValueError as error:
            wrong.append(str(error))
    if wrong:
        raise ValueError(" / ".join(wrong))
    return meant
