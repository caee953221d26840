"""Updates a large costmap 20 times per second, has a plan after each, and checks every plan.

A robot drives through rooms. Obstacles come and go in front of it, on its path, and are inflated as
Nav2 does. Where map_msgs is installed, the planner hears of them by updates of 60 x 60 cells, else
by full costmaps. Give the seconds that it lasts; 60 is the default.
"""

from __future__ import annotations

import array
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from client import (
    Client,
    cell_of,
    cells_of,
    initial_pose,
    map_message,
    plan_request,
    pose,
    values_of,
    wait_for_map,
)
from diagnostic_msgs.msg import DiagnosticArray
from map_fixture import RULE
from nav_msgs.msg import Path
from nav_msgs.srv import GetPlan
from numpy.typing import NDArray
from processes import claim_ros_domain, cpu_seconds, run_script, running_node
from random_maps import generate_map
from std_msgs.msg import Header

from ddqn_planner.grid import Cell, GridMap, clearance
from ddqn_planner.nodes.runtime import LATCHED

try:
    from map_msgs.msg import OccupancyGridUpdate
except ImportError:
    OccupancyGridUpdate = None

SIDE, RESOLUTION = 1000, 0.05
RATE = 20.0
WINDOW = 60
"""Cells per side of an update."""
REACH = 14
"""Cells over which an obstacle is inflated."""
STAY = 20
"""Updates until the window follows the robot."""
OLD = 60
"""Versions of the costmap that an answer may be of."""


