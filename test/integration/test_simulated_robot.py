"""The simulated robot of the driving demo: it follows paths, and asks again where it
cannot.
"""

import sys
from collections.abc import Callable

import numpy as np
import pytest
import simulated_robot
from client import Client
from driving_laws import always
from driving_worlds import World
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from processes import running
from simulated_robot import Robot
from std_msgs.msg import Header

from ddqn_planner.grid import Cell, GridMap, MoveRule, shortest_path


def world(occupancy: np.ndarray, *stations: Cell) -> World:
    law = always(np.ones(occupancy.shape))
    return World(GridMap(occupancy, 0.25), law, [*stations])


def metres(robot: Robot, path: tuple[Cell, ...]) -> np.ndarray:
    return np.array([robot.world.grid.cell_to_world(cell) for cell in path])


@pytest.mark.parametrize("seed", range(3))
def test_a_robot_drives_round_obstacles_and_never_into_one(seed: int) -> None:
    random = np.random.default_rng(seed)
    grid = GridMap(random.random((24, 24)) < 0.25)
    free = grid.free_cells()
    robot = Robot(world(grid.occupancy, free[0]), seed)
    at, drives = free[0], 0
    for _ in range(20):
        goal = free[random.integers(len(free))]
        path = shortest_path(grid, at, goal, MoveRule.ROBOT_SAFE)
        if not path:
            continue
        robot.follow(metres(robot, path))
        while robot.is_driving:
            robot.step()
            assert robot.world.grid.is_free(
                robot.world.grid.world_to_cell(robot.x, robot.y)
            )
        end = robot.world.grid.cell_to_world(goal)
        assert (robot.x, robot.y) == pytest.approx(end)
        at, drives = goal, drives + 1
    assert drives > 5


def test_a_robot_stands_rather_than_to_follow_a_path_beyond_a_wall() -> None:
    occupancy = np.zeros((9, 9), dtype=bool)
    occupancy[4] = True
    robot = Robot(world(occupancy, (4, 3)), 1)
    for row, is_followed in ((5, False), (2, True)):
        robot.follow(metres(robot, tuple((x, row) for x in range(9))))
        robot.step()
        assert robot.is_driving is is_followed


def test_a_robot_without_a_path_asks_again(
    make_client: Callable[[str], Client],
) -> None:
    client = make_client("/stranded")
    goals = client.subscribe(PoseStamped, "goal_pose")
    odometry = client.subscribe(Odometry, "odom", keep=1)
    script = simulated_robot.__file__
    with running(sys.executable, script, "--ros-args", "-r", "__ns:=/stranded"):
        at = odometry.wait().pose.pose.position
        goal = PoseStamped(header=Header(frame_id="map"))
        goal.pose.position.x, goal.pose.position.y = at.x + 5, at.y
        client.publish("goal_pose", goal, listeners=2)
        for _ in range(2):  # its own first goal, and the one that it sends again
            goals.wait(lambda message: message == goal)
            goals.clear()
