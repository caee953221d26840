import csv
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ddqn_planner import GridMap, MoveRule
from ddqn_planner.grid import path_length
from ddqn_planner.model import load_model
from ddqn_planner.training.checkpoint import CheckpointError
from ddqn_planner.training.episodes import Episode, read_cells
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.run import SAVE_INTERVAL, TrainingRun
from ddqn_planner.training.scenario import Scenario

PARAMETERS = HyperParameters(steps=400, filters=4, learning_starts=50)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def open_run(folder: Path, scenario: Scenario, **changes: object) -> TrainingRun:
    parameters = replace(PARAMETERS, **changes)  # type: ignore[arg-type]
    return TrainingRun(folder, [scenario], parameters, seed=0)


def finish(run: TrainingRun) -> list[Episode]:
    episodes = [episode for progress in run.steps() for episode in progress.episodes]
    run.close()
    return episodes


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "episodes.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("rule", MoveRule)
def test_an_episode_is_a_row_of_the_curves(
    small: Scenario, tmp_path: Path, rule: MoveRule
) -> None:
    episodes = finish(open_run(tmp_path, replace(small, move_rule=rule), steps=150))
    assert any(
        x != u and y != v for e in episodes for (x, y), (u, v) in pairwise(e.cells)
    )
    for row, episode in zip(rows(tmp_path), episodes, strict=True):
        assert int(row["episode"]) == episode.number
        assert float(row["average_reward"]) == pytest.approx(
            episode.average_reward, abs=1e-6
        )
        assert float(row["length"]) == pytest.approx(
            path_length(episode.cells), abs=1e-4
        )
    recorded = list(read_cells(tmp_path / "episodes.csv", every=3))
    assert recorded == [
        episode.cells for episode in episodes if episode.number % 3 == 0
    ]


def test_a_run_continues_from_its_checkpoint_and_rows(
    small: Scenario, tmp_path: Path
) -> None:
    uninterrupted = open_run(tmp_path / "uninterrupted", small)
    finish(uninterrupted)
    first = open_run(tmp_path / "cut", small)
    for _ in first.steps():
        if first.trainer.steps == 150:
            first.try_to_save()
        if first.trainer.steps == 220:  # killed between the two files of a save
            first.model_path.write_bytes(first.trainer.model_bytes())
            break
    first.close()
    assert load_model(first.model_path)[1].steps == 220
    second = open_run(tmp_path / "cut", small)
    assert second.trainer.steps == 150
    finish(second)
    assert load_model(second.model_path)[1].steps == 400
    assert rows(tmp_path / "cut") == rows(tmp_path / "uninterrupted")
    weights = [run.trainer.network.tensors.values() for run in (uninterrupted, second)]
    assert all(map(np.array_equal, *weights))


def test_a_finished_run_can_be_made_longer_but_not_changed(
    small: Scenario, tmp_path: Path
) -> None:
    finish(open_run(tmp_path, small, steps=100))
    before = contents(tmp_path)
    with pytest.raises(
        CheckpointError, match=r"gamma 0\.95 \(now 0\.9\), p_r"
    ) as refused:
        open_run(tmp_path, small, gamma=0.9, p_r=0.0)
    assert contents(tmp_path) == before
    assert (
        refused
    )  # its frames keep the failed run alive: the folder is unlocked all the same
    (tmp_path / "training.lock").unlink()  # a version without locks made it
    longer = open_run(tmp_path, small, steps=150)
    finish(longer)
    assert longer.trainer.steps == 150


NAMES = ["episodes.csv", "model.safetensors", ".episodes.csv.swp", "sub/thesis.tex"]


@pytest.mark.parametrize("name", NAMES)
def test_a_folder_of_something_else_is_left(
    small: Scenario, tmp_path: Path, name: str
) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text("mine")
    with pytest.raises(
        ValueError, match="no training; give a new or empty folder"
    ) as error:
        open_run(tmp_path, small)
    assert name.split("/")[0] in str(error.value)
    assert [entry for entry in tmp_path.rglob("*") if entry.is_file()] == [path]
    assert path.read_text() == "mine"


