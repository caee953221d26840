"""Kills each node while it works, and checks that nothing is broken."""

import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import cycle, islice
from pathlib import Path
from subprocess import Popen
from typing import Any, NamedTuple

import numpy as np
from client import RULE, Client, generated_map, plan_request, wait_for
from diagnostic_msgs.msg import DiagnosticArray
from map_files import save_map
from nav_msgs.msg import OccupancyGrid
from nav_msgs.msg import Path as PathMessage
from nav_msgs.srv import GetPlan, LoadMap
from processes import claim_ros_domain, run_script, running_node
from rcl_interfaces.srv import GetParameters
from std_srvs.srv import Trigger
from tables import table

from ddqn_planner.grid import OCCUPIED, MapFile
from ddqn_planner.grid.noise import MAX_NEW_OBSTACLES, random_requests
from ddqn_planner.model import load_model
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.training.environment import paper_scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import Trainer

KILLS = 50
SIDE = 1000  # cells of the map
GOALS = 6  # fields asked for at once: a second's work
TRY_TIME = 1.0
"""Seconds until a question is asked again: it may have gone to a killed node."""
START_TIME = 20.0  # the same for ~/start, which a second question would find started
LAST_WAIT = 0.5  # seconds that a client waits after a kill until it gives up
SAVE_TIME = 10.0  # seconds within which a save has ended
COUNTS = (
    "kills",
    "in a save",
    "restarts",
    "answers",
    "time-outs",
    "wrong paths",
    "temporaries",
)
Tally = Counter[str]  # the counts of COUNTS: what became of the kills of one node


class Call(NamedTuple):
    """A call of a service whose answer may never come."""

    service: Any
    future: Any


def send(service: Any, request: Any) -> Call:
    """Call a service without waiting for the answer."""
    return Call(service, service.call_async(request))


