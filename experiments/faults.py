"""Kills each node while it works, and checks that nothing is broken."""

import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from itertools import cycle, islice
from pathlib import Path
from subprocess import Popen
from typing import Any

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
SIDE, GOALS = 1000, 6  # cells of a map, and fields asked for at once: a second's work
TRY_TIME = (
    1.0  # seconds until a question is asked again: it may have gone to a killed node
)
START_TIME = 20.0  # the same for ~/start, which a second question would find started
LAST_WAIT = 0.5  # seconds that a client waits after a kill until it gives up
COUNTS = (
    "kills | in a save | restarts | answers | time-outs | wrong paths | temporaries"
)
Tally = Counter[str]  # the counts of COUNTS: what became of the kills of one node


class Faults(Client):
    """The nodes, and a client that kills them and sees what becomes of it."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.maps = self.subscribe(OccupancyGrid, "map", LATCHED, keep=1)
        self.diagnostics = self.subscribe(DiagnosticArray, "/diagnostics", keep=20)
        self.plans = self.subscribe(PathMessage, "plan", LATCHED, keep=1)
        self.random = np.random.default_rng(0)
        self.map_path, self.training_folder = folder / "map.yaml", folder / "training"
        self.map = generated_map("office", SIDE, 1.0)
        (ends,) = random_requests(self.map.grid.occupancy, RULE, 1, self.random)
        save_map(MapFile(self.map.values, 1.0, (0.0, 0.0, 0.0), *ends), self.map_path)
        self.watched = plan_request(self.map.grid, *ends)
        quiet, apart = ("--log-level", "fatal"), ("-r", "__ns:=/training")
        training = {
            "map_file": "dilemma",
            "steps": 10**9,
            "output_folder": self.training_folder,
        }
        server = {"yaml_filename": self.map_path}
        self.nodes = {
            "map_server": partial(running_node, "map_server_node", *quiet, **server),
            "planner": partial(running_node, "planner_node", *quiet),
            "trainer": partial(
                running_node, "trainer_node", *quiet, *apart, **training
            ),
            "follower": partial(
                running_node, "planner_node", *quiet, *apart, follow_trainer=True
            ),
        }
        self.children: dict[str, Popen[bytes]] = {}
        for name in self.nodes:
            self.start(name)

    def start(self, name: str) -> None:
        """Start a node."""
        self.children[name] = self.enter_context(self.nodes[name]())

    def kill(
        self, name: str, tally: Tally, calls: Sequence[tuple[Any, Any]]
    ) -> list[Any]:
        """Kill a node under calls, pairs of a service and a future.

        Count the answers and return them, None where there is none.
        """
        child = self.children.pop(name)
        child.kill()  # as a power cut would
        child.wait()
        time.sleep(LAST_WAIT)
        for service, future in calls:
            tally["answers" if future.done() else "time-outs"] += 1
            service.remove_pending_request(future)
        return [future.result() for _, future in calls]

    def ask(
        self, kind: Any, name: str, request: Any, accept: Any, wait: float = TRY_TIME
    ) -> Any:
        """Ask until an answer is accepted; return it."""

        def answer() -> Any:
            with suppress(TimeoutError):
                found = self.call(kind, name, request, wait)
                if accept(found):
                    return found
            time.sleep(0.05)
            return None

        return wait_for(f"answer from {name}", answer, self.children.values())

    def trigger(self, name: str) -> str:
        """Call a Trigger service until it succeeds; return its message."""
        name = f"/training/trainer/{name}"
        return str(
            self.ask(Trigger, name, None, lambda it: it.success, START_TIME).message
        )

    def ask_for_plan(
        self, tally: Tally, request: Any, accept: Any = lambda it: it.plan.poses
    ) -> None:
        """Ask for a plan until one comes, or until an answer is accepted.

        A wrong answer is counted.
        """
        plan = self.ask(GetPlan, "planner/get_plan", request, accept).plan
        # All goals can be reached: the check refuses an empty path.
        tally["wrong paths"] += bool(self.map.error(request, plan))

    def plan_for_active_goal(self, tally: Tally) -> None:
        """Send the planner a start and an active goal until it plans.

        The planner may be a new process that has missed them.
        """
        self.plans.clear()

        def planned() -> Any:
            self.publish_ends(self.watched)
            time.sleep(0.2)
            return self.plans.find(lambda plan: plan.poses)

        tally["wrong paths"] += bool(
            self.map.error(self.watched, wait_for("plan", planned))
        )

    def kill_planner(self, tally: Tally) -> None:
        """Kill the planner while it plans toward goals that it does not know."""
        get_plan = self.service(GetPlan, "planner/get_plan")
        requests = self.map.requests(GOALS, self.random)
        calls = [(get_plan, get_plan.call_async(request)) for request in requests]
        time.sleep(self.random.uniform(0.0, 1.0))
        for request, answer in zip(
            requests, self.kill("planner", tally, calls), strict=True
        ):
            tally["wrong paths"] += bool(
                answer and self.map.error(request, answer.plan)
            )
        self.start("planner")
        self.ask_for_plan(tally, requests[0])
        tally["restarts"] += 1

    def kill_map_server(self, tally: Tally) -> None:
        """Kill the map server while it loads, scatters over and restores its map."""
        self.plan_for_active_goal(tally)
        load = LoadMap.Request(map_url=str(self.map_path))
        requests = [
            *[(self.service(Trigger, "map_server/restore_map"), Trigger.Request())]
            * 20,
            *[(self.service(LoadMap, "map_server/load_map"), load)] * 4,
            (self.service(Trigger, "map_server/scatter_obstacles"), Trigger.Request()),
        ]
        self.random.shuffle(requests)
        calls = [
            (service, service.call_async(request)) for service, request in requests
        ]
        time.sleep(self.random.uniform(0.0, 2.0))
        self.kill("map_server", tally, calls)
        # The first answer must be a plan. With it, the plans of the last maps are out.
        self.ask_for_plan(tally, self.watched, bool)
        # The map is the loaded one with at most five obstacles more.
        values, known = np.array(self.maps.wait().data), self.map.values.ravel()
        new = values[values != known]
        intact = bool((new == OCCUPIED).all()) and len(new) <= MAX_NEW_OBSTACLES
        self.maps.clear()
        self.start("map_server")
        served = self.maps.wait()
        self.plan_for_active_goal(tally)
        tally["restarts"] += intact and np.array_equal(served.data, known)

    def kill_trainer(self, tally: Tally) -> None:
        """Kill the trainer while it saves after each step.

        The kill comes soon after a save was seen to begin.
        """
        save = self.service(Trigger, "/training/trainer/save")
        temporaries = partial(
            self.training_folder.glob, ".*"
        )  # what a killed save leaves
        until = time.monotonic() + self.random.uniform(0.2, 1.2)
        calls = []
        while time.monotonic() < until:
            calls.append((save, save.call_async(Trigger.Request())))
            time.sleep(0.002)
        while not any(temporaries()) and time.monotonic() < until + LAST_WAIT:
            pass
        time.sleep(self.random.uniform(0.0, 0.002))
        self.kill("trainer", tally, calls)
        tally["in a save"] += any(temporaries())
        # What it saved can be loaded.
        model, steps = self.training_folder / "model.safetensors", 0
        if model.exists():
            load_model(model)
        if (checkpoint := model.with_name("checkpoint.safetensors")).exists():
            trainer = Trainer([paper_scenario()], HyperParameters(), seed=0)
            trainer.restore(checkpoint)
            steps = trainer.steps
        self.start("trainer")
        self.ask(GetParameters, "/training/trainer/get_parameters", None, bool)
        message = self.trigger("start")
        # The planner that follows the trainer loads a model of its.
        self.set_parameters("/training/planner", model="any_map")
        self.diagnostics.clear()
        self.trigger("save")
        wait_for("model", lambda: self.diagnostics.find(_has_model_of_trainer))
        tally["temporaries"] = len([*temporaries()])
        tally["restarts"] += f"from step {steps} " in message


def _has_model_of_trainer(array: DiagnosticArray) -> bool:
    return any(value.value == "trainer/model" for value in array.status[0].values)


def main(arguments: Sequence[str]) -> int:
    """Kill nodes in turn, 50 times or so many; return 1 if anything is wrong."""
    kills = int(arguments[0]) if arguments else KILLS
    with (
        claim_ros_domain(),
        tempfile.TemporaryDirectory() as folder,
        Faults(Path(folder)) as faults,
    ):
        faults.ask_for_plan(Tally(), faults.watched)
        faults.trigger("start")
        faults.get_parameter("/training/planner", "model")
        kinds = {
            "planner_node | planning": faults.kill_planner,
            "map_server_node | publishing": faults.kill_map_server,
            "trainer_node | saving": faults.kill_trainer,
        }
        tallies = {node: Tally() for node in kinds}
        try:
            for node, kill in islice(cycle(kinds.items()), kills):
                tallies[node]["kills"] += 1
                kill(tallies[node])
        finally:
            names = COUNTS.split(" | ")
            rows = [
                [node, *(tally[name] for name in names)]
                for node, tally in tallies.items()
            ]
            print(table(f"node | killed while | {COUNTS}", rows))
    total = sum(tallies.values(), Tally())
    lost = total["kills"] - total["restarts"]
    return int(lost + total["wrong paths"] + total["temporaries"] > 0)


if __name__ == "__main__":
    run_script(main)
