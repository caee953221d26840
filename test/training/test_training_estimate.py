from dataclasses import replace

import numpy as np
import pytest

from ddqn_planner import GridMap, train
from ddqn_planner.training import HyperParameters, Scenario, Trainer, estimate

LARGE = Scenario(GridMap(np.zeros((81, 81))), (0, 0), (80, 80))
PARAMETERS = HyperParameters(steps=100_000)


def test_a_map_that_is_too_large_is_told_with_figures_and_remedies() -> None:
    small = Scenario(GridMap(np.zeros((80, 80))), (0, 0), (79, 79))
    assert estimate([small], PARAMETERS).warning == ""
    warning = estimate([LARGE], PARAMETERS).warning
    for text in ("81 x 81 cells", "100,000 steps", " seconds (", "MB", "any_map"):
        assert text in warning
    for steps, unit in ((10**6, "minutes"), (10**9, "hours")):
        longer = estimate([LARGE], HyperParameters(steps=steps)).warning
        assert f" {unit} (" in longer
    other = replace(PARAMETERS, network="propagation")
    assert estimate([LARGE], other).warning == ""


@pytest.mark.parametrize("network", ["paper", "propagation"])
def test_the_checkpoint_has_the_estimated_size(network: str) -> None:
    parameters = HyperParameters(network=network, steps=40, learning_starts=32)
    trainer = Trainer([LARGE], parameters, seed=0)
    for _ in trainer.run():
        pass
    size = sum(array.nbytes for array in trainer.arrays().values())
    assert estimate([LARGE], parameters).checkpoint_bytes == pytest.approx(size, 0.05)


def test_longer_trainings_on_larger_maps_take_longer() -> None:
    for network in ("paper", "propagation"):
        small = Scenario(GridMap(np.zeros((40, 40))), (0, 0), (9, 9))
        parameters = replace(PARAMETERS, network=network)
        brief = estimate([LARGE], replace(parameters, steps=10_000))
        long = estimate([LARGE], parameters)
        assert long.seconds == pytest.approx(10 * brief.seconds)
        quicker = estimate([small], parameters)
        assert quicker.steps_per_second > long.steps_per_second
        assert quicker.memory_bytes < long.memory_bytes


def test_steps_without_an_update_are_told() -> None:
    scenario = Scenario(GridMap(np.zeros((3, 3))), (0, 0), (2, 2))
    for number, values in enumerate(
        ({"learning_starts": 40}, {"learning_starts": 0, "update_interval": 41}) * 2
    ):
        steps = 40 if number < 2 else 41
        parameters = HyperParameters(filters=4, steps=steps, **values)
        trainer = Trainer([scenario], parameters, seed=0)
        for _ in trainer.run():
            pass
        is_told = "nothing is learned" in estimate([scenario], parameters).warning
        assert is_told == (trainer.updates == 0) == (steps == 40)
    with pytest.warns(UserWarning, match="steps is 3 and learning_starts 500: nothing"):
        train(scenario.grid, (0, 0), (2, 2), steps=3, learning_starts=500)


def test_training_in_one_call_warns() -> None:
    with pytest.warns(UserWarning, match="81 x 81 cells is too large"):
        train(LARGE.grid, LARGE.start, LARGE.goal, steps=1)
