import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import any_map
import numpy as np
import pytest
import trainings
from blind_robot import BlindTrainer
from goal_1 import convergence_row
from goal_2 import STARTS, trained_field
from goal_3 import PAPER, fixed_path, noisy_maps
from goal_3 import trainings as trainings_of_goal_3
from networks import random_network
from PIL import Image
from reproduce import EXPERIMENTS, main
from tables import mean_and_worst, median_and_range

from ddqn_planner.grid import MOVES, path_length, shortest_path
from ddqn_planner.model import ModelMetadata, load_model
from ddqn_planner.planning import Planner
from ddqn_planner.training.environment import GridVectorEnvironment, Scenario
from ddqn_planner.training.evaluation import length_ratios
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import Trainer

PROGRAM = Path(__file__).parents[1] / "reproduce.py"
QUICK = HyperParameters(
    steps=900,
    filters=4,
    learning_starts=50,
    learning_rate_decay=1.0,  # the same for 600 of 900 steps as for 600
    target_interval=100,
)
PATIENCE = 300
"""Seconds to wait for what should come at once: a loaded machine is slow, not wrong."""


@pytest.fixture
def small(small: Scenario) -> Scenario:
    """As the paper's robot moves."""
    return replace(small, move_rule=trainings.MOVE_RULE)


@pytest.mark.filterwarnings("ignore:All-NaN")  # of one seed that learns nothing
def test_every_experiment_writes_its_report_and_trains_what_is_new(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "before\n<!-- Goal ii: from every free cell -->\nold\n<!-- end -->\nafter\n"
    )
    command = ["--backend", "sequential", "--quick", "--out", str(tmp_path)]
    command += ["--noise", "on_path", "--hidden-units", "3", "--page", str(page)]
    assert main([*command, "--seeds", "1"]) == 0
    folder = tmp_path / "quick"
    report = (folder / "report.md").read_text()
    assert report in capsys.readouterr().out
    for title, _, _ in EXPERIMENTS.values():
        assert f"## {title}\n" in report
    for picture in re.findall(r"!\[.*?\]\((.*?)\)", report):
        with Image.open(folder / picture) as image:
            assert min(image.size) > 300
            assert len(image.convert("RGB").getcolors(image.width * image.height)) > 20
    assert "| on_path | paper, 3 hidden units |" in report
    assert "| on_path | paper, 3 hidden units, blind |" in report
    assert "near_path" not in report
    before, _, results = page.read_text().partition(
        "<!-- Goal ii: from every free cell -->\n"
    )
    assert (before, results[-20:]) == ("before\n", "\n<!-- end -->\nafter\n")
    assert "| propagation | " in results
    assert "](images/page/goal_2.png)" in results
    assert (tmp_path / "images" / "page" / "goal_2.png").exists()
    trained = {
        path: path.stat().st_mtime_ns for path in tmp_path.rglob("evaluations.csv")
    }
    assert len(trained) == 8 + 2 + 3
    # Only the second seed of both profiles is new.
    assert main([*command, "--experiment", "goal-2", "--seeds", "2"]) == 0
    assert trained == {path: path.stat().st_mtime_ns for path in trained}
    assert len([*tmp_path.rglob("evaluations.csv")]) == len(trained) + 2


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_experiments_end_with_all_their_processes(
    tmp_path: Path, number: int
) -> None:
    command = [sys.executable, PROGRAM, "--experiment", "goal-1", "--out", tmp_path]
    child = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + PATIENCE
    while not [*tmp_path.rglob("evaluations.csv")]:
        assert time.monotonic() < deadline
        assert child.poll() is None
        time.sleep(0.05)
    os.kill(child.pid, number)
    # To the end of what every process may print: so all of them have ended.
    _, printed = child.communicate(timeout=PATIENCE)
    assert child.returncode == 130
    assert "run the same command to resume" in printed


def test_wrong_options_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["--experiment", "goal-3", "--hidden-units", "-1", "--out", str(tmp_path)]
    assert main(command) == 2
    assert "hidden_units is -1" in capsys.readouterr().err


