"""Measures the figures of docs/benchmarks.md: `make bench`. Compared things run side by side."""

from __future__ import annotations

import signal
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from typing import Any

import demo
import gymnasium
import psutil
import torch
from client import pose
from nav_msgs.srv import GetPlan
from processes import executable, running
from stable_baselines3 import DQN
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from std_srvs.srv import Trigger
from torch import nn

from ddqn_planner import MoveRule, Planner
from ddqn_planner.resources import find_resource
from ddqn_planner.training.environment import GridEnvironment, Scenario, paper_scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import Trainer

CALLS = 1_000
FIELDS = 100
STEPS = 3_000
ROUNDS = 5


def main() -> int:
    """Print each figure beside its bound; return 1 if one is missed."""
    torch.set_num_threads(1)
    scenario = paper_scenario()
    missed = [measure_field(scenario), *measure_training(scenario)]
    with demo.client() as node:
        missed += measure_planner(node, scenario)
        missed += measure_trainer(node)
    return int(any(missed))


def report(figure: str, value: float, unit: str, bound: float, at_most: bool = True) -> bool:
    """Print a figure; return whether it misses its bound."""
    missed = value > bound if at_most else value < bound
    sign = "at most" if at_most else "at least"
    verdict = "MISSED" if missed else "ok"
    print(f"{figure:62} {value:8.2f} {unit:3} {sign:8} {bound:6.1f}  {verdict}", flush=True)
    return missed


def measure_field(scenario: Scenario) -> bool:
    """Time the Q field of the paper's map, computed anew each time."""
    planner = Planner.load("dilemma")
    times = []
    for _ in range(FIELDS):
        began = time.perf_counter()
        planner.network.q_values(scenario.grid, scenario.goal, planner.metadata.move_rule)
        times.append(1e3 * (time.perf_counter() - began))
    return report("Q field of the 20x20 map, median", statistics.median(times), "ms", 20)


