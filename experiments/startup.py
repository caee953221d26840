"""Measures how soon the executables are of use: `make bench`. Each figure stands beside its bar."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial

from client import Client, initial_pose, pose, wait_for
from map_fixture import MapFixture
from nav_msgs.msg import OccupancyGrid, Path
from processes import (
    claim_ros_domain,
    executable,
    memory,
    run_script,
    running,
    running_node,
)
from std_msgs.msg import Empty

from ddqn_planner.grid import read_map_file
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.resources import find_map

STARTS = 10
SETTLED = 0.6
"""Seconds after which a client is known to DDS."""

BARE_NODE = """
import rclpy
from std_msgs.msg import Empty
try:
    rclpy.init()
    node = rclpy.create_node("bare")
    node.create_subscription(Empty, "bare", lambda message: None, 10)
    rclpy.spin(node)
except KeyboardInterrupt:
    pass
"""
NO_BAR = float("inf")
UNITS = ("s wall", "s CPU", "MB")

Usage = tuple[float, float, float]
"""Wall time and CPU time, seconds; resident memory, MB."""


def node_usage(process: int, began: float) -> Usage:
    """Return what a running process has taken since it began."""
    with open(f"/proc/{process}/stat", encoding="utf-8") as file:
        user, system = file.read().rsplit(")", 1)[1].split()[11:13]
    ticks = int(user) + int(system)
    return time.monotonic() - began, ticks / os.sysconf("SC_CLK_TCK"), memory(process)


def start_planner(dilemma: MapFixture) -> Usage:
    """Start the planner node; return what it takes until its first plan."""
    start, goal = (pose(dilemma.grid, cell) for cell in ((6, 6), (17, 19)))
    # A client per start: one that has seen other nodes end is discovered more slowly.
    with Client() as client:
        plans = client.subscribe(Path, "plan", LATCHED)
        client.publish("map", dilemma.message(), LATCHED, listeners=0)
        time.sleep(SETTLED)
        began = time.monotonic()
        with running_node("planner_node", "--log-level", "error") as planner:
            client.publish("initialpose", initial_pose(start))
            client.publish("goal_pose", goal)
            plans.wait(lambda plan: plan.poses)
            return node_usage(planner.pid, began)


def start_map_server() -> Usage:
    """Start the map server; return what it takes until its first map is received."""
    with Client() as client:
        maps = client.subscribe(OccupancyGrid, "map", LATCHED)
        time.sleep(SETTLED)
        began = time.monotonic()
        with running_node("map_server_node", "--log-level", "error") as map_server:
            maps.wait()
            return node_usage(map_server.pid, began)


def start_bare_node() -> Usage:
    """Start a node with one subscription; return what it takes until it is discovered."""
    with Client() as client:
        publisher = client.publisher(Empty, "bare", listeners=0)
        time.sleep(SETTLED)
        began = time.monotonic()
        with running(sys.executable, "-c", BARE_NODE) as node:
            wait_for("the bare node", publisher.get_subscription_count)
            return node_usage(node.pid, began)


def run_command(*command: str) -> Usage:
    """Return what a command takes from start to end."""
    began, peak, ended = time.monotonic(), 0.0, 0
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    while not ended:
        # Not ru_maxrss: that begins with the memory of this process.
        with suppress(IndexError, OSError):
            peak = memory(child.pid, "VmHWM")
        time.sleep(0.002)
        ended, status, used = os.wait4(child.pid, os.WNOHANG)
    seconds = time.monotonic() - began
    child.returncode = os.waitstatus_to_exitcode(status)
    assert child.returncode == 0, f"{command} ended with {child.returncode}"
    return seconds, used.ru_utime + used.ru_stime, peak


def show(name: str, start: Callable[[], Usage], bars: Usage) -> bool:
    """Print the medians of some starts beside their bars; return whether all are met."""
    usages = [start() for _ in range(STARTS)]
    medians = [statistics.median(column) for column in zip(*usages, strict=True)]
    words = [
        f"{value:7.2f} {unit}" + (f" (at most {bar:g})" if bar < NO_BAR else "")
        for value, unit, bar in zip(medians, UNITS, bars, strict=True)
    ]
    slowest = max(seconds for seconds, _, _ in usages)
    fine = all(value <= bar for value, bar in zip(medians, bars, strict=True))
    print(
        f"{name:34} {', '.join(words)}, slowest {slowest:.2f} s  {'ok' if fine else 'MISSED'}",
        flush=True,
    )
    return fine


def main(_: Sequence[str]) -> int:
    """Print the table; return 1 if a bar is missed."""
    dilemma = MapFixture(read_map_file(find_map("dilemma")))
    program, no_bar = executable("ddqn-planner"), NO_BAR
    importing = partial(run_command, sys.executable, "-c", "import ddqn_planner")
    planner = partial(start_planner, dilemma)
    with claim_ros_domain():
        fine = [
            show("a bare rclpy node, discovered", start_bare_node, (no_bar, no_bar, no_bar)),
            show("map_server_node to its first map", start_map_server, (0.8, no_bar, 90)),
            show("planner_node to its first plan", planner, (1.5, 0.9, 210)),
        ]
    fine += [
        show("import ddqn_planner", importing, (no_bar, 0.3, no_bar)),
        show(
            "ddqn-planner plan dilemma",
            partial(run_command, program, "plan", "dilemma"),
            (1.2, no_bar, no_bar),
        ),
        show("ddqn-planner --help", partial(run_command, program, "--help"), (0.3, no_bar, no_bar)),
    ]
    return int(not all(fine))


if __name__ == "__main__":
    run_script(main)
