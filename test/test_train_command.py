import json
import os
import re
import signal
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from map_files import save_map
from PIL import Image

from ddqn_planner.commands import train as train_command
from ddqn_planner.grid import MapFile
from ddqn_planner.training import Scenario

TRAIN = (
    "train --network propagation --steps 600 --learning-rate 0.01 "
    "--learning-rate-decay 0.5 --learning-starts 50 --target-interval 50"
)


@pytest.fixture
def small_map(small: Scenario, tmp_path: Path) -> str:
    path = tmp_path / "small.yaml"
    percent = small.grid.occupancy.astype("int8") * 100
    save_map(MapFile(percent, start=small.start, goal=small.goal), path)
    return str(path)


def test_the_end_is_a_table_and_a_resumed_training_tells_its_first_step(
    console: Any, small_map: str, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    printed = console(TRAIN, small_map, "--out", folder).out
    assert "solved starts         16 of 16\n" in printed
    assert re.search(r"over optimum   mean 1\.\d{4}, worst 1\.\d{4}\n", printed)
    assert re.search(r"given start  \d\.\d\d, optimum \d\.\d\d\n", printed)
    assert re.search(r"given start after \d+ steps, from all after \d+ st", printed)
    assert re.search(r"600 steps, \d+ episodes, \d+\.\d s\n", printed)
    assert str(folder / "model.safetensors") in printed
    (folder / "curve.csv").unlink()  # as in a folder of version 0.5.0
    resumed = console(TRAIN, small_map, "--out", folder, "--steps", 601).out
    assert "given start at step 600 or before, from all at step 600" in resumed
    assert "s since step 600\n" in resumed


def test_json_alone_is_on_stdout(console: Any, small_map: str, tmp_path: Path) -> None:
    output = console(f"{TRAIN} --json --steps 2 {small_map} --out", tmp_path / "run")
    answer = json.loads(output.out)
    assert (answer["step"], answer["starts"], answer["is_complete"]) == (2, 16, True)
    assert [point["step"] for point in answer["curve"]][-1] == 2
    assert answer["files"]["model"] == str(tmp_path / "run" / "model.safetensors")
    assert answer["files"]["film"] is None
    assert answer["length"] is None or answer["length"] >= answer["optimum"]
    assert "from step 0 to 2" in output.err


def test_a_picture_and_a_film_are_saved_into_new_folders(
    console: Any, small_map: str, tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib")
    picture, film = tmp_path / "new" / "end.png", tmp_path / "films" / "training.gif"
    words = f"{TRAIN} --steps 1 {small_map} --picture {picture} --film {film} --out"
    console(words, tmp_path / "run")
    with Image.open(picture) as image, Image.open(film) as frames:
        assert image.size == frames.size
        assert frames.n_frames == 2


def test_a_training_that_a_signal_stops_says_so_and_saves_its_film(
    console: Any,
    small_map: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("matplotlib")

    numbers = [signal.SIGINT, signal.SIGHUP]

    class Interrupted(train_command._Watcher):
        def __call__(self, *arguments: Any) -> dict[str, object]:
            if self.record.trainer.steps >= 2:
                os.kill(os.getpid(), numbers[0])
            return super().__call__(*arguments)

    monkeypatch.setattr(train_command, "_Watcher", Interrupted)
    film, run = tmp_path / "film.gif", tmp_path / "run"
    command = TRAIN, small_map, "--out", run
    printed = console(*command, "--film", film, status=130).out
    assert re.search(rf"stopped at step \d+ and saved in {run}; run the sam", printed)
    with Image.open(film) as frames:
        assert frames.n_frames == 2
    del numbers[0]
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup ignores it
    as_json = console(*command, "--json", status=129)
    signal.signal(signal.SIGHUP, before)
    assert json.loads(as_json.out)["is_complete"] is False
    assert "run the same command to resume" in as_json.err
    monkeypatch.undo()
    answer = json.loads(console(*command, "--json").out)
    assert answer["first_step"] == 0
    steps = [point["step"] for point in answer["curve"]]
    assert steps == sorted({*steps, *range(0, 601, 6)})


def test_wrong_outputs_are_refused_before_the_training(
    console: Any, small_map: str, tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib")
    for options, reason in (
        ("--film film.mp4", r"--film is film\.mp4, .*; give one of \.gif, "),
        ("--picture end.xyz", r"--picture is end\.xyz, .*; give one of \."),
        ("--film /proc/none/a.gif", "cannot be written .*; give another --film"),
        ("--picture a.png --film a.png", "--film and --picture are one file"),
        (f"--film {small_map}", "--film is .*small.yaml, which ends in"),
    ):
        words = f"{TRAIN} {options} {small_map} --out"
        error = console(words, tmp_path / "r", status=2).err
        assert re.search(reason, error)
    assert not (tmp_path / "r").exists()


def test_tensorboard_gets_the_curve(
    console: Any, small_map: str, tmp_path: Path
) -> None:
    folder = tmp_path / "events"
    words = f"{TRAIN} --steps 60 {small_map} --tensorboard {folder} --out"
    try:
        reader: Any = import_module(
            "tensorboard.backend.event_processing.event_accumulator"
        )
    except ImportError:
        refused = console(words, tmp_path / "run", status=2).err
        assert "No module named 'tensorboard'; pip install tensorboard" in refused
        assert not (tmp_path / "run").exists()
        return
    console(words, tmp_path / "run")
    events = reader.EventAccumulator(str(folder))
    events.Reload()
    shares = events.Scalars("starts/solved_share")
    assert shares[0].step == 0
    assert shares[-1].step == 60
    assert all(0 <= share.value <= 1 for share in shares)
    rates = [rate.value for rate in events.Scalars("parameters/learning_rate")]
    assert rates == sorted(rates, reverse=True)
    assert np.isfinite(rates).all()
