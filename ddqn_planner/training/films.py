"""Pictures and films of a training: the map beside the curve. They need matplotlib."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ddqn_planner.files import as_path, write_atomically
from ddqn_planner.pictures import (
    PATH_COLOUR,
    draw_obstacles,
    film_format,
    picture_format,
)
from ddqn_planner.pictures import save_film as save_frames
from ddqn_planner.training.episodes import Episode, EpisodeEnd

if TYPE_CHECKING:
    from PIL.Image import Image

    from ddqn_planner.training.scenario import Scenario
    from ddqn_planner.training.training_record import (
        CurvePoint,
        Snapshot,
        TrainingRecord,
    )

# Okabe and Ito's palette, which people without colour vision can tell apart, too.
START_COLOURS: Final = ("#f7d9c4", "#bfe3d2")  # trapped, solved
EPISODE_COLOURS: Final = {
    EpisodeEnd.REACHED_GOAL: "#0072B2",
    EpisodeEnd.COLLIDED: "#8d6a9f",
    EpisodeEnd.OUT_OF_STEPS: "#6c757d",
}
CURVE_COLOUR: Final = "#009E73"
MILLISECONDS: Final = 120  # of a frame
LAST_MILLISECONDS: Final = 4_000
WIDE: Final = 1.6  # a map of this aspect has its curve below, not beside it
DOTS_PER_INCH: Final = 100


def save_picture(record: TrainingRecord, path: str | Path) -> None:
    """Save a picture of a record's last snapshot, see `TrainingRecord.save_picture`."""
    file = as_path(path)
    ending = picture_format(file)  # an error comes before the work
    picture = _TrainingPicture(record.scenario, record.trainer.parameters.steps)
    picture.show(record.curve, record.snapshots[-1])
    content = io.BytesIO()
    picture.figure.savefig(content, format=ending, dpi=DOTS_PER_INCH)
    write_atomically(file, content.getvalue())


def save_film(record: TrainingRecord, path: str | Path) -> None:
    """Save a film of all snapshots of a record, see `TrainingRecord.save_film`."""
    file = as_path(path)
    film_format(file)  # an error comes before the work
    save_frames(file, frames_of(record), MILLISECONDS, LAST_MILLISECONDS)


def frames_of(record: TrainingRecord) -> Iterator[Image]:
    """Yield a frame for each snapshot of a record."""
    picture = _TrainingPicture(record.scenario, record.trainer.parameters.steps)
    points_before = len(record.curve) - len(record.snapshots)
    for index, snapshot in enumerate(record.snapshots, points_before + 1):
        picture.show(record.curve[:index], snapshot)
        yield picture.frame()


