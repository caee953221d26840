"""Digests of functions: another one for whatever may change their compiled code."""

import hashlib
import pickle
from collections.abc import Iterator, Mapping
from enum import Enum
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np


def digest_of(function: FunctionType, options: Mapping[str, object]) -> str:
    """Return 16 hexadecimal digits for a function, all constants that it reads, and options."""
    description = repr((_Describer().of(function), sorted(options.items())))
    return hashlib.sha256(description.encode()).hexdigest()[:16]


def global_names(code: CodeType) -> set[str]:
    """Return the names of globals and attributes that code uses, with those of functions in it."""
    names = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            names |= global_names(constant)
    return names


class _Describer:
    """Turns values into plain ones whose texts differ, the same in each process."""

    def __init__(self) -> None:
        # Those that were described: functions may call each other.
        self._functions: set[FunctionType] = set()

    def of(self, value: Any, names: frozenset[str] = frozenset()) -> object:
        """Return the description of a value; of a module or a class, the attributes in `names`."""
        kind = _name_of(type(value))
        match value:
            case np.ndarray() if value.dtype.hasobject:
                return kind, value.shape, self.of(value.tolist())
            case np.ndarray() | np.generic():
                content = hashlib.sha256(value.tobytes()).hexdigest()
                return kind, repr(value.dtype), value.shape, content
            case Enum():
                return kind, value.name, self.of(value.value)
            case None | bool() | int() | float() | complex() | str() | bytes():
                return kind, repr(value)
            case tuple() | list():
                fields = getattr(value, "_fields", ())
                return kind, fields, [self.of(item) for item in value]
            case set() | frozenset():
                return kind, sorted(repr(self.of(item)) for item in value)
            case dict():
                return kind, [
                    (self.of(key), self.of(item)) for key, item in value.items()
                ]
            case CodeType():
                return kind, self._of_code(value)
            case FunctionType():
                return kind, self._of_function(value)
            case ModuleType() | type():
                fields = getattr(value, "_fields", ())  # of a NamedTuple
                return (
                    kind,
                    _name_of(value),
                    fields,
                    list(self._attributes(value, names)),
                )
        if hasattr(value, "py_func"):  # compiled
            return kind, self.of(value.py_func)
        if hasattr(value, "__name__"):  # built in, or of NumPy
            return kind, _name_of(value)
        try:
            return kind, pickle.dumps(value)
        except Exception:  # then numba can hardly make a constant of it
            return kind

    def _attributes(self, owner: Any, names: frozenset[str]) -> Iterator[object]:
        # Not by `getattr` of a module, which may import another one.
        is_module = isinstance(owner, ModuleType)
        for name in sorted(names):
            value = (
                vars(owner).get(name, owner)
                if is_module
                else getattr(owner, name, owner)
            )
            if value is not owner:
                yield name, self.of(value, names - {name})

    def _of_code(self, code: CodeType) -> object:
        counts = code.co_argcount, code.co_kwonlyargcount, code.co_flags
        names = code.co_names, code.co_freevars
        return (
            code.co_code,
            counts,
            names,
            [self.of(constant) for constant in code.co_consts],
        )

    def _of_function(self, function: FunctionType) -> object:
        if function in self._functions:
            return function.__qualname__
        self._functions.add(function)
        names = frozenset(global_names(function.__code__))
        scope = function.__globals__
        constants = [
            (name, self.of(scope[name], names)) for name in sorted(names & scope.keys())
        ]
        defaults = self.of(function.__defaults__), self.of(function.__kwdefaults__)
        enclosed = [self.of(cell.cell_contents) for cell in function.__closure__ or ()]
        code = self._of_code(function.__code__)
        return function.__qualname__, code, constants, defaults, enclosed


def _name_of(value: Any) -> str:
    name = getattr(value, "__qualname__", value.__name__)
    return f"{getattr(value, '__module__', '')}.{name}"
