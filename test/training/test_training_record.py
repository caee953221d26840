from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ddqn_planner import GridMap, Planner
from ddqn_planner.training import (
    EpisodeEnd,
    HyperParameters,
    Scenario,
    Trainer,
    TrainingRecord,
    evaluate,
)
from ddqn_planner.training.curve_file import CurveFile

PARAMETERS = HyperParameters(
    network="propagation",
    steps=600,
    learning_rate=0.01,
    learning_rate_decay=0.5,
    learning_starts=50,
    target_interval=50,
)


def record_of(
    scenarios: Sequence[Scenario], steps: int = 600, **options: int
) -> TrainingRecord:
    """The record of a training, or of its first steps."""
    trainer = Trainer(scenarios, PARAMETERS, seed=0)
    record = TrainingRecord(trainer, **options)
    for progress in trainer.run(steps, record.interval):
        record.add(progress)
    return record


def solved(planner: Planner, scenario: Scenario) -> int:
    field = planner.q_field(scenario.grid, scenario.goal)
    return evaluate(field, scenario.grid, scenario.move_rule).solved


def frames(path: Path) -> list[Image.Image]:
    with Image.open(path) as film:
        images = []
        for number in range(getattr(film, "n_frames", 1)):
            film.seek(number)
            images.append(film.convert("RGB"))
        return images


def test_the_curve_has_a_point_for_each_interval(small: Scenario) -> None:
    record = record_of([small], evaluations=6)
    assert [point.step for point in record.curve] == [0, 100, 200, 300, 400, 500, 600]
    last = record.curve[-1]
    assert (last.starts, last.solved) == (16, solved(record.trainer.planner(), small))
    assert last.solved_share == 1
    assert last.start_ratio == last.worst_ratio == pytest.approx(1)
    shares = last.reached_goal, last.collided, last.out_of_steps
    assert sum(shares) == pytest.approx(1)
    assert record.snapshots[-1].path[-1] == small.goal
    for_good = record.all_solved_for_good()
    assert for_good in [point.step for point in record.curve]
    assert record.start_solved_for_good() <= for_good


def test_the_curve_of_a_restored_training_is_that_of_the_whole(
    small: Scenario, tmp_path: Path
) -> None:
    whole, cut = record_of([small], steps=150), record_of([small], steps=102)
    cut.trainer.save_checkpoint(tmp_path / "checkpoint")
    for _ in cut.trainer.run(105):
        cut.evaluate()  # later than the checkpoint
    restored = Trainer([small], PARAMETERS, seed=0)
    restored.restore(tmp_path / "checkpoint")
    record = TrainingRecord(restored, earlier_curve=cut.curve)
    assert record.curve == [point for point in cut.curve if point.step <= 102]
    for progress in restored.run(150, every=record.interval):
        record.add(progress)
    for point, expected in zip(record.curve, whole.curve, strict=True):
        np.testing.assert_equal(point._replace(seconds=0), expected._replace(seconds=0))
    seconds = [point.seconds for point in record.curve]
    assert seconds == sorted(seconds)
    assert len(record.snapshots) == 1 + 48 // record.interval
    with pytest.raises(ValueError, match="no CurvePoint; give the curve of a record"):
        TrainingRecord(restored, earlier_curve=[1])  # type: ignore[list-item]


@pytest.mark.parametrize("rest", [b"", b"200,1.5,16", b"x,1\r\n", b"\xff\0,,,\r\n\r\n"])
def test_complete_points_of_a_broken_file_are_read(
    small: Scenario, tmp_path: Path, rest: bytes
) -> None:
    points = record_of([small], steps=18).curve
    path = tmp_path / "curve.csv"
    file = CurveFile(path, step=0)
    for point in [points[0], *points]:
        file.add(point)
    file.close()
    path.write_bytes(path.read_bytes() + rest)
    again = CurveFile(path, step=12)
    np.testing.assert_equal(again.earlier, points[:3])
    again.close()
    assert len(path.read_bytes().splitlines()) == 1 + 3
    CurveFile(path, step=0).close()  # a new training in the folder
    assert len(path.read_bytes().splitlines()) == 1


