"""A robot learns by driving where it is slow, with the real nodes."""

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from subprocess import Popen
from typing import Any

import numpy as np
import simulated_robot
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path

from ddqn_planner.experience.drives import ARRIVAL_DISTANCE
from ddqn_planner.grid import Cell
from ddqn_planner.nodes.driving import SLOWEST
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.pictures import save_film
from ddqn_planner.planning import Planner

sys.path.insert(0, str(FilePath(__file__).resolve().parents[1] / "experiments"))
from client import Client, Recorder, cells_of, pose, wait_for
from driving_laws import Float64
from driving_worlds import RULE, Routes, World, generated_world, path_seconds
from figures import ROUTE_STYLES, draw_slowness, draw_times, frame_of
from map_files import save_map
from processes import claim_ros_domain, run_script, running, running_node
from simulated_robot import SEED, WORLD

MISSIONS = 40
LISTENERS = 3  # to goals: the planner, the trainer and the robot
MEAN_OF = 8  # missions that a point of the curve sums up


@dataclass
class Mission:
    """A mission's routes, their true seconds, and the true and learned slowness."""

    routes: Routes
    seconds: dict[str, float]
    measured: float
    truth: Float64
    slowness: Float64

    def ratio(self, name: str) -> float:
        """Return the time of a route over the best possible one."""
        return self.seconds[name] / self.seconds["best possible"]


class Driver:
    """Sends the robot from station to station."""

    def __init__(
        self, client: Client, world: World, children: Sequence[Popen[bytes]]
    ) -> None:
        self.client, self.world, self.children = client, world, children
        self.odometry = client.subscribe(Odometry, "odom", keep=1)
        self.drives = client.subscribe(Path, "trainer/episode")
        self.plans = client.subscribe(Path, "plan", LATCHED, keep=1)
        # The last one: once its latched message comes, the others are connected, too.
        self.slowness = client.subscribe(
            OccupancyGrid, "trainer/slowness", LATCHED, keep=1
        )
        self.planner = Planner.load("any_map")

    def wait(
        self, what: str, recorder: Recorder, is_right: Any = lambda _: True
    ) -> Any:
        """Return the first message that is right."""
        return wait_for(what, lambda: recorder.find(is_right), self.children)

    def now(self) -> float:
        """Return the robot's time."""
        stamp = self.wait("odometry", self.odometry).header.stamp
        return float(stamp.sec + stamp.nanosec / 1e9)

    def known_slowness(self) -> Float64:
        """Return what the trainer says: (H, W)."""
        values = np.array(self.wait("slowness", self.slowness).data).clip(0)
        return np.asarray(
            SLOWEST ** (values.reshape(self.world.grid.occupancy.shape) / 100)
        )

    def drive(self, goal: Cell) -> Mission:
        """Drive to a station, and wait until the planner knows what that taught."""
        grid = self.world.grid
        slowness = self.known_slowness()
        began = self.now()
        self.plans.clear()
        self.drives.clear()
        stamped = pose(grid, goal)
        self.client.publish("goal_pose", stamped, listeners=LISTENERS)
        # The planner may still publish a path to the last goal.
        path = self.wait(
            "plan", self.plans, lambda plan: cells_of(grid, plan)[-1:] == [goal]
        )
        # The first plan may take long, as functions are compiled.
        departed = self.now()
        self.wait(
            "odometry at the goal",
            self.odometry,
            lambda message: _is_at(message.pose, stamped),
        )
        # Other drives end on the way: one that is long, or if the trainer hears the
        # goal late.
        self.wait("drive", self.drives, lambda path: _is_at(path.poses[-1], stamped, 2))
        measured = self.now() - departed
        time.sleep(0.3)  # the planner loads it
        learned = cells_of(grid, path)
        routes = self.world.routes(self.planner, learned[0], goal, began)
        routes = {
            "shortest": routes["shortest"],
            "learned": learned,
            "best possible": routes["best possible"],
        }
        seconds = {
            name: path_seconds(cells, self.world, began)
            for name, cells in routes.items()
        }
        truth = self.world.slowness(began)
        return Mission(routes, seconds, measured, truth, slowness)


