"""Measures the model for any map on large maps: fields, single queries, the node.

Part of `make bench`. Without arguments it measures on the package's own maps; with the path of a
ROS map, as of turtlebot3, the node plans on that one.
"""

from __future__ import annotations

import gc
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pyastar2d
import torch
from benchmark import compare_with_bare_service, report, timed
from client import Client, plan_request, wait_for
from nav_msgs.srv import GetPlan
from processes import claim_ros_domain, memory, run_script, running_node
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
    with claim_ros_domain(), Client() as client:
        missed += measure_node(client, Path(arguments[0] if arguments else find_map("office")))
        missed += measure_large_map(client)
    return int(any(missed))


def measure_fields(side: int) -> bool:
    """Compare the time of a field with that of scipy's Dijkstra, graph included, on each kind."""
    planner, ratios = Planner.load("any_map"), {}
    for kind in KINDS:
        random = np.random.default_rng(0)
        grid = GridMap(generate_map(kind, (side, side), random))
        goals = [goal for _, goal in random_requests(grid.occupancy, RULE, GOALS, random)]
        compare_with_dijkstra(planner, grid, goals[0], RULE)  # compiled code is loaded
        both = [compare_with_dijkstra(planner, grid, goal, RULE)[1::2] for goal in goals]
        field, dijkstra = (statistics.median(times) for times in zip(*both, strict=True))
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


def first_answer(client: Client, request: GetPlan.Request) -> tuple[float, int]:
    """Ask the planner until it has its map; return its first plan's milliseconds and poses."""
    service = client.service(GetPlan, "planner/get_plan")

    def answer() -> tuple[float, int] | None:
        took, response = timed(service, request)
        return (took, len(response.plan.poses)) if response.plan.poses else None

    return wait_for("plan", answer)


def measure_node(client: Client, map_file: Path) -> list[bool]:
    """Measure the first and the later answers of the planner node on a real-size map."""
    grid = load_map(map_file)
    pairs = random_requests(grid.occupancy, RULE, GOALS, np.random.default_rng(0))
    requests = [plan_request(grid, *cells) for cells in pairs]
    first, ratios = [], []
    server = running_node("map_server_node", yaml_filename=map_file.resolve())
    with server, running_node("planner_node"):
        first.append(first_answer(client, requests[0])[0])
        for request in requests[1:]:
            took, poses = first_answer(client, request)
            first.append(took)
            ours, bare = compare_with_bare_service(client, request, poses, CALLS)
            ratios.append(ours / bare)
            print(
                f"GetPlan of {poses} poses: first {took:.1f} ms, then {ours:.2f} ms; bare "
                f"service {bare:.2f} ms"
            )
    name = f"{map_file.stem}, {grid.width}x{grid.height}"
    # The node answers before its model is loaded: the first request waits for it.
    print(f"{name}: first GetPlan of a node that is starting {first[0]:.1f} ms")
    return [
        report(f"{name}: GetPlan to a new goal, slowest", max(first[1:]), "ms", 100),
        report(f"{name}: GetPlan again / bare service, worst", max(ratios), "x", 1.5),
    ]


def measure_large_map(client: Client) -> list[bool]:
    """Measure memory, and what other services take while a large field is computed."""
    random = np.random.default_rng(0)
    grid = GridMap(generate_map("office", (LARGE, LARGE), random))
    cells = random_requests(grid.occupancy, RULE, GOALS + 1, random)
    new = [plan_request(grid, *both) for both in cells[1:]]
    # Of one pose: a long path takes its own time.
    known = plan_request(grid, cells[0][0], cells[0][0])
    parameters = GetParameters.Request(names=["model"])
    questions = {
        "get_parameters": (GetParameters, "planner/get_parameters", parameters),
        "list_parameters": (ListParameters, "planner/list_parameters", ListParameters.Request()),
        "get_plan with a known field": (GetPlan, "planner/get_plan", known),
        "reload_model": (Trigger, "planner/reload_model", Trigger.Request()),
    }
    missed, waited = [], []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "large.yaml")
        save_map(grid, path)
        server = running_node("map_server_node", yaml_filename=path)
        with server, running_node("planner_node") as planner:
            first_answer(client, known)
            get_plan = client.service(GetPlan, "planner/get_plan")
            for name, (service_type, service_name, question) in questions.items():
                service, times = client.service(service_type, service_name), []
                for request in new:
                    timed(get_plan, known)
                    began = time.perf_counter()
                    plan = get_plan.call_async(request)
                    while not plan.done():
                        times.append(timed(service, question)[0])
                    waited.append(1e3 * (time.perf_counter() - began))
                figure = f"{LARGE}x{LARGE}, field under way: {name}, slowest of {len(times)}"
                missed.append(report(figure, max(times), "ms", 100))
            peak = memory(planner.pid, "VmHWM")
    print(f"{LARGE}x{LARGE}: GetPlan with a new field, median {statistics.median(waited):.0f} ms")
    missed.append(report(f"{LARGE}x{LARGE}: planner node, greatest memory", peak, "MB", 2000))
    return missed


if __name__ == "__main__":
    run_script(main)