def test_a_start_that_is_lost_again_is_not_solved_for_good(small: Scenario) -> None:
    record = record_of([small], steps=1)
    point = record.curve[0]._replace(starts=2)
    for step, start_ratio, count in ((5, 1.0, 2), (6, np.inf, 1), (7, 1.5, 2)):
        changes = {"step": step, "start_ratio": start_ratio, "solved": count}
        record.curve.append(point._replace(**changes))
    assert record.start_solved_for_good() == record.all_solved_for_good() == 7
    record.curve.append(point._replace(step=8, start_ratio=1.5, solved=1))
    assert record.start_solved_for_good() == 7
    assert record.all_solved_for_good() is None


def test_episodes_are_those_of_the_watched_map(small: Scenario) -> None:
    swapped = replace(small, start=small.goal, goal=small.start)
    record = record_of([small, swapped], scenario=1, evaluations=3)
    assert record.scenario is swapped
    for snapshot in record.snapshots:
        assert all(episode.scenario == 1 for episode in snapshot.episodes)
    shown = [episode for snap in record.snapshots for episode in snap.episodes]
    assert {episode.outcome for episode in shown} >= {EpisodeEnd.COLLIDED}


def test_a_film_has_a_frame_for_each_evaluation(
    small: Scenario, tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib")
    record = record_of([small], steps=100, evaluations=12)
    for ending in ("gif", "webp", "png"):
        file = tmp_path / "new folder" / f"film.{ending}"
        record.save_film(file)
        images = frames(file)
        # At the steps 0, 50 and 100.
        assert len(images) == len(record.curve) == 3
        assert len({image.tobytes() for image in images}) == 3
    for wrong in ("film.mp4", "film"):
        with pytest.raises(ValueError, match=r"the film is .*; give one of \.gif, "):
            record.save_film(tmp_path / wrong)


def test_a_picture_shows_one_way_zones_and_a_wide_map(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    occupancy = np.zeros((10, 80), np.bool_)
    forbidden = np.zeros(occupancy.shape, np.uint8)
    forbidden[:, 40:] = 0b00111000
    pictures = []
    for layer in (None, forbidden):
        scenario = Scenario(GridMap(occupancy, forbidden=layer), (1, 1), (70, 5))
        record = TrainingRecord(Trainer([scenario], PARAMETERS, seed=0))
        record.save_picture(tmp_path / "map.png")
        pictures.append(frames(tmp_path / "map.png")[0])
        record.save_picture(tmp_path / "map.svg")
    plain, one_way = (np.asarray(picture, dtype=int) for picture in pictures)
    assert (plain != one_way).any()
    assert plain.shape[1] > 2 * plain.shape[0]


def test_an_old_film_stays_if_the_disk_is_full(
    small: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    record = record_of([small], steps=1)

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    for name, save in (("a.gif", record.save_film), ("a.png", record.save_picture)):
        file = tmp_path / name
        file.write_bytes(b"old")
        with pytest.raises(OSError, match="No space left"):
            save(file)
        assert file.read_bytes() == b"old"


def test_a_record_takes_its_own_trainer_and_progress_alone(small: Scenario) -> None:
    trainer = Trainer([small], PARAMETERS, seed=0)
    with pytest.raises(ValueError, match="the trainer is None; give a Trainer"):
        TrainingRecord(None)  # type: ignore[arg-type]
    for name, value in {"scenario": 1, "evaluations": 0}.items():
        with pytest.raises(ValueError, match=f"{name} is {value}; give"):
            TrainingRecord(trainer, **{name: value})
    record = TrainingRecord(trainer, evaluations=1)
    with pytest.raises(ValueError, match="the progress is 3; give what"):
        record.add(3)  # type: ignore[arg-type]
    other = Trainer([small], PARAMETERS, seed=1)
    with pytest.raises(ValueError, match="of step 100, and the trainer at step 0"):
        record.add(next(other.run(every=100)))
    for _ in trainer.run(100):
        pass
    with pytest.raises(ValueError, match="of step 100 is another trainer's; give what"):
        record.add(other.last_progress)  # type: ignore[arg-type]
    for progress in trainer.run():
        record.add(progress)
        record.add(progress)  # is ignored
    steps = [point.step for point in record.curve]
    assert steps == [0, 600]
    assert record.add(progress) is None