def test_a_folder_is_of_one_run_at_a_time(small: Scenario, tmp_path: Path) -> None:
    first = open_run(tmp_path, small)
    steps = first.steps()
    for _ in range(100):
        next(steps)
    before = contents(tmp_path)
    with pytest.raises(ValueError, match=f"another process trains in {tmp_path}"):
        open_run(tmp_path, small)
    assert contents(tmp_path) == before
    first.close()
    assert not first.checkpoint_path.exists()
    assert len(finish(open_run(tmp_path, small))) == len(rows(tmp_path)) > 0


def test_a_failed_save_is_tried_again_later(small: Scenario, tmp_path: Path) -> None:
    run = open_run(tmp_path / "run", small, steps=10**6, environments=50)
    steps = run.steps()
    (tmp_path / "run").rename(tmp_path / "moved")
    (tmp_path / "run").touch()
    while run.trainer.steps < SAVE_INTERVAL:
        next(steps)
    assert str(tmp_path / "run") in run.save_error
    assert "make room" in run.save_error
    (tmp_path / "run").unlink()
    (tmp_path / "moved").rename(tmp_path / "run")
    while run.trainer.steps < 2 * SAVE_INTERVAL:
        assert not run.checkpoint_path.exists()
        next(steps)
    assert run.checkpoint_path.exists()
    assert run.save_error == ""
    run.close()


def test_a_last_save_that_fails_says_how_to_continue(
    small: Scenario, tmp_path: Path
) -> None:
    run = open_run(tmp_path / "run", small, steps=500, environments=50)
    (tmp_path / "run").rename(tmp_path / "moved")
    (tmp_path / "run").touch()
    finish(run)
    assert "make room" in run.save_error
    assert "start it again" in run.save_error
    assert "the training continues" not in run.save_error


def test_a_run_that_is_stopped_is_saved_and_ends(
    small: Scenario, tmp_path: Path
) -> None:
    run = open_run(tmp_path, small)
    for _ in run.steps():
        run.requests.add("stop")
    assert 0 < run.trainer.steps < PARAMETERS.steps
    assert run.saved_at == run.trainer.steps
    assert run.checkpoint_path.exists()
    run.close()


def test_a_training_that_diverged_is_not_saved(small: Scenario, tmp_path: Path) -> None:
    run = open_run(tmp_path, small)
    next(run.steps())
    run.try_to_save()
    before = contents(tmp_path)
    run.trainer.network.tensors["convolution.bias"].fill(np.nan)
    with pytest.raises(ValueError, match=r"diverged.*smaller learning_rate"):
        finish(run)
    run.close()
    after = contents(tmp_path)
    assert before.pop("episodes.csv") in after.pop("episodes.csv")
    assert after == before


def test_a_training_that_cannot_fit_is_refused_with_the_remedy(tmp_path: Path) -> None:
    grid = GridMap(np.zeros((300, 300), dtype=bool))
    greedy = replace(PARAMETERS, filters=1024, hidden_units=4096)  # 400 GB of weights
    for _ in range(2):  # the folder is not left locked
        with pytest.raises(MemoryError, match="a smaller map, or smaller filters"):
            TrainingRun(tmp_path, [Scenario(grid, (0, 0), (1, 1))], greedy, seed=0)


GOOD = b"1,9,0,reached_goal,2,2.0,1.5,0.75,0:0 1:0 2:0\r\n"


@given(
    st.lists(
        st.binary() | st.sampled_from([GOOD, GOOD[:-9], GOOD.replace(b"1:0", b"1:")])
    )
)
def test_complete_rows_of_a_broken_file_are_read(
    tmp_path_factory: pytest.TempPathFactory, lines: list[bytes]
) -> None:
    path = tmp_path_factory.mktemp("broken") / "episodes.csv"
    path.write_bytes(b"\n".join([*lines, b""]) + GOOD)
    cells = list(read_cells(path, every=1))
    assert cells[-1] == ((0, 0), (1, 0), (2, 0))


def test_an_episode_of_any_length_can_be_read_and_cut(
    small: Scenario, tmp_path: Path
) -> None:
    open_run(tmp_path, small).close()
    path = tmp_path / "episodes.csv"
    cells = b" ".join([b"0:0"] * 10**5)
    path.write_bytes(b"1,9,0,out_of_steps,2,2.0,1.5,0.75," + cells + b"\r\n")
    assert [len(cells) for cells in read_cells(path, every=1)] == [10**5]
    open_run(tmp_path, small).close()
    assert rows(tmp_path) == []
