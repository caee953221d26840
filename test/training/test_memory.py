from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open

from ddqn_planner import GridMap, MoveRule
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.memory import (
    MemoryShortageError,
    available_bytes,
    check_memory,
    training_bytes,
)
from ddqn_planner.training.run import TrainingRun
from ddqn_planner.training.trainer import CheckpointError, Trainer

TRAIN = """
import json, sys
import numpy as np, torch
from ddqn_planner import GridMap, MoveRule
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import Trainer

def peak():
    lines = dict(line.split(":") for line in open("/proc/self/status"))
    return int(lines["VmHWM"].split()[0]) * 1024

def train(side, maps, parameters):
    scenario = Scenario(GridMap(np.zeros((side, side), bool)), (0, 0), (side - 1, side - 1))
    trainer = Trainer([scenario] * maps, MoveRule.ROBOT_SAFE, HyperParameters(**parameters), 0)
    for _ in trainer.run(10**6):
        if trainer.updates == 2:
            break
    trainer.save_checkpoint(sys.argv[4])

torch.set_num_threads(1)
parameters = json.loads(sys.argv[3])
train(4, 1, {**parameters, "filters": 1, "batch_size": 1, "environments": 1})
before = peak()
train(int(sys.argv[1]), int(sys.argv[2]), parameters)
print(peak() - before)
"""
"""The memory that a training takes beyond a small one of its kind."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("side", "maps", "more"),
    [
        (300, 1, {}),
        (20, 400, {"network": "propagation"}),
    ],
)
def test_the_estimate_is_near_to_the_measured_memory(
    tmp_path: Path, side: int, maps: int, more: dict[str, object]
) -> None:
    parameters = HyperParameters(**{"learning_starts": 0, **more})  # type: ignore[arg-type]
    scenario = Scenario(GridMap(np.zeros((side, side), bool)), (0, 0), (side - 1, side - 1))
    estimate = training_bytes([scenario] * maps, parameters)
    arguments = [str(side), str(maps), json.dumps(asdict(parameters)), str(tmp_path / "x")]
    command = [sys.executable, "-c", TRAIN, *arguments]
    measured = int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert 0.7 * measured <= estimate <= 1.5 * measured, (estimate, measured)


def test_a_training_that_cannot_fit_is_refused_with_both_numbers(tmp_path: Path) -> None:
    scenario = Scenario(GridMap(np.zeros((2000, 2000), bool)), (0, 0), (1, 1))
    greedy = HyperParameters(filters=1024, batch_size=4096)
    remedy = r"takes about [\d,]{9,} MB .* [\d,]+ MB are available; take a smaller map"
    with pytest.raises(MemoryShortageError, match=remedy):
        TrainingRun(tmp_path / "run", [scenario], MoveRule.ROBOT_SAFE, greedy, seed=0)
    assert not (tmp_path / "run").exists()


def test_a_training_that_fits_is_accepted(small: Scenario) -> None:
    assert 0 < available_bytes() < os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    assert check_memory([small], HyperParameters()) == training_bytes([small], HyperParameters())


def test_each_parameter_that_takes_memory_raises_the_estimate(small: Scenario) -> None:
    # A small buffer: saving a large one takes more than all that the others can change.
    least = HyperParameters(replay_capacity=4096)
    estimate = training_bytes([small], least)
    for more in (
        replace(least, filters=64),
        replace(least, hidden_units=1024),
        replace(least, batch_size=4096),
        replace(least, environments=4096),
        replace(least, replay_capacity=100_000),
    ):
        assert training_bytes([small], more) > estimate
    assert training_bytes([small] * 1000, least) > estimate


def test_a_checkpoint_of_holes_is_refused_before_it_is_read(
    small: Scenario, tmp_path: Path
) -> None:
    path = tmp_path / "checkpoint.safetensors"
    trainer = Trainer([small], MoveRule.ROBOT_SAFE, HyperParameters(filters=4), seed=0)
    trainer.save_checkpoint(path)
    header = json.loads(path.read_bytes()[8:].split(b"}}", 1)[0] + b"}}")
    size = 2**30
    for entry in header.values():
        if "data_offsets" in entry:
            entry.update(shape=[0], data_offsets=[size, size])
    header["network.convolution.weight"].update(shape=[size // 4], data_offsets=[0, size])
    text = json.dumps(header).encode()
    with path.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        file.truncate(file.tell() + size)
    with safe_open(path, framework="pt") as opened:  # it is what it seems to be
        assert opened.get_slice("network.convolution.weight").get_shape() == [size // 4]
    before = peak_after_reset()
    with pytest.raises(CheckpointError, match="its tensors have other names, types or shapes"):
        Trainer.load_checkpoint(path, [small])
    assert peak() - before < 2**27


def peak() -> int:
    lines = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
    return int(lines["VmHWM"].split()[0]) * 1024


def peak_after_reset() -> int:
    Path("/proc/self/clear_refs").write_text("5")
    return peak()
