"""The trainer that learns from driving, and the planner that follows it: real nodes
over DDS.
"""

from __future__ import annotations

import math
import re
import resource
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus, GoalStatusArray
from builtin_interfaces.msg import Time
from client import Client, initial_pose, map_message, pose, values_of, wait_for
from geometry_msgs.msg import Point, Pose, PoseStamped
from integration.robot import changed
from integration.user import SOON, User, limited
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Header, UInt8MultiArray

from ddqn_planner import Experience, GridMap
from ddqn_planner.experience.drives import read_drives
from ddqn_planner.nodes.conversions import (
    CHANGES,
    bytes_message,
    bytes_of,
    has_changes,
)
from ddqn_planner.nodes.driving import NAVIGATION
from ddqn_planner.nodes.expected_times import ASK_PERIOD
from ddqn_planner.nodes.quality import LATCHED

VALUES = np.zeros((40, 100), dtype=np.int8)
VALUES[16:26, 15:85] = 100
GRID = GridMap(VALUES > 0, resolution=0.25)
"""A block with a way around it on each side; the lower one is shorter."""

START, GOAL = (3, 18), (96, 18)
UPPER = [(0.875, 4.625), (3.0, 7.5), (22.0, 7.5), (24.125, 4.625)]
LOWER = [(0.875, 4.625), (3.0, 3.5), (22.0, 3.5), (24.125, 4.625)]
"""Metres: from the start to the goal below the block."""

BEST_EFFORT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
OLD_FILE = FilePath(__file__).parents[1] / "experience" / "with_directions.npz"
NAMESPACE = "/drives"  # of the trainer and the planner that most tests share


class Site(User):
    """The user of a trainer that learns from driving: it says where the robot is."""

    def __init__(self, client: Client, folder: FilePath, robot: str = "") -> None:
        super().__init__(client, "driving", "trainer/experience_saved")
        self.folder, self.now, self.at = folder, time.monotonic(), LOWER[0]
        self.robot, self.space = f" {robot}".rstrip(), f"{robot}/".lstrip("/")
        self.experience = client.subscribe(
            UInt8MultiArray, "trainer/experience", LATCHED
        )
        self.slowness = client.subscribe(OccupancyGrid, "trainer/slowness", LATCHED)

    def begin(self, listeners: int = 1) -> None:
        """Send the map, and wait until the trainer has it and records."""
        self.client.publisher(Odometry, f"{self.space}odom", BEST_EFFORT)
        self.client.wait_for_discovery("trainer")
        self.client.publish("map", map_message(VALUES, GRID), LATCHED, listeners)
        self.state(state="recording", message="^recording")

    def odometry(self, x: float, y: float) -> Odometry:
        stamp = Time(sec=int(self.now), nanosec=int(1e9 * (self.now % 1)))
        message = Odometry(header=Header(stamp=stamp, frame_id="map"))
        message.pose.pose.position = Point(x=x, y=y)
        return message

    def send(self, message: Odometry) -> None:
        self.client.publish(f"{self.space}odom", message, BEST_EFFORT)

    def send_goal(self, x: float, y: float) -> None:
        """Send a goal, and wait until the trainer has it: poses may overtake it."""
        goal = PoseStamped(
            header=Header(frame_id="map"), pose=Pose(position=Point(x=x, y=y))
        )
        self.client.publish(f"{self.space}goal_pose", goal)
        self.state(**{f"goal{self.robot}": re.escape(f"({x:.6g}, {y:.6g})")})

    def move(self, points: list[tuple[float, float]], speed: float) -> None:
        """Drive along a line in steps of 0.1 m."""
        self.send(self.odometry(*self.at))
        for point in points:
            distance = math.dist(self.at, point)
            steps = max(round(distance / 0.1), 1)
            for there in np.linspace(self.at, point, steps + 1)[1:].tolist():
                self.now += distance / steps / speed
                self.send(self.odometry(*there))
            self.at = point
        wait_for("the robot's place", self.is_seen)

    def is_seen(self) -> bool:
        """Return whether the trainer knows where the robot is; else send it again."""
        place = re.escape("({:.6g}, {:.6g})".format(*self.at))
        with suppress(TimeoutError):
            return bool(self.state(timeout=5.0, **{f"robot{self.robot}": place}))
        self.now += 0.1
        self.send(self.odometry(*self.at))  # the last pose may be lost
        return False

    def drive(
        self, points: list[tuple[float, float]], speed: float, then: Any = lambda: None
    ) -> Path:
        """Drive to a goal and stand there; return the episode of it."""
        self.episodes.clear()
        self.saved.clear()
        self.send_goal(*points[-1])
        self.move(points, speed)

        def ends() -> Path | None:
            self.now += 0.1
            self.send(self.odometry(*self.at))
            then()
            time.sleep(0.01)
            return self.episodes.find()

        episode = wait_for("episode", ends)
        self.saved.wait()
        return episode

    def experience_after(self, changes: UInt8MultiArray) -> Experience:
        """Send changes that the planner cannot use; return what it then gets.

        They are sent again each second: the planner may get them before an experience
        that the trainer sent earlier, since two nodes send to one topic.
        """
        self.experience.clear()

        def experience() -> UInt8MultiArray | None:
            self.client.publish("trainer/experience", changes, LATCHED)
            with suppress(TimeoutError):
                return self.experience.wait(is_whole, timeout=1)
            return None

        whole = bytes_of("experience", wait_for("the experience", experience))
        return Experience.from_bytes(whole)

    def is_silent(self) -> bool:
        """Return whether no planner has asked for the experience for a while."""
        self.experience.clear()
        time.sleep(1.5 * ASK_PERIOD)
        return not self.experience.messages()

    def record_in(self, folder: FilePath) -> None:
        self.client.set_parameters("trainer", output_folder=str(folder))
        self.folder = folder

    @property
    def outcomes(self) -> list[str]:
        return [
            drive.outcome.value for drive in read_drives(self.folder / "episodes.csv")
        ]

    def learned(self) -> np.ndarray:
        return Experience.load(self.folder / "experience.npz").slowness(GRID)


