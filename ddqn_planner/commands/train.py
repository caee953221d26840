"""``ddqn-planner train``: trains a model on one map by the paper's method."""

from argparse import ArgumentParser
from collections.abc import Sequence

from ddqn_planner.commands.options import add_map_options, read_map
from ddqn_planner.commands.training_options import add_training_options, run_training
from ddqn_planner.grid import MoveRule
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.evaluation import evaluate
from ddqn_planner.training.hyper_parameters import HyperParameters


def run(parser: ArgumentParser, arguments: Sequence[str]) -> int:
    """Train, and print how many starts the greedy rollout solves.

    `parser` gets the command's options, which `arguments` give. Returns the exit code
    0.
    """
    add_map_options(parser, "corner_cutting")
    add_training_options(parser, "runs/train", HyperParameters())
    options = parser.parse_args(arguments)
    map_file, start, goal = read_map(options)
    scenario = Scenario(map_file.grid(), start, goal, MoveRule(options.move_rule))
    trainer = run_training(options, lambda: [scenario]).trainer
    field = trainer.planner().q_field(scenario.grid, goal)
    evaluation = evaluate(field, scenario.grid, field.move_rule)
    plan = field.rollout(start)
    from_start = f"{plan.length:.2f} cells" if plan.cells else "it is trapped"
    print(
        f"the greedy rollout solves {evaluation.solved} of {evaluation.starts} starts, "
        f"mean length {evaluation.mean_ratio:.4f} of the optimum; "
        f"from the start {from_start}"
    )
    return 0
