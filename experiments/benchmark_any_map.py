"""Measures the planner node with the model for any map, on large and on changing maps.

Part of `make bench`. Without arguments it measures on the package's own maps; with the path of a
ROS map, as of turtlebot3, the node plans on that one.
"""

from __future__ import annotations

import gc
import statistics
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from benchmark import compare_with_bare_service, report, timed
from client import Client, initial_pose, map_message, plan_request, pose, wait_for
from nav_msgs.msg import OccupancyGrid
from nav_msgs.msg import Path as PathMessage
from nav_msgs.srv import GetPlan
from processes import claim_ros_domain, memory, run_script, running_node
from random_maps import generate_map
from rcl_interfaces.srv import GetParameters, ListParameters
from startup import node_usage
from std_srvs.srv import Trigger

from ddqn_planner import GridMap, MoveRule, Planner, load_map
from ddqn_planner.grid import Cell, save_map
from ddqn_planner.grid.arguments import OCCUPIED
from ddqn_planner.grid.noise import random_requests
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.resources import find_map

RULE = MoveRule.ROBOT_SAFE
GOALS = 7
CALLS = 200
LARGE = 2000
CHANGING = 1024
RATE = 5
"""Maps per second."""


def main(arguments: Sequence[str]) -> int:
    """Print each figure beside its bound; return 1 if one is missed."""
    gc.freeze()  # else this process pauses to look for garbage among what it has imported
    map_file = Path(arguments[0] if arguments else find_map("office"))
    missed = []
    with claim_ros_domain():
        for measure in (
            partial(measure_node, map_file=map_file),
            measure_large_map,
            measure_new_maps,
            measure_changing_map,
        ):
            with Client() as client:  # else its last map would reach the next node
                missed += measure(client)
    return int(any(missed))


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


def office(side: int) -> tuple[GridMap, Cell, Cell]:
    """Return a generated office, with a start and a goal that a path joins."""
    random = np.random.default_rng(0)
    grid = GridMap(generate_map("office", (side, side), random))
    ((start, goal),) = random_requests(grid.occupancy, RULE, 1, random)
    return grid, start, goal


def message_of(grid: GridMap) -> OccupancyGrid:
    """Return the message of a map."""
    return map_message(OCCUPIED * grid.occupancy.astype(np.int8), grid)


def publish_request(client: Client, grid: GridMap, start: Cell, goal: Cell) -> None:
    """Publish the start and the goal."""
    client.publish("initialpose", initial_pose(pose(grid, start)))
    client.publish("goal_pose", pose(grid, goal))


def measure_new_maps(client: Client) -> list[bool]:
    """Measure how soon a new large map brings a path to the active goal."""
    plans, times = client.subscribe(PathMessage, "plan", LATCHED), []
    small = message_of(GridMap(np.zeros((5, 5), dtype=np.bool_)))
    first, *_ = office(LARGE)
    with running_node("planner_node"):
        for turns in range(4):
            grid = GridMap(np.rot90(first.occupancy, turns))
            client.publish("map", small, LATCHED)
            random = np.random.default_rng(turns)
            ((start, goal),) = random_requests(grid.occupancy, RULE, 1, random)
            publish_request(client, grid, start, goal)
            time.sleep(2)  # until the node has answered that these lie outside the small map
            message = message_of(grid)
            plans.clear()
            began = time.monotonic()
            client.publish("map", message, LATCHED)
            plans.wait(lambda plan: plan.poses)
            times.append(time.monotonic() - began)
    print(f"{LARGE}x{LARGE}: new map to path, first of the node {times[0]:.2f} s")
    seconds = statistics.median(times[1:])
    return [report(f"{LARGE}x{LARGE}: new map to path, median", seconds, "s", 0.3)]


def measure_changing_map(client: Client) -> list[bool]:
    """Measure the planner's share of a core while its map changes in a few cells, 5 Hz."""
    plans = client.subscribe(PathMessage, "plan", LATCHED)
    grid, start, goal = office(CHANGING)
    local, random, messages = Planner.load("any_map"), np.random.default_rng(0), [message_of(grid)]
    path = local.plan(grid, start, goal, RULE).cells
    while len(messages) < 12 * RATE:
        x, y = random.choice(path[3:-3])
        changed = grid.with_patch(~grid.occupancy[y : y + 2, x : x + 2], x, y)
        if local.plan(changed, start, goal, RULE).cells:
            messages.append(message_of(changed))
    with running_node("planner_node") as planner:
        publish_request(client, grid, start, goal)
        for number, message in enumerate(messages):
            if number == 2 * RATE:  # the node is warm
                plans.clear()
                began = time.monotonic()
                _, cpu_before, _ = node_usage(planner.pid, began)
            client.publish("map", message, LATCHED)
            time.sleep(1 / RATE)
        wall, cpu, _ = node_usage(planner.pid, began)
    print(f"{CHANGING}x{CHANGING}: {len(plans.messages())} plans in {wall:.1f} s")
    figure = f"{CHANGING}x{CHANGING}: a few cells change, 5 Hz: share of a core"
    return [report(figure, 100 * (cpu - cpu_before) / wall, "%", 10)]


if __name__ == "__main__":
    run_script(main)
