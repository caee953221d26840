"""Starts the map server and the planner, and shows a path on each of two maps."""

import sys
import time
from collections.abc import Sequence
from pathlib import Path as FilePath
from subprocess import Popen

import numpy as np
from nav_msgs.msg import OccupancyGrid, Path

from ddqn_planner.grid import MoveRule, path_length, read_map_file, shortest_distances
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.pictures import MAX_TEXT_WIDTH, draw_text, save_picture
from ddqn_planner.resources import find_map

sys.path.insert(0, str(FilePath(__file__).resolve().parents[1] / "experiments"))
from client import Client, cells_of, plan_request, wait_for
from processes import claim_ros_domain, run_script, running_node

# A map, the shipped model that plans on it, its move rule, and the picture's title and
# file.
Case = tuple[str, str, MoveRule, str, str]
CASES: tuple[Case, ...] = (
    ("dilemma", "dilemma", MoveRule.CORNER_CUTTING, "The paper's network", "demo.png"),
    ("office", "any_map", MoveRule.ROBOT_SAFE, "A map never seen", "demo_office.png"),
)


def show_path(client: Client, case: Case, children: Sequence[Popen[bytes]]) -> None:
    """Ask for a path as `ros2 topic pub` would; print and draw the path."""
    began, (map_name, _, rule, title, picture) = time.monotonic(), case
    plans = client.subscribe(Path, "plan", LATCHED)
    fields = client.subscribe(OccupancyGrid, "planner/value", LATCHED)
    map_file = read_map_file(find_map(map_name))
    grid, start, goal = (
        map_file.grid(),
        map_file.start or (0, 0),
        map_file.goal or (0, 0),
    )
    client.publish_ends(plan_request(grid, start, goal))
    plan = wait_for("plan", lambda: plans.find(lambda plan: plan.poses), children)
    print(
        f"the first plan came {time.monotonic() - began:.1f} s "
        "after the nodes were started"
    )
    cells = cells_of(grid, plan)
    if grid.width <= MAX_TEXT_WIDTH:
        print(draw_text(grid, cells))
    print(
        f"{grid.width} x {grid.height} cells, "
        f"path of {len(cells)} from {start} to {goal}"
    )
    length = path_length(cells)
    optimum = shortest_distances(grid, goal, rule)[start[::-1]]
    print(f"length {length:.2f} cells, optimum {optimum:.2f} under {rule.value}")
    field = wait_for("value field", fields.find, children)
    value = np.array(field.data, dtype=np.float32).reshape(grid.height, grid.width)
    value[value < 0] = np.nan
    title = f"{title}: {length:.2f} cells"
    save_picture(picture, grid, cells, value, title, "value field, 100 at the goal")
    print(f"picture: {picture}\n", flush=True)


def main(_: Sequence[str]) -> int:
    """Show a path on each map.

    No process is left behind, also when this one is interrupted.
    """
    with claim_ros_domain():
        for case in CASES:
            with (
                running_node(
                    "map_server_node", yaml_filename=f"{case[0]}.yaml"
                ) as server,
                running_node(
                    "planner_node", model=case[1], path_simplification="none"
                ) as planner,
                Client() as client,
            ):
                show_path(client, case, [server, planner])
    return 0


if __name__ == "__main__":
    run_script(main)