def inflated(obstacles: NDArray[np.bool_]) -> NDArray[np.int8]:
    """Return the values of Nav2's costmap for a radius of 0.22 m and an inflation of 0.7 m."""
    metres = clearance(obstacles) * RESOLUTION
    cost = (252 * np.exp(-3 * (metres - 0.22))).clip(1, 252).astype(int)
    values = np.where(metres <= 0.7, 1 + 97 * (cost - 1) // 251, 0)
    values[metres <= 0.22] = 99
    values[obstacles] = 100
    return values.astype(np.int8)


class Costmap:
    """A costmap that changes in a window around a robot."""

    def __init__(self, random: np.random.Generator) -> None:
        self._random = random
        # Rooms of 1.5 to 7.5 m; walls and doors of 0.5 m.
        rooms = generate_map("rooms", (SIDE // 10, SIDE // 10), random)
        self._walls = rooms.repeat(10, axis=0).repeat(10, axis=1)
        self._still = inflated(self._walls)
        self.values = self._still.copy()
        self.corner: Cell = (0, 0)

    def grid(self) -> GridMap:
        """Return which cells are free."""
        return GridMap(self.values >= 99, RESOLUTION)

    def window(self) -> tuple[slice, slice]:
        """Return the box that changes."""
        x, y = self.corner
        return slice(y, y + WINDOW), slice(x, x + WINDOW)

    def follow(self, robot: Cell) -> None:
        """Move the window to the robot."""
        x, y = (min(max(c - WINDOW // 2, REACH), SIDE - WINDOW - REACH) for c in robot)
        self.corner = x, y

    def change(self, robot: Cell, path: NDArray[np.int64], is_clear: bool) -> None:
        """Put obstacles on the path, where they do not touch the robot, in place of the old."""
        box = self.window()
        self.values[box] = self._still[box]
        x, y = self.corner
        in_window = path - (x - REACH, y - REACH)
        inside = ((in_window >= 2 * REACH) & (in_window < WINDOW)).all(axis=1)
        away = np.hypot(*(path - robot).T) > 9
        places = in_window[inside & away]
        if is_clear or not len(places):
            return
        wide = tuple(slice(side.start - REACH, side.stop + REACH) for side in box)
        obstacles = self._walls[wide].copy()
        for place_x, place_y in self._random.choice(places, 2):
            obstacles[place_y : place_y + 2, place_x : place_x + 2] = True
        self.values[box] = inflated(obstacles)[REACH:-REACH, REACH:-REACH]


def error(occupied: NDArray[np.bool_], cells: NDArray[np.int64], start: Cell, goal: Cell) -> str:
    """Say what is wrong with a path on a costmap; "" if nothing is."""
    if tuple(cells[0]) != start or tuple(cells[-1]) != goal:
        return f"a path from {cells[0]} to {cells[-1]}"
    (x, y), (next_x, next_y) = cells[:-1].T, cells[1:].T
    if max(np.abs(next_x - x).max(initial=0), np.abs(next_y - y).max(initial=0)) > 1:
        return "a step that is no move"
    # A diagonal move needs both cells beside it; for a straight one these are its own two.
    passed = occupied[next_y, next_x] | occupied[y, next_x] | occupied[next_y, x]
    return f"through {cells[1:][passed][0]}" if passed.any() else ""


def measure(seconds: float, by_service: bool) -> bool:
    """Drive through a costmap that changes; print a table, and return whether no path was wrong."""
    random = np.random.default_rng(0)
    costmap = Costmap(random)
    grid = costmap.grid()
    free = np.argwhere(grid.reachable([grid.free_cells()[0]], RULE))[:, ::-1]
    robot: Cell = tuple(free[0].tolist())
    costmap.follow(robot)
    goal = sent_goal = robot
    path = np.array([robot])
    milliseconds: list[float] = []
    wrong: list[str] = []
    kept: dict[int, NDArray[np.bool_]] = {}
    none = version = known = 0
    with (
        running_node("planner_node", "--log-level", "error", map_type="costmap") as planner,
        Client() as client,
    ):
        diagnostics = client.subscribe(DiagnosticArray, "/diagnostics", keep=1)
        plans = client.subscribe(Path, "plan")

        def new_plan() -> Path:
            """Return the plan from where the robot is now, by the service or by the topic."""
            if by_service:
                request = plan_request(grid, robot, goal)
                return client.call(GetPlan, "planner/get_plan", request).plan
            if goal != sent_goal:
                client.publish("goal_pose", pose(grid, goal))
            client.publish("initialpose", initial_pose(pose(grid, robot)))
            return plans.wait(
                lambda plan: (
                    not plan.poses
                    or [cell_of(grid, plan.poses[end]) for end in (0, -1)] == [robot, goal]
                )
            )

        def publish(whole: bool) -> None:
            stamp = Time(sec=version)
            kept[version] = costmap.values >= 99
            kept.pop(version - OLD, None)
            if whole or OccupancyGridUpdate is None:
                client.publish("map", map_message(costmap.values, grid, version), LATCHED)
                return
            update: Any = OccupancyGridUpdate(header=Header(frame_id="map", stamp=stamp))
            update.x, update.y = costmap.corner
            update.width = update.height = WINDOW
            update.data = array.array("b", costmap.values[costmap.window()].tobytes())
            client.publish("map_updates", update)

        version = 1
        publish(whole=True)
        wait_for_map(diagnostics, Time(sec=1))
        began = time.monotonic()
        computed = cpu_seconds(planner.pid)
        while (now := time.monotonic()) < began + seconds:
            if np.hypot(*np.subtract(goal, robot)) < 100:
                goal = tuple(random.choice(free).tolist())
            if version % STAY == 0:
                costmap.follow(robot)
            costmap.change(robot, path, is_clear=version % STAY >= STAY - 1)
            heard = diagnostics.find()
            if heard:
                known = int(float(values_of(heard.status[0])["map stamp (s)"]))
            version += 1
            plans.clear()
            publish(whole=False)
            asked = time.perf_counter()
            answer, sent_goal = new_plan(), goal
            milliseconds.append(1e3 * (time.perf_counter() - asked))
            cells = np.array(cells_of(grid, answer))
            if len(cells):
                possible = [v for v in kept if v >= known]
                errors = [error(kept[v], cells, robot, goal) for v in possible]
                if all(errors):
                    wrong.append(f"on costmap {version}: {errors[-1]}")
                path = cells
                robot = tuple(cells[min(1, len(cells) - 1)].tolist())
            else:
                none += 1
                goal = robot
            time.sleep(max(0.0, now + 1 / RATE - time.monotonic()))
        took = time.monotonic() - began
        share = (cpu_seconds(planner.pid) - computed) / took
    for line in wrong[:10]:
        print(line)
    kind = "full costmaps" if OccupancyGridUpdate is None else f"updates of {WINDOW} x {WINDOW}"
    median, slow = np.percentile(milliseconds, (50, 99))
    print(
        f"{SIDE} x {SIDE} cells, {version - 1} {kind} in {took:.0f} s, {(version - 1) / took:.1f} "
        f"per second, a plan after each by {'get_plan' if by_service else 'the topic plan'}\n"
        f"  paths {len(milliseconds) - none}, none {none}, wrong {len(wrong)}\n"
        f"  latency median {median:.1f} ms, 99 % {slow:.1f} ms\n"
        f"  the planner computes {share:.2f} of the time of one core",
        flush=True,
    )
    return not wrong


def main(arguments: Sequence[str]) -> int:
    """Run a planner node on a costmap that changes; return 1 if a path is wrong."""
    with claim_ros_domain():
        seconds = float(arguments[0]) if arguments else 60.0
        return int(not all(measure(seconds, by_service) for by_service in (False, True)))


if __name__ == "__main__":
    run_script(main)
