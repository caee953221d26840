"""The public names, their examples, and what a student does with them."""

import copy
import doctest
import pickle
import re
import signal
import sys
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image

import ddqn_planner
from ddqn_planner import (
    Experience,
    GridMap,
    Planner,
    PlanStatus,
    PosePlan,
    QField,
    load_map,
    train,
    training,
)
from ddqn_planner.grid import shortest_distances
from ddqn_planner.interrupts import interrupts_wait
from ddqn_planner.training import HyperParameters, Scenario, Trainer, TrainingRecord

BRIEF = HyperParameters(steps=300, filters=4, learning_starts=50)
PACKAGES = (ddqn_planner, training)
MODULES_WITH_EXAMPLES = (
    "experience.experience",
    "grid.grid_map",
    "grid.inflation",
    "grid.moves",
    "model.certificate",
    "planning.field",
    "planning.planner",
    "planning.segments",
    "training.gymnasium_environments",
    "training.hyper_parameters",
    "training.one_map",
    "training.scenario",
    "training.trainer",
)


@pytest.mark.parametrize("package", PACKAGES)
def test_each_public_name_is_imported_and_described(package: ModuleType) -> None:
    for name in package.__all__:
        value = getattr(package, name)
        assert name.isupper() or name.startswith("__") or value.__doc__, name
    with pytest.raises(AttributeError, match="no attribute 'no_such'"):
        package.no_such  # noqa: B018


@pytest.mark.parametrize("module", MODULES_WITH_EXAMPLES)
def test_the_examples_of_docstrings_are_right(module: str) -> None:
    failed, tried = doctest.testmod(import_module(f"ddqn_planner.{module}"))
    assert tried > 0
    assert failed == 0


def test_a_library_that_is_missing_is_named_with_its_remedy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delitem(vars(training), "Trainer", raising=False)
    monkeypatch.setitem(sys.modules, "ddqn_planner.training.trainer", None)
    with pytest.raises(ModuleNotFoundError, match=r"ddqn_planner\.training\.trainer"):
        train(GridMap(np.zeros((4, 5))), (0, 0), (4, 3))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stesp": 100}, r"no hyper-parameter 'stesp'; did you mean 'steps'\?"),
        ({"grid": np.zeros((4, 5))}, r"shape \(4, 5\); give a map: GridMap\(array\)"),
        ({"grid": "office"}, r"give a map: load_map\('office'\)"),
        ({"goal": (3, 3)}, "the goal .* is not a free cell"),
        ({"steps": 0}, "steps is 0"),
        ({"seed": 0.5}, "the seed is 0.5"),
        ({"move_rule": "sideways"}, "give one of robot_safe, corner_cutting"),
    ],
)
def test_a_wrong_training_says_what_would_be_right(
    options: dict[str, object], message: str
) -> None:
    walls = np.zeros((4, 5))
    walls[3, 3] = 1
    arguments = {"grid": GridMap(walls), "start": (0, 0), "goal": (4, 3)}
    with pytest.raises((TypeError, ValueError), match=message):
        train(**{**arguments, **options})


def test_training_takes_numbers_of_any_type_and_is_that_of_a_trainer() -> None:
    grid = GridMap(np.zeros((4, 5)))
    short = {"steps": np.int32(300), "filters": 4, "learning_starts": 50}
    planner = train(grid, np.array([0, 0]), [4, 3], np.uint8(7), **short)
    trainer = Trainer([Scenario(grid, (0, 0), (4, 3))], BRIEF, 7)
    for _ in trainer.run():
        pass
    assert planner.metadata == trainer.planner().metadata
    q, expected = (
        each.q_field(grid, (4, 3)).q for each in (planner, trainer.planner())
    )
    np.testing.assert_array_equal(q, expected)


@pytest.mark.parametrize("network", ["paper", "propagation"])
def test_a_training_is_stopped_copied_and_continued(
    small: Scenario, network: str
) -> None:
    parameters = replace(BRIEF, network=network, environments=3, update_interval=10)
    whole, cut = (Trainer([small], parameters) for _ in range(2))
    reports = list(whole.run(every=100))
    assert [report.step for report in reports] == [102, 201, 300]
    assert sum(len(report.episodes) for report in reports) == whole.episodes
    assert reports[-1][1:] == (
        whole.updates,
        reports[-1].episodes,
        whole.epsilon,
        whole.learning_rate,
    )
    for progress in cut.run():
        if progress.step >= 120:
            break
    trainings = cut, pickle.loads(pickle.dumps(cut)), copy.deepcopy(cut)
    for trainer in trainings:
        assert list(trainer.run(120)) == []
        for _ in trainer.run():
            pass
        for name, tensor in whole.network.tensors.items():
            np.testing.assert_array_equal(trainer.network.tensors[name], tensor)


