"""A robot that does not see new obstacles: a control for goal iii."""

from collections.abc import Sequence

import numpy as np
from trainings import SCENARIO

from ddqn_planner.model.networks import observation_background
from ddqn_planner.training.environment import GridVectorEnvironment, Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import Trainer


class BlindEnvironment(GridVectorEnvironment):
    """Robots that observe the paper's map, whatever map they are on.

    Moves, rewards and initial cells are those of the maps that they are on.
    """

    def __init__(
        self,
        scenarios: Sequence[Scenario],
        parameters: HyperParameters,
        random: np.random.Generator | None = None,
    ) -> None:
        super().__init__(scenarios, parameters, random)
        self.background[:] = observation_background(
            SCENARIO.grid.occupancy, SCENARIO.goal
        )


class BlindTrainer(Trainer):
    """Trains a robot that does not see new obstacles."""

    environment_class = BlindEnvironment
