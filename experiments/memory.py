"""Measures where the planner's memory goes, and whether reloads add to it.

And the memory of a trainer that learns from driving.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import client as ros
import numpy as np
import processes
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.srv import GetPlan
from rclpy.time import Time as RosTime
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from tables import report

from ddqn_planner import Planner
from ddqn_planner.grid import read_map_file
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.resources import find_map

PLANS = 8
POSES = 1000  # of a drive
LARGE = 2000  # cells of a side of the large map
RELOADS = 1500
FIRST_RELOADS = 50  # after which the memory is measured first
SETTLED = 5.0  # seconds until all is compiled, and what is not needed given back
KINDS = {"RssAnon": "own", "RssFile": "of files", "RssShmem": "shared", "VmRSS": "all"}
STEPS = str(Path(__file__).with_name("memory_steps.py"))


def measure_layers(fixture: ros.MapFixture) -> None:
    """Print the sizes of the arrays of a map, and those of one field on it."""
    grid = fixture.grid
    (request,) = fixture.requests(1, np.random.default_rng(0))
    start = ros.cell_of(grid, request.start)
    goal = ros.cell_of(grid, request.goal)
    field = Planner.load("any_map").q_field(grid, goal, ros.RULE)
    field.rollout(start)
    layers = [
        value.nbytes for value in vars(grid).values() if isinstance(value, np.ndarray)
    ]
    nbytes = {
        "message": grid.occupancy.size,  # a byte for each cell
        "map": sum(layers),
        "patches": field.costs.patch_number.nbytes if field.costs is not None else 0,
        "a field": field.nbytes,
    }
    sizes = ", ".join(f"{name} {size / 1e6:.1f} MB" for name, size in nbytes.items())
    print(f"{grid.width}x{grid.height}: {sizes}")


def measure_node(
    name: str, fixture: ros.MapFixture, bound: float, map_file: Path | None = None
) -> Iterator[bool]:
    """Measure the planner's memory after plans to some goals on a map.

    The map comes from a map server, or is sent.
    """
    requests = fixture.requests(PLANS, np.random.default_rng(0))
    with ros.Client() as client, processes.running_node("planner_node") as node:
        if map_file is not None:
            server = processes.running_node(
                "map_server_node", yaml_filename=map_file.resolve()
            )
            client.enter_context(server)
        else:
            client.publish("map", fixture.message(), LATCHED)
        get_plan = client.service(GetPlan, "planner/get_plan")
        ros.wait_for("plan", lambda: ros.ask(get_plan, requests[0]).plan.poses)
        time.sleep(SETTLED)
        greatest = 0.0
        for request in requests:
            ros.ask(get_plan, request)
            greatest = max(greatest, processes.memory(node.pid))
        megabytes = {
            words: processes.memory(node.pid, kind) for kind, words in KINDS.items()
        }
        split = ", ".join(f"{words} {size:.0f}" for words, size in megabytes.items())
        peak = processes.memory(node.pid, "VmHWM")
        print(
            f"{name}: MB after {PLANS} plans: {split}; "
            f"the greatest since the start {peak:.0f}"
        )
        yield report(
            f"{name}: planner_node, after any of the plans", greatest, "MB", bound
        )


def measure_reloads() -> Iterator[bool]:
    """Measure by how much reloads of the model make the planner node grow."""
    quiet = processes.running_node("planner_node", "--log-level", "error")
    with ros.Client() as client, quiet as node:
        memory = []
        for count in (FIRST_RELOADS, RELOADS):
            for _ in range(count):
                (result,) = client.set_parameters("planner", model="any_map")
                assert result.successful
            time.sleep(SETTLED)
            memory.append(processes.memory(node.pid, "RssAnon"))
    yield report(
        f"{RELOADS} reloads of the model: growth", memory[1] - memory[0], "MB", 1
    )


def measure_trainer(fixture: ros.MapFixture) -> Iterator[bool]:
    """Measure the memory of a trainer that learns from a drive on a map."""
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        parameters = {"learn_from": "driving", "output_folder": f"{folder}/drives"}
        client = stack.enter_context(ros.Client())
        node = stack.enter_context(processes.running_node("trainer_node", **parameters))
        slowness = client.subscribe(OccupancyGrid, "trainer/slowness", LATCHED)
        client.publish("map", fixture.message(), LATCHED)
        slowness.wait()
        for number in range(POSES):
            nanoseconds = int(1e9 + 2e8 * number)
            odometry = Odometry(header=Header(frame_id="map"))
            odometry.header.stamp = RosTime(nanoseconds=nanoseconds).to_msg()
            odometry.pose.pose.position.x = 1 + 0.1 * (number % 200)
            odometry.pose.pose.position.y = 1 + 0.01 * number
            client.publish("odom", odometry, POSES)
        time.sleep(SETTLED)
        client.call(Trigger, "trainer/stop")
        time.sleep(SETTLED)
        memory = processes.memory(node.pid)
    yield report("trainer_node that learns from driving", memory, "MB", 250)


def main(_: Sequence[str]) -> int:
    """Print tables, and each figure beside its bound; return 1 if one is missed."""
    office = find_map("office")
    office_fixture = ros.MapFixture(read_map_file(office))
    large_fixture = ros.generated_map("office", LARGE, seed=np.random.default_rng(0))
    with processes.claim_ros_domain():
        subprocess.run([sys.executable, STEPS], check=True)
        for fixture in (office_fixture, large_fixture):
            measure_layers(fixture)
        missed = [*measure_node("office", office_fixture, 210, office)]
        missed += measure_node(f"{LARGE}x{LARGE}", large_fixture, 250)
        missed += measure_reloads()
        missed += measure_trainer(office_fixture)
    return int(any(missed))


if __name__ == "__main__":
    processes.run_script(main, {})