def test_ctrl_c_loses_no_step_of_a_training(
    small: Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, cut = (Trainer([small], BRIEF) for _ in range(2))
    expected = [episode for progress in whole.run() for episode in progress.episodes]
    episodes = []
    advance = cut._advance

    def advance_with_ctrl_c(last_step: int) -> None:
        signal.raise_signal(signal.SIGINT)
        advance(last_step)

    monkeypatch.setattr(cut, "_advance", advance_with_ctrl_c)
    while cut.steps < BRIEF.steps:
        with pytest.raises(KeyboardInterrupt):
            next(cut.run())
    monkeypatch.undo()
    for progress in cut.run(until=BRIEF.steps + 1):
        episodes += progress.episodes
    assert episodes[: len(expected)] == expected


def test_a_second_ctrl_c_interrupts_at_once() -> None:
    reached = []
    with suppress(KeyboardInterrupt), interrupts_wait():
        reached.append("the block")
        signal.raise_signal(signal.SIGINT)
        reached.append("after Ctrl-C")
        signal.raise_signal(signal.SIGINT)
        reached.append("after a second Ctrl-C")
    assert reached == ["the block", "after Ctrl-C"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_missing_map_is_a_file_that_is_not_found() -> None:
    with pytest.raises(FileNotFoundError) as error:
        load_map("no_such_map")
    assert isinstance(error.value, ddqn_planner.MapNotFoundError)
    assert isinstance(error.value, ValueError)


def test_many_rollouts_are_those_of_each_start(small: Scenario) -> None:
    grid = load_map("dilemma")
    cells = [(x, y) for y in range(grid.height) for x in range(grid.width)]
    for model in ("any_map", "dilemma"):
        field = Planner.load(model).q_field(grid, (17, 19), "corner_cutting")
        plans = field.rollouts(cells)
        assert plans == [field.rollout(cell) for cell in cells]
        assert len({plan.status for plan in plans}) == 2
        assert field.rollouts([]) == []
        with pytest.raises(ValueError, match=r"\(20, 0\) lies outside the map"):
            field.rollouts([(6, 6), (20, 0)])


def test_cost_multipliers_are_factors_of_each_move() -> None:
    random = np.random.default_rng(0)
    occupancy = random.random((12, 15)) < 0.2
    occupancy[0, 0] = occupancy[11, 14] = False
    factors = random.uniform(1, 100, occupancy.shape)
    factors[occupancy] = np.nan  # is ignored
    cost = random.integers(100, size=occupancy.shape)
    grid = GridMap(occupancy, cost=cost, cost_multiplier=factors)
    expected = (1 + 0.04 * cost) * factors
    free = ~occupancy
    np.testing.assert_allclose(grid.cost_multiplier[free], expected[free], rtol=1e-6)
    plan = Planner.load("any_map").plan(grid, (0, 0), (14, 11))
    optimum = shortest_distances(grid, (14, 11), "robot_safe")[0, 0]
    assert plan.cost == pytest.approx(optimum)
    # Expected times multiply the factors, and each time only once.
    timed = Experience(0.5).apply(grid)
    assert timed.slowness == pytest.approx(grid.slowness)
    assert Experience(0.5).apply(timed).slowness == pytest.approx(timed.slowness)
    for wrong in (0.5, 101, np.inf):
        with pytest.raises(ValueError, match="give 1 to 100; percent belong into"):
            GridMap(occupancy, cost_multiplier=np.full(occupancy.shape, wrong))


def test_a_map_describes_itself_in_one_line() -> None:
    grid = GridMap(np.eye(3), 0.05, (1, -2.5, 0), cost=np.ones((3, 3)))
    assert repr(grid) == (
        "GridMap(3 x 3 cells of 0.05 m, origin (1, -2.5, 0), 6 free, with cost)"
    )


def test_what_a_notebook_shows_is_one_short_line(small: Scenario) -> None:
    grid = load_map("dilemma")
    planner = Planner.load("any_map")
    field = planner.q_field(grid, (17, 19), "corner_cutting")
    trainer = Trainer([small], HyperParameters(steps=200))
    record = TrainingRecord(trainer)
    point = record.curve[-1]
    progress = next(trainer.run(every=100))
    poses = PosePlan(PlanStatus.SUCCEEDED, poses=np.zeros((41, 3)), driven=20.0)
    shown = [
        (planner, "Planner(network any_map, robot_safe, trained for 1,536,000 steps"),
        (field, "QField(20 x 20 cells, goal (17, 19), corner_cutting)"),
        (QField((1, 2), field.q, field.legal), "QField(20 x 20 cells, goal (1, 2), "),
        (field.rollout((6, 6)), "Plan(19 cells from (6, 6) to (17, 19), length 22.97)"),
        (planner.plan(grid, (6, 6), (99, 0)), "Plan(GOAL_OUTSIDE_MAP: the goal lies "),
        (poses, "PosePlan(41 poses, bound 1, length 20.00)"),
        (trainer, f"Trainer(step 100 of 200, {trainer.episodes} episodes, network "),
        (trainer.parameters, "HyperParameters(steps=200)"),
        (HyperParameters(), "HyperParameters()"),
        (record, f"TrainingRecord(1 evaluations; step 0: {point.solved} of 16 starts"),
        (progress, f"Progress(step=100, updates=0, {trainer.episodes} episodes, eps"),
    ]
    for value, text in shown:
        assert repr(value).startswith(text)
        assert len(repr(value)) < 110


def test_the_film_of_the_docs_is_made_as_they_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = Path(__file__).resolve().parents[1] / "docs" / "python_api.md"
    blocks = re.findall(r"^```python\n(.*?)^```", page.read_text(), re.M | re.S)
    (example,) = [block for block in blocks if "save_film" in block]
    brief = example.replace("steps=10_000", "steps=500, filters=4")
    assert brief != example
    monkeypatch.chdir(tmp_path)
    scope: dict[str, Any] = {}
    exec(brief, scope)
    assert scope["progress"].step == 500
    with Image.open("training.gif") as film:
        assert film.n_frames >= 3
    with Image.open("training.png") as picture:
        assert picture.size > (500, 300)
