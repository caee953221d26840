"""What a training will take, before it begins, and whether the map is too large."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Final, NamedTuple

from ddqn_planner.model import NETWORKS
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.scenario import Scenario

# Measured by experiments/map_sizes.py, on one core. The paper's network: a step with an
# update by a batch of 32, without and with what grows with the weights, seconds.
SECONDS_OF_STEP: Final = 70e-6
SECONDS_OF_WEIGHT: Final = 2.3e-9
# A propagation network has as many weights on each map. With each copy of the target
# network, V of each cell is computed anew.
SECONDS_OF_PROPAGATION_STEP: Final = 1e-3
SECONDS_OF_CELL: Final = 2e-6
BYTES_OF_TRANSITION: Final = 40  # in the replay buffer
BYTES_OF_CELL: Final = 140  # tables of moves and rewards
FLOAT: Final = 4  # bytes
MOST_CELLS: Final = 80 * 80  # for the paper's network, see `estimate`


class Estimate(NamedTuple):
    """What a training takes on one processor core, and a warning."""

    steps_per_second: float
    seconds: float  # of all steps
    checkpoint_bytes: int
    memory_bytes: int  # beside that of the libraries, about 400 MB
    warning: str  # "" unless the maps are too large, or nothing is learned


def estimate(scenarios: Sequence[Scenario], parameters: HyperParameters) -> Estimate:
    """Return what a training on maps of one size will take; nothing is measured.

    A map of more than 80 x 80 cells counts as too large for the paper's network. With
    the default hyper-parameters, the network solves these shares of the starts:

    ======== ======
    cells    solved
    ======== ======
    20 x 20   100 %
    40 x 40    91 %
    60 x 60    72 %
    80 x 80    65 %
    100x100    21 %
    ======== ======

    ``python experiments/map_sizes.py`` measures the shares and the times. The times of
    other networks are rough.

    Parameters
    ----------
    scenarios : sequence of Scenario
        The maps to train on.
    parameters : HyperParameters
    """
    weights = _count_weights(scenarios[0], parameters)
    grid = scenarios[0].grid
    cells = grid.width * grid.height * len(scenarios)
    if parameters.network == "paper":
        seconds_of_update = SECONDS_OF_STEP * parameters.batch_size / 32
        seconds_of_update += SECONDS_OF_WEIGHT * weights
    else:
        seconds_of_update = SECONDS_OF_PROPAGATION_STEP
        seconds_of_update += SECONDS_OF_CELL * cells / parameters.target_interval
    seconds_of_step = seconds_of_update / parameters.update_interval
    # θ, θ⁻, Adam's two moments, and the average of θ
    copies = 5 if parameters.weight_averaging > 0 else 4
    transitions = min(parameters.replay_capacity, parameters.steps)
    checkpoint = FLOAT * copies * weights + BYTES_OF_TRANSITION * transitions
    replay = BYTES_OF_TRANSITION * parameters.replay_capacity
    result = Estimate(
        steps_per_second=1 / seconds_of_step,
        seconds=seconds_of_step * parameters.steps,
        checkpoint_bytes=checkpoint,
        # A save holds the model and the checkpoint as bytes, too.
        memory_bytes=5 * checkpoint + BYTES_OF_CELL * cells + replay,
        warning="",
    )
    warnings = [_warning_of_steps(parameters)]
    if parameters.network == "paper" and grid.width * grid.height > MOST_CELLS:
        warnings.append(_warning(scenarios[0], parameters, result))
    return result._replace(warning="; ".join(filter(None, warnings)))


def _count_weights(scenario: Scenario, parameters: HyperParameters) -> int:
    """Return how many weights and biases the network of a training has."""
    grid = scenario.grid
    sizes = {**asdict(parameters), "height": grid.height, "width": grid.width}
    shapes = NETWORKS[parameters.network].shapes(sizes)
    return sum(math.prod(shape) for shape in shapes.values())


def _warning_of_steps(parameters: HyperParameters) -> str:
    """Return the warning that no update falls within the steps; "" if one does."""
    steps = parameters.steps
    if steps <= parameters.learning_starts:
        name, value = "learning_starts", parameters.learning_starts
    elif steps < parameters.update_interval:
        name, value = "update_interval", parameters.update_interval
    else:
        return ""
    return (
        f"steps is {steps} and {name} {value}: nothing is learned; give more steps or "
        f"a smaller {name}"
    )


def _warning(
    scenario: Scenario, parameters: HyperParameters, estimated: Estimate
) -> str:
    """Return the warning that a map is too large for the paper's network."""
    grid = scenario.grid
    side = math.isqrt(MOST_CELLS)
    minutes = estimated.seconds / 60
    time = f"{minutes:,.0f} minutes"
    if minutes < 2:
        time = f"{estimated.seconds:,.0f} seconds"
    elif minutes > 120:
        time = f"{minutes / 60:,.0f} hours"
    return (
        f"a map of {grid.width} x {grid.height} cells is too large for the paper's "
        f"network, which solves few starts of more than {side} x {side} cells: "
        f"{parameters.steps:,} steps will take about {time} "
        f"({estimated.steps_per_second:,.0f} steps per second), a checkpoint "
        f"{estimated.checkpoint_bytes / 1e6:,.0f} MB and the memory "
        f"{estimated.memory_bytes / 1e6:,.0f} MB; plan with the shipped model any_map, "
        "train the network propagation, or give a smaller map"
    )
