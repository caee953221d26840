"""``ddqn-planner train-robot``: trains the model of a robot's body and motions."""

import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from ddqn_planner.commands.options import Option, add_options
from ddqn_planner.files import as_path, check_distinct, check_writable
from ddqn_planner.grid.arguments import as_whole
from ddqn_planner.model import save_model
from ddqn_planner.model.model_file import check_model_path
from ddqn_planner.robot.body_certificate import BodyCertificate
from ddqn_planner.robot.driving_costs import (
    CUSP_METRES,
    SPIN_METRES,
    DrivingCosts,
)
from ddqn_planner.robot.motions import BEHIND, HEADINGS
from ddqn_planner.training.robot import (
    MOST_STEPS,
    ROBOT,
    MotionOptions,
    RobotTrainer,
    read_motions,
)

OPTIONS = (
    Option(
        "footprint",
        str,
        None,
        "'[[x, y], ...]', metres, or a radius, as in Nav2's costmaps",
    ),
    Option(
        "padding",
        float,
        0.0,
        "metres by which the body counts as larger: room for a controller",
    ),
    Option("motion", str, None, "differential, ackermann or omnidirectional"),
    Option("turning-radius", float, 0.0, "of its bends, metres; ackermann needs it"),
    Option("resolution", float, 0.05, "of the maps, metres per cell"),
    Option(
        "headings",
        int,
        HEADINGS,
        "16, 32 or 64; more pass narrower gaps",
    ),
    Option(
        "lattice",
        Path,
        None,
        "a file of Nav2's lattice generator, instead of motion, turning radius, "
        "resolution and headings",
    ),
    Option("allow-reverse", bool, False, "the lattice's motions also in reverse"),
    Option(
        "bend-cost",
        float,
        None,
        "of a metre in a bend, in metres driven straight ahead: by default 1.15, or "
        "what the lattice says",
    ),
    Option("reverse-cost", float, BEHIND, "of a metre in reverse or sideways"),
    Option(
        "cusp-cost",
        float,
        CUSP_METRES,
        "of a change between ahead and reverse, in metres",
    ),
    Option(
        "spin-cost", float, SPIN_METRES, "of a turn by a radian on the spot, in metres"
    ),
    Option("out", Path, "my_robot.safetensors", "the model's file"),
    Option("seed", int, 0, "seed of the training"),
    Option("steps", int, ROBOT.steps, "transitions after which to give up"),
)


def run(parser: ArgumentParser, arguments: Sequence[str]) -> int:
    """Train until the body is proved, and save the model.

    `parser` gets the command's options, which `arguments` give. Returns the exit code:
    0, or 1 without a proof after ``--steps``.
    """
    add_options(parser, *OPTIONS)
    options = parser.parse_args(arguments)
    as_whole("--steps", options.steps, 1, MOST_STEPS)
    out = as_path(options.out, "--out")
    check_model_path(out)  # before a long training
    check_writable(out, "--out")
    check_distinct({"--out": out}, {"--lattice": options.lattice})
    motions = read_motions(
        MotionOptions(
            options.motion,
            options.turning_radius,
            options.resolution,
            options.headings,
            options.lattice,
            options.allow_reverse,
            DrivingCosts(
                options.bend_cost,
                options.reverse_cost,
                options.cusp_cost,
                options.spin_cost,
            ),
        )
    )
    trainer = RobotTrainer(options.footprint, motions, options.seed, options.padding)
    try:
        certificate = _train_with_bar(trainer, options.steps)
    except KeyboardInterrupt:
        print(
            f"stopped after {trainer.steps:,} transitions; nothing is saved, and the "
            "same command begins anew",
            file=sys.stderr,
        )
        raise
    print(f"{trainer.steps:,} transitions: {certificate}")
    if not certificate.proved:
        remedy = "give more --steps, or another --seed or --resolution"
        print(f"not saved; {remedy}", file=sys.stderr)
        return 1
    save_model(out, trainer.network, trainer.metadata())
    return 0


def _train_with_bar(trainer: RobotTrainer, until: int) -> BodyCertificate:
    """Train until the body is proved or until step `until`; return the certificate."""
    # disable=None: no bar if the output is not a terminal.
    with tqdm(total=until, disable=None) as bar:
        for certificate in trainer.run(until):
            bar.update(trainer.steps - bar.n)
            bar.set_postfix(
                weak=certificate.weak, forbidden=certificate.forbidden, refresh=False
            )
    return certificate