class PaperFeatures(BaseFeaturesExtractor):
    """The paper's convolution, for Stable-Baselines3; its Q head is the fully connected layer."""

    def __init__(self, observation_space: gymnasium.spaces.Box, filters: int) -> None:
        height, width = observation_space.shape
        super().__init__(observation_space, filters * ((height + 1) // 2) * ((width + 1) // 2))
        self.convolution = nn.Conv2d(1, filters, kernel_size=3, stride=2, padding=1)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return (B, features)."""
        return torch.relu(self.convolution(observations.unsqueeze(1))).flatten(1)


def stable_baselines(scenario: Scenario, p: HyperParameters) -> DQN:
    """Return Stable-Baselines3's DQN with our network, batch and replay ratio."""
    return DQN(
        "MlpPolicy",
        GridEnvironment(scenario, MoveRule.CORNER_CUTTING, p),
        learning_rate=p.learning_rate,
        buffer_size=p.replay_capacity,
        learning_starts=p.learning_starts,
        batch_size=p.batch_size,
        gamma=p.gamma,
        train_freq=p.update_interval,
        gradient_steps=1,
        target_update_interval=p.target_interval,
        exploration_initial_eps=p.epsilon_start,
        exploration_final_eps=p.epsilon_end,
        policy_kwargs={
            "features_extractor_class": PaperFeatures,
            "features_extractor_kwargs": {"filters": p.filters},
            "net_arch": [],
        },
        seed=0,
        device="cpu",
    )


def measure_training(scenario: Scenario) -> list[bool]:
    """Compare our steps/s with Stable-Baselines3's: one update of 32 transitions a step."""
    # ε at its last value for both from the start: a random action costs no forward pass.
    p = HyperParameters(epsilon_start=HyperParameters().epsilon_end)
    ours = Trainer([scenario], MoveRule.CORNER_CUTTING, p, seed=0)
    theirs = stable_baselines(scenario, p)
    assert count_weights(theirs.q_net) == count_weights(ours.network)

    def train_ours() -> None:
        for _ in ours.run(ours.steps + STEPS):
            pass

    def train_theirs() -> None:
        theirs.learn(STEPS, reset_num_timesteps=False)

    train_ours()  # both past `learning_starts`, and warm
    train_theirs()
    ratios, rates = [], []
    for _ in range(ROUNDS):
        our_rate, their_rate = steps_a_second(train_ours), steps_a_second(train_theirs)
        ratios.append(our_rate / their_rate)
        rates.append((our_rate, their_rate))
    our_rate, their_rate = (statistics.median(rate) for rate in zip(*rates, strict=True))
    figure = f"training: {our_rate:.0f} steps/s; Stable-Baselines3 {their_rate:.0f}; ratio"
    return [report(figure, statistics.median(ratios), "x", 1.5, at_most=False)]


def steps_a_second(train: Callable[[], None]) -> float:
    """Return the environment steps a second of a function that makes `STEPS`."""
    began = time.perf_counter()
    train()
    return STEPS / (time.perf_counter() - began)


def count_weights(network: nn.Module) -> int:
    """Return the number of weights and biases."""
    return sum(parameter.numel() for parameter in network.parameters())


def call(client: Any, request: Any) -> float:
    """Call a service; return how long its answer took, milliseconds."""
    answered = threading.Event()
    began = time.perf_counter()
    future = client.call_async(request)
    future.add_done_callback(lambda _: answered.set())
    assert answered.wait(demo.TIMEOUT), f"no answer from {client.srv_name}"
    return 1e3 * (time.perf_counter() - began)


def measure_planner(node: demo.Client, scenario: Scenario) -> list[bool]:
    """Measure the planner node: its first plan, its round trips, its memory."""
    began = time.monotonic()
    map_server = running(executable("map_server_node"))
    with map_server as first, running(executable("planner_node")) as planner:
        plan = demo.request_plan(node, [first, planner], scenario)
        seconds = time.monotonic() - began
        start, goal = pose(scenario.grid, scenario.start), plan.poses[-1]
        request = GetPlan.Request(start=start, goal=goal)
        request.start.pose.position = plan.poses[0].pose.position
        bare = node.create_client(GetPlan, "bare/get_plan")
        script = __file__.replace("benchmark.py", "bare_service.py")
        with running(sys.executable, script, str(len(plan.poses))):
            assert bare.wait_for_service(demo.TIMEOUT)
            ours, theirs = [], []
            for _ in range(CALLS):
                ours.append(call(node.get_plan, request))
                theirs.append(call(bare, request))
        memory = psutil.Process(planner.pid).memory_info().rss / 1e6
    ours_ms, theirs_ms = statistics.median(ours), statistics.median(theirs)
    figure = f"GetPlan, known field: {ours_ms:.2f} ms; bare service {theirs_ms:.2f} ms; ratio"
    return [
        report("process start to first plan", seconds, "s", 6),
        report(figure, ours_ms / theirs_ms, "x", 1.5),
        report("planner node, resident memory", memory, "MB", 500),
    ]


def measure_trainer(node: demo.Client) -> list[bool]:
    """Measure the trainer node while it trains: its services, and how soon a signal ends it."""
    missed: list[bool] = []
    slowest: dict[str, float] = {}
    clients = {
        name: node.create_client(Trigger, f"trainer/{name}")
        for name in ("start", "save", "replay", "stop")
    }
    for number in (signal.SIGINT, signal.SIGTERM):
        with tempfile.TemporaryDirectory() as folder:
            map_file = find_resource("maps", "dilemma.yaml")
            parameters = (f"output_folder:={folder}", f"map_file:={map_file}", "steps:=1000000")
            arguments = [word for parameter in parameters for word in ("-p", parameter)]
            with running(executable("trainer_node"), "--ros-args", *arguments) as trainer:
                assert clients["start"].wait_for_service(demo.TIMEOUT)
                # A service is found before its node spins: the first answer says that it does.
                waited = call(clients["stop"], Trigger.Request())
                print(f"trainer: first answer of the node, while it comes up: {waited:.0f} ms")
                first = call(clients["start"], Trigger.Request())
                slowest["start"] = max(slowest.get("start", 0.0), first)
                time.sleep(10)  # thousands of steps: a checkpoint and curves of some size
                for name in ("start", "save", "replay", "stop"):
                    times = [call(clients[name], Trigger.Request()) for _ in range(50)]
                    slowest[name] = max(slowest.get(name, 0.0), *times)
                for _ in range(20):  # until the training that was stopped has saved itself
                    call(clients["start"], Trigger.Request())
                    time.sleep(0.1)
                began = time.monotonic()
                trainer.send_signal(number)
                exit_code = trainer.wait()
                seconds = time.monotonic() - began
            assert exit_code == 0, f"{number.name} ended the trainer with {exit_code}"
        missed.append(report(f"trainer: {number.name} to exit", seconds, "s", 3))
    missed += [
        report(f"trainer: ~/{name} while it trains, slowest of 100", ms, "ms", 100)
        for name, ms in slowest.items()
    ]
    return missed


if __name__ == "__main__":
    sys.exit(main())
