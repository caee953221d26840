"""Plans robot paths on grid maps with a Double DQN."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

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

_LAYERS = {"Experience": "experience"}
_LAYERS |= dict.fromkeys(("GridMap", "MoveRule", "inflate", "load_map"), "grid")
"""Where a name is, unless in `planning`."""


def __getattr__(name: str) -> Any:
    """Import a public name at its first use, so that a program loads only what it uses."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_LAYERS.get(name, 'planning')}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
