"""Functions that numba compiles. Nothing is imported or compiled before the first call."""

import logging
import zlib
from collections.abc import Callable
from functools import cache, wraps
from threading import Lock
from types import FunctionType
from typing import Any, TypeVar, cast

import numpy as np

Function = TypeVar("Function", bound=Callable[..., Any])

_importing = Lock()


def compiled(function: Function, **options: Any) -> Function:
    """Compile a function, and the compiled ones that it calls, at its first call; keep the code."""

    @cache
    def dispatcher() -> Any:
        scope = dict(function.__globals__)
        names = function.__code__.co_names
        calls = [name for name in names if hasattr(scope.get(name), "dispatcher")]
        scope |= {name: scope[name].dispatcher() for name in calls}
        to_compile = FunctionType(function.__code__, scope)
        # numba looks at the file of a function alone to see whether the code it has kept is old.
        code, called = function.__code__, [scope[name].py_func.__qualname__ for name in calls]
        values = *code.co_consts, *map(scope.get, names)
        constants = [it for it in values if isinstance(it, (int, float, tuple, np.ndarray))]
        digest = zlib.crc32(code.co_code + f"{called} {constants} {options}".encode())
        to_compile.__qualname__ = f"{function.__name__}_{digest:08x}"
        with _importing:
            numba = _import_numba()
        # Without checks of divisors and entries for C, which none needs, they compile sooner.
        settings = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, **options}
        try:
            return numba.njit(cache=True, **settings)(to_compile)
        except RuntimeError:  # no folder is writable: each process compiles again
            return numba.njit(**settings)(to_compile)

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


@cache
def _import_numba() -> Any:
    """Import numba without scipy.linalg, which takes 0.2 s and no function here needs."""
    import numba
    from numba.core import event
    from numba.np import linalg

    # numba imports it to check for a BLAS, and checks again when it compiles a function with one.
    check = linalg.ensure_blas
    linalg.ensure_blas = lambda: None
    try:
        from numba.np import arraymath  # noqa: F401
    finally:
        linalg.ensure_blas = check

    class Announcement(event.Listener):
        """Logs once that a function is compiled: loaded from the cache it would take no time."""

        is_due = True

        def on_start(self, compiling: Any) -> None:
            dispatcher = compiling.data["dispatcher"]
            if self.is_due and dispatcher.py_func.__module__.startswith("ddqn_planner."):
                self.is_due = False
                folder = dispatcher.stats.cache_path
                lost = "set NUMBA_CACHE_DIR to a folder that can be written to keep the result"
                logging.getLogger("ddqn_planner").warning(
                    "ddqn_planner compiles its functions, %s",
                    f"once, and keeps them in {folder}" if folder else f"at each start; {lost}",
                )

        def on_end(self, compiling: Any) -> None:
            pass

    event.register("numba:compile", Announcement())  # type: ignore[no-untyped-call]
    return numba
