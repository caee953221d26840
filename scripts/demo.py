"""Starts the map server and the planner, asks for a path over ROS, and shows it, on two maps.

Both nodes are processes of their own, in a ROS domain of their own. Start and goal are published
as `ros2 topic pub` would. No process is left behind, also when this one is interrupted.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from subprocess import Popen

import numpy as np
from client import Client, cells_of, initial_pose, pose, values_of, wait_for
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid, Path
from processes import claim_ros_domain, run_script, running_node

from ddqn_planner.grid import Cell, MoveRule, path_length, read_map_file, shortest_distances
from ddqn_planner.nodes.conversions import grid_from_message
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.pictures import MAX_TEXT_WIDTH, draw_text, save_picture
from ddqn_planner.resources import find_map


@dataclass(frozen=True)
class Case:
    """A map, and the shipped model that plans on it."""

    map_name: str
    model: str
    move_rule: MoveRule
    title: str
    picture: str


CASES = (
    Case("dilemma", "dilemma", MoveRule.CORNER_CUTTING, "The paper's network", "demo.png"),
    Case("office", "any_map", MoveRule.ROBOT_SAFE, "A map never seen", "demo_office.png"),
)


def start_and_goal(map_name: str) -> tuple[Cell, Cell]:
    """Return the start and the goal of a shipped map."""
    map_file = read_map_file(find_map(map_name))
    assert map_file.start is not None
    assert map_file.goal is not None
    return map_file.start, map_file.goal


def show_path(client: Client, case: Case, children: Sequence[Popen[bytes]], began: float) -> None:
    """Ask for a path; print it with its times, and draw it."""
    maps = client.subscribe(OccupancyGrid, "map", LATCHED)
    plans = client.subscribe(Path, "plan", LATCHED)
    fields = client.subscribe(OccupancyGrid, "planner/value", LATCHED)
    diagnostics = client.subscribe(DiagnosticArray, "/diagnostics")
    grid = grid_from_message(wait_for("map", maps.find, children))
    start, goal = start_and_goal(case.map_name)
    stamped = pose(grid, start)
    client.publish("initialpose", initial_pose(stamped))
    # The planner has to know the start before it gets the goal, else it plans twice, and reports
    # the second plan, which finds its field ready.
    wait_for("start", lambda: client.get_plan(PoseStamped(), stamped).poses, children)
    client.publish("goal_pose", pose(grid, goal))
    plan = wait_for("plan", lambda: plans.find(lambda plan: plan.poses), children)
    seconds = time.monotonic() - began

    cells = cells_of(grid, plan)
    length = path_length(cells, case.move_rule)
    optimum = shortest_distances(grid, goal, case.move_rule)[start[1], start[0]]
    if grid.width <= MAX_TEXT_WIDTH:
        print(draw_text(grid, cells))
        print("path: " + " ".join(f"({x}, {y})" for x, y in cells))
    else:
        print(f"{grid.width} x {grid.height} cells, path of {len(cells)} from {start} to {goal}")
    print(f"length {length:.2f} cells, optimum {optimum:.2f} under {case.move_rule.value}")

    def times() -> dict[str, str] | None:
        values = (values_of(message.status[0]) for message in diagnostics.messages())
        return next((v for v in values if v["path length (cells)"] == f"{length:.3f}"), None)

    found = wait_for("diagnostics", times, children)
    planned = sum(float(found[f"{part} time (ms)"]) for part in ("field", "rollout"))
    print(f"planned in {planned:.1f} ms; first plan {seconds:.1f} s after the nodes were started")
    value = wait_for("value field", fields.find, children)
    values = np.array(value.data, dtype=np.float32).reshape(grid.height, grid.width)
    values[values < 0] = np.nan
    title = f"{case.title}: {length:.2f} cells"
    save_picture(case.picture, grid, cells, values, title, "value field, 100 at the goal")
    print(f"picture: {case.picture}\n", flush=True)


def main(_: Sequence[str]) -> int:
    """Show a path on each map."""
    with claim_ros_domain():
        for case in CASES:
            began = time.monotonic()
            with (
                Client() as client,
                running_node("map_server_node", yaml_filename=f"{case.map_name}.yaml") as server,
                running_node("planner_node", model=case.model) as planner,
            ):
                show_path(client, case, [server, planner], began)
    return 0


if __name__ == "__main__":
    run_script(main)
