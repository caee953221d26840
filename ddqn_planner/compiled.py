"""Functions that numba compiles. Nothing is imported or compiled before the first call."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cache, wraps
from threading import Lock
from types import FunctionType
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])

_importing = Lock()


def compiled(function: Function) -> Function:
    """Compile a function at its first call, with the functions of this kind that it calls."""

    @cache
    def dispatcher() -> Any:
        scope = dict(function.__globals__)
        for name in function.__code__.co_names:
            if hasattr(scope.get(name), "dispatcher"):
                scope[name] = scope[name].dispatcher()
        return compiled_now(FunctionType(function.__code__, scope))

    @wraps(function)
    def call(*arguments: Any) -> Any:
        return dispatcher()(*arguments)

    call.dispatcher = dispatcher  # type: ignore[attr-defined]
    return cast(Function, call)


def compiled_now(function: Function) -> Function:
    """Import numba, and compile a function for its first call.

    The code is kept for other processes where a folder is writable.
    """
    numba = _import_numba()
    try:
        with_cache: Function = numba.njit(cache=True, nogil=True)(function)
        return with_cache
    except RuntimeError:  # no folder is writable: each process compiles again
        without_cache: Function = numba.njit(nogil=True)(function)
        return without_cache


def _import_numba() -> Any:
    """Import numba without scipy.linalg, which takes 0.2 s and no function here needs.

    numba imports it to check for a BLAS, and checks again when it compiles a function that needs
    one: the first check can be left out.
    """
    import numba
    from numba.np import linalg

    with _importing:
        _announce_compiling()
        check = linalg.ensure_blas
        linalg.ensure_blas = lambda: None
        try:
            from numba.np import arraymath  # noqa: F401
        finally:
            linalg.ensure_blas = check
    return numba


@cache
def _announce_compiling() -> None:
    """Log once when a function is compiled: loaded from the cache it would take no time."""
    from numba.core import event

    class Announcement(event.Listener):
        def on_start(self, compiling: Any) -> None:
            dispatcher = compiling.data["dispatcher"]
            if dispatcher.py_func.__module__.startswith("ddqn_planner."):
                _announce(bool(dispatcher.stats.cache_path))

        def on_end(self, compiling: Any) -> None:
            pass

    event.register("numba:compile", Announcement())  # type: ignore[no-untyped-call]


@cache
def _announce(is_kept: bool) -> None:
    """Log a line, which Python prints to stderr where the program has set up no logging."""
    kept = "the result is kept for the next start"
    lost = "set NUMBA_CACHE_DIR to a folder that can be written to keep the result"
    logging.getLogger("ddqn_planner").warning(
        "ddqn_planner compiles its functions, which takes some seconds; %s",
        kept if is_kept else lost,
    )