def _is_at(stamped: Any, goal: PoseStamped, factor: float = 1) -> bool:
    """Return whether a pose is so near to the goal that the robot has arrived."""
    position = stamped.pose.position
    goal_position = goal.pose.position
    metres = math.hypot(position.x - goal_position.x, position.y - goal_position.y)
    return metres <= factor * ARRIVAL_DISTANCE


def save_pictures(world: World, missions: Sequence[Mission]) -> None:
    """Save a GIF with a frame per mission, a picture and a curve.

    The picture shows the best of the last missions.
    """
    width = min(MEAN_OF, len(missions))
    best = min(
        missions[-width:],
        key=lambda mission: mission.ratio("learned") - mission.ratio("shortest"),
    )
    frames = []
    for number, mission in enumerate(missions, start=1):
        learned = {"learned": mission.routes["learned"]}
        panels = {
            "what nobody told the robot": (mission.truth, mission.routes),
            "what it has learned": (mission.slowness, learned),
        }
        figure: Any = draw_slowness(world.grid, world.stations, panels, (8.4, 4.7))
        ratio = mission.ratio("learned")
        title = f"mission {number}: {ratio:.2f} of the best possible time"
        figure.suptitle(title, fontsize=11)
        frames.append(frame_of(figure))
        if mission is best:
            frames[-1].save("demo_driving.png")
    save_film("demo_driving.gif", frames, 450)
    seconds = {
        name: [np.array([mission.seconds[name] for mission in missions])]
        for name in ROUTE_STYLES
    }
    best_seconds = seconds.pop("best possible")
    curve, _ = draw_times(seconds, best_seconds, width, banded="learned")
    curve.savefig("demo_driving_curve.png", dpi=110)


def mission_count(arguments: Sequence[str]) -> int:
    """Return the number of missions from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "missions",
        nargs="?",
        type=int,
        default=MISSIONS,
        help="how many the robot drives, by default %(default)s",
    )
    count: int = parser.parse_args(arguments).missions
    if count < 1:
        parser.error(f"the number of missions is {count}; give 1 or more")
    return count


def main(arguments: Sequence[str]) -> int:
    """Drive the missions, and save what they show."""
    count = mission_count(arguments)
    world, random = generated_world(WORLD, SEED), np.random.default_rng(SEED)
    # Its route is compared with others cell by cell.
    planning = {
        "start_source": "odometry",
        "move_rule": RULE.value,
        "follow_trainer": True,
    }
    planning["path_simplification"] = "none"
    with tempfile.TemporaryDirectory() as folder, claim_ros_domain():
        map_file = FilePath(folder) / "world.yaml"
        save_map(world.grid, map_file)
        learning = {"learn_from": "driving", "output_folder": f"{folder}/drives"}
        with (
            Client() as client,
            running_node("map_server_node", yaml_filename=map_file) as server,
            running_node("planner_node", **planning) as planner,
            running_node("trainer_node", **learning) as trainer,
            running(sys.executable, simulated_robot.__file__) as robot,
        ):
            driver = Driver(client, world, [server, planner, trainer, robot])
            goal, missions = world.stations[0], list[Mission]()
            for number in range(1, count + 1):
                others = [station for station in world.stations if station != goal]
                goal = others[random.integers(len(others))]
                mission = driver.drive(goal)
                missions.append(mission)
                learned, shortest = (
                    mission.ratio(name) for name in ("learned", "shortest")
                )
                print(
                    f"mission {number:2d}: drove {mission.measured:5.1f} s; "
                    f"its route takes {learned:.2f} of the best possible time, "
                    f"the shortest {shortest:.2f}",
                    flush=True,
                )
    save_pictures(world, missions)
    print("saved demo_driving.gif, demo_driving.png and demo_driving_curve.png")
    return 0


if __name__ == "__main__":
    run_script(main)
