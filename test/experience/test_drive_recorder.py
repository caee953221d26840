from __future__ import annotations

import math

import numpy as np
import pytest

from ddqn_planner.experience.drives import MOST_SAMPLES, DriveEnd, DriveRecorder

RATE = 20.0


class Robot:
    """A robot that drives along x, and the drives that were recorded."""

    def __init__(self) -> None:
        self.now, self.x = 100.0, 0.0
        self.drives: list[tuple[DriveEnd, np.ndarray, np.ndarray]] = []
        self.recorder = DriveRecorder(lambda *drive: self.drives.append(drive))

    def move(self, metres: float, speed: float = 0.5) -> None:
        self._for(abs(metres) / speed, math.copysign(speed, metres))

    def stand(self, seconds: float) -> None:
        self._for(seconds, 0.0)

    def _for(self, seconds: float, speed: float) -> None:
        for _ in range(round(seconds * RATE)):
            self.now, self.x = self.now + 1 / RATE, self.x + speed / RATE
            self.recorder.add(self.now, self.x, 2.0)

    @property
    def outcomes(self) -> list[str]:
        return [outcome.value for outcome, _, _ in self.drives]


@pytest.fixture
def robot() -> Robot:
    robot = Robot()
    robot.stand(1)
    return robot


def test_a_drive_ends_when_the_robot_stands_at_its_goal(robot: Robot) -> None:
    robot.recorder.set_goal(5.0, 2.0)
    robot.stand(10)
    robot.move(5)
    assert robot.drives == []
    robot.stand(3)
    assert robot.outcomes == ["arrived"]
    _, seconds, positions = robot.drives[0]
    assert positions[0] == pytest.approx([0.1, 2], abs=0.05)
    assert positions[-1] == pytest.approx([5, 2], abs=0.05)
    assert seconds[-1] - seconds[0] == pytest.approx(11.8, abs=0.5)
    robot.stand(200)
    assert len(robot.drives) == 1  # who stands drives nowhere


def test_a_wait_on_the_way_belongs_to_the_drive(robot: Robot) -> None:
    robot.recorder.set_goal(5.0, 2.0)
    robot.move(2.5)
    robot.stand(60)
    robot.move(2.5)
    robot.stand(3)
    (drive,) = robot.drives
    assert drive[1][-1] - drive[1][0] == pytest.approx(72, abs=1)


def test_samples_are_thinned(robot: Robot) -> None:
    robot.move(2, speed=0.1)
    robot.stand(30)
    robot.recorder.end(DriveEnd.STOPPED)
    _, seconds, positions = robot.drives[0]
    steps = np.hypot(*np.diff(positions, axis=0).T)
    times = np.diff(seconds)
    assert ((steps >= 0.05 - 1e-9) | (times >= 0.5 - 1e-9)).all()
    assert times.max() < 0.6


@pytest.mark.parametrize(("end", "outcome"), [(2.2, "arrived"), (1.0, "new_goal")])
def test_a_new_goal_ends_a_drive(robot: Robot, end: float, outcome: str) -> None:
    robot.recorder.set_goal(2.0, 2.0)
    robot.move(end)
    robot.recorder.set_goal(2.0, 2.0)
    assert robot.drives == []  # a goal that is repeated is none
    robot.recorder.set_goal(9.0, 2.0)
    assert robot.outcomes == [outcome]
    robot.move(1)
    robot.recorder.end(DriveEnd.STOPPED)
    assert robot.outcomes == [outcome, "stopped"]


def test_a_long_pause_ends_a_drive_and_the_next_begins_there(robot: Robot) -> None:
    robot.move(2)
    robot.stand(300)
    assert robot.outcomes == ["paused"]
    robot.move(2)
    robot.recorder.end(DriveEnd.STOPPED)
    assert robot.outcomes == ["paused", "stopped"]
    assert robot.drives[1][2][0] == pytest.approx([2.1, 2], abs=0.1)


def test_who_gives_up_ends_a_drive_also_before_it_moved(robot: Robot) -> None:
    robot.recorder.abort()
    robot.move(1)
    robot.recorder.abort()
    assert robot.outcomes == ["aborted", "aborted"]
    assert robot.drives[0][2].tolist() == [[0, 2]]
    assert robot.drives[1][2][-1] == pytest.approx([1, 2], abs=0.1)


def test_nothing_aborts_without_a_pose() -> None:
    robot = Robot()
    robot.recorder.abort()
    assert robot.drives == []


def test_a_long_drive_is_cut_and_goes_on(robot: Robot) -> None:
    robot.move(0.06 * 2.5 * MOST_SAMPLES, speed=1.2)
    robot.recorder.end(DriveEnd.STOPPED)
    assert robot.outcomes == ["cut", "cut", "stopped"]
    for (_, before, _), (_, after, _) in zip(robot.drives, robot.drives[1:], strict=False):
        assert before[-1] == after[0]


@pytest.mark.parametrize(("jump", "drives"), [(0.9, 1), (50, 2)])
def test_a_clock_that_jumps_back_ends_the_drive_and_the_next_has_its_times(
    robot: Robot, jump: float, drives: int
) -> None:
    robot.move(2)
    robot.now -= jump
    robot.x = 0.0
    robot.move(2)
    robot.recorder.end(DriveEnd.STOPPED)
    assert robot.outcomes == ["stopped"] * drives
    for _, seconds, positions in robot.drives[-drives:]:
        assert drives == 1 or (np.diff(seconds) > 0).all()
        assert positions[-1] == pytest.approx([2, 2], abs=0.1)


def test_noise_of_the_pose_is_no_drive(robot: Robot) -> None:
    random = np.random.default_rng(1)
    for now in np.arange(200, 400, 0.05):
        robot.recorder.add(now, *random.normal([0, 2], 0.07))
    robot.recorder.end(DriveEnd.STOPPED)
    assert robot.drives == []


@pytest.mark.parametrize("wrong", [math.nan, math.inf, 1e300])
def test_numbers_that_name_no_place_are_refused(robot: Robot, wrong: float) -> None:
    for numbers in ((wrong, 0.0, 0.0), (0.0, wrong, 0.0), (0.0, 0.0, wrong)):
        with pytest.raises(ValueError, match="give finite numbers"):
            robot.recorder.add(*numbers)
    robot.move(1)
    robot.recorder.end(DriveEnd.STOPPED)
    assert robot.outcomes == ["stopped"]
