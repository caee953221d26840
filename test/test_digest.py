"""Which changes give compiled functions another digest, and so new code."""

import math
from collections.abc import Callable
from enum import Enum, IntEnum
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps

from ddqn_planner.compiled import compiled
from ddqn_planner.digest import digest_of


class Color(Enum):
    RED = 1
    BLUE = 2


class Number(IntEnum):
    ONE = 1


class Point(NamedTuple):
    x: float
    y: float


class Vector(NamedTuple):
    x: float
    y: float


def function_of(source: str, **scope: Any) -> Any:
    """Return the function `f` that a source defines, with globals."""
    exec(source, scope)
    return scope["f"]


def digest(constant: object, body: str = "CONSTANT") -> str:
    return digest_of(
        function_of(f"def f(x):\n    return {body}", CONSTANT=constant), {}
    )


def changed_table(kind: Any) -> np.ndarray:
    table: np.ndarray = np.zeros((48, 48), kind)
    table[20, 30] = 1
    return table


CONSTANTS = [
    None,
    *(True, 1, 1.0, 1j, "1", b"1", -0.0, 0.0, math.nan, math.inf),
    *(
        kind(1)
        for kind in (np.bool_, np.int8, np.uint64, np.float32, np.float64, np.complex64)
    ),
    *(
        np.uint64(2),
        np.float32(1.0000001),
        np.str_("1"),
        np.datetime64(1, "s"),
        np.datetime64(1, "m"),
    ),
    *(
        np.zeros(2304),
        np.zeros((48, 48)),
        np.zeros((48, 48), np.float32),
        changed_table(float),
    ),
    *(
        changed_table(np.uint8),
        changed_table(np.int8),
        changed_table(bool),
        np.zeros((0, 3)),
    ),
    *(
        np.array(1),
        np.array([1]),
        np.array([(1, 2)], "i4,i4"),
        np.array([(1, 2)], "i4,u4"),
    ),
    *(
        (),
        (1,),
        ((1,),),
        (1, 1),
        ((1, 1),),
        (1, (1,)),
        ((1,), 1),
        (np.uint8(1),),
        (1.0,),
        ("1",),
    ),
    *(
        [1],
        range(1),
        range(2),
    ),
    *(
        Color.RED,
        Color.BLUE,
        Number.ONE,
        Point(1, 2),
        Vector(1, 2),
        Point(2, 1),
        Point,
        Vector,
        Color,
    ),
    *(
        math.sin,
        math.cos,
        np.sin,
        np.cos,
        np.uint8,
        np.uint16,
        int,
        float,
        np.dtype("i4"),
    ),
    *(numba.types.int32, numba.types.int64, np.linalg.norm),
]


def test_each_constant_has_a_digest_of_its_own() -> None:
    digests = [digest(constant) for constant in CONSTANTS]
    twins = [
        (CONSTANTS[digests.index(each)], constant)
        for number, (each, constant) in enumerate(zip(digests, CONSTANTS, strict=True))
        if digests.index(each) != number
    ]
    assert not twins


@given(nps.arrays(st.sampled_from([np.uint8, np.float32]), (6, 384)), st.data())
def test_any_entry_of_a_table_counts(table: np.ndarray, data: Any) -> None:
    before = digest(table)
    assert digest(table.copy()) == before == digest(np.asfortranarray(table))
    place = data.draw(st.tuples(st.integers(0, 5), st.integers(0, 383)))
    content = table[place].tobytes()
    other = table.copy()
    other.view(np.uint8).reshape(6, 384, -1)[place] ^= 1
    assert other[place].tobytes() != content
    assert digest(other) != before


