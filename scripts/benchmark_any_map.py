"""Measures the model for any map on large maps: fields, single queries, the node.

Part of `make bench`. Without arguments it measures on the package's own maps; with the path of a
ROS map, as of turtlebot3, the node plans on that one.
"""

from __future__ import annotations

import gc
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import demo
import numpy as np
import pyastar2d
import torch
from benchmark import call, report
from client import plan_request
from nav_msgs.srv import GetPlan
from processes import executable, running
from rcl_interfaces.srv import GetParameters, ListParameters
from std_srvs.srv import Trigger

from ddqn_planner import GridMap, MoveRule, Planner, load_map
from ddqn_planner.benchmarks.generalisation import compare_with_dijkstra
from ddqn_planner.experiments.goal_1 import a_star
from ddqn_planner.grid import Cell, save_map
from ddqn_planner.grid.generators import KINDS, generate_map, random_requests
from ddqn_planner.resources import find_map
from ddqn_planner.training.environment import Scenario

RULE = MoveRule.ROBOT_SAFE
GOALS = 7
CALLS = 200
LARGE = 2000


def main(arguments: Sequence[str]) -> int:
    """Print each figure beside its bound; return 1 if one is missed."""
    torch.set_num_threads(1)
    gc.freeze()  # else this process pauses to look for garbage among what it has imported
    missed = [measure_fields(256), measure_fields(1024)]
    compare_single_queries(256)
    with demo.client() as node:
        missed += measure_node(node, str(arguments[0] if arguments else find_map("office")))
        missed += measure_large_map(node)
    return int(any(missed))


def measure_fields(side: int) -> bool:
    """Compare the time of a field with that of scipy's Dijkstra, graph included, on each kind."""
    planner, ratios = Planner.load("any_map"), {}
    for kind in KINDS:
        random = np.random.default_rng(0)
        grid = GridMap(generate_map(kind, (side, side), random))
        goals = [goal for _, goal in random_requests(grid.occupancy, RULE, GOALS, random)]
        compare_with_dijkstra(planner, grid, goals[0], RULE)  # compiled code is loaded
        both = [compare_with_dijkstra(planner, grid, goal, RULE) for goal in goals]
        field, dijkstra = (statistics.median(row[column] for row in both) for column in (1, 3))
        ratios[kind] = field / dijkstra
        print(f"{side}x{side} {kind}: field {field:.1f} ms, Dijkstra {dijkstra:.1f} ms")
    worst = max(ratios, key=lambda kind: ratios[kind])
    return report(f"field / Dijkstra at {side}x{side}, worst kind ({worst})", ratios[worst], "x", 1)


def compare_single_queries(side: int) -> None:
    """Print what one path costs that is asked for once; A* in C++ is not to be beaten."""
    planner, random = Planner.load("any_map"), np.random.default_rng(0)
    grid = GridMap(generate_map("random_20", (side, side), random))
    weights = np.where(grid.occupancy, np.inf, 1).astype(np.float32)
    requests = random_requests(grid.occupancy, RULE, GOALS, random)

    def with_new_field(start: Cell, goal: Cell) -> object:
        return Planner(planner.network, planner.metadata).plan(grid, start, goal, RULE)

    def with_known_field(start: Cell, goal: Cell) -> object:
        return planner.plan(grid, start, goal, RULE)

    def own_a_star(start: Cell, goal: Cell) -> object:
        return a_star(Scenario(grid, start, goal), RULE)

    def pyastar(start: Cell, goal: Cell) -> object:
        return pyastar2d.astar_path(weights, start[::-1], goal[::-1], allow_diagonal=True)

    for _, goal in requests:
        _ = planner.q_field(grid, goal, RULE).policy
    planners: dict[str, Callable[[Cell, Cell], object]] = {
        "ours, new field": with_new_field,
        "ours, known field": with_known_field,
        "our A*": own_a_star,
        "pyastar2d A* (cuts corners, a diagonal counts 1)": pyastar,
    }
    for name, plan in planners.items():
        times = []
        for start, goal in requests:
            began = time.perf_counter()
            plan(start, goal)
            times.append(1e3 * (time.perf_counter() - began))
        print(f"one query at {side}x{side}, {name}: median {statistics.median(times):.2f} ms")


def plan_of(client: Any, asked: GetPlan.Request) -> Any:
    """Return the plan of a service's answer."""
    future = client.call_async(asked)
    demo.wait_for("plan", future.done, [])
    return future.result().plan


