"""Double DQN of the paper's network, compiled: the steps and updates of `Trainer`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ddqn_planner.model.networks import ROBOT
from ddqn_planner.model.shared_background import (
    Network,
    changes,
    compiled,
    evaluate,
    look,
    network_of,
    windows_of,
)
from ddqn_planner.training.double_dqn import ReplayBuffer
from ddqn_planner.training.environment import GridVectorEnvironment
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.networks import PaperModule

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8  # Adam's, as torch has them

MOST_STEPS = 50  # in one call, up to the next multiple of it: there an evaluation may be due


class Numbers(NamedTuple):
    """Hyper-parameters by their names."""

    learning_rate: float
    gamma: float
    learning_starts: int
    update_interval: int
    target_interval: int
    epsilon_start: float
    epsilon_end: float
    epsilon_steps: int
    max_episode_steps: int


class Robots(NamedTuple):
    """The N robots of an environment, and the cells that they enter: (steps, N)."""

    scenario: NDArray[np.int64]
    cell: NDArray[np.int64]
    steps: NDArray[np.int64]
    total_reward: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    trail: NDArray[np.int64]


def player(
    module: PaperModule,
    target: PaperModule,
    moments: Mapping[Any, Mapping[str, Tensor]],
    environment: GridVectorEnvironment,
    replay: ReplayBuffer,
    total_reward: NDArray[np.float64],
    parameters: HyperParameters,
) -> tuple[Robots, Callable[..., int]]:
    """Return `play` for a module, its target and Adam's moments, which it changes in place."""
    windows = windows_of(environment.background, environment.shape, ROBOT)

    def network(tensors: Sequence[Tensor]) -> Network:
        arrays = [tensor.detach().numpy() for tensor in tensors]
        return network_of(arrays, len(windows.common))

    weights = [*module.parameters()]
    means, squares = ([moments[w][name] for w in weights] for name in ("exp_avg", "exp_avg_sq"))
    parts: list[Sequence[Tensor]] = [
        weights,
        [*target.parameters()],
        [w.clone() for w in weights],
        means,
        squares,
    ]
    networks: Any = [network(part) for part in parts]
    flat = tuple(tuple(array.reshape(-1) for array in part[:6]) for part in networks)
    terminated, truncated = np.zeros((2, parameters.environments), np.bool_)
    trail = np.zeros((MOST_STEPS, parameters.environments), np.int64)
    e = environment
    robots = Robots(e.scenario, e.cell, e.steps, total_reward, terminated, truncated, trail)
    numbers = Numbers(*(getattr(parameters, name) for name in Numbers._fields))
    kind = ("double_dqn", "dqn", "printed").index(parameters.target)
    game = numbers, kind, (e.legal, e.rewards, e.offset, e.goal), windows
    memory = replay.transitions, ReplayBuffer(parameters.batch_size).transitions
    arguments: Any = *game, *networks[:3], flat, *memory, robots
    return robots, partial(play, *arguments)


@compiled
def greedy(q: Any) -> int:
    """Return the first action of the greatest Q (8,)."""
    best = 0
    for action in range(1, 8):
        if q[action] > q[best]:
            best = action
    return best


@compiled
def differentiate(
    batch: Any, windows: Any, online: Any, target: Any, kind: int, gradient: Any, flat: Any
) -> float:
    """Set the gradient of the mean squared error of a batch, see `double_dqn_loss`; return it."""
    count, filters = online.after.shape
    units, size, most = online.output.size, batch.cell.size, 4 + windows.differing.size
    changed, patch = np.empty(most, np.int64), np.empty((most, 9), np.float32)
    before, output = np.empty((most, filters), np.float32), np.empty(units, np.float32)
    q, q_target = np.empty(8, np.float32), np.empty(8, np.float32)
    error, errors = np.empty(units, np.float32), np.zeros(units, np.float32)
    # What goes back to the common windows, and the kernel's gradient.
    back, kernel = np.zeros((count, filters), np.float32), np.zeros((9, filters), np.float32)
    for part in flat:
        for number in range(part.size):
            part[number] = 0
    loss = 0.0
    for n in range(size):
        scenario, action = batch.scenario[n], batch.action[n]
        found = changes(windows, scenario, batch.next_cell[n], changed, patch)
        evaluate(target, changed, patch, found, before, output, q_target)
        evaluate(online, changed, patch, found, before, output, q)
        best = greedy(q_target if kind == 1 else q)
        y = batch.reward[n] + batch.discount[n] * (q if kind == 2 else q_target)[best]
        found = changes(windows, scenario, batch.cell[n], changed, patch)
        evaluate(online, changed, patch, found, before, output, q)
        loss += (q[action] - y) ** 2 / size
        slope = np.float32(2) * (q[action] - y) / size
        pass_back_last(online, gradient, output, action, slope, error)
        for u in range(len(online.eight) or units):
            errors[u] += error[u]
        for number in range(found):
            window = changed[number]
            for f in range(filters):
                feature = max(before[number, f], np.float32(0))
                change = feature - online.after[window, f]
                through = pass_back(online, gradient, f * count + window, change, error)
                if online.after[window, f] > 0:
                    back[window, f] -= through
                before[number, f] = through if feature > 0 else np.float32(0)
            spread(before, number, patch, number, gradient.kernel_bias, kernel)
    for window in range(count):
        for f in range(filters):
            feature = online.after[window, f]
            if feature > 0:
                back[window, f] += pass_back(online, gradient, f * count + window, feature, errors)
        spread(back, window, windows.common, window, gradient.kernel_bias, kernel)
    for u in range(units):
        gradient.layer_bias[u] = errors[u]
    for f in range(filters):
        for at in range(9):
            gradient.kernel[f, at] = kernel[at, f]
    return loss


