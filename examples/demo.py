"""Starts the map server and the planner, asks for a path over ROS, and shows it, on two maps."""

import sys
import time
from collections.abc import Sequence
from pathlib import Path as FilePath
from subprocess import Popen

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid, Path

from ddqn_planner.grid import MoveRule, path_length, read_map_file, shortest_distances
from ddqn_planner.nodes.conversions import grid_from_message
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.pictures import MAX_TEXT_WIDTH, draw_text, save_picture
from ddqn_planner.resources import find_map

sys.path.insert(0, str(FilePath(__file__).resolve().parents[1] / "experiments"))
from client import Client, cells_of, initial_pose, pose, values_of, wait_for
from processes import claim_ros_domain, run_script, running_node

# A map, the shipped model that plans on it, its move rule, and the picture's title and file.
Case = tuple[str, str, MoveRule, str, str]
CASES: tuple[Case, ...] = (
    ("dilemma", "dilemma", MoveRule.CORNER_CUTTING, "The paper's network", "demo.png"),
    ("office", "any_map", MoveRule.ROBOT_SAFE, "A map never seen", "demo_office.png"),
)


def show_path(client: Client, case: Case, children: Sequence[Popen[bytes]]) -> None:
    """Ask for a path as `ros2 topic pub` would; print it with its times, and draw it."""
    began, (map_name, _, rule, title, picture) = time.monotonic(), case
    maps = client.subscribe(OccupancyGrid, "map", LATCHED)
    plans = client.subscribe(Path, "plan", LATCHED)
    fields = client.subscribe(OccupancyGrid, "planner/value", LATCHED)
    diagnostics = client.subscribe(DiagnosticArray, "/diagnostics")
    grid = grid_from_message(wait_for("map", maps.find, children))
    map_file = read_map_file(find_map(map_name))
    start, goal = map_file.start or (0, 0), map_file.goal or (0, 0)
    stamped = pose(grid, start)
    client.publish("initialpose", initial_pose(stamped))
    # The planner has to know the start before it gets the goal, else it plans twice, and reports
    # the second plan, which finds its field ready.
    wait_for("start", lambda: client.get_plan(PoseStamped(), stamped).poses, children)
    client.publish("goal_pose", pose(grid, goal))
    plan = wait_for("plan", lambda: plans.find(lambda plan: plan.poses), children)
    seconds = time.monotonic() - began

    cells = cells_of(grid, plan)
    length = path_length(cells, rule)
    optimum = shortest_distances(grid, goal, rule)[start[::-1]]
    if grid.width <= MAX_TEXT_WIDTH:
        print(draw_text(grid, cells))
        print("path: " + " ".join(f"({x}, {y})" for x, y in cells))
    else:
        print(f"{grid.width} x {grid.height} cells, path of {len(cells)} from {start} to {goal}")
    print(f"length {length:.2f} cells, optimum {optimum:.2f} under {rule.value}")

    def times() -> dict[str, str] | None:
        values = (values_of(message.status[0]) for message in diagnostics.messages())
        return next((v for v in values if v["path length (cells)"] == f"{length:.3f}"), None)

    found = wait_for("diagnostics", times, children)
    planned = sum(float(found[f"{part} time (ms)"]) for part in ("field", "rollout"))
    print(f"planned in {planned:.1f} ms; first plan {seconds:.1f} s after the nodes were started")
    field = wait_for("value field", fields.find, children)
    value = np.array(field.data, dtype=np.float32).reshape(grid.height, grid.width)
    value[value < 0] = np.nan
    title = f"{title}: {length:.2f} cells"
    save_picture(picture, grid, cells, value, title, "value field, 100 at the goal")
    print(f"picture: {picture}\n", flush=True)


def main(_: Sequence[str]) -> int:
    """Show a path on each map; no process is left behind, also when this one is interrupted."""
    with claim_ros_domain():
        for case in CASES:
            with (
                running_node("map_server_node", yaml_filename=f"{case[0]}.yaml") as server,
                running_node("planner_node", model=case[1]) as planner,
                Client() as client,
            ):
                show_path(client, case, [server, planner])
    return 0


if __name__ == "__main__":
    run_script(main)
