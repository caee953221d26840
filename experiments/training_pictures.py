"""The pictures of docs/training.md, which doc_pictures.py saves."""

import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from figures import COLOURS, draw_curves, draw_map, draw_path, plt
from numpy.typing import NDArray

from ddqn_planner.grid import MOVES
from ddqn_planner.pictures import PATH_COLOUR
from ddqn_planner.planning import Planner
from ddqn_planner.training import (
    Episode,
    HyperParameters,
    Scenario,
    Snapshot,
    Trainer,
    TrainingRecord,
    paper_scenario,
)
from ddqn_planner.training.films import EPISODE_COLOURS, START_COLOURS
from ddqn_planner.training.reward import move_reward

PAGE: Final = Path(__file__).resolve().parents[1] / "docs" / "training.md"
PROGRAM: Final = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
PLAIN: Final = HyperParameters(target="dqn", p_r=0, alpha=0, beta=0)
VARIANTS: Final[Mapping[str, HyperParameters]] = {
    "both": HyperParameters(),
    "neither": HyperParameters(p_r=0, alpha=0, beta=0),
    "initialisation alone": HyperParameters(alpha=0, beta=0),
    "reward alone": HyperParameters(p_r=0),
}
SEEDS: Final = 5
EVALUATION_INTERVAL: Final = 1_000  # steps
DEAD_END_STEPS: Final = (10_000, 50_000)
TRAINING_STEPS: Final = (1_000, 10_000, 20_000)
FILM_STEPS: Final = 25_000
FILM_FRAMES: Final = 40
INITIAL_CELLS: Final = 300  # episodes whose initial cell is drawn
NARROW: Final = 6.4  # inches, so that the letters are large on a narrow screen


def task() -> Any:
    """Draw the paper's map with the best path, and the eight actions."""
    scenario = paper_scenario()
    grid = scenario.grid
    plan = Planner.load("any_map").plan(
        grid, scenario.start, scenario.goal, scenario.move_rule
    )
    ratios = {"width_ratios": [1.6, 1]}
    figure, (map_axes, action_axes) = plt.subplots(
        1, 2, figsize=(NARROW, 3.9), layout="constrained", gridspec_kw=ratios
    )
    draw_map(map_axes, scenario, f"20 x 20 cells; best path {plan.length:.2f} cells")
    draw_path(map_axes, plan.cells, 0, "best path")
    map_axes.text(4.2, 6.4, "start", fontsize=11, ha="right", va="center")
    map_axes.text(17.6, 19, "end", fontsize=10, va="center")
    arrow = {"arrowstyle": "-|>", "color": COLOURS[0], "linewidth": 2}
    for action, (x, y) in enumerate(MOVES):
        head = (0.9 * x, 0.9 * y)
        tail = (0.15 * x, 0.15 * y)
        action_axes.annotate("", head, tail, arrowprops=arrow)
        label = {"ha": "center", "va": "center", "fontsize": 12}
        action_axes.text(1.15 * x, 1.15 * y, str(action), **label)
    action_axes.set(xlim=(-1.5, 1.5), ylim=(-1.5, 1.5), aspect="equal")
    action_axes.set_title("the eight actions", loc="left", fontsize=10)
    action_axes.axis("off")
    return figure


def dead_end() -> Any:
    """Draw the last episodes of a plain DQN, after two numbers of steps."""
    trainer = Trainer([paper_scenario()], PLAIN, seed=0)
    return _snapshots(trainer, DEAD_END_STEPS)


def training() -> Any:
    """Draw which starts reach the goal after three numbers of steps."""
    trainer = Trainer([paper_scenario()], seed=0)
    return _snapshots(trainer, TRAINING_STEPS, shows_episodes=False)


def _snapshots(
    trainer: Trainer, steps: tuple[int, ...], shows_episodes: bool = True
) -> Any:
    """Draw the state of a training after some numbers of steps, one below another."""
    record = TrainingRecord(trainer)
    figure, panels = plt.subplots(
        1, len(steps), figsize=(NARROW, NARROW / len(steps) + 1.1), layout="constrained"
    )
    for axes, step in zip(panels, steps, strict=True):
        for progress in trainer.run(step, every=500):
            record.add(progress)
        point = record.evaluate()
        title = f"step {step:,}\n{point.solved} of {point.starts} starts"
        _draw_snapshot(axes, record.scenario, record.snapshots[-1], shows_episodes)
        axes.set_title(title, loc="left", fontsize=11)
    handles: list[Any] = [
        plt.Rectangle((0, 0), 1, 1, color=START_COLOURS[1], label="start is solved"),
        plt.Rectangle((0, 0), 1, 1, color=START_COLOURS[0], label="start is trapped"),
    ]
    if shows_episodes:
        outcomes = {
            episode.outcome
            for snapshot in record.snapshots[1:]
            for episode in snapshot.episodes
        }
        for outcome in sorted(outcomes):
            label = f"episode: {outcome.value.replace('_', ' ')}"
            colour = EPISODE_COLOURS[outcome]
            handles.append(plt.Line2D([], [], color=colour, label=label))
    else:
        handles.append(plt.Line2D([], [], color=PATH_COLOUR, label="greedy path"))
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=3 - shows_episodes,
        frameon=False,
    )
    return figure


