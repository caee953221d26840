"""What a parameter may be, and what users mean who write it in another way."""

import math
from array import array
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import field, fields
from types import MappingProxyType
from typing import Any, Final, NamedTuple, TypeVar

from rcl_interfaces import msg
from rclpy.exceptions import InvalidNamespaceException
from rclpy.validate_namespace import validate_namespace

NAMESPACES: Final = "namespaces"
MODELS: Final = "models that know a body"
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

NOTHING_REPLACED: Final[Mapping[str, str]] = MappingProxyType({})

# Of a number its least and greatest value; of a text its choices, or words for them.
Allowed = tuple[float, float] | list[str] | str
T = TypeVar("T")


class Declared(NamedTuple):
    """The declaration of a parameter, as users read it."""

    default: Any
    description: str
    allowed: Allowed = ""
    read_only: bool = False
    replaced: Mapping[str, str] = NOTHING_REPLACED  # by choices of older versions

    @property
    def limits(self) -> str:
        """Which values are allowed, in words."""
        if isinstance(self.allowed, tuple):
            form = "{} to {}" if isinstance(self.default, int) else "{:g} to {:g}"
            return form.format(*self.allowed)
        if isinstance(self.allowed, list):
            return f"one of {self.allowed}"
        return self.allowed

    def descriptor(self) -> msg.ParameterDescriptor:
        """Return the descriptor that ROS stores, by which it checks ranges."""
        descriptor = msg.ParameterDescriptor(
            description=self.description, read_only=self.read_only
        )
        if not isinstance(self.allowed, tuple):
            descriptor.additional_constraints = self.limits
            return descriptor
        number_type = type(self.default)
        low, high = self.allowed
        ends = {"from_value": number_type(low), "to_value": number_type(high)}
        if number_type is int:
            descriptor.integer_range = [msg.IntegerRange(**ends)]
        else:
            descriptor.floating_point_range = [msg.FloatingPointRange(**ends)]
        return descriptor

    def read(self, name: str, value: Any) -> Any:
        """Return a value that a user set, in the type of the default.

        A whole number is a number, and 65.0 is 65. A choice may have capitals, and
        blanks around it.

        Parameters
        ----------
        name : str
            The parameter's, for errors.
        value : object
            As ROS reads it from YAML, from a file, or gets it in a message.

        Raises
        ------
        ValueError
            If the parameter cannot have this value; with the remedy.
        """
        if isinstance(value, array):  # ROS makes it of a list of numbers
            value = value.tolist()
        if isinstance(self.default, list):
            return self._read_list(name, value)
        value = self._in_type(value)
        if type(value) is not type(self.default):
            raise ValueError(f"{name} is {self._shown(value)}; give {self._wanted}")
        if isinstance(self.allowed, tuple):
            return self._read_number(name, value, *self.allowed)
        if isinstance(self.allowed, list):
            return self._read_choice(name, value, self.allowed)
        if self.allowed == NOT_EMPTY and not value.strip():
            noun = self.description[0].lower() + self.description[1:]
            raise ValueError(f"{name} is {value!r}; name {noun}")
        return value

    def _in_type(self, value: object) -> Any:
        """Return a number in the type of the parameter's default, if nothing is lost.

        65 becomes 65.0 for a float, and 65.0 becomes 65 for an int. Any other value is
        returned unchanged.
        """
        default_type = type(self.default)
        if default_type is float and type(value) is int:
            return float(value)
        if default_type is int and type(value) is float and value.is_integer():
            return int(value)
        return value

    def _read_choice(self, name: str, value: str, choices: list[str]) -> str:
        """Return which of the choices a text means; see `read`."""
        choice = value.strip().lower()
        if choice in choices:
            return choice
        if choice in self.replaced:
            raise ValueError(f"{name} {choice} is gone; give {self.replaced[choice]}")
        names = ", ".join(choice or "''" for choice in choices)
        raise ValueError(f"{name} is {value!r}; give one of {names}")

    def _read_number(self, name: str, value: Any, low: float, high: float) -> Any:
        """Return a number from `low` to `high`, else raise a ValueError; see `read`.

        For a number beyond an end by no more than rounding, the end is returned.
        """
        if low <= value <= high:
            return value
        for end in (low, high):
            if math.isclose(value, end, rel_tol=ROUNDED):
                return type(value)(end)
        raise ValueError(f"{name} is {value}; give {self.limits}")

    def _read_list(self, name: str, value: Any) -> list[str]:
        """Return a list of texts without blanks at their ends; see `read`.

        Namespaces have no slashes at their ends either. Empty and repeated texts are
        left out. If none is left the list is [""], as ROS has no type for an empty
        list.
        """
        texts = [value] if isinstance(value, str) else value or []
        is_list = isinstance(texts, list)
        if not is_list or not all(isinstance(item, str) for item in texts):
            raise ValueError(f"{name} is {self._shown(value)}; give {self._wanted}")
        stripped = [text.strip() for text in texts]
        if self.allowed == NAMESPACES:
            stripped = [text.strip("/") for text in stripped]
        unique = [*dict.fromkeys(filter(None, stripped))]
        if self.allowed == NAMESPACES:
            _check_namespaces(name, unique)
        return unique or [""]

    @property
    def _wanted(self) -> str:
        """What to give, in words."""
        kind = type(self.default)
        if kind is bool:
            return "true or false"
        if kind is list:
            example = "[r1, r2]" if self.allowed == NAMESPACES else "[car, my/file]"
            return f"a list of {self.allowed}, such as {example}"
        return TYPES[kind] if kind is str else f"{TYPES[kind]}, {self.limits}"

    def _shown(self, value: object) -> str:
        """Return a wrong value in words: its type, and whether its quotes are wrong."""
        if value is None:  # also what ROS makes of [] and of blanks
            return "no value, an empty list or blanks"
        words = f"{value!r}, {TYPES.get(type(value), type(value).__name__)}"
        if isinstance(self.default, str) and isinstance(value, (bool, int, float)):
            return f"{words} (with quotes, '{value}', it is a text)"
        if isinstance(value, str) and isinstance(self.default, (bool, int, float)):
            return f"{words} (a number and a truth value have no quotes)"
        return words


