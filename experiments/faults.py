"""Kills each node in turn while it works, starts it again, and checks that nothing is broken.

The planner is killed while it plans, the map server while it publishes, the trainer while it saves:
by SIGKILL, each time at a random moment. After each kill there must be a plan within a minute, also
while the map server is gone. `make faults` kills 50 times; an argument gives another number.
"""

from __future__ import annotations

import array
import random
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
from client import TIMEOUT, Client, initial_pose, plan_request, pose, wait_for
from diagnostic_msgs.msg import DiagnosticArray
from map_fixture import RULE, MapFixture
from nav_msgs.msg import OccupancyGrid
from nav_msgs.msg import Path as PathMessage
from nav_msgs.srv import GetPlan, LoadMap
from processes import claim_ros_domain, run_script, running_node
from random_maps import generate_map
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger
from tables import table

from ddqn_planner.grid import OCCUPIED, Cell, MapFile, save_map
from ddqn_planner.grid.noise import MAX_NEW_OBSTACLES, random_requests
from ddqn_planner.model import load_model
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.training.environment import paper_scenario
from ddqn_planner.training.trainer import Trainer

KILLS = 50
SIDE = 1000
"""Cells: a map so large that its fields are killed in."""

GOALS = 6
"""Fields that the planner is asked for at once: a second's work."""

TRY_TIME = 1.0
"""Seconds until a question is asked again: it may have gone to the node that was killed."""

START_TIME = 20.0
"""The same for ~/start, which a second question would find started."""

PLAN_TIME = 60.0
"""Seconds within which there must be a plan after a kill, on a loaded machine."""

LAST_WAIT = 0.5
"""Seconds that a client waits after a kill until it gives up."""

GET_PLAN = "planner/get_plan"


@dataclass
class Tally:
    """What became of the kills of one node: a row of the table."""

    node: str
    killed_while: str
    kills: int = 0
    in_a_save: int = 0
    restarts: int = 0
    answers: int = 0
    time_outs: int = 0
    without_a_plan: int = 0
    wrong_paths: int = 0
    temporaries: int = 0

    @property
    def right(self) -> bool:
        """Whether all restarts worked, no plan was missing, and nothing wrong came or stayed."""
        wrong = self.without_a_plan or self.wrong_paths or self.temporaries
        return self.restarts == self.kills and not wrong


