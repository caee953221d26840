"""Functions that numba compiles. Nothing is imported or compiled before the first call."""

from collections.abc import Callable
from contextlib import suppress
from functools import cache, wraps
from threading import Lock
from types import FunctionType
from typing import Any, TypeVar, cast

from ddqn_planner.digest import digest_of, global_names

Function = TypeVar("Function", bound=Callable[..., Any])

_importing = Lock()


def compiled(function: Function, **options: Any) -> Function:
    """Compile a function, and the compiled ones that it calls, at its first call; keep the code."""

    @cache
    def dispatcher() -> Any:
        scope = dict(function.__globals__)
        for name in global_names(function.__code__):
            if hasattr(scope.get(name), "dispatcher"):
                scope[name] = scope[name].dispatcher()
        to_compile = FunctionType(
            function.__code__,
            scope,
            argdefs=function.__defaults__,
            closure=function.__closure__,
        )
        to_compile.__kwdefaults__ = function.__kwdefaults__
        # numba looks at the file of a function alone to see whether the code it has kept is old.
        digest = digest_of(to_compile, options)
        to_compile.__qualname__ = f"{function.__name__}_{digest}"
        # Without checks of divisors and entries for C, which none needs, they compile sooner.
        settings = {
            "nogil": True,
            "error_model": "numpy",
            "no_cfunc_wrapper": True,
            **options,
        }
        with _importing:
            numba = _import_numba()
            from ddqn_planner.code_cache import CheckedCache
        compiling = numba.njit(**settings)(to_compile)
        with suppress(
            RuntimeError, OSError
        ):  # no folder is writable: each process compiles again
            compiling._cache = CheckedCache(to_compile)
        return compiling

    @wraps(function)
    def call(*arguments: Any) -> Any:
        return dispatcher()(*arguments)

    call.dispatcher = dispatcher  # type: ignore[attr-defined]
    return cast(Function, call)


def in_place(function: Function) -> Function:
    """Compile a function that makes no array: without counts of references, sooner and faster."""
    return compiled(function, _nrt=False)


def inner(function: Function, **options: Any) -> Function:
    """Let compiled functions call it without its entry for Python, so that they compile sooner."""
    # For tuples of many arrays that entry is most of the code.
    with_entry = compiled(function, **options)
    without = compiled(function, no_cpython_wrapper=True, **options)
    with_entry.dispatcher = without.dispatcher  # type: ignore[attr-defined]
    return with_entry


def inlined(function: Function) -> Function:
    """Let functions which are `in_place` call a function compiled; Python calls it as it is."""
    options = {"_nrt": False, "forceinline": True, "no_cpython_wrapper": True}
    function.dispatcher = compiled(function, **options).dispatcher  # type: ignore[attr-defined]
    return function


def specialised(function: Function, **parts: Callable[..., Any]) -> Function:
    """Compile an algorithm that makes no array, with its abstract functions replaced.

    So one algorithm serves several data structures, and calls none of them indirectly.
    `parts` are compiled functions, by the names that the algorithm's module gives them.
    """
    scope = {**function.__globals__, **parts}
    code = function.__code__
    return in_place(cast(Function, FunctionType(code, scope, function.__name__)))


@cache
def _import_numba() -> Any:
    """Import numba without scipy.linalg, which takes 0.2 s and no function here needs."""
    import numba
    from numba.np import linalg

    # numba imports it to check for a BLAS, and checks again when it compiles a function with one.
    check = linalg.ensure_blas
    linalg.ensure_blas = lambda: None
    try:
        from numba.np import arraymath  # noqa: F401
    finally:
        linalg.ensure_blas = check
    return numba