@pytest.fixture(scope="module")
def run_trainer(run_node: Any) -> Callable[..., Any]:
    def run(
        folder: FilePath,
        namespace: str,
        exit_code: int = 0,
        robots: Any = ("",),
        **modules: str,
    ) -> Any:
        given = {
            "learn_from": "driving",
            "output_folder": str(folder),
            "replay_period": 0.002,
        }
        modules |= {"sitecustomize": SOON}
        parameters = {**given, "robots": [*robots]}
        return run_node("trainer_node", parameters, (), namespace, exit_code, **modules)

    return run


@pytest.fixture(scope="module")
def trainer(
    run_trainer: Any, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Any]:
    with run_trainer(tmp_path_factory.mktemp("first") / "drives", NAMESPACE) as node:
        yield node


@pytest.fixture(scope="module")
def planner(run_node: Any) -> Iterator[Any]:
    parameters = {"follow_trainer": True, "move_rule": "robot_safe"}
    with run_node("planner_node", parameters, namespace=NAMESPACE) as node:
        yield node


@pytest.fixture(scope="module")
def client(make_client: Any) -> Client:
    return make_client(NAMESPACE)


@pytest.fixture
def site(trainer: Any, client: Client, tmp_path: FilePath) -> Iterator[Site]:
    """The user of the shared trainer, which records in a new folder."""
    site = Site(client, tmp_path / "drives")
    site.call("stop")
    trainer.forget_log()
    site.record_in(site.folder)
    site.call("start")
    site.begin()
    yield site
    assert "Traceback" not in trainer.log


def is_whole(message: UInt8MultiArray) -> bool:
    return not has_changes(message)


def is_below(path: Path) -> bool:
    return len(path.poses) > 0 and all(it.pose.position.y < 5 for it in path.poses)


def is_above(path: Path) -> bool:
    return len(path.poses) > 0 and all(it.pose.position.y > 4 for it in path.poses)


