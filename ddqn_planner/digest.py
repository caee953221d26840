"""Digests of functions, which differ if their compiled code may differ."""

import hashlib
from collections.abc import Iterator, Mapping
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

MISSING = object()  # in place of the value of an attribute that does not exist


def digest_of(function: FunctionType, options: Mapping[str, object]) -> str:
    """Return 16 hexadecimal digits for a function and the options of its compilation.

    They depend on the function's code, and on all globals that it reads: constants, and
    functions with their own code and globals.
    """
    description = repr((_Describer().describe(function), sorted(options.items())))
    return hashlib.sha256(description.encode()).hexdigest()[:16]


def global_names(code: CodeType) -> set[str]:
    """Return the names of globals and attributes that code uses.

    The names that functions within the code use are among them.
    """
    names = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            names |= global_names(constant)
    return names


class _Describer:
    """Describes values by tuples, lists and texts, whose `repr` tells values apart.

    The description of a value is the same in each process. Constants of types that
    numba cannot compile, such as sets, need no description of their own.
    """

    def __init__(self) -> None:
        """Begin without any described function."""
        # The functions that have been described: functions may call each other.
        self._functions: set[FunctionType] = set()

    def describe(self, value: object, names: frozenset[str] = frozenset()) -> object:
        """Return a description of a value: the name of its type, and its content.

        The content of a module or a class are its attributes with names in `names`.
        """
        kind = _name_of(type(value))
        match value:
            case np.ndarray() | np.generic():
                content = hashlib.sha256(value.tobytes()).hexdigest()
                return kind, repr(value.dtype), value.shape, content
            case tuple() | list():
                items = [self.describe(item) for item in value]
                return kind, getattr(value, "_fields", ()), items
            case CodeType():
                return kind, self._code(value)
            case FunctionType():
                return kind, self._function(value)
            case ModuleType() | type():
                fields = getattr(value, "_fields", ())  # of a NamedTuple
                attributes = list(self._attributes(value, names))
                return kind, _name_of(value), fields, attributes
        if hasattr(value, "py_func"):  # compiled
            return kind, self.describe(value.py_func)
        if hasattr(value, "__name__"):  # built in, or of NumPy
            return kind, _name_of(value)
        return kind, repr(value)

    def _attributes(self, owner: object, names: frozenset[str]) -> Iterator[object]:
        """Yield the names and descriptions of attributes of a module or class `owner`.

        They are the attributes with names in `names` that `owner` has.
        """
        for name in sorted(names):
            # Not by `getattr` of a module, which may import another one.
            value: object
            if isinstance(owner, ModuleType):
                value = vars(owner).get(name, MISSING)
            else:
                value = getattr(owner, name, MISSING)
            if value is not MISSING:
                yield name, self.describe(value, names - {name})

    def _code(self, code: CodeType) -> object:
        """Describe the code of a function, with its constants."""
        counts = code.co_argcount, code.co_kwonlyargcount, code.co_flags
        names = code.co_names, code.co_freevars
        constants = [self.describe(constant) for constant in code.co_consts]
        return code.co_code, counts, names, constants

    def _function(self, function: FunctionType) -> object:
        """Describe a function with its defaults and all globals that it reads."""
        if function in self._functions:
            return function.__qualname__  # described before: a call in a circle ends
        self._functions.add(function)
        names = frozenset(global_names(function.__code__))
        scope = function.__globals__
        used_globals = [
            (name, self.describe(scope[name], names))
            for name in sorted(names & scope.keys())
        ]
        defaults_by_name = function.__kwdefaults__ or {}
        defaults = (
            self.describe(function.__defaults__),
            self.describe(tuple(defaults_by_name.items())),
        )
        closure = function.__closure__ or ()
        enclosed = [self.describe(cell.cell_contents) for cell in closure]
        code = self._code(function.__code__)
        return function.__qualname__, code, used_globals, defaults, enclosed


def _name_of(value: Any) -> str:
    """Return the module and the name of a class, function or module."""
    name = getattr(value, "__qualname__", value.__name__)
    return f"{getattr(value, '__module__', '')}.{name}"
