"""A robot learns by driving where it is slow: 40 missions, with the real nodes, in two minutes.

It starts the map server, the planner, the trainer and a simulated robot, each as a process of its
own, in a ROS domain of their own, and sends goals. It saves a film of the missions, a picture of
what the robot learned, and a curve of the true time of its routes over the best possible. With a
number, so many missions.
"""

from __future__ import annotations

import math
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from subprocess import Popen
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from geometry_msgs.msg import PoseStamped
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.patheffects import withStroke
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from numpy.typing import NDArray
from PIL import Image

from ddqn_planner.experience.drives import ARRIVAL_DISTANCE
from ddqn_planner.grid import Cell, GridMap, MoveRule, save_map
from ddqn_planner.nodes.driving import SLOWEST
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.pictures import draw_obstacles
from ddqn_planner.planning import Planner

sys.path.insert(0, str(FilePath(__file__).resolve().parents[1] / "experiments"))
from client import Client, Recorder, cells_of, pose, wait_for
from driving_worlds import World, generated_world, path_seconds
from processes import claim_ros_domain, run_script, running, running_node

WORLD, SEED, SPEED_UP = "office", 9, 40.0
MISSIONS = 40
RULE = MoveRule.ROBOT_SAFE
LISTENERS = 3
"""To goals: the planner, the trainer and the robot."""

MEAN_OF = 8
"""Missions that a point of the curve sums up."""

COLOURS = {"shortest": "#555555", "learned": "#0072B2", "best possible": "#CC79A7"}
STYLES = {"shortest": ":", "learned": "-", "best possible": "--"}
Routes = dict[str, Sequence[Cell]]


@dataclass
class Mission:
    """The routes of a mission, their true seconds, and what the trainer knew before."""

    routes: Routes
    seconds: dict[str, float]
    measured: float
    truth: NDArray[np.float64]
    slowness: NDArray[np.float64]


class Driver:
    """Sends the robot from station to station."""

    def __init__(self, client: Client, world: World, children: Sequence[Popen[bytes]]) -> None:
        self.client, self.world, self.children = client, world, children
        self.odometry = client.subscribe(Odometry, "odom", keep=1)
        self.drives = client.subscribe(Path, "trainer/episode")
        self.plans = client.subscribe(Path, "plan", LATCHED, keep=1)
        # The last one: once its latched message comes, the others are connected, too.
        self.slowness = client.subscribe(OccupancyGrid, "trainer/slowness", LATCHED, keep=1)
        self.planner = Planner.load("any_map")
        self.at = world.stations[0]

    def wait(self, what: str, recorder: Recorder, is_right: Any = lambda _: True) -> Any:
        """Return the first message that is right."""
        return wait_for(what, lambda: recorder.find(is_right), self.children)

    def now(self) -> float:
        """Return the robot's time."""
        stamp = self.wait("odometry", self.odometry).header.stamp
        return float(stamp.sec + stamp.nanosec / 1e9)

    def plan(self, grid: GridMap, start: Cell, goal: Cell) -> tuple[Cell, ...]:
        """Return the path on a map."""
        return self.planner.plan(grid, start, goal, RULE, start_clearing_radius=1).cells

    def known_slowness(self) -> NDArray[np.float64]:
        """Return what the trainer says: (H, W)."""
        message = self.wait("slowness", self.slowness)
        shape = self.world.grid.occupancy.shape
        return np.asarray(SLOWEST ** (np.array(message.data).reshape(shape).clip(0) / 100))

    def drive(self, goal: Cell) -> Mission:
        """Drive to a station, and wait until the planner knows what that taught."""
        world, grid = self.world, self.world.grid
        slowness, began = self.known_slowness(), self.now()
        truth = world.slowness(began)
        self.plans.clear()
        self.drives.clear()
        stamped = pose(grid, goal)
        self.client.publish("goal_pose", stamped, listeners=LISTENERS)
        # The planner may still publish a path to the last goal.
        path = self.wait("plan", self.plans, lambda plan: cells_of(grid, plan)[-1:] == [goal])
        cells = cells_of(grid, path)
        self.wait("odometry at the goal", self.odometry, lambda at: _is_at(at.pose, stamped))
        # Other drives end on the way: one that is long, or if the trainer hears the goal late.
        self.wait("drive", self.drives, lambda path: _is_at(path.poses[-1], stamped, 2))
        measured = self.now() - began
        time.sleep(0.3)  # the planner loads it
        self.at = goal
        routes = {
            "shortest": self.plan(grid, cells[0], goal),
            "learned": cells,
            "best possible": self.plan(world.known(began), cells[0], goal),
        }
        seconds = {name: path_seconds(cells, truth, grid) for name, cells in routes.items()}
        return Mission(routes, seconds, measured, truth, slowness)


def _is_at(stamped: Any, goal: PoseStamped, factor: float = 1) -> bool:
    """Return whether a pose is so near to the goal that the robot has arrived."""
    at, there = stamped.pose.position, goal.pose.position
    return math.dist((at.x, at.y), (there.x, there.y)) <= factor * ARRIVAL_DISTANCE


def draw(axes: Any, world: World, slowness: NDArray[np.float64], routes: Routes) -> Any:
    """Draw slowness and routes."""
    shown = np.where(world.grid.occupancy, np.nan, slowness)
    image = axes.imshow(shown, origin="lower", cmap="YlOrRd", norm=LogNorm(1, SLOWEST))
    draw_obstacles(axes, world.grid)
    for name, cells in routes.items():
        outline = [withStroke(linewidth=4, foreground="white")]
        style = {"color": COLOURS[name], "label": name, "path_effects": outline}
        axes.plot(*np.transpose(cells), STYLES[name], linewidth=2.2, **style)
    axes.scatter(*np.transpose(world.stations), 30, color="black", zorder=4)
    axes.set(xticks=[], yticks=[])
    return image


