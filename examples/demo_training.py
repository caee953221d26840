"""A robot learns to leave the dead end of the paper's map: a film."""

import argparse
import sys
from collections.abc import Sequence

from ddqn_planner.training import (
    HyperParameters,
    Trainer,
    TrainingRecord,
    paper_scenario,
)

FILM = "demo_training.gif"


def main(arguments: Sequence[str]) -> int:
    """Train, print how well, and save the film."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "steps",
        nargs="?",
        type=int,
        default=HyperParameters().steps,
        help="of the training, by default %(default)s",
    )
    steps = parser.parse_args(arguments).steps
    try:
        parameters = HyperParameters(steps=steps)
    except ValueError as error:
        parser.error(str(error))
    trainer = Trainer([paper_scenario()], parameters, seed=0)
    record = TrainingRecord(trainer, evaluations=60)
    for progress in trainer.run(every=record.interval):
        point = record.add(progress)
        if point is not None:
            share = f"{point.solved_share:4.0%} of the starts are solved"
            print(f"step {point.step:6,}: {share}", flush=True)
    record.save_film(FILM)
    print(f"saved {FILM}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
