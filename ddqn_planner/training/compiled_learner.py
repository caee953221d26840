"""Double DQN of the paper's network, compiled: the steps and updates of `Trainer`.

What all states of a map share is computed once. A robot changes at most four windows of the
convolution; S maps of one kind differ from what most of them show in a few windows more. C = cells
of a map, L = windows, F = filters, U = outputs of the layer after the convolution, D = windows that
may differ.
"""

from collections import namedtuple
from collections.abc import Sequence
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
FLAGS = {
    "reassoc": True,
    "contract": True,
    "arcp": True,
    "nsz": True,
}  # a set has no fixed order
compiled, inner = (
    partial(each, fastmath=FLAGS) for each in (compiling.compiled, compiling.inner)
)
inner_in_place = partial(
    inner, _nrt=False
)  # without counts of references, as it makes no array

BETA_1, BETA_2, EPSILON = 0.9, 0.999, np.float32(1e-8)  # Adam's, as torch has them
LEAST = np.float32(1e-30)  # mean of a gradient: less moves no weight
WINDOWS = 5_000  # that the steps of one call look at: so it returns within milliseconds

# The hyper-parameters that are numbers, for compiled code.
NUMBERS: Any = {
    f.name: type(f.default) for f in fields(HyperParameters) if f.type in (int, float)
}
Numbers: Any = namedtuple("Numbers", [*NUMBERS])  # type: ignore[misc]


class Windows(NamedTuple):
    """What the convolution sees of the maps without a robot, and of B states."""

    common: Floats  # (L, 9): each window as most maps have it
    own: Floats  # (S, L, 9): as each map has it
    differing: Integers  # the windows of map 0 that are not the common ones, those of map 1, ...
    ends: Integers  # (S + 1,): those of map s are from ends[s] to before ends[s + 1]
    shape: tuple[int, int]  # (H, W)
    patch: Floats  # (B * D, 9): each state's windows that are not the common ones
    changed: Integers  # (B * D,): which they are
    first: (
        Integers  # (B + 1,): those of state n are from first[n] to before first[n + 1]
    )
    before: Floats  # (B * D, F): their convolution before ReLU by the network that was asked last


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
    own_output: Floats  # (B, U): of the layer after it
    q: Floats  # (B, 8)
    eight: tuple[
        int, ...
    ]  # of 8 zeros where U is 8: a known number of turns is twice as fast


def arrays_of(
    parts: Sequence[dict[str, Any]],
    environment: GridVectorEnvironment,
    replay: ReplayBuffer,
) -> tuple[Any, Any, Any]:
    """Return what `play` takes of a training: its game, what it learns, and its robots."""
    e, p = environment, environment.parameters
    slopes = {name: np.zeros_like(tensor) for name, tensor in parts[0].items()}
    most = max(p.batch_size, p.environments)
    windows, networks = networks_of(e.background, e.shape, [*parts, slopes], most)
    online, target, mean, square, gradient = networks
    selection = target if p.target == "dqn" else online  # see `double_dqn_gradient`
    evaluation = online if p.target == "printed" else target
    numbers = Numbers(
        *(as_number(getattr(p, name)) for name, as_number in NUMBERS.items())
    )
    batch, actions = ReplayBuffer(p.batch_size).transitions, np.zeros_like(e.cell)
    of_update = batch, selection.q, evaluation.q, gradient, mean.weights, square.weights
    learning = numbers, windows, online, target, replay.transitions, *of_update
    robots = e.scenario, e.cell, actions, e.steps, e.visited, e.total_reward
    game = e.legal, e.rewards, e.next_cell, e.goal
    return game, learning, (*robots, e.terminated, e.truncated)


