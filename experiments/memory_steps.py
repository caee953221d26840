"""Prints the memory of a process after each step of the planner node's start."""

import os
import sys
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

import processes

from ddqn_planner.memory import give_back, reuse_small_arrays

KINDS = {"RssAnon": "own memory", "RssFile": "of files", "VmRSS": "all"}


def load(*modules: str) -> Any:
    """Import modules; return the last one."""
    return [import_module(module) for module in modules][-1]


def initialise() -> None:
    """Initialise ROS, without a node."""
    load("nav_msgs.srv", "rcl_interfaces.srv", "rclpy").init()


def create_node() -> Any:
    """Create a node: DDS begins."""
    return load("rclpy").create_node("memory")


def load_model() -> Any:
    """Load the default model."""
    return load("ddqn_planner").Planner.load("any_map")


def load_code() -> None:
    """Load all compiled code; plan on maps of a few cells."""
    list(load("ddqn_planner.warm_up").warm_up(load_model()))


STEPS: dict[str, Callable[[], Any]] = {
    "Python": reuse_small_arrays,
    "NumPy": partial(load, "numpy"),
    "rclpy": initialise,
    "a node, with Fast DDS": create_node,
    "the planner node's modules": partial(load, "ddqn_planner.nodes.planner_node"),
    "the model": load_model,
    "LLVM": partial(load, "llvmlite.binding"),
    "numba": lambda: load("ddqn_planner.compiled")._import_numba(),
    "compiled code, loaded": load_code,
    "LLVM's pages given back": give_back,
}


def main() -> None:
    """Print a table."""
    load_results = []
    print("| after | " + " | ".join(f"{kind}, MB" for kind in KINDS.values()) + " |")
    print("|---" * (1 + len(KINDS)) + "|")
    for name, step in STEPS.items():
        load_results.append(step())
        memory = [processes.memory(os.getpid(), kind) for kind in KINDS]
        print(
            f"| {name} | " + " | ".join(f"{size:.0f}" for size in memory) + " |",
            flush=True,
        )
    loaded = [
        name for name in ("scipy", "PIL", "matplotlib", "torch") if name in sys.modules
    ]
    print("modules that no plan needs:", ", ".join(loaded) or "none")


if __name__ == "__main__":
    main()
