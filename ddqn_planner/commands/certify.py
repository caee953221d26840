"""Prove which moves a model takes for possible, for all costs and unknown cells.

The proof bounds the error of the learned costs too, and so the cost of planned paths. The exit code
is 1 if there is no proof.
"""

from __future__ import annotations

import argparse

from ddqn_planner.model import load_model
from ddqn_planner.model.certificate import NO_CERTIFICATE


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("model", nargs="?", default="any_map", help="name or file")


def run(options: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    network, metadata = load_model(options.model)
    certificate = network.certificate(metadata.move_rule)
    print(certificate or NO_CERTIFICATE)
    return 0 if certificate and certificate.proved else 1
