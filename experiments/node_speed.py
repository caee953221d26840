"""Measures the executables: start, answers, memory, share of a core."""

import gc
import os
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import client as ros
import numpy as np
import processes
from nav_msgs.msg import OccupancyGrid
from nav_msgs.msg import Path as PathMessage
from nav_msgs.srv import GetPlan
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger
from tables import report

from ddqn_planner import GridMap, Planner
from ddqn_planner.grid import OCCUPIED, Cell, MapFile, read_map_file
from ddqn_planner.grid.noise import random_requests
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.resources import find_map

BARE = [sys.executable, str(Path(__file__).with_name("bare_service.py"))]
STARTS, CALLS, GOALS, LARGE, CHANGING = 10, 200, 7, 2000, 1024
RATE = 5  # maps per second
IDLE = 30  # seconds
SETTLED = 0.6  # seconds after which a client is known to DDS
FREE = float("inf")
Usage = tuple[
    float, float, float
]  # wall time and CPU time, seconds; resident memory, MB


def usage(child: AbstractContextManager[Any], wait: Callable[[], Any]) -> Usage:
    """Start a process; return what it takes until a wait ends."""
    time.sleep(SETTLED)
    began = time.monotonic()
    with child as node:
        wait()
        return (
            time.monotonic() - began,
            processes.cpu_seconds(node.pid),
            processes.memory(node.pid),
        )


# A client per start: one that has seen other nodes end is discovered more slowly.


def start_planner(*environment: str) -> Usage:
    """Start the planner node; return what it takes until its first plan."""
    fixture = ros.shipped_maps()["dilemma"]
    (request,) = fixture.requests(1, np.random.default_rng(0))
    with ros.Client() as client:
        plans = client.subscribe(PathMessage, "plan", LATCHED)
        client.publish("map", fixture.message(), LATCHED, listeners=0)

        def first_plan() -> None:
            client.publish_ends(request)
            plans.wait(lambda plan: plan.poses)

        command = (
            processes.executable("planner_node"),
            "--ros-args",
            "--log-level",
            "error",
        )
        return usage(processes.running("env", *environment, *command), first_plan)


def start_cold_planner() -> Usage:
    """Do the same with nothing compiled."""
    with tempfile.TemporaryDirectory() as folder:
        return start_planner(f"NUMBA_CACHE_DIR={folder}")


def start_map_server() -> Usage:
    """Start the map server; return what it takes until its first map is received."""
    with ros.Client() as client:
        maps = client.subscribe(OccupancyGrid, "map", LATCHED)
        return usage(
            processes.running_node("map_server_node", "--log-level", "error"), maps.wait
        )


def start_bare_node() -> Usage:
    """Start a node with one service; return what it takes until it is discovered."""
    with ros.Client() as client:
        ready = client.node.create_client(GetPlan, "bare/get_plan").service_is_ready
        return usage(
            processes.running(*BARE, "0"), lambda: ros.wait_for("the bare node", ready)
        )