class _TrainingPicture:
    """A figure of one scenario, drawn once; each frame changes what differs."""

    def __init__(self, scenario: Scenario, steps: int) -> None:
        """Draw what stays: the map, its start and its goal, and the axes of the curve.

        `steps` are those of the whole training.
        """
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.collections import LineCollection
        from matplotlib.colors import ListedColormap
        from matplotlib.figure import Figure

        grid = scenario.grid
        aspect = grid.width / grid.height
        self.figure = Figure(figsize=_size(aspect), layout="constrained")
        self._canvas: Any = FigureCanvasAgg(self.figure)  # which has no types
        self._is_laid_out = False
        if aspect > WIDE:
            ratios = {"height_ratios": [1, max(aspect / 4, 0.8)]}
            self._map, self._axes = self.figure.subplots(2, 1, gridspec_kw=ratios)
        else:
            self._map, self._axes = self.figure.subplots(1, 2)
        empty = np.full(grid.occupancy.shape, np.nan)
        self._starts = self._map.imshow(
            empty,
            origin="lower",
            cmap=ListedColormap(START_COLOURS),
            vmin=0,
            vmax=1,
            interpolation="nearest",
        )
        draw_obstacles(self._map, grid)
        self._episodes = LineCollection([], linewidths=1.1, alpha=0.4, zorder=2)
        self._map.add_collection(self._episodes)
        self._draw_path(scenario)
        self._draw_axes(steps)

    def _draw_path(self, scenario: Scenario) -> None:
        """Draw the start, the goal, an empty path between them, and the legend."""
        from matplotlib.lines import Line2D
        from matplotlib.patches import Patch
        from matplotlib.patheffects import withStroke

        outline = [withStroke(linewidth=5, foreground="white")]
        (self._path,) = self._map.plot(
            [], [], color=PATH_COLOUR, linewidth=2.6, path_effects=outline, zorder=3
        )
        style: dict[str, Any] = {"color": "black", "edgecolors": "white", "zorder": 4}
        self._map.scatter(*scenario.start, 70, marker="o", **style)
        self._map.scatter(*scenario.goal, 190, marker="*", **style)
        self._map.set(xticks=[], yticks=[], aspect="equal")
        handles: list[Any] = [
            Patch(color=START_COLOURS[1], label="solved"),
            Patch(color=START_COLOURS[0], label="trapped"),
            Line2D([], [], color=PATH_COLOUR, linewidth=2.6, label="greedy path"),
        ]
        for outcome, colour in EPISODE_COLOURS.items():
            label = outcome.value.replace("_", " ")
            handles.append(Line2D([], [], color=colour, alpha=0.6, label=label))
        self.figure.legend(
            handles=handles,
            loc="outside lower center",
            ncols=len(handles),
            frameon=False,
            fontsize=9,
        )

    def _draw_axes(self, steps: int) -> None:
        """Draw the axes of the curve, for a training of so many steps."""
        (self._curve,) = self._axes.plot([], [], color=CURVE_COLOUR, linewidth=2)
        self._axes.set(xlim=(0, steps), ylim=(0, 103), xlabel="environment steps")
        self._axes.set_ylabel("solved starts [%]")
        self._axes.xaxis.set_major_formatter(lambda step, _: f"{step:,.0f}")
        self._axes.xaxis.set_major_locator(_few_ticks())
        self._axes.grid(alpha=0.3)

    def show(self, curve: Sequence[CurvePoint], snapshot: Snapshot) -> None:
        """Show a snapshot, and the curve up to it."""
        point = curve[-1]
        is_start = snapshot.is_solved >= 0
        self._starts.set_data(np.where(is_start, snapshot.is_solved, np.nan))
        self._show_episodes(snapshot.episodes)
        # (N, 2) cells; a rollout that is trapped has none
        self._path.set_data(*np.reshape(snapshot.path, (-1, 2)).T)
        self._map.set_title(f"step {point.step:,}", loc="left", fontsize=11)
        steps = [point.step for point in curve]
        percents = [100 * point.solved_share for point in curve]
        self._curve.set_data(steps, percents)
        title = f"{point.solved:,} of {point.starts:,} starts reach the goal"
        self._axes.set_title(title, loc="left", fontsize=11)

    def _show_episodes(self, episodes: Sequence[Episode]) -> None:
        """Draw the cells of episodes, each in the colour of its outcome."""
        self._episodes.set_segments([np.array(episode.cells) for episode in episodes])
        self._episodes.set_color(
            [EPISODE_COLOURS[episode.outcome] for episode in episodes]
        )

    def frame(self) -> Image:
        """Return the figure as an image."""
        from PIL import Image

        self.figure.set_dpi(DOTS_PER_INCH)
        self._canvas.draw()
        if not self._is_laid_out:
            # The layout stays: to find it takes most of the time of a frame.
            self.figure.set_layout_engine("none")
            self._is_laid_out = True
        return Image.fromarray(np.asarray(self._canvas.buffer_rgba())).convert("RGB")


def _size(aspect: float) -> tuple[float, float]:
    """Return the width and the height of a figure, inches, by the map's aspect."""
    if aspect > WIDE:
        return 9.6, min(9.6 / aspect, 5.0) + 3.0
    return 9.6, 4.9


def _few_ticks() -> Any:
    """Return a locator of few ticks at round whole numbers."""
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(nbins=5, integer=True)
