"""Makes the grid environment known to Gymnasium, without loading either.

Gymnasium 1 asks no installed package for its environments: a program that uses one
imports the package. It may do so before or after it imports Gymnasium.
"""

import sys
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Final

GYMNASIUM: Final = "gymnasium"
ENVIRONMENT: Final = "ddqn_planner/Grid-v0"
_MODULE: Final = "ddqn_planner.training.gymnasium_environments"


class _GymnasiumFinder:
    """A finder of the import system: the environment follows when Gymnasium loads."""

    def find_spec(
        self, name: str, path: object = None, target: object = None
    ) -> ModuleSpec | None:
        """Return how to load Gymnasium; None for any other module."""
        if name != GYMNASIUM:
            return None
        sys.meta_path.remove(self)
        spec = find_spec(name)  # of the other finders
        if spec is None or spec.loader is None:
            return spec
        load = spec.loader.exec_module

        def load_and_register(module: ModuleType) -> None:
            load(module)
            _register()

        spec.loader.exec_module = load_and_register  # type: ignore[method-assign]
        return spec


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