def test_the_robot_goes_round_what_was_slow_until_it_forgets(
    planner: Any, site: Site
) -> None:
    site.begin(listeners=2)
    plans = site.client.subscribe(Path, "plan", LATCHED)
    ends = pose(GRID, START), pose(GRID, GOAL)
    wait_for("first way", lambda: is_below(site.client.get_plan(*ends)))

    site.drive(UPPER, speed=0.5)
    site.drive(UPPER[::-1], speed=0.5)
    episode = site.drive(LOWER, speed=0.1)
    assert episode.header.frame_id == "map"
    first, last = episode.poses[0].pose.position, episode.poses[-1].pose.position
    assert (first.x, first.y) == pytest.approx(LOWER[0], abs=0.2)
    assert (last.x, last.y) == pytest.approx(LOWER[-1], abs=0.1)
    *_, drive = read_drives(site.folder / "episodes.csv")
    assert drive.metres == pytest.approx(23.8, abs=0.5)
    assert drive.seconds[-1] - drive.seconds[0] == pytest.approx(238, abs=10)

    assert site.saved.wait().data == str(site.folder / "experience.npz")
    # After each drive, the trainer tells what has changed alone.
    assert len(site.experience.wait(has_changes).data) < 20_000
    slowness = site.learned()
    assert slowness[14, 50] > 2
    shown = site.slowness.wait(lambda message: max(message.data) > 40)
    values = np.array(shown.data).reshape(VALUES.shape)
    assert (values[VALUES > 0] == -1).all()
    assert values[14, 50] == pytest.approx(100 * math.log10(slowness[14, 50]), abs=1)
    assert values[30, 50] < 10

    wait_for("other way", lambda: not is_below(site.client.get_plan(*ends)))
    site.client.publish("initialpose", initial_pose(ends[0]))
    site.client.publish("goal_pose", ends[1], listeners=2)
    length = 0.25 * len(plans.wait(lambda plan: len(plan.poses) > 50).poses)
    key = "expected time (s)"
    forecast = site.diagnostics.wait(lambda array: key in values_of(array.status[0]))
    assert float(values_of(forecast.status[0])[key]) > length / 0.5 * 0.8

    broken = bytes_message(
        "experience", (site.folder / "experience.npz").read_bytes()[:-20]
    )
    site.client.publish("trainer/experience", broken, LATCHED)
    planner.wait_for_log("experience refused: no experience")
    assert not is_below(site.client.get_plan(*ends))

    # Changes of what the planner does not know: as if it had missed a message.
    unknown = Experience(nominal_speed=0.5)
    state = unknown.state
    unknown.record_failure((5.0, 5.0))
    changes = unknown.changes_since(state)
    assert changes is not None
    for data in (changes, changes[:-20]):  # or as if another version had written it
        known = site.experience_after(bytes_message(CHANGES, data)).evidence
        assert known.driven == pytest.approx(330, rel=0.1)
    wait_for("end of questions", site.is_silent)
    assert not is_below(site.client.get_plan(*ends))

    site.episodes.clear()
    site.call("replay")
    site.episodes.wait(lambda path: len(path.poses) == 3)
    site.episodes.wait(lambda path: len(path.poses) > 40)

    site.slowness.clear()
    assert "experience_forgotten.npz has what was known" in site.call("forget")
    site.slowness.wait(lambda message: max(message.data) == 0)
    wait_for("first way", lambda: is_below(site.client.get_plan(*ends)))
    kept = str(site.folder / "experience_forgotten.npz")
    assert site.client.set_parameters("planner", experience=kept)
    wait_for("other way", lambda: not is_below(site.client.get_plan(*ends)))
    # The file of an older version, of places far from both ways.
    assert site.client.set_parameters("planner", experience=str(OLD_FILE))
    wait_for("first way", lambda: is_below(site.client.get_plan(*ends)))
    assert site.client.set_parameters("planner", experience="")
    wait_for("first way", lambda: is_below(site.client.get_plan(*ends)))
    assert site.outcomes == ["arrived"] * 3


