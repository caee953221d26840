"""Double DQN of the paper's network, compiled: the steps and updates of `Trainer`.

What all states of a map share is computed once. A robot changes at most four windows of the
convolution; S maps of one kind differ from what most of them show in a few windows more. C = cells
of a map, L = windows, F = filters, U = outputs of the layer after the convolution, D = windows that
may differ.
"""

from collections import namedtuple
from collections.abc import Iterable, Sequence
from dataclasses import fields
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner import compiled as compiling
from ddqn_planner.model.networks import ROBOT, window_cells
from ddqn_planner.training.double_dqn import ReplayBuffer
from ddqn_planner.training.environment import GridVectorEnvironment
from ddqn_planner.training.hyper_parameters import HyperParameters

Floats = NDArray[np.floating[Any]]
Integers = NDArray[np.int64]

# Sums in any order, so that eight are added at once; NaN and infinity as ever.
FLAGS = {"reassoc": True, "contract": True, "arcp": True, "nsz": True}  # a set has no fixed order
compiled = partial(compiling.compiled, fastmath=FLAGS)

BETA_1, BETA_2, EPSILON = 0.9, 0.999, np.float32(1e-8)  # Adam's, as torch has them
LEAST = np.float32(1e-30)  # mean of a gradient: less moves no weight
DQN, PRINTED = 1, 2  # other targets than Double DQN's
WINDOWS = 5_000  # that the steps of one call look at: so it returns within milliseconds

Tensors = dict[str, NDArray[np.float32]]

# The hyper-parameters that are numbers, for compiled code.
NUMBERS: Any = {f.name: type(f.default) for f in fields(HyperParameters) if f.type in (int, float)}
Numbers: Any = namedtuple("Numbers", [*NUMBERS])  # type: ignore[misc]


class Windows(NamedTuple):
    """What the convolution sees of the maps without a robot."""

    common: Floats  # (L, 9): each window as most maps have it
    own: Floats  # (S, L, 9): as each map has it
    differing: Integers  # the windows of map 0 that are not the common ones, those of map 1, ...
    ends: Integers  # (S + 1,): those of map s are from ends[s] to before ends[s + 1]
    shape: tuple[int, int]  # (H, W)


class Network(NamedTuple):
    """A module's weights, and what it makes of the common windows and of B states."""

    weights: Floats  # all that follow, up to `last_bias`
    kernel: Floats  # (9, F)
    kernel_bias: Floats  # (F,)
    layer: Floats  # (F * L, U)
    layer_bias: Floats  # (U,)
    last: Floats  # (U, 8), empty without a hidden layer: then U is 8
    last_bias: Floats
    after: Floats  # (L, F): the convolution after ReLU
    output: Floats  # (U,): of the layer after the convolution
    patch: Floats  # (B * D, 9): each state's windows that are not the common ones
    changed: Integers  # (B * D,): which they are
    first: Integers  # (B + 1,): those of state n are from first[n] to before first[n + 1]
    own_before: Floats  # (B * D, F): their convolution before ReLU
    own_output: Floats  # (B, U): of the layer after it
    q: Floats  # (B, 8)
    windows: Windows
    eight: tuple[int, ...]  # of 8 zeros where U is 8: a known number of turns is twice as fast


def arrays_of(
    parts: tuple[Tensors, ...], environment: GridVectorEnvironment, replay: ReplayBuffer
) -> tuple[Any, Any, Any]:
    """Return what `play` takes of a training: its game, what it learns, and its robots."""
    e, p = environment, environment.parameters
    online, target, mean, square = parts
    gradient = {name: np.zeros_like(tensor) for name, tensor in online.items()}
    all_parts = online, target, gradient, mean, square
    networks = networks_of(environment, all_parts, max(p.batch_size, p.environments))
    kind = ("double_dqn", "dqn", "printed").index(p.target)
    numbers = Numbers(*(as_number(getattr(p, name)) for name, as_number in NUMBERS.items()))
    robots = e.scenario, e.cell, e.steps, e.visited, e.total_reward, e.terminated, e.truncated
    game = e.legal, e.rewards, e.next_cell, e.goal
    return game, (numbers, kind, networks, replay.transitions), robots