@compiled
def pass_back_last(
    network: Any, gradient: Any, output: Any, action: int, slope: Any, error: Any
) -> None:
    """Set the error (U,) of the outputs, given that of an action; add the last layer's gradient."""
    for u in range(len(network.eight) or output.size):
        error[u] = 0
    if len(network.eight):
        error[action] = slope
        return
    gradient.last_bias[action] += slope
    for u in range(output.size):
        if output[u] > 0:
            gradient.last[action, u] += slope * output[u]
            error[u] = slope * network.last[action, u]


@compiled
def pass_back(network: Any, gradient: Any, row: int, feature: Any, error: Any) -> Any:
    """Add to the gradient of a feature's weights; return that of the feature."""
    through = np.float32(0)
    for u in range(len(network.eight) or error.size):
        gradient.layer[row, u] += feature * error[u]
        through += network.layer[row, u] * error[u]
    return through


@compiled
def spread(back: Any, row: int, patch: Any, number: int, bias: Any, kernel: Any) -> None:
    """Add to the gradients of bias (F,) and kernel (9, F) what goes back to a window."""
    for f in range(bias.size):
        bias[f] += back[row, f]
    for at in range(9):
        seen = patch[number, at]
        if seen != 0:
            for f in range(bias.size):
                kernel[at, f] += seen * back[row, f]


@compiled
def adam(weight: Any, gradient: Any, mean: Any, square: Any, rate: float, updates: int) -> None:
    """Take Adam's step number `updates` (Kingma and Ba 2015, with torch's place of epsilon)."""
    step = np.float32(rate / (1 - BETA_1**updates))
    root = np.float32(1 / np.sqrt(1 - BETA_2**updates))
    one, two, epsilon = np.float32(1 - BETA_1), np.float32(1 - BETA_2), np.float32(EPSILON)
    for number in range(weight.size):
        slope = gradient[number]
        mean[number] += one * (slope - mean[number])
        square[number] += two * (slope * slope - square[number])
        weight[number] -= step * mean[number] / (np.sqrt(square[number]) * root + epsilon)


@compiled
def play(
    numbers: Any,
    kind: int,
    game: Any,
    windows: Any,
    online: Any,
    target: Any,
    gradient: Any,
    flat: Any,
    replay: Any,
    batch: Any,
    robots: Any,
    exploration: Any,
    sampling: Any,
    counters: Any,
    until: int,
) -> int:
    """Make steps until an episode ends, or `until`; return how many.

    The counters are steps, updates and replayed transitions.
    """
    weights, targets, gradients, means, squares = flat
    legal, rewards, offset, goal = game
    scenario, cell, episode_steps, total_reward, terminated, truncated, trail = robots
    look(online, windows)
    look(target, windows)
    most, count, made = 4 + windows.differing.size, cell.size, 0
    changed, patch = np.empty(most, np.int64), np.empty((most, 9), np.float32)
    before = np.empty((most, online.after.shape[1]), np.float32)
    output, q = np.empty(online.output.size, np.float32), np.empty(8, np.float32)
    actions, is_over = np.empty(count, np.int64), False
    steps, updates, added = counters
    until = min(until, (steps // MOST_STEPS + 1) * MOST_STEPS)
    while steps < until and not is_over:
        share = min(steps / numbers.epsilon_steps, 1.0)
        epsilon = numbers.epsilon_start + share * (numbers.epsilon_end - numbers.epsilon_start)
        for n in range(count):
            actions[n] = exploration.integers(0, 8)
        for n in range(count):
            if exploration.random() >= epsilon:
                found = changes(windows, scenario[n], cell[n], changed, patch)
                evaluate(online, changed, patch, found, before, output, q)
                actions[n] = greedy(q)
        for n in range(count):
            at = scenario[n], actions[n], cell[n]
            after = cell[n] + offset[actions[n]] if legal[at] else cell[n]
            episode_steps[n] += 1
            terminated[n] = not legal[at] or after == goal[scenario[n]]
            truncated[n] = not terminated[n] and episode_steps[n] >= numbers.max_episode_steps
            is_over |= terminated[n] or truncated[n]
            slot = added % replay.cell.size
            replay.scenario[slot], replay.action[slot], replay.cell[slot] = at
            replay.reward[slot], replay.next_cell[slot] = rewards[at], after
            replay.discount[slot] = 0.0 if terminated[n] else numbers.gamma
            total_reward[n] += rewards[at]
            cell[n] = trail[made, n] = after
            added += 1
        made, steps_before, steps = made + 1, steps, steps + count
        due = steps // numbers.update_interval - steps_before // numbers.update_interval
        for _ in range(due if steps > numbers.learning_starts else 0):
            for n in range(batch.cell.size):
                slot = sampling.integers(0, min(added, replay.cell.size))
                batch.scenario[n], batch.action[n] = replay.scenario[slot], replay.action[slot]
                batch.cell[n], batch.next_cell[n] = replay.cell[slot], replay.next_cell[slot]
                batch.reward[n], batch.discount[n] = replay.reward[slot], replay.discount[slot]
            differentiate(batch, windows, online, target, kind, gradient, gradients)
            updates += 1
            for part in range(len(weights)):
                rate = numbers.learning_rate
                adam(weights[part], gradients[part], means[part], squares[part], rate, updates)
            look(online, windows)
            if updates % numbers.target_interval == 0:
                for part in range(len(weights)):
                    for number in range(weights[part].size):
                        targets[part][number] = weights[part][number]
                look(target, windows)
    counters[0], counters[1], counters[2] = steps, updates, added
    return made