def networks_of(
    background_SC: Floats,
    shape: tuple[int, int],
    parts: Sequence[dict[str, Any]],
    batch: int,
) -> tuple[Windows, list[Network]]:
    """Return networks of the paper's tensors, which from now on are parts of them, for B states.

    The maps are of shape (H, W); all floats are as exact as their backgrounds.
    """
    zeros: Any = partial(np.zeros, dtype=background_SC.dtype)
    own = np.pad(background_SC, [(0, 0), (0, 1)])[
        :, window_cells(shape)
    ]  # 0 outside the map
    common = np.sort(own, axis=0)[len(own) // 2]
    scenario, differing = np.nonzero((own != common).any(axis=2))
    ends = np.searchsorted(scenario, np.arange(len(own) + 1))
    rows, filters = (
        batch * (4 + int(np.diff(ends).max())),
        len(parts[0]["convolution.bias"]),
    )
    seen = zeros((rows, 9)), np.zeros(rows, np.int64), np.zeros(batch + 1, np.int64)
    windows = Windows(
        common, own, differing, ends, shape, *seen, zeros((rows, filters))
    )
    networks = []
    for tensors in parts:
        turned = [t.T if t.ndim < 3 else t.reshape(-1, 9).T for t in tensors.values()]
        turned += [np.zeros((0, 8)), np.zeros(0)][: 6 - len(turned)]
        weights = np.concatenate([array.ravel() for array in turned], dtype=own.dtype)
        split = np.split(weights, np.cumsum([array.size for array in turned])[:-1])
        layers: Any = [
            part.reshape(t.shape) for part, t in zip(split, turned, strict=True)
        ]
        units, has_last = len(layers[3]), len(tensors) > 4
        for (name, tensor), array in zip(tensors.items(), layers, strict=False):
            tensors[name] = array.T.reshape(tensor.shape)
        own_output, of_common = (
            zeros((batch, units)),
            (zeros((len(common), filters)), zeros(units)),
        )
        q, eight = (zeros((batch, 8)), ()) if has_last else (own_output, (0,) * 8)
        networks.append(
            Network._make([weights, *layers, *of_common, own_output, q, eight])
        )
    return windows, networks


@inner_in_place
def put(values: Any, array: Any) -> None:
    """Copy values into an array (N,)."""
    for n in range(array.size):
        array[n] = values[n]


@inner_in_place
def add(values: Any, array: Any) -> None:
    """Add values to an array (N,)."""
    for n in range(array.size):
        array[n] += values[n]


@inner_in_place
def look(network: Any, windows: Any) -> None:
    """Compute what a network makes of the common windows."""
    layer, after, output = network.layer, network.after, network.output
    count, filters = after.shape
    convolve(network.kernel, network.kernel_bias, windows.common, count, after)
    put(network.layer_bias, output)
    for f in range(filters):
        for window in range(count):
            feature = after[window, f] = max(after[window, f], np.float32(0))
            if feature != 0:
                for u in range(len(network.eight) or output.size):
                    output[u] += feature * layer[f * count + window, u]


@inner_in_place
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


@inner_in_place
def evaluate(network: Any, windows: Any, scenario: Any, cell: Any) -> None:
    """Compute Q of robots in cells (B,) of maps (B,)."""
    see(windows, scenario, cell)
    layer, last, output, q = network.layer, network.last, network.own_output, network.q
    first, changed, after, before = (
        windows.first,
        windows.changed,
        network.after,
        windows.before,
    )
    (count, filters), units = after.shape, network.output.size
    convolve(
        network.kernel, network.kernel_bias, windows.patch, first[cell.size], before
    )
    for n in range(cell.size):
        put(network.output, output[n])
        for row in range(first[n], first[n + 1]):
            window, seen = changed[row], np.float32(0)
            for f in range(filters):
                seen += abs(max(before[row, f], np.float32(0)) - after[window, f])
            for f in range(filters if seen != 0 else 0):
                change = max(before[row, f], np.float32(0)) - after[window, f]
                if change != 0:
                    for u in range(len(network.eight) or units):
                        output[n, u] += change * layer[f * count + window, u]
        if not len(network.eight):
            put(network.last_bias, q[n])
            for u in range(units):
                for action in range(8 if output[n, u] > 0 else 0):  # most are not
                    q[n, action] += output[n, u] * last[u, action]


@inner_in_place
def see(windows: Any, scenario: Any, cell: Any) -> None:
    """Cut the windows that are not the common ones of maps (B,) with robots in cells (B,)."""
    changed, patch, first = windows.changed, windows.patch, windows.first
    differing, ends = windows.differing, windows.ends
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
        for number in range(ends[scenario[n]], ends[scenario[n] + 1]):
            window, is_new = differing[number], True
            for other in range(first[n], with_robot):
                is_new &= changed[other] != window
            if is_new:
                changed[end] = window
                for at in range(9):
                    patch[end, at] = own[scenario[n], window, at]
                end += 1
        first[n + 1] = end


@compiled
def play(
    game: Any, learning: Any, robots: Any, random: Any, counters: Any, until: int
) -> None:
    """Make steps until an episode ends, or `until`, or some milliseconds have passed.

    The counters are steps, updates and replayed transitions.
    """
    legal, rewards, next_cell, goal = game
    numbers, windows, online, target, replay = learning[:5]
    (
        scenario,
        cell,
        actions,
        episode_steps,
        visited,
        total_reward,
        terminated,
        truncated,
    ) = robots
    exploration, sampling = random
    look(online, windows)
    look(target, windows)
    count, is_over = cell.size, False
    until = min(until, counters[0] + count * max(1, WINDOWS // len(online.after)))
    while counters[0] < until and not is_over:
        share = min(counters[0] / numbers.epsilon_steps, 1.0)
        epsilon = numbers.epsilon_start + share * (
            numbers.epsilon_end - numbers.epsilon_start
        )
        for n in range(count):
            actions[n] = exploration.integers(0, 8)
        evaluate(online, windows, scenario, cell)
        for n in range(count):
            if exploration.random() >= epsilon:
                actions[n] = online.q[n].argmax()
        for n in range(count):
            at = scenario[n], actions[n], cell[n]
            after = next_cell[actions[n], cell[n]] if legal[at] else cell[n]
            episode_steps[n] += 1
            terminated[n] = not legal[at] or after == goal[scenario[n]]
            truncated[n] = (
                not terminated[n] and episode_steps[n] >= numbers.max_episode_steps
            )
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


@inner
def update(learning: Any, sampling: Any, counters: Any) -> None:
    """Make one Double DQN update with a batch from the replay buffer, see `double_dqn_gradient`."""
    numbers, windows, online, target, replay = learning[:5]
    batch, selection, evaluation, gradient, mean, square = learning[5:]
    size = batch.cell.size
    for n in range(size):
        slot = sampling.integers(0, min(counters[2], replay.cell.size))
        batch.scenario[n], batch.cell[n] = replay.scenario[slot], replay.cell[slot]
        batch.action[n], batch.next_cell[n] = (
            replay.action[slot],
            replay.next_cell[slot],
        )
        batch.reward[n], batch.discount[n] = replay.reward[slot], replay.discount[slot]
    evaluate(online, windows, batch.scenario, batch.next_cell)
    evaluate(target, windows, batch.scenario, batch.next_cell)
    for n in range(size):
        best = selection[n].argmax()
        batch.reward[n] += batch.discount[n] * evaluation[n, best]  # the target y
    evaluate(online, windows, batch.scenario, batch.cell)
    gradient.q[:] = 0
    for n in range(size):
        action = batch.action[n]
        gradient.q[n, action] = 2 * (online.q[n, action] - batch.reward[n]) / size
    differentiate(online, windows, gradient, size)
    counters[1] += 1
    adam(
        online.weights,
        gradient.weights,
        mean,
        square,
        numbers.learning_rate,
        counters[1],
    )
    look(online, windows)
    if counters[1] % numbers.target_interval == 0:
        put(online.weights, target.weights)
        look(target, windows)


@inner_in_place
def differentiate(network: Any, windows: Any, gradient: Any, count: int) -> None:
    """Add to a loss's gradients, given that by Q of the states that a network has seen."""
    layer, layer_gradient, error = network.layer, gradient.layer, gradient.own_output
    # Where the convolution of a state's windows is read, its gradient is written.
    after, before, own_before = network.after, gradient.after, windows.before
    gradient.output[:] = 0
    before[:] = 0  # by what is before ReLU
    (total, filters), units = after.shape, network.output.size
    for n in range(count):
        if not len(network.eight):
            add(gradient.q[n], gradient.last_bias)
            for u in range(units):
                output, error[n, u] = max(network.own_output[n, u], np.float32(0)), 0
                for action in range(8 if output > 0 else 0):
                    gradient.last[u, action] += gradient.q[n, action] * output
                    error[n, u] += gradient.q[n, action] * network.last[u, action]
        add(error[n], gradient.output)
        for row in range(windows.first[n], windows.first[n + 1]):
            window = windows.changed[row]
            for f in range(filters):
                feature, through = max(own_before[row, f], np.float32(0)), np.float32(0)
                change, number = feature - after[window, f], f * total + window
                if (
                    feature != 0 or change != 0
                ):  # most features are 0, with the robot and without
                    for u in range(len(network.eight) or units):
                        layer_gradient[number, u] += change * error[n, u]
                        through += layer[number, u] * error[n, u]
                    if after[window, f] > 0:
                        before[window, f] -= through
                own_before[row, f] = through if feature > 0 else np.float32(0)
    for window in range(total):
        for f in range(filters):
            feature, number = after[window, f], f * total + window
            if feature > 0:
                for u in range(len(network.eight) or units):
                    layer_gradient[number, u] += feature * gradient.output[u]
                    before[window, f] += layer[number, u] * gradient.output[u]
    add(gradient.output, gradient.layer_bias)
    add_kernel(gradient.kernel, gradient.kernel_bias, windows.common, total, before)
    rows = windows.first[count]
    add_kernel(gradient.kernel, gradient.kernel_bias, windows.patch, rows, own_before)


@inner_in_place
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


@inner_in_place
def adam(
    weights: Any, slopes: Any, means: Any, squares: Any, rate: float, updates: int
) -> None:
    """Take Adam's step number `updates` (Kingma and Ba 2015, with torch's place of epsilon)."""
    step = np.float32(rate / (1 - BETA_1**updates))
    root = np.float32(1 / np.sqrt(1 - BETA_2**updates))
    one, two = np.float32(1 - BETA_1), np.float32(1 - BETA_2)
    for number in range(weights.size):
        slope, average = slopes[number], means[number]
        average += one * (slope - average)
        # Most fade away, as few features live: a processor is slow where it is denormal.
        average = average if abs(average) > LEAST else np.float32(0)
        means[number] = average
        squares[number] += two * (slope * slope - squares[number])
        weights[number] -= step * average / (np.sqrt(squares[number]) * root + EPSILON)
        slopes[number] = 0
