"""``ddqn-planner certify``: proves what a model takes for possible."""

from argparse import ArgumentParser
from collections.abc import Sequence

from ddqn_planner.commands.options import MODEL_HELP
from ddqn_planner.model import load_model
from ddqn_planner.model.certificate import NO_CERTIFICATE


def run(parser: ArgumentParser, arguments: Sequence[str]) -> int:
    """Print the certificate of a model; return 0 if it proves the model, else 1."""
    parser.add_argument("model", nargs="?", default="any_map", help=MODEL_HELP)
    network, metadata = load_model(parser.parse_args(arguments).model)
    certificate = network.certificate(metadata.move_rule)
    print(certificate or NO_CERTIFICATE)
    return 0 if certificate and certificate.proved else 1
