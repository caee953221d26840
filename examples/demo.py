"""Starts the map server and the planner, and shows a path on each of two maps."""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path as FilePath
from subprocess import Popen
from typing import NamedTuple

import numpy as np
from nav_msgs.msg import OccupancyGrid, Path

from ddqn_planner.grid import MoveRule, path_length, read_map_file, shortest_distances
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.pictures import MAX_TEXT_WIDTH, draw_text, save_picture
from ddqn_planner.resources import find_map

sys.path.insert(0, str(FilePath(__file__).resolve().parents[1] / "experiments"))
from client import Client, cells_of, plan_request, wait_for
from processes import claim_ros_domain, run_script, running_node


class Case(NamedTuple):
    """A shipped map, and the shipped model that plans on it."""

    map_name: str
    model: str
    move_rule: MoveRule  # of the model
    title: str  # of the picture
    picture: str  # its file


CASES = (
    Case(
        "dilemma", "dilemma", MoveRule.CORNER_CUTTING, "The paper's network", "demo.png"
    ),
    Case(
        "office", "any_map", MoveRule.ROBOT_SAFE, "A map never seen", "demo_office.png"
    ),
)


def show_path(client: Client, case: Case, nodes: Sequence[Popen[bytes]]) -> None:
    """Ask for a path as `ros2 topic pub` would; print and draw the path."""
    began = time.monotonic()
    plans = client.subscribe(Path, "plan", LATCHED)
    fields = client.subscribe(OccupancyGrid, "planner/value", LATCHED)
    map_file = read_map_file(find_map(case.map_name))
    grid = map_file.grid()
    start = map_file.start or (0, 0)
    goal = map_file.goal or (0, 0)
    client.publish_ends(plan_request(grid, start, goal))
    plan = wait_for("plan", lambda: plans.find(lambda plan: plan.poses), nodes)
    seconds = time.monotonic() - began
    print(f"the first plan came {seconds:.1f} s after the nodes were started")
    cells = cells_of(grid, plan)
    if grid.width <= MAX_TEXT_WIDTH:
        print(draw_text(grid, cells))
    size = f"{grid.width} x {grid.height} cells"
    print(f"{size}, path of {len(cells)} from {start} to {goal}")
    length = path_length(cells)
    optimum = shortest_distances(grid, goal, case.move_rule)[start[::-1]]
    rule = case.move_rule.value
    print(f"length {length:.2f} cells, optimum {optimum:.2f} under {rule}")
    field = wait_for("value field", fields.find, nodes)
    value = np.array(field.data, dtype=np.float32).reshape(grid.height, grid.width)
    value[value < 0] = np.nan
    title = f"{case.title}: {length:.2f} cells"
    label = "value field, 100 at the goal"
    save_picture(case.picture, grid, cells, value, title, label)
    print(f"picture: {case.picture}\n", flush=True)


def main(arguments: Sequence[str]) -> int:
    """Show a path on each map.

    No process is left behind, also when this one is interrupted.
    """
    argparse.ArgumentParser(description=__doc__).parse_args(arguments)
    with claim_ros_domain():
        for case in CASES:
            yaml_file = f"{case.map_name}.yaml"
            with (
                running_node("map_server_node", yaml_filename=yaml_file) as server,
                running_node(
                    "planner_node", model=case.model, path_simplification="none"
                ) as planner,
                Client() as client,
            ):
                show_path(client, case, [server, planner])
    return 0


if __name__ == "__main__":
    run_script(main)