def test_a_training_that_was_cut_off_ends_as_if_it_had_not_been(
    small: Scenario, tmp_path: Path
) -> None:
    folders = [tmp_path / name for name in ("whole", "cut")]
    whole, cut = (
        trainings.Training(folder, QUICK, (small,), 1, 300) for folder in folders
    )
    trainings.train(whole)
    trainings.train(replace(cut, parameters=replace(QUICK, steps=600)))
    trainings.in_parallel(trainings.train, [cut])
    runs = [trainings.read_csv(folder / "evaluations.csv") for folder in folders]
    assert runs[0]["step"].tolist() == [300, 600, 900]
    for name in set(runs[0].dtype.names or ()):
        np.testing.assert_array_equal(runs[0][name], runs[1][name])
    models = [folder / "model.safetensors" for folder in folders]
    assert models[0].read_bytes() == models[1].read_bytes()
    other = replace(cut, parameters=replace(QUICK, gamma=0.5))
    with pytest.raises(ValueError, match=r"gamma 0\.95"):
        trainings.in_parallel(trainings.train, [other])


def test_the_last_of_the_networks_that_solve_the_most_is_kept(
    small: Scenario, tmp_path: Path
) -> None:
    trainings.train(
        trainings.Training(tmp_path, QUICK, (small,), seed=1, evaluation_interval=50)
    )
    solved = np.flatnonzero(
        trainings.read_csv(tmp_path / "evaluations.csv")["solved"] == 1
    )
    assert len(solved) > 1
    assert load_model(tmp_path / "kept.safetensors")[1].steps == 50 * (solved[-1] + 1)


def test_the_over_estimation_is_that_of_the_free_cells_but_the_goal(
    small: Scenario,
) -> None:
    trainer = Trainer([small], QUICK, seed=0)
    found = trainings.evaluate_training(trainer, np.full(20, -2.0, dtype=np.float32))
    value = trainer.planner().q_field(small.grid, small.goal).q.max(axis=0)
    cells = [cell for cell in small.grid.free_cells() if cell != small.goal]
    expected = np.mean([value[y, x] + 2.0 for x, y in cells])
    assert found["overestimation"] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("alpha", [0.0, 0.6])
def test_the_optimal_value_is_what_the_best_policy_earns(
    small: Scenario, alpha: float
) -> None:
    parameters = replace(QUICK, alpha=alpha)
    environment = GridVectorEnvironment([small], parameters)
    value = trainings.optimal_value(environment)
    # Bellman's equation, with what the environment itself does.
    for x, y in small.grid.free_cells():
        returns = []
        for action in range(len(MOVES)):
            environment.reset()
            environment.cell = np.array([y * 5 + x])
            reward, terminated, _ = environment.move(np.array([action]))
            onward = (
                0.0 if terminated[0] else parameters.gamma * value[environment.cell[0]]
            )
            returns.append(float(reward[0] + onward))
        if (x, y) != small.goal:
            assert value[y * 5 + x] == pytest.approx(max(returns), abs=0.02)


def test_the_blind_robot_observes_the_papers_map_and_acts_on_its_own() -> None:
    noisy, _ = noisy_maps(3, 0, "near_path")
    trainer = BlindTrainer(noisy, PAPER, seed=0)
    sighted = Trainer([trainings.SCENARIO, *noisy], PAPER, seed=0).environment
    maps = np.arange(3)
    cell = trainer.environment.start
    observed = trainer.environment.observe(maps, cell)
    np.testing.assert_array_equal(observed, sighted.observe(0 * maps, cell))
    assert (observed != sighted.observe(1 + maps, cell)).any(axis=(1, 2)).all()
    np.testing.assert_array_equal(trainer.environment.rewards, sighted.rewards[1:])


def test_the_profile_of_goal_iii_reaches_the_trainer(tmp_path: Path) -> None:
    jobs = trainings_of_goal_3(trainings.Settings(tmp_path, 1, noise=("near_path",)))
    blind = {
        job.trainer_class is BlindTrainer: job.parameters
        for job in jobs
        if job.parameters.network == "paper"
    }
    assert blind[True] == blind[False] == PAPER
    trainer = Trainer([trainings.SCENARIO], PAPER, seed=0)
    settings = trainer.environment.parameters
    assert settings.priority * settings.weight_decay > 0
    assert trainer.planner().network.tensors.keys() == trainer.average.keys()


def evaluations(length: list[float]) -> np.ndarray:
    """One evaluation per 100 steps, solved where it has a length."""
    rows = [(100 * n, float(np.isfinite(c)), 0.0, c) for n, c in enumerate(length)]
    names = ("step", "solved", "solved_unmasked", "length")
    return np.array(rows, [(name, np.float64) for name in names])


