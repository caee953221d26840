"""Functions that numba compiles: at their first call, so that an import is fast."""

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
    """Return a function that is compiled at its first call, and kept on disk.

    Functions of this package that it calls are compiled with it. `options` are those of
    `numba.njit`. The result has an attribute `dispatcher`: a function without
    parameters that returns numba's object, which compiled code can call.
    """

    @cache
    def dispatcher() -> Any:
        """Return numba's object for the function, made at the first call."""
        # Code that numba compiles can call numba's objects alone: compiled functions
        # among the globals are replaced by their objects.
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
        # Numba uses its code on disk while the function's file is the same, even if a
        # global of another file has changed. So the name of the code has a digest.
        digest = digest_of(to_compile, options)
        to_compile.__qualname__ = f"{function.__name__}_{digest}"
        # Functions compile sooner without checks of divisors and without entries for C.
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
        # If no folder is writable, each process compiles again.
        with suppress(RuntimeError, OSError):
            compiling._cache = CheckedCache(to_compile)
        return compiling

    @wraps(function)
    def call(*arguments: Any) -> Any:
        """Call the compiled function."""
        return dispatcher()(*arguments)

    call.dispatcher = dispatcher  # type: ignore[attr-defined]
    return cast(Function, call)


def in_place(function: Function) -> Function:
    """Compile a function that makes no array: faster, without reference counts."""
    return compiled(function, _nrt=False)


def inner(function: Function, **options: Any) -> Function:
    """Compile a function twice: for Python, and for compiled functions that call it.

    The second version has no entry for Python. That entry is most of the code if the
    parameters are tuples of many arrays, and without it the callers compile sooner.
    `options` are those of `compiled`.
    """
    with_entry = compiled(function, **options)
    without = compiled(function, no_cpython_wrapper=True, **options)
    with_entry.dispatcher = without.dispatcher  # type: ignore[attr-defined]
    return with_entry


def inlined(function: Function) -> Function:
    """Compile a function into the compiled functions that call it.

    The callers must be `in_place`. Where Python calls the function, it is not compiled.
    """
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
    """Import numba without scipy.linalg, which no function needs and takes 0.2 s."""
    import numba
    from numba.np import linalg

    # Numba imports scipy.linalg to check for a BLAS. It checks again when it compiles a
    # function that needs a BLAS.
    check = linalg.ensure_blas
    linalg.ensure_blas = lambda: None
    try:
        from numba.np import arraymath  # noqa: F401
    finally:
        linalg.ensure_blas = check
    return numba