def _check_namespaces(name: str, namespaces: Sequence[str]) -> None:
    """Raise a ValueError, with a parameter's name, if one of them is no namespace."""
    for namespace in namespaces:
        try:
            validate_namespace(f"/{namespace}")
        except InvalidNamespaceException:
            problem = f"{name} holds {namespace!r}, which is no namespace"
            remedy = "give letters, digits and _, such as r1"
            raise ValueError(f"{problem}; {remedy}") from None


Parameters = Mapping[str, Declared]


def parameter(
    default: T,
    description: str,
    allowed: Allowed = "",
    read_only: bool = False,
    replaced: Mapping[str, str] = NOTHING_REPLACED,
) -> T:
    """Declare a parameter as a field of a dataclass of settings.

    The arguments are the fields of `Declared`, which becomes the field's metadata.
    """
    declaration = Declared(default, description, allowed, read_only, replaced)
    metadata = {"declaration": declaration}
    entry: T
    if isinstance(default, list):  # each instance has a list of its own
        entry = field(default_factory=lambda: copy(default), metadata=metadata)
    else:
        entry = field(default=default, metadata=metadata)
    return entry


def declared_by(settings: Any) -> dict[str, Declared]:
    """Return what the fields of a dataclass of settings declare, by their names."""
    return {entry.name: entry.metadata["declaration"] for entry in fields(settings)}


def read_all(parameters: Parameters, values: Mapping[str, object]) -> dict[str, Any]:
    """Return the values of some parameters in the types of their defaults.

    A ValueError names all values that are wrong, with remedies; see `Declared.read`.
    """
    typed_values = {}
    problems = []
    for name, value in values.items():
        try:
            typed_values[name] = parameters[name].read(name, value)
        except ValueError as error:
            problems.append(str(error))
    if problems:
        raise ValueError(" / ".join(problems))
    return typed_values
