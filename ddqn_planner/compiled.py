"""Functions that numba compiles. Nothing is imported or compiled before the first call."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import Any


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function at its first call, and keep the code for other processes if possible."""

    @cache
    def dispatcher() -> Callable[..., Any]:
        import numba

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
