"""What one sees of a training: a curve of evaluations, a picture and a film."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import Cell, shortest_distances
from ddqn_planner.grid.arguments import as_whole
from ddqn_planner.training.episodes import Episode, EpisodeEnd, Progress
from ddqn_planner.training.evaluation import Evaluation, ratios_to, summary_of

if TYPE_CHECKING:
    from ddqn_planner.training.trainer import Trainer

# In a training; they take 1 to 5 % of its time, see experiments/map_sizes.py.
EVALUATIONS: Final = 100
MOST_EVALUATIONS: Final = 10**12  # as many as a training can have steps
SHOWN_EPISODES: Final = 40  # the last ones before an evaluation


class CurvePoint(NamedTuple):
    """The numbers of an evaluation, and of the episodes since the evaluation before."""

    step: int
    seconds: float  # of the training until then
    starts: int  # cells from which a path leads to the goal
    solved: int  # of them: from where the greedy rollout reaches the goal
    mean_ratio: float  # cost of those rollouts over the least; NaN if none is solved
    worst_ratio: float
    start_ratio: float  # the same from the given start; infinite if it is trapped
    epsilon: float
    learning_rate: float
    reward_per_step: float  # NaN without an episode, as the shares
    reached_goal: float  # share of the episodes
    collided: float
    out_of_steps: float

    @property
    def solved_share(self) -> float:
        """Share of the starts that the greedy rollout solves, 0 to 1."""
        return self.solved / self.starts


class Snapshot(NamedTuple):
    """What a picture shows of an evaluation."""

    # (H, W): 1 where the greedy rollout reaches the goal, 0 where it is trapped, -1 at
    # the goal and where no path leads to it.
    is_solved: NDArray[np.int8]
    path: tuple[Cell, ...]  # the greedy rollout from the given start; () if trapped
    episodes: tuple[Episode, ...]  # the last ones, see `TrainingRecord`


class TrainingRecord:
    """Watches a trainer on one of its maps.

    `add` takes what the trainer yields, and evaluates the network once in `interval`
    steps.

    Attributes
    ----------
    scenario : Scenario
        The map, start and goal that it watches.
    interval : int
        Environment steps from an evaluation to the next.
    curve : list of CurvePoint
        The evaluations of the whole training, in the order of their steps.
    snapshots : list of Snapshot
        What the last evaluations look like: of `curve[-len(snapshots):]`.
    """

    def __init__(
        self,
        trainer: Trainer,
        scenario: int = 0,
        evaluations: int = EVALUATIONS,
        earlier_curve: Sequence[CurvePoint] = (),
    ) -> None:
        """Evaluate the network as it is now.

        Parameters
        ----------
        trainer : Trainer
            At any step; a film begins with this step.
        scenario : int
            The number of the map in `trainer.scenarios`.
        evaluations : int
            How many evaluations a whole training has: as many frames has its film.
        earlier_curve : sequence of CurvePoint
            The `curve` of an earlier record of this training, if it continues from a
            checkpoint. Points after the trainer's step are left out.
        """
        from ddqn_planner.training.trainer import Trainer  # needs torch

        if not isinstance(trainer, Trainer):
            raise ValueError(f"the trainer is {trainer!r}; give a Trainer")
        scenario = as_whole("scenario", scenario, 0, len(trainer.scenarios) - 1)
        steps = trainer.parameters.steps
        evaluations = as_whole("evaluations", evaluations, 1, MOST_EVALUATIONS)
        if not all(isinstance(point, CurvePoint) for point in earlier_curve):
            raise ValueError(
                "earlier_curve holds what is no CurvePoint; give the curve of a record"
            )
        self.trainer = trainer
        self.scenario = trainer.scenarios[scenario]
        self.interval = max(1, steps // evaluations)
        self.curve = [point for point in earlier_curve if point.step <= trainer.steps]
        self.snapshots: list[Snapshot] = []
        self._scenario_number = scenario
        self._optimum = shortest_distances(
            self.scenario.grid, self.scenario.goal, self.scenario.move_rule
        )
        self._episodes: list[Episode] = []  # since the last evaluation
        self._last_step = trainer.steps  # of which the episodes are known
        seconds = self.curve[-1].seconds if self.curve else 0.0  # of the training
        self._begin = time.monotonic() - seconds
        self.evaluate()

    def __repr__(self) -> str:
        """Return how many evaluations it has, and the last one, in one line."""
        point = self.curve[-1]
        return (
            f"TrainingRecord({len(self.curve)} evaluations; step {point.step:,}: "
            f"{point.solved:,} of {point.starts:,} starts solved)"
        )

    @property
    def optimum(self) -> float:
        """The least cost of a path from the given start to the goal."""
        x, y = self.scenario.start
        return float(self._optimum[y, x])

    def add(self, progress: Progress) -> CurvePoint | None:
        """Add the episodes of a progress; return an evaluation if one was due.

        Call this at once with all that `Trainer.run` yields: a progress of another step
        or another trainer is a ValueError. One that was added before is ignored.
        """
        if not isinstance(progress, Progress):
            raise ValueError(
                f"the progress is {progress!r}; give what the trainer's run yields"
            )
        if progress.step != self.trainer.steps:
            raise ValueError(
                f"the progress is of step {progress.step}, and the trainer at step "
                f"{self.trainer.steps}; give what this trainer's run yields, at once"
            )
        if progress != self.trainer.last_progress:
            raise ValueError(
                f"the progress of step {progress.step} is another trainer's; give what "
                "this trainer's run yields"
            )
        if progress.step <= self._last_step:
            return None
        self._last_step = progress.step
        self._episodes.extend(progress.episodes)
        evaluated = self.curve[-1].step // self.interval
        is_due = progress.step // self.interval > evaluated
        return self.evaluate() if is_due else None

    def evaluate(self) -> CurvePoint:
        """Evaluate the network as it is now, unless this step is in the curve."""
        is_in_curve = bool(self.curve) and self.curve[-1].step == self.trainer.steps
        if is_in_curve and self.snapshots:
            return self.curve[-1]
        scenario = self.scenario
        field = self.trainer.planner().q_field(scenario.grid, scenario.goal)
        ratios = ratios_to(self._optimum, field, scenario.grid)  # (H, W)
        x, y = scenario.start
        is_solved = np.where(np.isnan(ratios), -1, np.isfinite(ratios))
        snapshot = Snapshot(
            is_solved=is_solved.astype(np.int8),
            path=field.rollout(scenario.start).cells,
            episodes=self._shown_episodes(),
        )
        self.snapshots.append(snapshot)
        if not is_in_curve:  # an earlier record knows its episodes, too
            self.curve.append(self._point(summary_of(ratios), float(ratios[y, x])))
        self._episodes.clear()
        return self.curve[-1]

    def _shown_episodes(self) -> tuple[Episode, ...]:
        """Return the last episodes on the map: from its start, if any began there."""
        episodes = [
            episode
            for episode in self._episodes
            if episode.scenario == self._scenario_number
        ]
        from_start = [
            episode for episode in episodes if episode.cells[0] == self.scenario.start
        ]
        return tuple((from_start or episodes)[-SHOWN_EPISODES:])

    def _point(self, evaluation: Evaluation, start_ratio: float) -> CurvePoint:
        """Return the numbers of an evaluation, and of the episodes before it."""
        trainer = self.trainer
        episodes = self._episodes
        reward = sum(episode.total_reward for episode in episodes)
        moves = sum(episode.moves for episode in episodes)
        return CurvePoint(
            step=trainer.steps,
            seconds=time.monotonic() - self._begin,
            starts=evaluation.starts,
            solved=evaluation.solved,
            mean_ratio=evaluation.mean_ratio,
            worst_ratio=evaluation.worst_ratio,
            start_ratio=start_ratio,
            epsilon=trainer.epsilon,
            learning_rate=trainer.parameters.learning_rate_at(trainer.steps),
            reward_per_step=reward / moves if moves else np.nan,
            reached_goal=_share(episodes, EpisodeEnd.REACHED_GOAL),
            collided=_share(episodes, EpisodeEnd.COLLIDED),
            out_of_steps=_share(episodes, EpisodeEnd.OUT_OF_STEPS),
        )

    def start_solved_for_good(self) -> int | None:
        """Return the step from which on the given start is solved; None if it is not.

        It is that of an evaluation: up to `interval` steps too late.
        """
        return self._first_step(
            [np.isfinite(point.start_ratio) for point in self.curve]
        )

    def all_solved_for_good(self) -> int | None:
        """Return the step from which on all starts are solved, as for the given one."""
        return self._first_step([point.solved == point.starts for point in self.curve])

    def _first_step(self, holds: Sequence[bool]) -> int | None:
        """Return the step from which on a condition holds for all points of the curve.

        `holds` says for which points it does. None if it does not at the end.
        """
        first_step = None
        for point, does_hold in zip(self.curve, holds, strict=True):
            if not does_hold:
                first_step = None
            elif first_step is None:
                first_step = point.step
        return first_step

    def save_picture(self, path: str | Path) -> None:
        """Save a picture of the training's present state, with its curve.

        The ending of the path says in which format; a ValueError lists the formats. It
        needs matplotlib.
        """
        from ddqn_planner.training.films import save_picture

        self.evaluate()
        save_picture(self, path)

    def save_film(self, path: str | Path) -> None:
        """Save a film of the training so far, as a .gif, .webp or animated .png.

        It has a frame for each evaluation, and shows the last one longest. It needs
        matplotlib.
        """
        from ddqn_planner.training.films import save_film

        self.evaluate()
        save_film(self, path)


def _share(episodes: Sequence[Episode], outcome: EpisodeEnd) -> float:
    """Return which share of episodes has an outcome; NaN without episodes."""
    if not episodes:
        return np.nan
    return sum(episode.outcome is outcome for episode in episodes) / len(episodes)
