"""Show live what the ROS nodes publish.

Opens rerun's viewer with map, value field and plan, and a training's episodes and reward. It shows
the last map, value and plan, and what comes after it was started.
"""

from __future__ import annotations

import argparse
from pathlib import Path


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add("--save", type=Path, metavar="FILE", help="write a recording (.rrd), open no viewer")
    add("--planner", default="planner", metavar="NODE", help="name of the planner node")
    add("--trainer", default="trainer", metavar="NODE", help="name of the trainer node")
    # rclpy finds them in sys.argv.
    add("--ros-args", nargs="...", default=argparse.SUPPRESS, help="as for any ROS node")


def run(options: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    from ddqn_planner.nodes.watch import watch  # the help needs no ROS

    return watch(options.planner, options.trainer, options.save)