def _draw_snapshot(
    axes: Any, scenario: Scenario, snapshot: Snapshot, shows_episodes: bool
) -> None:
    """Draw solved and trapped starts, the greedy path, and the last episodes."""
    is_start = snapshot.is_solved >= 0
    colours = plt.matplotlib.colors.ListedColormap(START_COLOURS)
    shown = np.where(is_start, snapshot.is_solved, np.nan)
    axes.imshow(shown, origin="lower", cmap=colours, vmin=0, vmax=1)
    draw_map(axes, scenario, "")
    if shows_episodes:
        for episode in snapshot.episodes:
            colour = EPISODE_COLOURS[episode.outcome]
            axes.plot(*np.transpose(episode.cells), color=colour, alpha=0.5)
    if snapshot.path:
        axes.plot(*np.transpose(snapshot.path), color=PATH_COLOUR, linewidth=3)


def improvements() -> Any:
    """Draw where episodes begin, and which legal move has the greatest reward."""
    scenario = paper_scenario()
    figure, (initial_axes, reward_axes) = plt.subplots(
        1, 2, figsize=(NARROW, 3.9), layout="constrained"
    )
    draw_map(initial_axes, scenario, "")
    episodes = _first_episodes(scenario)
    first_cells = [episode.cells[0] for episode in episodes]
    random_cells = [cell for cell in first_cells if cell != scenario.start]
    initial_axes.scatter(*np.transpose(random_cells), 14, color=COLOURS[0], zorder=3)
    at_start = len(first_cells) - len(random_cells)
    title = f"1. {len(random_cells)} random, {at_start} at the start"
    initial_axes.set_title(title, loc="left", fontsize=11)
    draw_map(reward_axes, scenario, "")
    image = _draw_reward(reward_axes, scenario)
    reward_axes.set_title("2. moves of greatest reward", loc="left", fontsize=11)
    figure.colorbar(image, ax=reward_axes, label="reward", shrink=0.7)
    return figure


def _first_episodes(scenario: Scenario) -> list[Episode]:
    """Return the first episodes of a training by the defaults."""
    trainer = Trainer([scenario], seed=0)
    episodes: list[Episode] = []
    for progress in trainer.run():
        episodes += progress.episodes
        if len(episodes) >= INITIAL_CELLS:
            break
    return episodes[:INITIAL_CELLS]


def _draw_reward(axes: Any, scenario: Scenario) -> Any:
    """Draw an arrow along the legal move of greatest reward, and the reward."""
    grid = scenario.grid
    reward = move_reward(grid, scenario.start, scenario.goal, HyperParameters())
    legal = grid.legal_moves(scenario.move_rule)  # (8, H, W)
    legal_reward = np.where(legal, reward, -np.inf)
    action = legal_reward.argmax(axis=0)  # (H, W)
    greatest = legal_reward.max(axis=0)
    # The reward of the goal is 10: the colours are those of the other moves.
    is_shown = ~grid.occupancy & (greatest < 2)
    is_shown[scenario.goal[::-1]] = False
    image = axes.imshow(
        np.where(is_shown, greatest, np.nan),
        origin="lower",
        cmap="RdYlGn",
        vmin=-0.9,
        vmax=0.9,
    )
    y, x = np.nonzero(is_shown)
    dx, dy = 0.7 * MOVES[action[y, x]].T
    style = {"angles": "xy", "scale_units": "xy", "scale": 1, "pivot": "middle"}
    axes.quiver(x, y, dx, dy, width=0.005, headwidth=5, **style)
    return image


def learning_curves() -> Any:
    """Draw the share of solved starts by the steps, without and with improvements."""
    curves = {name: _curves(parameters) for name, parameters in VARIANTS.items()}
    figure, axes = plt.subplots(figsize=(NARROW, 4.2), layout="constrained")
    steps = np.arange(1, curves["both"][0].size + 1) * EVALUATION_INTERVAL
    draw_curves(axes, steps, curves, "environment steps", "solved starts [%]")
    axes.xaxis.set_major_formatter(lambda step, _: f"{step:,.0f}")
    axes.set(ylim=(0, 103))
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=11)
    return figure


def _curves(parameters: HyperParameters) -> list[NDArray[np.float64]]:
    """Return the percentage of solved starts at the evaluations, for each seed."""
    curves = []
    for seed in range(SEEDS):
        trainer = Trainer([paper_scenario()], parameters, seed)
        record = TrainingRecord(trainer, evaluations=1)
        for _ in trainer.run(every=EVALUATION_INTERVAL):
            record.evaluate()
        shares = [100 * point.solved_share for point in record.curve[1:]]
        curves.append(np.array(shares))
    return curves


def save_own_map(path: Path) -> None:
    """Save the picture that the page's program for an own map makes."""
    blocks = PROGRAM.findall(PAGE.read_text(encoding="utf-8"))
    (program,) = (block for block in blocks if path.name in block)
    with TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-c", program], cwd=folder, check=True)
        path.write_bytes((Path(folder) / path.name).read_bytes())


def save_film(path: Path) -> None:
    """Save a film of the first half of a training by the defaults."""
    trainer = Trainer([paper_scenario()], seed=0)
    steps = trainer.parameters.steps
    record = TrainingRecord(trainer, evaluations=FILM_FRAMES * steps // FILM_STEPS)
    for progress in trainer.run(FILM_STEPS, every=record.interval):
        record.add(progress)
    record.save_film(path)