def test_recording_stops_and_continues_unless_the_experience_is_broken(
    site: Site,
) -> None:
    assert "call ~/stop first" in site.refusal()
    site.move(LOWER[1:2], 0.1)
    assert "stopped after drive 1" in site.call("stop")
    for service in ("save", "forget"):
        assert "call ~/start first" in site.call(service, succeeds=False)
    assert "no drives were being recorded" in site.call("stop")
    file = site.folder / "experience.npz"
    file.write_bytes(broken := file.read_bytes()[:-20])
    assert "experience.npz: cannot be read" in site.refusal()
    site.state(state="failed", message="experience.npz: cannot be read")
    assert file.read_bytes() == broken
    file.unlink()
    assert "after drive 1" in site.call("start")
    assert site.learned()[16, 7] > 2  # from the record
    site.move(LOWER[2:3], 0.5)
    site.call("stop")
    assert site.outcomes == ["stopped", "stopped"]


def test_who_gives_up_ends_the_drive_and_moves_fail_there(site: Site) -> None:
    def send(*numbers: int) -> None:
        for number in numbers:
            message = GoalStatusArray(
                status_list=[GoalStatus(status=GoalStatus.STATUS_ABORTED)]
            )
            message.status_list[0].goal_info.goal_id.uuid = [number] * 16
            site.client.publish(NAVIGATION, message, LATCHED)

    site.move(LOWER[:1], 0.5)
    send(1)  # before: nobody knows where
    site.client.wait_for_discovery("trainer")
    site.call(
        "save"
    )  # what came before it is done: the goal may not overtake the status
    site.send_goal(*LOWER[3])
    site.drive(LOWER[1:3], 0.5, then=lambda: send(1, 2))
    assert site.outcomes == ["aborted"]
    slowness = site.learned()
    assert slowness[14, 87] > slowness[14, 50]


def test_malformed_odometry_is_refused_and_the_next_is_taken(
    site: Site, trainer: Any
) -> None:
    for field, value, reason in (
        (
            "header.frame_id",
            "odom",
            "frame is 'odom', (the map's is 'map'|and no transform leads)",
        ),
        ("header.stamp", Time(), "has no stamp"),
        (
            "pose.pose.position.x",
            math.nan,
            r"\(nan, 1.0\).*give finite numbers|x = nan",
        ),
        ("pose.pose.position.x", 1e300, r"\(1e\+300, 1.0\).*give finite numbers"),
    ):
        trainer.forget_log()
        for _ in range(5):
            site.send(changed(site.odometry(1.0, 1.0), field, value))
        site.state(state="recording", message=f"odom refused: .*({reason})")
        assert trainer.log.count("odom refused") == 1
        site.move(LOWER[1:2], 0.5)
        site.state(state="recording", message="^recording$")
    site.call("stop")
    assert site.outcomes == ["stopped"]


def test_nothing_is_lost_while_the_disk_is_full(site: Site, trainer: Any) -> None:
    site.drive(LOWER[:2], 0.1)
    size = (site.folder / "episodes.csv").stat().st_size + 10
    trainer.forget_log()  # it is limited, too
    with limited(trainer.process, resource.RLIMIT_FSIZE, size):
        site.move(LOWER[2:], 0.1)
        site.send_goal(9.0, 9.0)
        site.state(state="recording", message="cannot save to .*; make room")
        assert site.outcomes == ["arrived"]
        site.call("stop", succeeds=False)  # it would lose the drive
    trainer.wait_for_log("the experience is saved again")
    assert trainer.log.count("make room") == 1
    warning = r"drives 0\.1\d* m/s in the open, nominal_speed is 0\.5"
    assert len(re.findall(warning, trainer.log)) == 1
    assert float(site.state()["learned speed (m/s)"]) == pytest.approx(0.1, abs=0.03)
    assert site.outcomes == ["arrived", "new_goal"]


