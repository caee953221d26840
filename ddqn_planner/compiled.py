"""Functions that numba compiles. Nothing is imported or compiled before the first call."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from threading import Lock
from typing import Any

_importing = Lock()


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function at its first call, and keep the code for other processes if possible."""

    @cache
    def dispatcher() -> Callable[..., Any]:
        numba = _import_numba()
        try:
            with_cache: Callable[..., Any] = numba.njit(cache=True, nogil=True)(function)
            return with_cache
        except RuntimeError:  # no folder is writable: each process compiles again
            without_cache: Callable[..., Any] = numba.njit(nogil=True)(function)
            return without_cache

    @wraps(function)
    def call(*arguments: Any) -> Any:
        return dispatcher()(*arguments)

    return call


def _import_numba() -> Any:
    """Import numba without scipy.linalg, which takes 0.2 s and no function here needs.

    numba imports it to check for a BLAS, and checks again when it compiles a function that needs
    one: the first check can be left out.
    """
    import numba
    from numba.np import linalg

    with _importing:
        check = linalg.ensure_blas
        linalg.ensure_blas = lambda: None
        try:
            from numba.np import arraymath  # noqa: F401
        finally:
            linalg.ensure_blas = check
    return numba
