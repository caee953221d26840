from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ddqn_planner import MoveRule
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.run import TrainingRun, read_cells
from ddqn_planner.training.trainer import CheckpointError, Episode

PARAMETERS = HyperParameters(steps=400, filters=4, learning_starts=50)


def open_run(folder: Path, scenario: Scenario, **changes: object) -> TrainingRun:
    parameters = replace(PARAMETERS, **changes)  # type: ignore[arg-type]
    return TrainingRun(folder, [scenario], MoveRule.ROBOT_SAFE, parameters, seed=0)


def finish(run: TrainingRun) -> list[Episode]:
    episodes = [episode for finished in run.steps() for episode in finished]
    run.close()
    return episodes


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "episodes.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_each_episode_is_a_row_of_the_curves(small: Scenario, tmp_path: Path) -> None:
    episodes = finish(open_run(tmp_path, small))
    assert [int(row["episode"]) for row in rows(tmp_path)] == [e.number for e in episodes]
    assert [float(row["average_reward"]) for row in rows(tmp_path)] == pytest.approx(
        [episode.average_reward for episode in episodes], abs=1e-6
    )
    recorded = list(read_cells(tmp_path / "episodes.csv", every=3))
    assert recorded == [episode.cells for episode in episodes if episode.number % 3 == 0]


def test_a_run_goes_on_from_its_checkpoint_and_loses_no_row(
    small: Scenario, tmp_path: Path
) -> None:
    whole = open_run(tmp_path / "whole", small)
    finish(whole)
    first = open_run(tmp_path / "cut", small)
    for _ in first.steps():
        if first.trainer.steps == 150:
            first.save()
        if first.trainer.steps == 220:  # killed here: 70 steps after its checkpoint
            break
    first.close()
    second = open_run(tmp_path / "cut", small)
    assert second.trainer.steps == 150
    finish(second)
    assert rows(tmp_path / "cut") == rows(tmp_path / "whole")
    for a, b in zip(
        whole.trainer.network.parameters(), second.trainer.network.parameters(), strict=True
    ):
        assert torch.equal(a, b)


def test_a_finished_run_can_be_made_longer(small: Scenario, tmp_path: Path) -> None:
    finish(open_run(tmp_path, small))
    longer = open_run(tmp_path, small, steps=500)
    finish(longer)
    assert longer.trainer.steps == 500


@pytest.mark.parametrize(
    ("changes", "named"), [({"gamma": 0.9}, r"gamma 0\.95 \(now 0\.9\)"), ({"p_r": 0.0}, "p_r")]
)
def test_other_parameters_do_not_overwrite_a_run(
    small: Scenario, tmp_path: Path, changes: dict[str, object], named: str
) -> None:
    finish(open_run(tmp_path, small))
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(CheckpointError, match=named):
        open_run(tmp_path, small, **changes)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_tensorboard_gets_the_curves_where_it_is_installed(small: Scenario, tmp_path: Path) -> None:
    episodes = finish(open_run(tmp_path, small))
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert len(events.Scalars("average_reward")) == len(episodes)