def test_constants_count_wherever_the_function_gets_them() -> None:
    def module(value: object) -> ModuleType:
        constants = ModuleType("constants")
        constants.CONSTANT = value  # type: ignore[attr-defined]
        constants.inner = SimpleNamespace()  # type: ignore[attr-defined]
        return constants

    def outer(value: object) -> ModuleType:
        constants = ModuleType("outer")
        constants.inner = module(value)  # type: ignore[attr-defined]
        return constants

    def in_class(value: object) -> type:
        return type("Constants", (), {"CONSTANT": value})

    sources: list[tuple[str, Callable[[Any], dict[str, Any]]]] = [
        ("def f(x): return x + VALUE.CONSTANT", lambda value: {"VALUE": module(value)}),
        (
            "def f(x): return x + VALUE.inner.CONSTANT",
            lambda value: {"VALUE": outer(value)},
        ),
        (
            "def f(x): return x + VALUE.CONSTANT",
            lambda value: {"VALUE": in_class(value)},
        ),
        (
            "def f(x):\n def g(y): return y + VALUE\n return g(x)",
            lambda value: {"VALUE": value},
        ),
        (
            "def f(x): return sum([y + VALUE for y in x])",
            lambda value: {"VALUE": value},
        ),
        ("def f(x, y=VALUE): return x + y", lambda value: {"VALUE": value}),
        ("def f(x, *, y=VALUE): return x + y", lambda value: {"VALUE": value}),
        (
            "def f(x): return g(x)",
            lambda value: {"g": function_of("def f(x): return VALUE", VALUE=value)},
        ),
        (
            "def f(x): return g(x)",
            lambda value: {
                "g": numba.njit(function_of("def f(x): return VALUE", VALUE=value))
            },
        ),
    ]
    for source, scope in sources:
        values = np.uint64(1), np.uint64(2), np.uint32(1), (1, 2)
        digests = [
            digest_of(function_of(source, **scope(value)), {}) for value in values
        ]
        assert len({*digests}) == len(values), source
        again = digest_of(function_of(source, **scope(np.uint64(1))), {})
        assert again == digests[0], source


def test_constants_in_the_code_count() -> None:
    bodies = [
        *(
            "1000",
            "1001",
            "1000.0",
            "(1, 2, (3, 4))",
            "(1, 2, (3, 5))",
            "'a'",
            "'b'",
            "None",
            "...",
        ),
        *(
            "x in {1, 2}",
            "x in {1, 3}",
            "x in (1, 3)",
            "x + 1",
            "x - 1",
            "x.real",
            "x.imag",
        ),
        *(
            "(lambda y: y + 1)(x)",
            "(lambda y: y + 2)(x)",
            "x if x else 2",
            "x if x else 3",
        ),
    ]
    assert len({digest(0, body) for body in bodies}) == len(bodies)


def test_options_count() -> None:
    options: list[dict[str, object]] = [
        {},
        {"nogil": True},
        {"nogil": False},
        {"inline": "always"},
    ]
    assert (
        len({digest_of(function_of("def f(x): return x"), each) for each in options})
        == 4
    )


def test_functions_that_call_each_other_have_a_digest() -> None:
    def digest_with(constant: int) -> str:
        scope: dict[str, Any] = {"CONSTANT": constant}
        exec("def f(x): return g(x)\ndef g(x): return f(x) + CONSTANT", scope)
        return digest_of(scope["f"], {})

    assert digest_with(1) == digest_with(1) != digest_with(2)


def test_a_changed_constant_gives_new_code(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    table = np.zeros(2304, np.uint8)
    other = table.copy()
    other[1000] = 1
    for constant, sums in [
        (np.uint64(1), 2),
        (np.uint64(2), 3),
        (np.float32(0.5), 1.5),
        (table, 1),
        (other, 2),
        ((1, (2, np.int8(3))), 4),
        ((1, (2, np.int8(4))), 5),
    ]:
        body = "CONSTANT"
        if isinstance(constant, np.ndarray):
            body = "CONSTANT[1000]"
        elif isinstance(constant, tuple):
            body = "CONSTANT[1][1]"
        scope: dict[str, Any] = {"CONSTANT": constant, "__name__": "test_digest"}
        # The same file and line for all: else numba itself finds the code old.
        exec(compile(f"def f(x): return x + {body}", __file__, "exec"), scope)
        for n_hits in range(2):
            dispatcher = compiled(scope["f"]).dispatcher()
            assert dispatcher(1) == sums
            assert sum(dispatcher.stats.cache_hits.values()) == n_hits


def test_defaults_and_enclosed_constants_are_compiled() -> None:
    step = np.uint64(3)

    def function(x: int, factor: int = 2) -> int:
        return x * factor + int(step)

    assert compiled(function)(2) == 7
    assert compiled(function)(2, 5) == 13