def test_a_fleet_teaches_one_trainer_and_each_robot_plans_by_all(
    run_trainer: Any, run_node: Any, make_client: Any, tmp_path: FilePath
) -> None:
    """On a computer without torch; the planners are on others, which do not have its
    folder.
    """
    names, folder = ["one", "two", "three"], tmp_path / "drives"
    missing = "No module named 'torch'"
    torch = f'raise ModuleNotFoundError("{missing}", name="torch")'
    sites = [Site(make_client("/fleet"), folder, name) for name in names]
    with run_trainer(
        folder, "/fleet", exit_code=-signal.SIGKILL, robots=[*names, "one"], torch=torch
    ) as node:
        ways = [*zip(sites, (UPPER, UPPER[::-1], LOWER), (0.5, 0.5, 0.1), strict=True)]
        for site, way, speed in ways:
            site.at = way[0]
            site.begin()
            site.send_goal(*way[-1])
            site.move(way[1:2], speed)  # all are under way at once
        for site, way, speed in ways:
            site.drive(way[2:], speed)
        sites[0].send_goal(9.0, 9.0)
        sites[0].move([UPPER[2]], 0.5)  # it is under way when the trainer is killed
        node.wait_for_log("drive 3 by three: 23")
        folder.rename(tmp_path / "moved")
        remaps = [f"{topic}:=/fleet/{topic}" for topic in ("map", "trainer/experience")]
        parameters = {"follow_trainer": True, "move_rule": "robot_safe"}
        with run_node("planner_node", parameters, remaps, "/fleet/one"):
            robot = make_client("/fleet/one")
            ends = pose(GRID, START), pose(GRID, GOAL)
            wait_for("the other way", lambda: is_above(robot.get_plan(*ends)))
            node.stop(signal.SIGKILL)
            assert is_above(robot.get_plan(*ends))
    sites[0].folder = tmp_path / "moved"
    assert sites[0].outcomes == ["arrived"] * 3


def test_two_trainers_whose_files_are_merged_know_the_drives_of_both_robots_once(
    run_trainer: Any, run_node: Any, make_client: Any, tmp_path: FilePath
) -> None:
    ways = {"one": (UPPER, 0.5), "two": (LOWER, 0.1)}
    sites = {
        name: Site(make_client(f"/{name}"), tmp_path / f"drives_{name}")
        for name in ways
    }
    ends = pose(GRID, START), pose(GRID, GOAL)
    parameters = {"follow_trainer": True, "move_rule": "robot_safe"}
    with (
        run_trainer(sites["one"].folder, "/one"),
        run_trainer(sites["two"].folder, "/two"),
    ):
        for name, (way, speed) in ways.items():
            sites[name].at = way[0]
            sites[name].begin()
            sites[name].drive(way, speed)
        files = [site.folder / "experience.npz" for site in sites.values()]
        for _ in range(2):
            for file, other in (files, files[::-1]):
                experience = Experience.load(file)
                experience.merge(Experience.load(other))
                experience.save(file)
        one = sites["one"]
        with run_node("planner_node", parameters, namespace="/one"):
            one.begin(listeners=2)
            plan = one.client.get_plan
            wait_for("first way", lambda: is_below(plan(*ends)))
            one.drive(UPPER[::-1], 0.5)  # then it saves, and finds the other's drives
            wait_for("other way", lambda: is_above(plan(*ends)))
    merged = Experience.load(files[0])
    robots = merged.evidence.fleet.members
    assert {robot.robot for robot in robots} == {"one", "two"}
    assert merged.evidence.driven == pytest.approx(238 + 2 * 56, rel=0.1)


def test_a_kill_loses_nothing_but_the_drive_under_way_and_an_end_not_even_that(
    site: Site, trainer: Any, run_trainer: Any, make_client: Any, tmp_path: FilePath
) -> None:
    """The last test, as it ends the trainer of the others."""
    killed = Site(make_client("/killed"), tmp_path / "killed")
    with run_trainer(killed.folder, "/killed", exit_code=-signal.SIGKILL) as node:
        killed.begin()
        killed.drive(LOWER[:2], speed=0.1)
        killed.send_goal(*LOWER[0])
        killed.move([LOWER[2]], 0.5)
        node.stop(signal.SIGKILL)
    site.call("stop")
    site.record_in(killed.folder)
    site.call("start")
    site.at = killed.at  # not where the first drive was slow
    site.drive([LOWER[3]], speed=0.5)
    assert "drive 2: " in trainer.log
    site.send_goal(*LOWER[0])
    site.move([LOWER[2]], 0.5)
    site.call("save")
    assert trainer.stop() == 0
    assert site.outcomes == ["arrived", "arrived", "stopped"]
    assert site.learned()[18, 3] > 2  # of the first drive
