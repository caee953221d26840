"""The training on one map, in one call."""

import difflib
import warnings
from dataclasses import fields
from typing import Any

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.planning import Planner
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.scenario import Scenario
from ddqn_planner.training.training_estimate import estimate


def train(
    grid: GridMap,
    start: Cell,
    goal: Cell,
    seed: int = 0,
    *,
    move_rule: MoveRule | str = MoveRule.CORNER_CUTTING,
    **hyper_parameters: Any,
) -> Planner:
    """Train the paper's network on a map, and return a planner with this network.

    It learns to reach this goal on this map; `Planner.save` saves it. The same
    arguments give the same network. A UserWarning tells that a map is too large for the
    paper's network, see `estimate`, or that the steps are too few to learn anything.

    Parameters
    ----------
    grid : GridMap
    start, goal : (x, y)
        Two free cells that a path joins.
    seed : int
        Of all random draws: 0 to 2^63 - 1.
    move_rule : MoveRule
        Which moves are legal; by default the paper's rule.
    **hyper_parameters
        Any field of `HyperParameters`, such as ``steps=20_000``; by default the
        paper's values.

    Raises
    ------
    ValueError
        If an argument is wrong, no path joins the cells, or the training diverged.
    TypeError
        If there is no hyper-parameter of a name.
    ModuleNotFoundError
        If torch or gymnasium is missing, the extra "train" of the package.

    Examples
    --------
    >>> import numpy as np
    >>> from ddqn_planner import GridMap, train
    >>> grid = GridMap(np.zeros((4, 5)))
    >>> planner = train(grid, (0, 0), (4, 3), steps=1000, learning_starts=50)
    >>> round(planner.plan(grid, (0, 0), (4, 3)).length, 2)
    5.24
    """
    _check_names(hyper_parameters)
    scenario = Scenario(grid, start, goal, MoveRule(move_rule))
    parameters = HyperParameters(**hyper_parameters)
    warning = estimate([scenario], parameters).warning
    if warning:
        warnings.warn(warning, stacklevel=2)
    from ddqn_planner.training import Trainer  # needs torch

    trainer = Trainer([scenario], parameters, seed)
    for _ in trainer.run():
        pass
    if trainer.has_diverged:
        raise ValueError("the training diverged; give a smaller learning_rate")
    return trainer.planner()


def _check_names(hyper_parameters: dict[str, Any]) -> None:
    """Raise a TypeError that tells the nearest name of an unknown hyper-parameter."""
    names = [field.name for field in fields(HyperParameters)]
    for name in hyper_parameters:
        if name not in names:
            similar = difflib.get_close_matches(name, names, 1)
            remedy = f"did you mean {similar[0]!r}?" if similar else ", ".join(names)
            raise TypeError(f"there is no hyper-parameter {name!r}; {remedy}")