def networks_of(
    environment: GridVectorEnvironment, parts: Iterable[Tensors], batch: int
) -> tuple[Network, ...]:
    """Return networks of the paper's tensors, which from now on are parts of them."""
    windows = windows_of(environment.background, environment.shape)
    networks = []
    for tensors in parts:
        network: Any = network_of([*tensors.values()], windows, batch)
        for (name, tensor), array in zip(tensors.items(), network[1:], strict=False):
            tensors[name] = array.T.reshape(tensor.shape)
        networks.append(network)
    return tuple(networks)


def windows_of(background_SC: Floats, shape: tuple[int, int]) -> Windows:
    """Cut backgrounds of maps of shape (H, W) into windows."""
    cut_L9 = window_cells(shape)
    background_SC = np.pad(background_SC, [(0, 0), (0, 1)])  # 0 outside the map
    own = background_SC[:, cut_L9]
    common = np.sort(background_SC, axis=0)[len(own) // 2][cut_L9]
    scenario, differing = np.nonzero((own != common).any(axis=2))
    ends = np.searchsorted(scenario, np.arange(len(own) + 1))
    return Windows(common, own, differing, ends, shape)


def network_of(tensors: Sequence[Floats], windows: Windows, batch: int) -> Network:
    """Return a network for B states with a copy of a model's tensors, as exact as the windows."""
    turned = [t.T if t.ndim < 3 else t.reshape(-1, 9).T for t in tensors]
    turned += [np.zeros((0, 8)), np.zeros(0)][: 6 - len(turned)]
    zeros: Any = partial(np.zeros, dtype=windows.own.dtype)
    weights = np.concatenate([array.ravel() for array in turned], dtype=windows.own.dtype)
    ends = np.cumsum([array.size for array in turned])[:-1]
    parts = [p.reshape(t.shape) for p, t in zip(np.split(weights, ends), turned, strict=True)]
    of_all = len(windows.common), len(tensors[0])
    units, rows = len(tensors[3]), batch * (4 + int(np.diff(windows.ends).max()))
    common = zeros(of_all), zeros(units), zeros((rows, 9))
    numbers = np.zeros(rows, np.int64), np.zeros(batch + 1, np.int64)
    own = zeros((rows, of_all[1])), zeros((batch, units))
    q, eight = (zeros((batch, 8)), ()) if len(tensors) > 4 else (own[1], (0,) * 8)
    return Network._make([weights, *parts, *common, *numbers, *own, q, windows, eight])


@compiled
def look(network: Any) -> None:
    """Compute what a network makes of the common windows."""
    layer, after, output = network.layer, network.after, network.output
    count, filters = after.shape
    convolve(network.kernel, network.kernel_bias, network.windows.common, count, after)
    output[:] = network.layer_bias
    for f in range(filters):
        for window in range(count):
            feature = after[window, f] = max(after[window, f], np.float32(0))
            if feature != 0:
                for u in range(len(network.eight) or output.size):
                    output[u] += feature * layer[f * count + window, u]


@compiled
def convolve(kernel: Any, bias: Any, patch: Any, count: int, before: Any) -> None:
    """Compute the convolution of so many windows."""
    for row in range(count):
        for f in range(bias.size):
            before[row, f] = bias[f]
        for at in range(9):
            seen = patch[row, at]
            if seen != 0:
                for f in range(bias.size):
                    before[row, f] += seen * kernel[at, f]


@compiled
def evaluate(network: Any, scenario: Any, cell: Any) -> None:
    """Compute Q of robots in cells (B,) of maps (B,)."""
    see(network, scenario, cell)
    layer, last, output, q = network.layer, network.last, network.own_output, network.q
    first, after, before = network.first, network.after, network.own_before
    (count, filters), units = after.shape, network.output.size
    convolve(network.kernel, network.kernel_bias, network.patch, first[cell.size], before)
    for n in range(cell.size):
        output[n] = network.output
        for row in range(first[n], first[n + 1]):
            window, seen = network.changed[row], np.float32(0)
            for f in range(filters):
                seen += abs(max(before[row, f], np.float32(0)) - after[window, f])
            for f in range(filters if seen != 0 else 0):
                change = max(before[row, f], np.float32(0)) - after[window, f]
                if change != 0:
                    for u in range(len(network.eight) or units):
                        output[n, u] += change * layer[f * count + window, u]
        if not len(network.eight):
            q[n] = network.last_bias
            for u in range(units):
                for action in range(8 if output[n, u] > 0 else 0):  # most are not
                    q[n, action] += output[n, u] * last[u, action]


@compiled
def see(network: Any, scenario: Any, cell: Any) -> None:
    """Cut the windows that are not the common ones of maps (B,) with robots in cells (B,)."""
    windows, changed, patch, first = network.windows, network.changed, network.patch, network.first
    own, (height, width), end = windows.own, windows.shape, 0
    for n in range(cell.size):
        y, x = divmod(cell[n], width)
        for row in range(y // 2, min((y + 1) // 2, (height - 1) // 2) + 1):
            for column in range(x // 2, min((x + 1) // 2, (width - 1) // 2) + 1):
                changed[end] = row * ((width + 1) // 2) + column
                for at in range(9):  # a copy of a slice takes three times as long
                    patch[end, at] = own[scenario[n], changed[end], at]
                patch[end, 3 * (y + 1 - 2 * row) + x + 1 - 2 * column] = ROBOT
                end += 1
        with_robot = end
        for number in range(windows.ends[scenario[n]], windows.ends[scenario[n] + 1]):
            window, is_new = windows.differing[number], True
            for other in range(first[n], with_robot):
                is_new &= changed[other] != window
            if is_new:
                changed[end] = window
                for at in range(9):
                    patch[end, at] = own[scenario[n], window, at]
                end += 1
        first[n + 1] = end


@compiled
def play(game: Any, learning: Any, robots: Any, random: Any, counters: Any, until: int) -> None:
    """Make steps until an episode ends, or `until`, or some milliseconds have passed.

    The counters are steps, updates and replayed transitions.
    """
    legal, rewards, next_cell, goal = game
    numbers, _, networks, replay = learning
    scenario, cell, episode_steps, visited, total_reward, terminated, truncated = robots
    exploration, sampling = random
    online, target = networks[:2]
    look(online)
    look(target)
    count, is_over = cell.size, False
    actions = np.empty(count, np.int64)
    until = min(until, counters[0] + count * max(1, WINDOWS // len(online.after)))
    while counters[0] < until and not is_over:
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
            cell[n] = visited[n, episode_steps[n]] = after
        before, counters[0] = counters[0], counters[0] + count
        due = counters[0] // numbers.update_interval - before // numbers.update_interval
        for _ in range(due if counters[0] > numbers.learning_starts else 0):
            update(learning, sampling, counters)


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
    layer, layer_gradient, error = network.layer, gradient.layer, gradient.own_output
    after, before, own_before = network.after, gradient.after, gradient.own_before
    gradient.output[:] = 0
    before[:] = 0  # by what is before ReLU
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
    one, two = np.float32(1 - BETA_1), np.float32(1 - BETA_2)
    weights, slopes, means, squares = online.weights, gradient.weights, mean.weights, square.weights
    for number in range(weights.size):
        slope, average = slopes[number], means[number]
        average += one * (slope - average)
        # Most fade away, as few features live: a processor is slow where it is denormal.
        average = average if abs(average) > LEAST else np.float32(0)
        means[number] = average
        squares[number] += two * (slope * slope - squares[number])
        weights[number] -= step * average / (np.sqrt(squares[number]) * root + EPSILON)
        slopes[number] = 0