def save_film(path: FilePath, world: World, missions: Sequence[Mission]) -> None:
    """Save a GIF with a frame per mission."""
    frames = []
    for number, mission in enumerate(missions, start=1):
        figure, both = plt.subplots(1, 2, figsize=(8.4, 4.7), layout="constrained")
        draw(both[0], world, mission.truth, mission.routes)
        both[0].set_title("what nobody told the robot", loc="left", fontsize=10)
        draw(both[1], world, mission.slowness, {"learned": mission.routes["learned"]})
        both[1].set_title("what it has learned", loc="left", fontsize=10)
        ratio = mission.seconds["learned"] / mission.seconds["best possible"]
        figure.suptitle(f"mission {number}: {ratio:.2f} of the best possible time", fontsize=11)
        figure.legend(*both[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        canvas: Any = FigureCanvasAgg(figure)
        canvas.draw()
        image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        frames.append(image.quantize(64))
        plt.close(figure)
    times = [1200 if number in (0, len(frames) - 1) else 450 for number in range(len(frames))]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=times, loop=0)


def save_picture(path: FilePath, world: World, driver: Driver) -> None:
    """Save true and learned slowness, with the routes of the mission where it matters most."""
    truth, learned = world.slowness(driver.now()), driver.known_slowness()
    known = world.grid.with_slowness(truth.astype(np.float32), 0.5)
    pairs = [(a, b) for a in world.stations for b in world.stations if a < b]

    def lost(pair: tuple[Cell, Cell]) -> float:
        return float(
            path_seconds(driver.plan(world.grid, *pair), truth, world.grid)
            - path_seconds(driver.plan(known, *pair), truth, world.grid)
        )

    start, goal = max(pairs, key=lost)
    asked = driver.client.get_plan(pose(world.grid, start), pose(world.grid, goal))
    routes = {
        "shortest": driver.plan(world.grid, start, goal),
        "learned": cells_of(world.grid, asked),
        "best possible": driver.plan(known, start, goal),
    }
    figure, both = plt.subplots(1, 2, figsize=(11, 5.6), layout="constrained")
    for axes, slowness, title in (
        (both[0], truth, "true slowness, which nobody told the robot"),
        (both[1], learned, "what it learned by driving"),
    ):
        image = draw(axes, world, slowness, routes)
        axes.set_title(title, loc="left", fontsize=11)
    bar = figure.colorbar(image, ax=both, label="seconds over seconds at nominal speed", shrink=0.8)
    bar.set_ticks([1, 2, 5, 10], labels=["1", "2", "5", "10"])
    bar.minorticks_off()
    figure.legend(*both[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def save_curve(path: FilePath, missions: Sequence[Mission]) -> None:
    """Save the true time of the routes over the best possible, from mission to mission."""
    figure, axes = plt.subplots(figsize=(7.2, 3.6), layout="constrained")
    width = min(MEAN_OF, len(missions))
    seconds = {
        name: np.convolve([m.seconds[name] for m in missions], np.ones(width), mode="valid")
        for name in COLOURS
    }
    for name in ("shortest", "learned"):
        ratio = seconds[name] / seconds["best possible"]
        number = np.arange(len(ratio)) + width
        axes.plot(number, ratio, STYLES[name], color=COLOURS[name], linewidth=2, label=name)
    axes.axhline(1, color="black", linewidth=0.8)
    axes.set(xlabel=f"mission (mean of the last {width})", ylabel="true time over the best")
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(arguments: Sequence[str]) -> int:
    """Drive the missions, and save what they show."""
    count = int(arguments[0]) if arguments else MISSIONS
    world = generated_world(WORLD, SEED)
    robot = [sys.executable, str(FilePath(__file__).with_name("simulated_robot.py")), "--ros-args"]
    for name, value in {"world": WORLD, "seed": SEED, "speed_up": SPEED_UP}.items():
        robot += ["-p", f"{name}:={value}"]
    random = np.random.default_rng(SEED)
    with tempfile.TemporaryDirectory() as folder, claim_ros_domain():
        map_file = FilePath(folder) / "world.yaml"
        save_map(world.grid, map_file)
        drives = f"{folder}/drives"
        with (
            Client() as client,
            running_node("map_server_node", yaml_filename=map_file) as server,
            running_node(
                "planner_node", start_source="odometry", move_rule=RULE.value, follow_trainer=True
            ) as planner,
            running_node("trainer_node", learn_from="driving", output_folder=drives) as trainer,
            running(*robot) as robot_process,
        ):
            driver = Driver(client, world, [server, planner, trainer, robot_process])
            missions: list[Mission] = []
            for number in range(1, count + 1):
                others = [station for station in world.stations if station != driver.at]
                missions.append(driver.drive(others[random.integers(len(others))]))
                each = missions[-1].seconds
                print(
                    f"mission {number:2d}: drove {missions[-1].measured:5.1f} s; its route takes "
                    f"{each['learned'] / each['best possible']:.2f} of the best possible time, the "
                    f"shortest {each['shortest'] / each['best possible']:.2f}",
                    flush=True,
                )
            save_picture(FilePath("demo_driving.png"), world, driver)
    save_film(FilePath("demo_driving.gif"), world, missions)
    save_curve(FilePath("demo_driving_curve.png"), missions)
    print("saved demo_driving.gif, demo_driving.png and demo_driving_curve.png")
    return 0


if __name__ == "__main__":
    run_script(main)
