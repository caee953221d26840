"""A robot learns to leave the dead end of the paper's map: a film.

The number of steps is an argument, 50,000 by default.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from ddqn_planner import Planner
from ddqn_planner.grid import Cell
from ddqn_planner.training.environment import Scenario, paper_scenario
from ddqn_planner.training.evaluation import length_ratios
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import Trainer

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "experiments"))
from figures import COLOURS, draw_map, draw_path, frame_of, save_film

FRAMES = 60


def draw(
    scenario: Scenario,
    planner: Planner,
    episodes: Sequence[Sequence[Cell]],
    curve: Sequence[tuple[int, float]],
    steps: int,
) -> tuple[Image.Image, float]:
    """Draw the last episode and the policy; return the share of solved starts."""
    field = planner.q_field(scenario.grid, scenario.goal)
    ratios = length_ratios(field, scenario.grid, scenario.move_rule)
    solved = np.where(np.isnan(ratios), np.nan, np.isfinite(ratios))
    share = float(np.nanmean(solved))
    step = planner.metadata.steps
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.6, 4.8), layout="constrained")
    left.imshow(solved, origin="lower", cmap="RdYlGn", vmin=-0.6, vmax=1.6, alpha=0.6)
    draw_map(left, scenario, f"step {step:,}: {share:.0%} of the cells lead to the end")
    for cells in episodes:
        left.plot(*np.transpose(cells), color=COLOURS[0], alpha=0.35, linewidth=1.2)
    draw_path(left, field.rollout(scenario.start).cells, 0, "the path it would take")
    right.plot(*np.transpose([*curve, (step, share)]), color=COLOURS[2], linewidth=2)
    right.set(xlim=(0, steps), ylim=(0, 1.03), xlabel="environment steps")
    title = "share of the starts from which the robot reaches the end"
    right.set_title(title, fontsize=10)
    right.grid(alpha=0.3)
    return frame_of(figure), share


def main(arguments: Sequence[str]) -> int:
    """Train, print how well, and save the film."""
    steps = int(arguments[0]) if arguments else HyperParameters().steps
    scenario = paper_scenario()
    parameters = HyperParameters(steps=steps)
    trainer = Trainer([scenario], parameters, seed=0)
    interval = max(1, steps // FRAMES)
    curve: list[tuple[int, float]] = []
    frames: list[Image.Image] = []
    episodes: list[Sequence[Cell]] = []
    for progress in trainer.run(every=interval):
        for episode in progress.episodes:
            # What it does from the given start, in the dead end.
            if episode.cells[0] == scenario.start:
                episodes.append(episode.cells)
        if trainer.steps // interval > len(curve):
            frame, share = draw(scenario, trainer.planner(), episodes, curve, steps)
            curve.append((trainer.steps, share))
            frames.append(frame)
            print(f"step {trainer.steps:6,}: {share:4.0%} of the starts are solved")
            sys.stdout.flush()
            episodes.clear()
    save_film("demo_training.gif", frames, 200)
    print("saved demo_training.gif")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
