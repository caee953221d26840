"""Double DQN of the paper's network, compiled: the steps and updates of `Trainer`."""

from collections import namedtuple
from collections.abc import Iterable
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.model.networks import ROBOT
from ddqn_planner.model.shared_background import (
    Network,
    compiled,
    evaluate,
    look,
    network_of,
    windows_of,
)
from ddqn_planner.training.double_dqn import ReplayBuffer
from ddqn_planner.training.environment import GridVectorEnvironment
from ddqn_planner.training.hyper_parameters import HyperParameters

BETA_1, BETA_2, EPSILON = 0.9, 0.999, np.float32(1e-8)  # Adam's, as torch has them
LEAST = np.float32(1e-30)  # mean of a gradient: less moves no weight

DQN, PRINTED = 1, 2  # other targets than Double DQN's

WINDOWS = 5_000  # that all steps of one call look at: so it returns within milliseconds

Tensors = dict[str, NDArray[np.float32]]

# The hyper-parameters that are numbers, for compiled code.
NUMBERS: Any = {
    f.name: type(f.default) for f in fields(HyperParameters) if not isinstance(f.default, str)
}
Numbers: Any = namedtuple("Numbers", [*NUMBERS])  # type: ignore[misc]


def arrays_of(
    parts: tuple[Tensors, ...],
    environment: GridVectorEnvironment,
    replay: ReplayBuffer,
    total_reward: NDArray[np.float64],
) -> tuple[Any, Any, Any]:
    """Return what `play` takes of a training: its game, what it learns, and its robots."""
    e, p = environment, environment.parameters
    online, target, mean, square = parts
    gradient = {name: np.zeros_like(tensor) for name, tensor in online.items()}
    all_parts = online, target, gradient, mean, square
    networks = networks_of(environment, all_parts, max(p.batch_size, p.environments))
    kind = ("double_dqn", "dqn", "printed").index(p.target)
    numbers = Numbers(*(as_number(getattr(p, name)) for name, as_number in NUMBERS.items()))
    trail = np.zeros((max(1, WINDOWS // len(networks[0].after)), p.environments), np.int64)
    terminated, truncated = np.zeros((2, p.environments), np.bool_)
    robots = e.scenario, e.cell, e.steps, total_reward, terminated, truncated, trail
    game = e.legal, e.rewards, e.next_cell, e.goal
    return game, (numbers, kind, networks, replay.transitions), robots


def networks_of(
    environment: GridVectorEnvironment, parts: Iterable[Tensors], batch: int
) -> tuple[Network, ...]:
    """Return networks of the paper's tensors, which from now on are parts of them."""
    windows = windows_of(environment.background, environment.shape, ROBOT)
    networks = []
    for tensors in parts:
        network: Any = network_of([*tensors.values()], windows, batch)
        for (name, tensor), array in zip(tensors.items(), network[1:], strict=False):
            tensors[name] = array.T.reshape(tensor.shape)
        networks.append(network)
    return tuple(networks)


@compiled
def play(game: Any, learning: Any, robots: Any, random: Any, counters: Any, until: int) -> int:
    """Make steps until an episode ends, or `until`, or the trail is full; return how many.

    The counters are steps, updates and replayed transitions.
    """
    legal, rewards, next_cell, goal = game
    numbers, _, networks, replay = learning
    scenario, cell, episode_steps, total_reward, terminated, truncated, trail = robots
    exploration, sampling = random
    online, target = networks[:2]
    look(online)
    look(target)
    count, made, is_over = cell.size, 0, False
    actions = np.empty(count, np.int64)
    while counters[0] < until and made < len(trail) and not is_over:
        share = min(counters[0] / numbers.epsilon_steps, 1.0)
        epsilon = numbers.epsilon_start + share * (numbers.epsilon_end - numbers.epsilon_start)
        for n in range(count):
            actions[n] = exploration.integers(0, 8)
        evaluate(online, scenario, cell)
        for n in range(count):
            if exploration.random() >= epsilon:
                actions[n] = online.q[n].argmax()
        for n in range(count):
            at = scenario[n], actions[n], cell[n]
            after = next_cell[actions[n], cell[n]] if legal[at] else cell[n]
            episode_steps[n] += 1
            terminated[n] = not legal[at] or after == goal[scenario[n]]
            truncated[n] = not terminated[n] and episode_steps[n] >= numbers.max_episode_steps
            is_over |= terminated[n] or truncated[n]
            slot = counters[2] % replay.cell.size
            replay.scenario[slot], replay.action[slot], replay.cell[slot] = at
            replay.reward[slot], replay.next_cell[slot] = rewards[at], after
            replay.discount[slot] = 0.0 if terminated[n] else numbers.gamma
            counters[2] += 1
            total_reward[n] += rewards[at]
            cell[n] = trail[made, n] = after
        made += 1
        before, counters[0] = counters[0], counters[0] + count
        due = counters[0] // numbers.update_interval - before // numbers.update_interval
        for _ in range(due if counters[0] > numbers.learning_starts else 0):
            update(learning, sampling, counters)
    return made


@compiled
def update(learning: Any, sampling: Any, counters: Any) -> None:
    """Make one Double DQN update with a batch from the replay buffer, see `double_dqn_gradient`."""
    numbers, kind, (online, target, gradient, mean, square), replay = learning
    slots = np.empty(numbers.batch_size, np.int64)
    for n in range(slots.size):
        slots[n] = sampling.integers(0, min(counters[2], replay.cell.size))
    scenario, next_cell = replay.scenario[slots], replay.next_cell[slots]
    evaluate(online, scenario, next_cell)
    evaluate(target, scenario, next_cell)
    y = replay.reward[slots]
    for n in range(slots.size):
        best = (target.q if kind == DQN else online.q)[n].argmax()
        next_q = (online.q if kind == PRINTED else target.q)[n, best]
        y[n] += replay.discount[slots[n]] * next_q
    evaluate(online, scenario, replay.cell[slots])
    gradient.q[:] = 0
    for n in range(slots.size):
        action = replay.action[slots[n]]
        gradient.q[n, action] = 2 * (online.q[n, action] - y[n]) / slots.size
    differentiate(online, gradient, slots.size)
    counters[1] += 1
    adam(online, gradient, mean, square, numbers.learning_rate, counters[1])
    look(online)
    if counters[1] % numbers.target_interval == 0:
        target.weights[:] = online.weights
        look(target)


@compiled
def differentiate(network: Any, gradient: Any, count: int) -> None:
    """Add to a loss's gradients, given that by Q of the states that a network has seen."""
    gradient.output[:] = 0
    gradient.before[:] = 0
    layer, layer_gradient, error = network.layer, gradient.layer, gradient.own_output
    after, before, own_before = network.after, gradient.before, gradient.own_before
    (windows, filters), units = after.shape, network.output.size
    for n in range(count):
        if not len(network.eight):
            gradient.last_bias[:] += gradient.q[n]
            for u in range(units):
                output, error[n, u] = max(network.own_output[n, u], np.float32(0)), 0
                for action in range(8 if output > 0 else 0):
                    gradient.last[u, action] += gradient.q[n, action] * output
                    error[n, u] += gradient.q[n, action] * network.last[u, action]
        for u in range(units):
            gradient.output[u] += error[n, u]
        for row in range(network.first[n], network.first[n + 1]):
            window = network.changed[row]
            for f in range(filters):
                feature, through = max(network.own_before[row, f], np.float32(0)), np.float32(0)
                change, number = feature - after[window, f], f * windows + window
                if feature != 0 or change != 0:  # most features are 0, with the robot and without
                    gradient.awake[min(number, gradient.awake.size - 1)] = True
                    for u in range(len(network.eight) or units):
                        layer_gradient[number, u] += change * error[n, u]
                        through += layer[number, u] * error[n, u]
                    if after[window, f] > 0:
                        before[window, f] -= through
                own_before[row, f] = through if feature > 0 else np.float32(0)
    for window in range(windows):
        for f in range(filters):
            feature, number = after[window, f], f * windows + window
            if feature > 0:
                gradient.awake[min(number, gradient.awake.size - 1)] = True
                for u in range(len(network.eight) or units):
                    layer_gradient[number, u] += feature * gradient.output[u]
                    before[window, f] += layer[number, u] * gradient.output[u]
    gradient.layer_bias[:] += gradient.output
    add_kernel(gradient.kernel, gradient.kernel_bias, network.windows.common, windows, before)
    rows = network.first[count]
    add_kernel(gradient.kernel, gradient.kernel_bias, network.patch, rows, own_before)


@compiled
def add_kernel(kernel: Any, bias: Any, patch: Any, count: int, before: Any) -> None:
    """Add to the gradients of kernel and bias, given that of the convolution of windows."""
    for row in range(count):
        for f in range(bias.size):
            bias[f] += before[row, f]
        for at in range(9):
            seen = patch[row, at]
            if seen != 0:
                for f in range(bias.size):
                    kernel[at, f] += seen * before[row, f]


@compiled
def adam(online: Any, gradient: Any, mean: Any, square: Any, rate: float, updates: int) -> None:
    """Take Adam's step number `updates` (Kingma and Ba 2015, with torch's place of epsilon)."""
    step = np.float32(rate / (1 - BETA_1**updates))
    root = np.float32(1 / np.sqrt(1 - BETA_2**updates))
    one, two, always = np.float32(1 - BETA_1), np.float32(1 - BETA_2), np.ones((2, 1), np.bool_)
    first = online.kernel.size + online.kernel_bias.size
    ends = 0, first, first + online.layer.size, online.weights.size
    for part, awake in enumerate((always[0], gradient.awake, always[1])):
        start, end, shape = ends[part], ends[part + 1], (len(awake), -1)
        weights = online.weights[start:end].reshape(shape)
        slopes = gradient.weights[start:end].reshape(shape)
        means = mean.weights[start:end].reshape(shape)
        squares = square.weights[start:end].reshape(shape)
        for row in range(len(awake)):
            if not awake[row]:  # it has neither a gradient nor a mean of earlier ones
                for number in range(weights.shape[1]):
                    squares[row, number] -= two * squares[row, number]
                continue
            momentum = np.float32(0)
            for number in range(weights.shape[1]):
                slope, average = slopes[row, number], means[row, number]
                average += one * (slope - average)
                # Most fade away, as few features live: a processor is slow where it is denormal.
                average = average if abs(average) > LEAST else np.float32(0)
                means[row, number], momentum = average, momentum + abs(average)
                squares[row, number] += two * (slope * slope - squares[row, number])
                divisor = np.sqrt(squares[row, number]) * root + EPSILON
                weights[row, number] -= step * average / divisor
                slopes[row, number] = 0
            awake[row] = momentum != 0