def measure_node(node: demo.Client, map_file: str) -> list[bool]:
    """Measure the first and the later answers of the planner node on a real-size map."""
    grid = load_map(map_file)
    random = np.random.default_rng(0)
    requests = [
        plan_request(grid, *cells) for cells in random_requests(grid.occupancy, RULE, GOALS, random)
    ]
    parameter = f"yaml_filename:={Path(map_file).resolve()}"
    first, ratios = [], []
    bare = node.create_client(GetPlan, "bare/get_plan")
    map_server = running(executable("map_server_node"), "--ros-args", "-p", parameter)
    with map_server, running(executable("planner_node")):
        first.append(first_answer(node, requests[0]))
        script = __file__.replace("benchmark_any_map.py", "bare_service.py")
        for asked in requests[1:]:
            first.append(call(node.get_plan, asked))
            poses = len(plan_of(node.get_plan, asked).poses)
            with running(sys.executable, script, str(poses)):
                assert bare.wait_for_service(demo.TIMEOUT)
                call(bare, asked)
                pairs = [(call(node.get_plan, asked), call(bare, asked)) for _ in range(CALLS)]
            ours, theirs = (statistics.median(times) for times in zip(*pairs, strict=True))
            ratios.append(ours / theirs)
            print(
                f"GetPlan of {poses} poses: first {first[-1]:.1f} ms, then {ours:.2f} ms; bare "
                f"service {theirs:.2f} ms"
            )
    name = f"{Path(map_file).stem}, {grid.width}x{grid.height}"
    return [
        report(
            f"{name}: GetPlan to a new goal, first ever {first[0]:.1f} ms, slowest",
            max(first),
            "ms",
            100,
        ),
        report(f"{name}: GetPlan again / bare service, worst", max(ratios), "x", 1.5),
    ]


def first_answer(node: demo.Client, asked: GetPlan.Request) -> float:
    """Ask the planner until it has its map; return how long its first plan took, milliseconds."""
    assert node.get_plan.wait_for_service(demo.TIMEOUT)

    def answer() -> float:
        began = time.perf_counter()
        poses = plan_of(node.get_plan, asked).poses
        return 1e3 * (time.perf_counter() - began) if poses else 0.0

    return demo.wait_for("map", answer, [])


def measure_large_map(node: demo.Client) -> list[bool]:
    """Measure memory, and what other services take while a large field is computed."""
    random = np.random.default_rng(0)
    grid = GridMap(generate_map("office", (LARGE, LARGE), random))
    cells = random_requests(grid.occupancy, RULE, GOALS + 1, random)
    new = [plan_request(grid, *both) for both in cells[1:]]
    known = plan_request(
        grid, cells[0][0], cells[0][0]
    )  # of one pose: a long path takes its own time
    services = {
        "get_parameters": (
            node.create_client(GetParameters, "planner/get_parameters"),
            GetParameters.Request(names=["model"]),
        ),
        "list_parameters": (
            node.create_client(ListParameters, "planner/list_parameters"),
            ListParameters.Request(),
        ),
        "get_plan with a known field": (node.get_plan, known),
        "reload_model": (node.create_client(Trigger, "planner/reload_model"), Trigger.Request()),
    }
    missed, waited = [], []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "large.yaml")
        save_map(grid, path)
        parameter = f"yaml_filename:={path}"
        map_server = running(executable("map_server_node"), "--ros-args", "-p", parameter)
        with map_server, running(executable("planner_node")) as planner:
            first_answer(node, known)
            for name, (client, question) in services.items():
                times = []
                for asked in new:
                    plan_of(node.get_plan, known)
                    began = time.perf_counter()
                    plan = node.get_plan.call_async(asked)
                    while not plan.done():
                        times.append(call(client, question))
                    waited.append(1e3 * (time.perf_counter() - began))
                figure = f"{LARGE}x{LARGE}, field under way: {name}, slowest of {len(times)}"
                missed.append(report(figure, max(times), "ms", 100))
            memory = Path(f"/proc/{planner.pid}/status").read_text(encoding="utf-8")
    print(f"{LARGE}x{LARGE}: GetPlan with a new field, median {statistics.median(waited):.0f} ms")
    peak = int(memory.split("VmHWM:")[1].split()[0]) / 1e3
    missed.append(report(f"{LARGE}x{LARGE}: planner node, greatest memory", peak, "MB", 2000))
    return missed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
