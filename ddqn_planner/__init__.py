"""Plans robot paths on grid maps with a Double DQN."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ddqn_planner.gymnasium_registration import register_environment

if TYPE_CHECKING:
    from ddqn_planner.experience import Experience
    from ddqn_planner.grid import GridMap, MoveRule, inflate, load_map
    from ddqn_planner.planning import (
        Plan,
        PlanMethod,
        Planner,
        PlanStatus,
        QField,
        simplify,
    )

__all__ = [
    "Experience",
    "GridMap",
    "MoveRule",
    "Plan",
    "PlanMethod",
    "PlanStatus",
    "Planner",
    "QField",
    "inflate",
    "load_map",
    "simplify",
]

# The packages of the public names; all others are in `planning`.
_PACKAGES = {
    "Experience": "experience",
    "GridMap": "grid",
    "MoveRule": "grid",
    "inflate": "grid",
    "load_map": "grid",
}


def __getattr__(name: str) -> Any:
    """Import a public name at its first use, so that a program loads what it uses."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    package = import_module(f"{__name__}.{_PACKAGES.get(name, 'planning')}")
    value = getattr(package, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, too, before they are imported."""
    return sorted([*globals(), *__all__])


register_environment()
