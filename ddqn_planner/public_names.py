"""Public names of a package, each imported at its first use."""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def imported_at_first_use(
    package: str, modules: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return the functions ``__getattr__`` and ``__dir__`` of a package.

    So a program loads only the libraries that it uses. If one is missing, the
    ModuleNotFoundError says what to install.

    Parameters
    ----------
    package : str
        Its name, for which ``__name__`` stands in the package.
    modules : mapping of str
        The module, relative to the package, of each public name.
    """
    namespace = vars(sys.modules[package])

    def import_name(name: str) -> Any:
        """Return the value of a public name."""
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        try:
            module = import_module(f"{package}.{modules[name]}")
        except ModuleNotFoundError as error:
            # It imports ten modules, which would delay each program.
            from ddqn_planner.resources import with_remedy

            raise ModuleNotFoundError(with_remedy(error)) from error
        value = getattr(module, name)
        namespace[name] = value
        return value

    def list_names() -> list[str]:
        """Return all names of the package, also public names not imported yet."""
        return sorted({*namespace, *modules})

    return import_name, list_names
