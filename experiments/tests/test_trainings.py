from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from profiles import MOVE_RULE
from settings import first_kept, mean_and_worst, median_and_range
from supervised import best_moves, cross_entropy, train_supervised
from tables import table, write_table
from trainings import (
    Training,
    TrainingEvaluation,
    evaluate_training,
    in_parallel,
    optimal_value,
    read_evaluations,
    train,
)

from ddqn_planner.grid import LENGTHS, MOVES, shortest_distances
from ddqn_planner.model import load_model
from ddqn_planner.planning import Planner
from ddqn_planner.training.environment import GridVectorEnvironment, Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import Trainer

QUICK = HyperParameters(steps=900, filters=4, learning_starts=50, target_interval=100)


def evaluation(step: int, solved: int) -> TrainingEvaluation:
    return TrainingEvaluation(step, 0, 0, 0.0, solved, solved, 1.0, 0.0)


@pytest.mark.slow
def test_a_training_that_was_cut_off_ends_as_if_it_had_not_been(
    small: Scenario, tmp_path: Path
) -> None:
    folders = [tmp_path / name for name in ("whole", "cut")]
    whole, cut = (Training(folder, QUICK, (small,), 1, 300) for folder in folders)
    train(whole)
    train(replace(cut, parameters=replace(QUICK, steps=600)))
    in_parallel(train, [cut])
    runs = [read_evaluations(folder) for folder in folders]
    assert [e.step for e in runs[0]] == [300, 600, 900]
    for a, b in zip(*runs, strict=True):
        np.testing.assert_equal(asdict(replace(a, seconds=0.0)), asdict(replace(b, seconds=0.0)))
    seconds = [e.seconds for e in runs[1]]
    assert seconds == sorted(seconds)
    models = [folder / "model.safetensors" for folder in folders]
    assert models[0].read_bytes() == models[1].read_bytes()


def test_the_last_of_the_networks_that_solve_the_most_is_kept(
    small: Scenario, tmp_path: Path
) -> None:
    train(Training(tmp_path, QUICK, (small,), seed=1, evaluation_interval=50))
    solved = [e.solved for e in read_evaluations(tmp_path)]
    assert solved.count(1) > 1
    last = max(number for number, count in enumerate(solved) if count == 1)
    assert load_model(tmp_path / "kept.safetensors")[1].steps == 50 * (last + 1)


def test_the_over_estimation_is_that_of_the_free_cells_but_the_goal(small: Scenario) -> None:
    trainer = Trainer([small], MOVE_RULE, QUICK, seed=0)
    optimum = np.full(20, -2.0, dtype=np.float32)
    found = evaluate_training(trainer, optimum, seconds=1.0)
    value = trainer.planner().q_field(small.grid, small.goal).q.max(axis=0)
    cells = [cell for cell in small.grid.free_cells() if cell != small.goal]
    expected = np.mean([value[y, x] + 2.0 for x, y in cells])
    assert found.overestimation == pytest.approx(expected, rel=1e-5)


@pytest.mark.slow
def test_what_a_job_raises_is_raised(small: Scenario, tmp_path: Path) -> None:
    training = Training(tmp_path, QUICK, (small,), seed=1, evaluation_interval=300)
    train(training)
    other = replace(training, parameters=replace(QUICK, gamma=0.5))
    with pytest.raises(ValueError, match=r"gamma 0\.95"):
        in_parallel(train, [other])


@pytest.mark.parametrize("alpha", [0.0, 0.6])
def test_the_optimal_value_is_what_the_best_policy_earns(small: Scenario, alpha: float) -> None:
    parameters = replace(QUICK, alpha=alpha)
    environment = GridVectorEnvironment([small], MOVE_RULE, parameters)
    value = optimal_value(environment)
    # Bellman's equation, with what the environment itself does.
    for x, y in small.grid.free_cells():
        if (x, y) == small.goal:
            continue
        returns = []
        for action in range(len(MOVES)):
            environment.cell = np.array([y * 5 + x])
            reward, terminated, _ = environment.move(np.array([action]))
            onward = 0.0 if terminated[0] else parameters.gamma * value[environment.cell[0]]
            returns.append(float(reward[0] + onward))
        assert value[y * 5 + x] == pytest.approx(max(returns), abs=0.02)


def test_best_moves_begin_shortest_paths(small: Scenario) -> None:
    best = best_moves(small).reshape(4, 5, 8)
    distance = shortest_distances(small.grid, small.goal, MOVE_RULE)
    assert not best[small.grid.occupancy].any()
    assert not best[small.goal[::-1]].any()
    for x, y in small.grid.free_cells():
        for action in np.flatnonzero(best[y, x]):
            dx, dy = MOVES[action]
            assert distance[y, x] == pytest.approx(LENGTHS[action] + distance[y + dy, x + dx])


def test_cross_entropy_is_zero_when_the_best_moves_have_all_the_weight() -> None:
    q = torch.tensor([[50.0, 50.0, 0.0], [0.0, 0.0, 50.0]])
    assert cross_entropy(q, torch.tensor([[1, 1, 0], [0, 0, 1]]).bool()) < 1e-6
    even = cross_entropy(torch.zeros(1, 4), torch.tensor([[1, 0, 0, 0]]).bool())
    assert even.item() == pytest.approx(np.log(4))


def test_a_supervised_network_finds_the_shortest_path(small: Scenario, tmp_path: Path) -> None:
    training = Training(tmp_path, QUICK, (small,), seed=0, evaluation_interval=300)
    train_supervised(training)
    path = tmp_path / "model.safetensors"
    written = path.stat().st_mtime_ns
    train_supervised(training)
    assert path.stat().st_mtime_ns == written
    planner = Planner.load(path)
    plan = planner.plan(small.grid, small.start, small.goal)
    optimum = shortest_distances(small.grid, small.goal, MOVE_RULE)[small.start[::-1]]
    assert plan.length == pytest.approx(optimum)


def test_median_and_range_say_never_for_infinity_and_leave_nan_out() -> None:
    assert median_and_range([3, 1, 2000]) == "3 (1 to 2,000)"
    assert median_and_range([2.5, 2.5], 1) == "2.5"
    assert median_and_range([500, np.inf, 700]) == "700 (500 to never)"
    assert median_and_range([np.nan, 4]) == "4"
    assert median_and_range([np.nan]) == "none"


def test_mean_and_worst_leave_out_seeds_without_ratios() -> None:
    assert mean_and_worst([[1.0, 2.0], [], [3.0]]) == [
        "2.2500 (1.5000 to 3.0000)",
        "2.5000 (2.0000 to 3.0000)",
    ]
    assert mean_and_worst([[]]) == ["none", "none"]


@pytest.mark.parametrize(
    ("solved", "first"), [((0, 1, 0, 1, 1), 3), ((1, 1), 0), ((1, 0), None), ((), None)]
)
def test_what_is_solved_for_good_is_solved_to_the_end(
    solved: tuple[int, ...], first: int | None
) -> None:
    run = [evaluation(step, value) for step, value in enumerate(solved)]
    kept = first_kept(run, lambda e: e.solved == 1)
    assert (kept.step if kept else None) == first


def test_a_table_is_markdown_and_csv(tmp_path: Path) -> None:
    expected = "| a | b |\n| --- | --- |\n| 1 | x |"
    assert table(["a", "b"], [[1, "x"]]) == expected
    assert write_table(tmp_path / "table.csv", ["a", "b"], [[1, "x"]]) == expected
    assert (tmp_path / "table.csv").read_text() == "a,b\n1,x\n"