def run_command(*command: str) -> Usage:
    """Return what a command takes from start to end."""
    began, peak, ended = time.monotonic(), 0.0, 0
    silent = [(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
    child = os.posix_spawn(command[0], command, os.environ, file_actions=silent)
    while not ended:
        # Not ru_maxrss: that begins with the memory of this process.
        with suppress(IndexError, OSError):
            peak = processes.memory(child, "VmHWM")
        time.sleep(0.002)
        ended, status, used = os.wait4(child, os.WNOHANG)
    assert status == 0, f"{command} ended with {os.waitstatus_to_exitcode(status)}"
    return time.monotonic() - began, used.ru_utime + used.ru_stime, peak


def measure_starts() -> Iterator[bool]:
    """Print the medians of some starts beside their bounds."""
    imported = partial(run_command, sys.executable, "-c", "import ddqn_planner")
    planned = partial(
        run_command, processes.executable("ddqn-planner"), "plan", "dilemma"
    )
    starts: dict[str, tuple[Callable[[], Usage], Usage]] = {
        "a bare rclpy node, discovered": (start_bare_node, (FREE, FREE, FREE)),
        "map_server_node to its first map": (start_map_server, (0.8, FREE, 90)),
        "planner_node to its first plan": (start_planner, (1.5, 0.9, 210)),
        "planner_node with nothing compiled": (start_cold_planner, (FREE, 4, FREE)),
        "import ddqn_planner": (imported, (FREE, 0.3, FREE)),
        "ddqn-planner plan dilemma": (planned, (1.2, FREE, FREE)),
    }
    for name, (start, bounds) in starts.items():
        columns = list(zip(*(start() for _ in range(STARTS)), strict=True))
        name = f"{name} (slowest {max(columns[0]):.2f} s)"
        for column, unit, bound in zip(
            columns, ("s", "CPU", "MB"), bounds, strict=True
        ):
            yield report(name, statistics.median(column), unit, bound)


def timed(service: Any, request: Any) -> tuple[float, Any]:
    """Call a service; return how long its answer took, milliseconds, and the answer."""
    began = time.perf_counter()
    answer = ros.ask(service, request)
    return 1e3 * (time.perf_counter() - began), answer


def measure_requests(client: ros.Client, map_file: Path) -> Iterator[bool]:
    """Measure the first and the later answers of the planner node on a map."""
    fixture = ros.MapFixture(read_map_file(map_file))
    requests = fixture.requests(GOALS, np.random.default_rng(0))
    first_times = []
    ratios = []
    server = processes.running_node("map_server_node", yaml_filename=map_file.resolve())
    with server, processes.running_node("planner_node"):
        planner = client.service(GetPlan, "planner/get_plan")
        ros.wait_for("plan", lambda: ros.ask(planner, requests[0]).plan.poses)
        for request in requests[1:]:
            first_ms, answer = timed(planner, request)
            first_times.append(first_ms)
            poses = len(answer.plan.poses)
            planner_times = []
            bare_times = []
            with processes.running(*BARE, str(poses)):
                bare = client.service(GetPlan, "bare/get_plan")
                timed(bare, request)
                for _ in range(CALLS):
                    planner_times.append(timed(planner, request)[0])
                    bare_times.append(timed(bare, request)[0])
            planner_ms = statistics.median(planner_times)
            bare_ms = statistics.median(bare_times)
            ratios.append(planner_ms / bare_ms)
            print(
                f"GetPlan of {poses} poses: first {first_ms:.1f} ms, "
                f"then {planner_ms:.2f} ms; bare service {bare_ms:.2f} ms"
            )
    name = f"{map_file.stem}, {fixture.grid.width}x{fixture.grid.height}"
    yield report(f"{name}: GetPlan to a new goal, slowest", max(first_times), "ms", 100)
    yield report(f"{name}: GetPlan again / bare service, worst", max(ratios), "x", 1.5)


def measure_large_map(client: ros.Client) -> Iterator[bool]:
    """Measure services beside a large field, memory, and new large maps."""
    random, waited = np.random.default_rng(0), []
    fixture = ros.generated_map("office", LARGE, seed=random)
    known, *new = fixture.requests(GOALS + 1, random)
    known.goal = known.start  # a long path would take its own time
    questions = {
        "get_parameters": (GetParameters, GetParameters.Request(names=["model"])),
        "list_parameters": (ListParameters, ListParameters.Request()),
        "get_plan": (GetPlan, known),
        "set_parameters": (
            SetParameters,
            SetParameters.Request(
                parameters=[Parameter("model", value="any_map").to_parameter_msg()]
            ),
        ),
    }
    with processes.running_node("planner_node") as planner:
        client.publish("map", fixture.message(), LATCHED)
        get_plan = client.service(GetPlan, "planner/get_plan")
        ros.wait_for("plan", lambda: ros.ask(get_plan, known).plan.poses)
        for name, (service_type, question) in questions.items():
            service, times = client.service(service_type, f"planner/{name}"), []
            for request in new:
                timed(get_plan, known)
                began = time.perf_counter()
                plan = get_plan.call_async(request)
                while not plan.done():
                    times.append(timed(service, question)[0])
                waited.append(1e3 * (time.perf_counter() - began))
            figure = (
                f"{LARGE}x{LARGE}, field under way: {name}, slowest of {len(times)}"
            )
            yield report(figure, max(times), "ms", 100)
        print(
            f"{LARGE}x{LARGE}: GetPlan with a new field, "
            f"{statistics.median(waited):.0f} ms"
        )
        peak = processes.memory(planner.pid, "VmHWM")
        yield report(
            f"{LARGE}x{LARGE}: planner node, greatest memory", peak, "MB", 2000
        )
        plans, seconds = client.subscribe(PathMessage, "plan", LATCHED), []
        for turns in (1, 2, 3):
            origin = LARGE * turns, 0.0, 0.0
            turned = ros.MapFixture(
                MapFile(np.rot90(fixture.values, turns), 1.0, origin)
            )
            client.publish_ends(*turned.requests(1, random))
            time.sleep(
                2
            )  # until the node has answered that these lie outside the map before
            message = turned.message()
            plans.clear()
            began = time.monotonic()
            client.publish("map", message, LATCHED)
            plans.wait(lambda plan: plan.poses)
            seconds.append(time.monotonic() - began)
    yield report(
        f"{LARGE}x{LARGE}: new map to path", statistics.median(seconds), "s", 0.3
    )


def measure_changing_map(client: ros.Client) -> Iterator[bool]:
    """Measure the planner's share of a core.

    It has no goal at first; then a few cells change.
    """
    name = f"{CHANGING}x{CHANGING}"
    random = np.random.default_rng(0)
    fixture = ros.generated_map("office", CHANGING, seed=random)
    grid = fixture.grid
    ((start, goal),) = random_requests(grid.occupancy, ros.RULE, 1, random)
    messages = [fixture.message()]
    messages += changed_maps(grid, start, goal, 12 * RATE - 1, random)
    with processes.running_node("planner_node") as planner:
        client.publish("map", messages[0], LATCHED)
        time.sleep(IDLE / 2)  # until all is compiled
        cpu = processes.cpu_seconds(planner.pid)
        time.sleep(IDLE)
        idle_cpu = processes.cpu_seconds(planner.pid) - cpu
        share = 100 * idle_cpu / IDLE
        yield report(f"{name}: no goal: share of a core", share, "%", 0.2)
        client.publish_ends(ros.plan_request(grid, start, goal))
        for number, message in enumerate(messages):
            if number == 2 * RATE:  # the node is warm
                began = time.monotonic()
                cpu = processes.cpu_seconds(planner.pid)
            client.publish("map", message, LATCHED)
            time.sleep(1 / RATE)
        seconds = time.monotonic() - began
        busy_cpu = processes.cpu_seconds(planner.pid) - cpu
    figure = f"{name}: a few cells change, {RATE} Hz: share of a core"
    yield report(figure, 100 * busy_cpu / seconds, "%", 8)


def changed_maps(
    grid: GridMap, start: Cell, goal: Cell, count: int, random: ros.Random
) -> list[OccupancyGrid]:
    """Return messages of the map, each with 2 x 2 other cells on the shortest path."""
    planner = Planner.load("any_map")
    path = planner.plan(grid, start, goal, ros.RULE).cells
    messages: list[OccupancyGrid] = []
    while len(messages) < count:
        x, y = random.choice(path[3:-3])
        changed = grid.with_patch(~grid.occupancy[y : y + 2, x : x + 2], x, y)
        if planner.plan(changed, start, goal, ros.RULE).cells:
            values = OCCUPIED * changed.occupancy.astype(np.int8)
            messages.append(ros.map_message(values, changed))
    return messages


def measure_trainer(client: ros.Client) -> Iterator[bool]:
    """Measure the trainer while it trains.

    Measured are its services, and how soon a signal ends it.
    """
    slowest = dict.fromkeys(("start", "save", "replay", "stop"), 0.0)

    def call(name: str, times: int = 1) -> float:
        service = client.service(Trigger, f"trainer/{name}")
        return max(timed(service, Trigger.Request())[0] for _ in range(times))

    options = {"map_file": "dilemma", "steps": 1_000_000}
    for number in (signal.SIGINT, signal.SIGTERM):
        with (
            tempfile.TemporaryDirectory() as folder,
            processes.running_node(
                "trainer_node", output_folder=folder, **options
            ) as trainer,
        ):
            print(
                "trainer: first ~/start, once torch is imported: "
                f"{call('start'):.0f} ms"
            )
            time.sleep(10)  # thousands of steps: a checkpoint and curves of some size
            for name in slowest:
                slowest[name] = max(slowest[name], call(name, 50))
            for _ in range(20):  # until the training that was stopped has saved itself
                slowest["start"] = max(slowest["start"], call("start"))
                time.sleep(0.1)
            began = time.monotonic()
            trainer.send_signal(number)
            assert trainer.wait() == 0, (
                f"{number.name} ended it with {trainer.returncode}"
            )
            seconds = time.monotonic() - began
        yield report(f"trainer: {number.name} to exit", seconds, "s", 3)
    for name, ms in slowest.items():
        yield report(
            f"trainer: ~/{name} while it trains, slowest of 100", ms, "ms", 100
        )


def main(arguments: Sequence[str]) -> int:
    """Print each figure beside its bound.

    Return 1 if a bound is missed. The path of another ROS map is an argument.
    """
    map_file = find_map(arguments[0] if arguments else "office")
    with processes.claim_ros_domain():
        missed = [*measure_starts()]
        # Else this process pauses to look for garbage among what it has imported.
        gc.freeze()
        for measure in (
            partial(measure_requests, map_file=find_map("dilemma")),
            partial(measure_requests, map_file=map_file),
            measure_large_map,
            measure_changing_map,
            measure_trainer,
        ):
            with ros.Client() as client:  # else its last map would reach the next node
                missed += measure(client)
    return int(any(missed))


if __name__ == "__main__":
    processes.run_script(main, {"map": "a ROS map's YAML file (the office)"})
