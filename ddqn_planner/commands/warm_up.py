"""``ddqn-planner warm-up``: compiles the code of plans before a node needs it."""

import time
from argparse import ArgumentParser
from collections.abc import Sequence

from ddqn_planner.commands.options import MODEL_HELP
from ddqn_planner.planning import Planner
from ddqn_planner.warm_up import warm_up


def run(parser: ArgumentParser, arguments: Sequence[str]) -> int:
    """Compile the code of a model's plans, and print how long that took; return 0."""
    parser.add_argument("model", nargs="?", default="any_map", help=MODEL_HELP)
    planner = Planner.load(parser.parse_args(arguments).model)
    began = time.perf_counter()
    for _ in warm_up(planner, learns=True):
        pass
    print(f"compiled, or loaded, in {time.perf_counter() - began:.1f} s")
    return 0