def test_a_row_tells_from_when_on_a_path_is_found_and_is_the_shortest() -> None:
    shortest, longer = 22.970562748, 24.142135624
    run = evaluations([np.nan, longer, shortest, np.nan, longer, shortest])
    assert convergence_row([run]) == ["1 (0) of 1", "400", "500", "22.97"]
    assert convergence_row([run, run[:4]]) == [
        "1 (0) of 2",
        "never (400 to never)",
        "never (500 to never)",
        "22.97",
    ]
    always = evaluations([shortest])
    assert convergence_row([always]) == ["1 (0) of 1", "0", "0", "22.97"]


def test_legal_moves_predicted_to_fail_count_as_wrong_and_the_reverse() -> None:
    network = random_network("any_map", filters=2)
    metadata = ModelMetadata(
        "any_map", {"filters": 2}, trainings.MOVE_RULE, 0.95, "", 0, 0, ""
    )
    # A straight move is legal in half of the 256 patches with a free centre. A diagonal
    # one too if corners may be cut, else in an eighth.
    legal = 4 * (128 + 128 + 128 + 32)
    for bias, wrong in ((100.0, 4096 - legal), (-100.0, legal)):
        network.tensors["moves.bias"].fill(bias)
        assert any_map.move_errors(Planner(network, metadata))[0] == wrong


def test_the_q_that_the_loss_trains_adds_up_the_papers_rewards(paper: Scenario) -> None:
    metadata = ModelMetadata(
        "propagation", {"filters": 2}, trainings.MOVE_RULE, 0.95, "", 0, 0, ""
    )
    network = random_network("propagation", filters=2)
    # Told that every move succeeds: its rollouts go straight to the goal, and are
    # trapped by walls.
    network.tensors["moves.bias"].fill(100.0)
    planner = Planner(network, metadata)
    ratios = length_ratios(
        planner.q_field(paper.grid, paper.goal), paper.grid, trainings.MOVE_RULE
    )
    assert STARTS.sum() == 286
    assert 0 < np.isfinite(ratios)[STARTS].sum() < 286
    field = trained_field(planner)
    goal_x, goal_y = paper.goal
    assert field.q[0, goal_y, goal_x - 1] == pytest.approx(10.0, abs=1e-3)
    # Two moves before the end: Section 4.2's reward of one, and the end's, discounted.
    one, two = (
        np.hypot(goal_x - k - paper.start[0], goal_y - paper.start[1]) for k in (1, 2)
    )
    expected = 0.6 * 1.0 + 0.4 * (one - two - 1.0) + 0.95 * 10.0
    assert field.q[0, goal_y, goal_x - 2] == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("noise", trainings.NOISE)
def test_noisy_maps_differ_and_more_test_maps_leave_the_training_maps(
    paper: Scenario, noise: str
) -> None:
    training, test = noisy_maps(30, 30, noise)
    scenarios = [*training, *test]
    prints = [scenario.grid.fingerprint for scenario in scenarios]
    assert (len(training), len(set(prints))) == (30, 60)
    assert prints[:30] == [s.grid.fingerprint for s in noisy_maps(30, 31, noise)[0]]
    path = fixed_path(training)
    assert (path[0], path[-1]) == (paper.start, paper.goal)
    shortest = shortest_path(paper.grid, paper.start, paper.goal, trainings.MOVE_RULE)
    assert path_length(path) > path_length(shortest)
    if noise == "on_path":  # every inner cell of the path can be avoided at once
        assert all(
            scenario.grid.is_free(cell) for scenario in scenarios for cell in path
        )


def test_statistics_say_never_for_infinity_and_leave_nan_out() -> None:
    assert median_and_range([3, 1, 2000]) == "3 (1 to 2,000)"
    assert median_and_range([2.5, 2.5], 1) == "2.5"
    assert median_and_range([500, np.inf, 700]) == "700 (500 to never)"
    assert median_and_range([np.nan, 4]) == "4"
    assert median_and_range([np.nan]) == "none"
    expected = ["2.2500 (1.5000 to 3.0000)", "2.5000 (2.0000 to 3.0000)"]
    assert mean_and_worst([[1.0, 2.0], [], [3.0]]) == expected
    assert mean_and_worst([[]]) == ["none", "none"]
