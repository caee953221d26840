"""Trains and measures the requested experiments, and writes their report."""

from __future__ import annotations

from typing import Final

from ddqn_planner.experiments import ablation, any_map, goal_1, goal_2, goal_3, targets
from ddqn_planner.experiments.settings import Settings
from ddqn_planner.experiments.trainings import in_parallel, train
from ddqn_planner.files import write_atomically

EXPERIMENTS: Final = {
    "goal-1": goal_1,
    "ablation": ablation,
    "goal-2": goal_2,
    "goal-3": goal_3,
    "targets": targets,
    "any-map": any_map,
}
"""Each has a title, ``trainings(settings)``, and ``report(settings)`` for their results."""


def reproduce(names: list[str], settings: Settings) -> str:
    """Run experiments, and write ``report.md`` with its tables (also as CSV) and figures.

    Trainings that an earlier call finished in the same folder are not repeated. Return the report,
    Markdown.
    """
    settings.out.mkdir(parents=True, exist_ok=True)
    modules = {name: EXPERIMENTS[name] for name in names}
    # Experiments share trainings: each folder is trained once.
    trainings = {
        training.folder: training
        for module in modules.values()
        for training in module.trainings(settings)
    }
    in_parallel(train, list(trainings.values()))
    sections = [
        f"## {module.TITLE}\n\n"
        f"`ddqn-planner reproduce --experiment {name} {settings.options()}`\n\n"
        f"{module.report(settings)}"
        for name, module in modules.items()
    ]
    text = "\n\n".join(sections) + "\n"
    write_atomically(settings.out / "report.md", text.encode())
    return text