class Faults(Client):
    """The nodes, and a client that kills them and sees what becomes of it."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.maps = self.subscribe(OccupancyGrid, "map", LATCHED, keep=1)
        self.diagnostics = self.subscribe(DiagnosticArray, "/diagnostics", keep=20)
        self.plans = self.subscribe(PathMessage, "plan", LATCHED, keep=1)
        self.random = np.random.default_rng(0)
        self.map_path = folder / "map.yaml"
        self.training_folder = folder / "training"
        self.map = generated_map("office", SIDE, 1.0)
        (ends,) = random_requests(self.map.grid.occupancy, RULE, 1, self.random)
        save_map(MapFile(self.map.values, 1.0, (0.0, 0.0, 0.0), *ends), self.map_path)
        self.active_request = plan_request(self.map.grid, *ends)
        quiet = ("--log-level", "fatal")
        in_namespace = (*quiet, "-r", "__ns:=/training")
        server_parameters = {"yaml_filename": self.map_path}
        trainer_parameters = {
            "map_file": "dilemma",
            "steps": 10**9,
            "output_folder": self.training_folder,
        }
        self.nodes = {
            "map_server": partial(
                running_node, "map_server_node", *quiet, **server_parameters
            ),
            "planner": partial(running_node, "planner_node", *quiet),
            "trainer": partial(
                running_node, "trainer_node", *in_namespace, **trainer_parameters
            ),
            "follower": partial(
                running_node, "planner_node", *in_namespace, follow_trainer=True
            ),
        }
        self.children: dict[str, Popen[bytes]] = {}
        for name in self.nodes:
            self.start(name)

    def start(self, name: str) -> None:
        """Start a node."""
        self.children[name] = self.enter_context(self.nodes[name]())

    def kill(self, name: str, tally: Tally, calls: Sequence[Call]) -> list[Any]:
        """Kill a node under calls.

        Count the answers and return them, None where there is none.
        """
        child = self.children.pop(name)
        child.kill()  # as a power cut would
        child.wait()
        time.sleep(LAST_WAIT)
        answers = []
        for call in calls:
            tally["answers" if call.future.done() else "time-outs"] += 1
            call.service.remove_pending_request(call.future)
            answers.append(call.future.result())
        return answers

    def ask(
        self,
        kind: Any,
        name: str,
        request: Any,
        accepts: Callable[[Any], Any],
        timeout: float = TRY_TIME,
    ) -> Any:
        """Ask until an answer is accepted; return it."""

        def accepted_answer() -> Any:
            with suppress(TimeoutError):
                answer = self.call(kind, name, request, timeout)
                if accepts(answer):
                    return answer
            time.sleep(0.05)
            return None

        return wait_for(f"answer from {name}", accepted_answer, self.children.values())

    def trigger(self, name: str) -> str:
        """Call a Trigger service until it succeeds; return its message."""
        name = f"/training/trainer/{name}"
        answer = self.ask(
            Trigger, name, None, lambda answer: answer.success, START_TIME
        )
        return str(answer.message)

    def ask_for_plan(
        self,
        tally: Tally,
        request: GetPlan.Request,
        accepts: Callable[[Any], Any] = lambda answer: answer.plan.poses,
    ) -> None:
        """Ask for a plan until one comes, or until an answer is accepted.

        A wrong answer is counted.
        """
        answer = self.ask(GetPlan, "planner/get_plan", request, accepts)
        self._check(tally, request, answer.plan)

    def _check(self, tally: Tally, request: GetPlan.Request, plan: Any) -> None:
        """Count a plan that is wrong.

        An empty one is: all goals can be reached.
        """
        if self.map.error(request, plan):
            tally["wrong paths"] += 1

    def plan_for_active_goal(self, tally: Tally) -> None:
        """Send the planner a start and an active goal until it plans.

        The planner may be a new process that has missed them.
        """
        self.plans.clear()

        def plan() -> Any:
            self.publish_ends(self.active_request)
            time.sleep(0.2)
            return self.plans.find(lambda plan: plan.poses)

        self._check(tally, self.active_request, wait_for("plan", plan))

    def kill_planner(self, tally: Tally) -> None:
        """Kill the planner while it plans toward goals that it does not know."""
        get_plan = self.service(GetPlan, "planner/get_plan")
        requests = self.map.requests(GOALS, self.random)
        calls = [send(get_plan, request) for request in requests]
        time.sleep(self.random.uniform(0.0, 1.0))
        answers = self.kill("planner", tally, calls)
        for request, answer in zip(requests, answers, strict=True):
            if answer:
                self._check(tally, request, answer.plan)
        self.start("planner")
        self.ask_for_plan(tally, requests[0])
        tally["restarts"] += 1

    def kill_map_server(self, tally: Tally) -> None:
        """Kill the map server while it loads, scatters over and restores its map."""
        self.plan_for_active_goal(tally)
        self.kill("map_server", tally, self._send_map_requests())
        # The first answer must be a plan. With it, the plans of the last maps are out.
        self.ask_for_plan(tally, self.active_request, bool)
        loaded_values = self.map.values.ravel()
        values = np.array(self.maps.wait().data)
        new_values = values[values != loaded_values]
        is_intact = len(new_values) <= MAX_NEW_OBSTACLES
        is_intact &= bool((new_values == OCCUPIED).all())
        self.maps.clear()
        self.start("map_server")
        served_map = self.maps.wait()
        self.plan_for_active_goal(tally)
        if is_intact and np.array_equal(served_map.data, loaded_values):
            tally["restarts"] += 1

    def _send_map_requests(self) -> list[Call]:
        """Send the map server requests in any order, for up to two seconds."""
        load = self.service(LoadMap, "map_server/load_map")
        restore = self.service(Trigger, "map_server/restore_map")
        scatter = self.service(Trigger, "map_server/scatter_obstacles")
        load_request = LoadMap.Request(map_url=str(self.map_path))
        requests = [
            *[(restore, Trigger.Request())] * 20,
            *[(load, load_request)] * 4,
            (scatter, Trigger.Request()),
        ]
        self.random.shuffle(requests)
        calls = [send(service, request) for service, request in requests]
        time.sleep(self.random.uniform(0.0, 2.0))
        return calls

    def kill_trainer(self, tally: Tally) -> None:
        """Kill the trainer in a save, and start it again.

        The training must resume, and the planner that follows it must load its model.
        """
        calls = self._send_saves()
        self.kill("trainer", tally, calls)
        tally["in a save"] += any(self._temporaries())
        steps = self._saved_steps()
        self.start("trainer")
        self.ask(GetParameters, "/training/trainer/get_parameters", None, bool)
        message = self.trigger("start")
        # Then the model of the trainer is a new one for the planner.
        self.set_parameters("/training/planner", model="any_map")
        self.diagnostics.clear()
        self.trigger("save")
        wait_for("model", lambda: self.diagnostics.find(_has_model_of_trainer))
        tally["temporaries"] = len(self._left_temporaries())
        tally["restarts"] += f"from step {steps} " in message

    def _send_saves(self) -> list[Call]:
        """Let the trainer save after each step, until a save was seen to begin."""
        save = self.service(Trigger, "/training/trainer/save")
        deadline = time.monotonic() + self.random.uniform(0.2, 1.2)
        calls = []
        while time.monotonic() < deadline:
            calls.append(send(save, Trigger.Request()))
            time.sleep(0.002)
        while not self._temporaries() and time.monotonic() < deadline + LAST_WAIT:
            pass
        time.sleep(self.random.uniform(0.0, 0.002))
        return calls

    def _temporaries(self) -> list[Path]:
        """Return the files that a save writes first, and a killed one leaves."""
        return [*self.training_folder.glob(".*")]

    def _left_temporaries(self) -> list[Path]:
        """Return the temporary files that stay: those of a save under way do not.

        Their names are random, so another save has others.
        """
        left = self._temporaries()
        deadline = time.monotonic() + SAVE_TIME
        while left and time.monotonic() < deadline:
            time.sleep(0.05)
            left = [path for path in left if path.exists()]
        return left

    def _saved_steps(self) -> int:
        """Load what the trainer saved; return the steps of its checkpoint."""
        model = self.training_folder / "model.safetensors"
        checkpoint = self.training_folder / "checkpoint.safetensors"
        if model.exists():
            load_model(model)
        if not checkpoint.exists():
            return 0
        trainer = Trainer([paper_scenario()], HyperParameters(), seed=0)
        trainer.restore(checkpoint)
        return trainer.steps


def _has_model_of_trainer(array: DiagnosticArray) -> bool:
    (status,) = array.status
    return any(entry.value == "trainer/model" for entry in status.values)


class Kind(NamedTuple):
    """A kind of kill: which node is killed while it does what."""

    node: str
    activity: str
    kill: Callable[[Tally], None]


def tally_table(kinds: Sequence[Kind], tallies: Mapping[str, Tally]) -> str:
    """Return a table with a row for each kind of kill."""
    rows = []
    for kind in kinds:
        counts = [tallies[kind.node][name] for name in COUNTS]
        rows.append([kind.node, kind.activity, *counts])
    return table(" | ".join(("node", "killed while", *COUNTS)), rows)


def main(arguments: Sequence[str]) -> int:
    """Kill nodes in turn, 50 times or so many; return 1 if anything is wrong."""
    kills = int(arguments[0]) if arguments else KILLS
    with (
        claim_ros_domain(),
        tempfile.TemporaryDirectory() as folder,
        Faults(Path(folder)) as faults,
    ):
        faults.ask_for_plan(Tally(), faults.active_request)
        faults.trigger("start")
        faults.get_parameter("/training/planner", "model")
        kinds = (
            Kind("planner_node", "planning", faults.kill_planner),
            Kind("map_server_node", "publishing", faults.kill_map_server),
            Kind("trainer_node", "saving", faults.kill_trainer),
        )
        tallies = {kind.node: Tally() for kind in kinds}
        try:
            for kind in islice(cycle(kinds), kills):
                tally = tallies[kind.node]
                tally["kills"] += 1
                kind.kill(tally)
        finally:
            print(tally_table(kinds, tallies))
    total = sum(tallies.values(), Tally())
    lost = total["kills"] - total["restarts"]
    return int(lost + total["wrong paths"] + total["temporaries"] > 0)


if __name__ == "__main__":
    run_script(main, {"kills": "kills of all nodes together (50)"})
