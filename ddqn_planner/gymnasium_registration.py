"""Makes the grid environment known to Gymnasium, without loading either.

Gymnasium 1 asks no installed package for its environments: a program that uses one
imports the package. It may do so before or after it imports Gymnasium.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import TYPE_CHECKING, Final, cast

if TYPE_CHECKING:  # it loads a dozen other modules
    from importlib.abc import Loader

GYMNASIUM: Final = "gymnasium"
ENVIRONMENT: Final = "ddqn_planner/Grid-v0"
_MODULE: Final = "ddqn_planner.training.gymnasium_environments"


class _RegisteringLoader:
    """Loads Gymnasium as its own loader does, and registers the environment."""

    def __init__(self, loader: Loader, finder: _GymnasiumFinder) -> None:
        """Make a loader in place of `loader`; `finder` has then done its work."""
        self._loader = loader
        self._finder = finder

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        """Return what Gymnasium's own loader creates."""
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        """Run Gymnasium, and then register the environment."""
        # Whoever asks later for the module's loader gets its own.
        module.__loader__ = self._loader
        if module.__spec__ is not None:
            module.__spec__.loader = self._loader
        self._loader.exec_module(module)
        if self._finder in sys.meta_path:
            sys.meta_path.remove(self._finder)
            _register()


class _GymnasiumFinder:
    """A finder of the import system: the environment follows when Gymnasium loads."""

    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None,
        target: ModuleType | None = None,
    ) -> ModuleSpec | None:
        """Return how to load Gymnasium, by another finder; None for other modules."""
        if fullname != GYMNASIUM:
            return None
        for finder in sys.meta_path:
            if finder is self:
                continue
            spec = finder.find_spec(fullname, path, target)
            if spec is not None and spec.loader is not None:
                spec.loader = cast("Loader", _RegisteringLoader(spec.loader, self))
            if spec is not None:
                return spec
        return None


def _register() -> None:
    """Register the environment of one robot, and that of N robots, by their names."""
    import gymnasium

    gymnasium.register(
        ENVIRONMENT,
        entry_point=f"{_MODULE}:GridEnvironment",
        vector_entry_point=f"{_MODULE}:BatchedGridEnvironment",
    )


def register_environment() -> None:
    """Register the environment now, or as soon as the program imports Gymnasium."""
    if GYMNASIUM in sys.modules:
        _register()
    else:
        sys.meta_path.insert(0, _GymnasiumFinder())