class Faults:
    """The nodes, which end with a stack, and what a client sees of them."""

    def __init__(self, client: Client, folder: Path, stack: ExitStack) -> None:
        self.client = client
        self.maps = client.subscribe(OccupancyGrid, "map", LATCHED, keep=1)
        self.plans = client.subscribe(PathMessage, "plan", LATCHED, keep=1)
        self.diagnostics = client.subscribe(DiagnosticArray, "/diagnostics", keep=20)
        self._draw, self._random = random.Random(0), np.random.default_rng(0)
        self.map_path, self.training_folder = folder / "map.yaml", folder / "training"
        occupancy = generate_map("office", (SIDE, SIDE), self._random)
        (self._watched,) = random_requests(occupancy, RULE, 1, self._random)
        map_file = MapFile(OCCUPIED * occupancy, 1.0, (0.0, 0.0, 0.0), *self._watched)
        save_map(map_file, self.map_path)
        self._map = MapFixture(map_file)
        quiet, apart = ("--log-level", "fatal"), ("-r", "__ns:=/training")
        training = {"map_file": "dilemma", "steps": 10**9, "output_folder": self.training_folder}
        self._nodes: dict[str, Callable[[], Any]] = {
            "map_server": partial(
                running_node, "map_server_node", *quiet, yaml_filename=self.map_path
            ),
            "planner": partial(running_node, "planner_node", *quiet),
            "trainer": partial(running_node, "trainer_node", *quiet, *apart, **training),
            "follower": partial(running_node, "planner_node", *quiet, *apart, follow_trainer=True),
        }
        self._stack = stack
        self.children: dict[str, subprocess.Popen[bytes]] = {}
        for name in self._nodes:
            self.start(name)

    # Nodes

    def start(self, name: str) -> None:
        """Start a node."""
        self.children[name] = self._stack.enter_context(self._nodes[name]())

    def kill(self, name: str, tally: Tally, calls: Sequence[tuple[Any, Any]]) -> list[Any]:
        """Kill a node, as a power cut would, under calls: pairs of a service and a future.

        Count the answers that came before, and the time-outs; return the answers, or None.
        """
        child = self.children.pop(name)
        child.kill()
        child.wait()
        time.sleep(LAST_WAIT)
        for service, future in calls:
            tally.answers += future.done()
            tally.time_outs += not future.done()
            service.remove_pending_request(future)
        return [future.result() for _, future in calls]

    # Asking

    def ask(
        self,
        service_type: Any,
        name: str,
        request: Any = None,
        accept: Callable[[Any], Any] = bool,
        try_time: float = TRY_TIME,
        timeout: float = TIMEOUT,
    ) -> Any:
        """Ask until an answer is accepted; return it."""

        def answer() -> Any:
            with suppress(TimeoutError):
                found = self.client.call(service_type, name, request, try_time)
                if accept(found):
                    return found
            time.sleep(0.05)
            return None

        return wait_for(f"answer from {name}", answer, self.children.values(), timeout)

    def trigger(self, name: str, try_time: float = TRY_TIME) -> str:
        """Call a Trigger service until it succeeds; return its message."""
        answer = self.ask(Trigger, name, None, lambda answer: answer.success, try_time)
        return str(answer.message)

    def parameter(self, node: str, name: str) -> Any:
        """Return a parameter's value message."""
        request = GetParameters.Request(names=[name])
        return self.ask(GetParameters, f"{node}/get_parameters", request).values[0]

    def ask_for_plan(
        self, start: Cell, goal: Cell, accept: Callable[[Any], Any] = lambda found: found.plan.poses
    ) -> PathMessage:
        """Ask for a plan until there is one, or an answer is accepted."""
        request = self._request((start, goal))
        return self.ask(GetPlan, GET_PLAN, request, accept, timeout=PLAN_TIME).plan

    def plan_for_active_goal(self) -> PathMessage:
        """Give the planner a start and an active goal until it plans: it may be a new one."""
        start, goal = (pose(self._map.grid, cell) for cell in self._watched)
        self.plans.clear()

        def planned() -> PathMessage | None:
            self.client.publish("initialpose", initial_pose(start))
            self.client.publish("goal_pose", goal)
            time.sleep(0.2)
            found: PathMessage | None = self.plans.find(lambda plan: plan.poses)
            return found

        return wait_for("plan", planned, timeout=PLAN_TIME)

    def check_plan(
        self, tally: Tally, ask: Callable[[], PathMessage], cells: tuple[Cell, Cell]
    ) -> bool:
        """Ask for a plan; count it if it is wrong, or none comes in time; return whether one came.

        A plan of a map with new obstacles must be right on the map without them too.
        """
        with suppress(TimeoutError):
            if (plan := ask()).poses:
                tally.wrong_paths += bool(self._map.error(self._request(cells), plan))
                return True
        tally.without_a_plan += 1
        said = [message.status[0] for message in self.diagnostics.messages()]
        reasons = [status.message for status in said if status.name == "/planner: plan"]
        print(f"no plan after kill {tally.kills} of {tally.node}: {reasons[-1:]}", flush=True)
        return False

    def _request(self, cells: tuple[Cell, Cell]) -> GetPlan.Request:
        return plan_request(self._map.grid, *cells)

    # Killing

    def kill_planner(self, tally: Tally) -> None:
        """Kill the planner while it plans toward goals that it does not know."""
        get_plan = self.client.service(GetPlan, GET_PLAN)
        asked = random_requests(self._map.grid.occupancy, RULE, GOALS, self._random)
        calls = [(get_plan, get_plan.call_async(self._request(cells))) for cells in asked]
        time.sleep(self._draw.uniform(0.0, 1.0))
        for cells, answer in zip(asked, self.kill("planner", tally, calls), strict=True):
            if answer is not None:  # all goals can be reached: the check refuses an empty path
                tally.wrong_paths += bool(self._map.error(self._request(cells), answer.plan))
        self.start("planner")
        tally.restarts += self.check_plan(tally, partial(self.ask_for_plan, *asked[0]), asked[0])

    def kill_map_server(self, tally: Tally) -> None:
        """Kill the map server while it loads, scatters over and restores its map."""
        self.plan_for_active_goal()
        load = LoadMap.Request(map_url=str(self.map_path))
        requests = [
            *[(self.client.service(Trigger, "map_server/restore_map"), Trigger.Request())] * 20,
            *[(self.client.service(LoadMap, "map_server/load_map"), load)] * 4,
            (self.client.service(Trigger, "map_server/scatter_obstacles"), Trigger.Request()),
        ]
        self._draw.shuffle(requests)
        calls = [(service, service.call_async(request)) for service, request in requests]
        time.sleep(self._draw.uniform(0.0, 2.0))
        self.kill("map_server", tally, calls)
        # The first answer must be a plan. With it, the plans of the last maps are out.
        first_answer = partial(self.ask_for_plan, *self._watched, accept=bool)
        self.check_plan(tally, first_answer, self._watched)
        # The map is the loaded one with at most five obstacles more.
        values = np.frombuffer(self.maps.wait().data, np.int8).reshape(self._map.values.shape)
        new = values[values != self._map.values]
        whole = bool((new == OCCUPIED).all()) and len(new) <= MAX_NEW_OBSTACLES
        self.maps.clear()
        self.start("map_server")
        served = self.maps.wait()
        self.check_plan(tally, self.plan_for_active_goal, self._watched)
        tally.restarts += whole and served.data == array.array("b", self._map.values.tobytes())

    def kill_trainer(self, tally: Tally) -> None:
        """Kill the trainer while it saves after each step, soon after a save was seen to begin."""
        save = self.client.service(Trigger, "/training/trainer/save")
        until = time.monotonic() + self._draw.uniform(0.2, 1.2)
        calls = []
        while time.monotonic() < until:
            calls.append((save, save.call_async(Trigger.Request())))
            time.sleep(0.002)
        while not self.temporaries() and time.monotonic() < until + LAST_WAIT:
            pass
        time.sleep(self._draw.uniform(0.0, 0.002))
        self.kill("trainer", tally, calls)
        tally.in_a_save += bool(self.temporaries())
        steps = self.saved_steps()
        self.start("trainer")
        self.parameter("/training/trainer", "seed")
        message = self.trigger("/training/trainer/start", START_TIME)
        self.follow()
        tally.temporaries = len(self.temporaries())
        tally.restarts += f"from step {steps} " in message

    def temporaries(self) -> list[Path]:
        """Return what the killed trainers left of their saves."""
        return [*self.training_folder.glob(".*")]

    def saved_steps(self) -> int:
        """Load the model and the checkpoint, where there are any; return the checkpoint's steps."""
        model = self.training_folder / "model.safetensors"
        checkpoint = self.training_folder / "checkpoint.safetensors"
        if model.exists():
            load_model(model)
        if not checkpoint.exists():
            return 0
        return Trainer.load_checkpoint(checkpoint, [paper_scenario()]).steps

    def follow(self) -> None:
        """Wait until the planner that follows the trainer has loaded a model of its."""
        other = Parameter("model", value="any_map").to_parameter_msg()
        request = SetParameters.Request(parameters=[other])
        name = "/training/planner/set_parameters"
        self.ask(SetParameters, name, request, lambda answer: answer.results[0].successful)
        self.trigger("/training/trainer/save")
        saved = str(self.training_folder / "model.safetensors")
        model = partial(self.parameter, "/training/planner", "model")
        wait_for("model", lambda: model().string_value == saved)

    def kill_in_turn(self, kills: int) -> bool:
        """Kill so many times, and print what became of it; return whether all is right."""
        self.ask_for_plan(*self._watched)
        self.trigger("/training/trainer/start", START_TIME)
        self.parameter("/training/planner", "model")
        tallies = {
            self.kill_planner: Tally("planner_node", "planning"),
            self.kill_map_server: Tally("map_server_node", "publishing"),
            self.kill_trainer: Tally("trainer_node", "saving"),
        }
        try:
            for kill, tally in islice(cycle(tallies.items()), kills):
                tally.kills += 1
                kill(tally)
        finally:
            header = " | ".join(Tally.__annotations__).replace("_", " ")
            print(table(header, [[*vars(tally).values()] for tally in tallies.values()]))
        return all(tally.right for tally in tallies.values())


def main(arguments: Sequence[str]) -> int:
    """Kill so many times; return 1 if anything is wrong."""
    with (
        claim_ros_domain(),
        Client() as client,
        tempfile.TemporaryDirectory() as folder,
        ExitStack() as stack,
    ):
        faults = Faults(client, Path(folder), stack)
        return int(not faults.kill_in_turn(int(arguments[0]) if arguments else KILLS))


if __name__ == "__main__":
    run_script(main)
