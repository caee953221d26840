"""A simulated robot bumps into obstacles, and learns its body until it is proved."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ddqn_planner.model import RobotNetwork, load_model, model_bytes
from ddqn_planner.robot.footprint import swept_cells
from ddqn_planner.training.robot import (
    MotionOptions,
    RobotTrainer,
    read_motions,
    train_robot,
)

TINY = "[[0.34, 0.09], [-0.09, 0.09], [-0.09, -0.09], [0.34, -0.09]]"
MOTION = MotionOptions("ackermann", turning_radius=0.6, resolution=0.25)
FORK = (
    "[[0.56, 0.2], [0.56, 0.1], [0.4, 0.1], [0.4, -0.1], [0.56, -0.1], "
    "[0.56, -0.2], [0.3, -0.2], [0.3, 0.2], [0.56, 0.2]]"
)


def test_the_command_trains_a_robot_that_is_proved(
    console: Any, tmp_path: Path
) -> None:
    path = tmp_path / "tiny.safetensors"
    command = "train-robot --motion ackermann --resolution 0.25"
    given = (
        "--turning-radius",
        0.6,
        "--padding",
        0.02,
        "--out",
        path,
        "--footprint",
        TINY,
    )
    assert re.search(
        "steps|seed", console(command, *given, "--steps", 20_000, status=1).err
    )
    assert not path.exists()
    printed = console(command, *given).out
    assert re.search(r"transitions: proved: all [\d,]+ cells", printed)
    network, metadata = load_model(path)
    assert isinstance(network, RobotNetwork)
    assert network.footprint.max() == pytest.approx(0.36)
    expected = swept_cells(network.footprint, network.motions)
    np.testing.assert_array_equal(network.swept(), expected)
    assert 20_000 < metadata.steps < 2_000_000
    assert "no others do" in console("certify", path).out


def test_a_concave_body_ahead_of_its_origin_is_learned() -> None:
    options: Any = {"motion": "ackermann", "turning_radius": 0.3, "resolution": 0.25}
    planner = train_robot(json.loads(FORK), **options)
    network = planner.network
    assert isinstance(network, RobotNetwork)
    expected = swept_cells(network.footprint, network.motions)
    np.testing.assert_array_equal(network.swept(), expected)
    assert not expected[0, expected.shape[1] // 2, expected.shape[2] // 2]


def test_a_robot_that_is_not_proved_is_no_planner() -> None:
    reason = "after 10 steps the model is not proved: .*; give more steps, or"
    with pytest.raises(ValueError, match=reason):
        train_robot(TINY, "ackermann", turning_radius=0.6, resolution=0.25, steps=10)


def test_the_same_seed_trains_the_same_model() -> None:
    contents = []
    for seed in (1, 1, 2):
        trainer = RobotTrainer(TINY, read_motions(MOTION), seed)
        for _ in trainer.run(30_000):
            pass
        contents.append(model_bytes(trainer.network, trainer.metadata()))
    assert contents[0] == contents[1] != contents[2]


def test_a_robot_bumps_where_its_body_touches_an_obstacle() -> None:
    trainer = RobotTrainer(TINY, read_motions(MOTION), 0)
    motions, width = trainer.network.motions, trainer.width
    swept = trainer.network.of_primitives(trainer.network.swept_by_unit)
    reach, collisions = swept.shape[1] // 2, 0
    for _ in trainer.run(20 * trainer.parameters.environments):
        pass
    made = (values[: trainer.steps] for values in trainer.replay.transitions)
    for number, cell, action, reward, after, discount in zip(*made, strict=True):
        (y, x), heading = divmod(cell // 16, width), cell % 16
        primitive = trainer.primitive_KN[action, heading]
        assert motions.start[primitive] == heading
        # The maps repeat in all directions.
        rows, columns = (np.arange(-reach, reach + 1) + at for at in (y, x))
        occupancy = np.zeros((width, width), dtype=bool)
        obstacle = trainer.obstacle_y_M[number], trainer.obstacle_x_M[number]
        occupancy[obstacle] = True
        seen = occupancy[np.ix_(rows % width, columns % width)]
        bumps = bool((seen & swept[primitive]).any())
        dx, dy = motions.offset[primitive]
        reached = (
            16 * ((y + dy) % width * width + (x + dx) % width) + motions.end[primitive]
        )
        assert after == (cell if bumps else reached)
        goes_on = not bumps and after != trainer.goal_M[number]
        assert discount == (np.float32(trainer.parameters.gamma) if goes_on else 0)
        assert reward == (-1000 if bumps else -motions.cost[primitive])
        collisions += bumps
    assert 30 < collisions < 2000


WRONG = {
    "--motion differential --resolution nan": "resolution is nan",
    "--motion differential --lattice x.json": "one of the two",
    "": "neither motion nor lattice is given; give one of the two: motion differential",
    "--lattice none.json": "none.json: it cannot be read (No such file or directory)",
    "--motion differential --headings 24": "headings is 24; give one of 16, 32, 64",
    "--motion differential --padding -0.1": "padding is -0.1",
    "--motion differential --steps 0": "--steps is 0; give a whole number, 1 to",
    "--motion differential --steps -5": "--steps is -5; give a whole number, 1 to",
    "--motion differential --resolution 1e-9": "resolution is 1e-09; give metres",
    "--motion differential --resolution 1e6": "resolution is 1000000.0; give metres",
    "--motion differential --turning-radius 1e300": "radius is 1e+300 m; give at most",
    "--motion differential --padding 1e300": "padding is 1e+300; give 0 to 10 metres",
}


@pytest.mark.parametrize("options", WRONG)
def test_what_is_no_robot_is_refused(
    console: Any, tmp_path: Path, options: str
) -> None:
    given = "--out", tmp_path / "robot.safetensors", *options.split()
    assert (
        WRONG[options] in console("train-robot --footprint 0.2", *given, status=2).err
    )
    assert not any(tmp_path.iterdir())


def test_a_training_makes_as_many_transitions_as_it_may() -> None:
    trainer = RobotTrainer(TINY, read_motions(MOTION), 0)
    for steps in (1000, 1001):
        for _ in trainer.run(steps):
            pass
        assert trainer.steps == len(trainer.replay) == steps
    for wrong in (0, -5, 0.5, True, 1e300, None):
        with pytest.raises(
            ValueError, match=r"number of steps is .* give a whole number, 1 to"
        ):
            next(trainer.run(wrong))  # type: ignore[arg-type]
