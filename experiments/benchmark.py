"""Measures the figures of docs/benchmarks.md: `make bench`. Compared things run side by side."""

from __future__ import annotations

import signal
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import torch
from client import TIMEOUT, Client, initial_pose, plan_request, pose, wait_for
from nav_msgs.msg import Path as PathMessage
from nav_msgs.srv import GetPlan
from processes import claim_ros_domain, memory, run_script, running, running_node
from stable_baselines3 import DQN
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from std_srvs.srv import Trigger
from torch import nn

from ddqn_planner import MoveRule, Planner
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.training.environment import GridEnvironment, Scenario, paper_scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.trainer import Trainer

CALLS = 1_000
FIELDS = 100
STEPS = 3_000
ROUNDS = 5


def main(_: Sequence[str]) -> int:
    """Print each figure beside its bound; return 1 if one is missed."""
    torch.set_num_threads(1)
    scenario = paper_scenario()
    missed = [measure_field(scenario), measure_training(scenario)]
    with claim_ros_domain(), Client() as client:
        missed += measure_planner(client, scenario)
        missed += measure_trainer(client)
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


def measure_training(scenario: Scenario) -> bool:
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
        our_rate, their_rate = steps_per_second(train_ours), steps_per_second(train_theirs)
        ratios.append(our_rate / their_rate)
        rates.append((our_rate, their_rate))
    our_rate, their_rate = (statistics.median(rate) for rate in zip(*rates, strict=True))
    figure = f"training: {our_rate:.0f} steps/s; Stable-Baselines3 {their_rate:.0f}; ratio"
    return report(figure, statistics.median(ratios), "x", 1.5, at_most=False)


def steps_per_second(train: Callable[[], None]) -> float:
    """Return the environment steps per second of a function that makes `STEPS`."""
    began = time.perf_counter()
    train()
    return STEPS / (time.perf_counter() - began)


def count_weights(network: nn.Module) -> int:
    """Return the number of weights and biases."""
    return sum(parameter.numel() for parameter in network.parameters())


def timed(service: Any, request: Any) -> tuple[float, Any]:
    """Call a service; return how long its answer took, milliseconds, and the answer."""
    answered = threading.Event()
    began = time.perf_counter()
    future = service.call_async(request)
    future.add_done_callback(lambda _: answered.set())
    assert answered.wait(TIMEOUT), f"no answer from {service.srv_name}"
    return 1e3 * (time.perf_counter() - began), future.result()


def compare_with_bare_service(
    client: Client, request: Any, poses: int, calls: int
) -> tuple[float, float]:
    """Return the median times of the planner and of a bare service that answers as much, ms."""
    script = Path(__file__).with_name("bare_service.py")
    with running(sys.executable, str(script), str(poses)):
        ours = client.service(GetPlan, "planner/get_plan")
        bare = client.service(GetPlan, "bare/get_plan")
        timed(bare, request)
        pairs = [(timed(ours, request)[0], timed(bare, request)[0]) for _ in range(calls)]
    ours_ms, bare_ms = (statistics.median(times) for times in zip(*pairs, strict=True))
    return ours_ms, bare_ms


def measure_planner(client: Client, scenario: Scenario) -> list[bool]:
    """Measure the planner node: its first plan, its round trips, its memory."""
    plans = client.subscribe(PathMessage, "plan", LATCHED)
    began = time.monotonic()
    with running_node("map_server_node") as first, running_node("planner_node") as planner:
        client.publish("initialpose", initial_pose(pose(scenario.grid, scenario.start)))
        client.publish("goal_pose", pose(scenario.grid, scenario.goal))
        plan = wait_for("plan", lambda: plans.find(lambda plan: plan.poses), [first, planner])
        seconds = time.monotonic() - began
        request = plan_request(scenario.grid, scenario.start, scenario.goal)
        ours, bare = compare_with_bare_service(client, request, len(plan.poses), CALLS)
        resident = memory(planner.pid)
    figure = f"GetPlan, known field: {ours:.2f} ms; bare service {bare:.2f} ms; ratio"
    return [
        report("process start to first plan", seconds, "s", 6),
        report(figure, ours / bare, "x", 1.5),
        report("planner node, resident memory", resident, "MB", 500),
    ]


def measure_trainer(client: Client) -> list[bool]:
    """Measure the trainer node while it trains: its services, and how soon a signal ends it."""
    missed: list[bool] = []
    slowest: dict[str, float] = {}

    def call(name: str, times: int = 1) -> float:
        service = client.service(Trigger, f"trainer/{name}")
        return max(timed(service, Trigger.Request())[0] for _ in range(times))

    for number in (signal.SIGINT, signal.SIGTERM):
        with (
            tempfile.TemporaryDirectory() as folder,
            running_node(
                "trainer_node", output_folder=folder, map_file="dilemma", steps=1_000_000
            ) as trainer,
        ):
            # A service is found before its node spins: the first answer says that it does.
            print(f"trainer: first answer of the node, while it starts: {call('stop'):.0f} ms")
            print(f"trainer: first ~/start, once torch is imported: {call('start'):.0f} ms")
            call("stop")
            time.sleep(1)  # until it has saved itself
            slowest["start"] = max(slowest.get("start", 0.0), call("start"))
            time.sleep(10)  # thousands of steps: a checkpoint and curves of some size
            for name in ("start", "save", "replay", "stop"):
                slowest[name] = max(slowest.get(name, 0.0), call(name, 50))
            for _ in range(20):  # until the training that was stopped has saved itself
                call("start")
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
    run_script(main)
