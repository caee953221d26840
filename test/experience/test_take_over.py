from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ddqn_planner import Experience, GridMap
from ddqn_planner.experience import evidence

GRID = GridMap(np.zeros((60, 200), dtype=np.bool_), resolution=0.25)


def drive(experience: Experience, y: float, seconds: float = 80.0) -> None:
    time = np.linspace(0, seconds, 201)
    experience.record(time, np.column_stack([5 + time * 40 / seconds, np.full(201, y)]))


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many places were spread by each call."""
    counts: list[int] = []
    spread = evidence.spread_evidence

    def counting(occupancy: np.ndarray, cells: np.ndarray, *rest: object) -> None:
        counts.append(len(cells))
        spread(occupancy, cells, *rest)

    monkeypatch.setattr(evidence, "spread_evidence", counting)
    return counts


def test_only_what_is_new_is_spread_and_the_result_is_the_same(
    tmp_path: Path, counted: list[int]
) -> None:
    path = tmp_path / "experience.npz"
    trainer = Experience(0.5)
    used: Experience | None = None
    for number, y in enumerate((3.0, 8.0, 8.0, 11.0)):
        drive(trainer, y, seconds=90.0 + 40 * number)
        expected = trainer.slowness(GRID)
        trainer.save(path)
        newer = Experience.load(path)
        if used is not None:
            newer.take_over(used)
        used = newer
        if number == 2:
            continue  # this one is never spread
        counted.clear()
        slowness = used.slowness(GRID)
        assert sum(counted) < 1.1 * (trainer.evidence.places if number == 0 else 330)
        np.testing.assert_allclose(slowness, expected, rtol=0.021)  # one step


def test_experience_that_was_forgotten_begins_anew(tmp_path: Path) -> None:
    path = tmp_path / "experience.npz"
    trainer = Experience(0.5)
    drive(trainer, 3.0, 200.0)
    trainer.slowness(GRID)
    newer = Experience(0.5)
    drive(newer, 11.0, 200.0)
    newer.save(path)
    loaded = Experience.load(path)
    loaded.take_over(trainer)
    np.testing.assert_array_equal(loaded.slowness(GRID), Experience.load(path).slowness(GRID))
    assert trainer.slowness(GRID)[12, 60] > 1.5
