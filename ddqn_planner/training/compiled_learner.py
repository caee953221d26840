"""Double DQN of the paper's network, compiled: the steps and updates of `Trainer`.

Most of what the convolution sees is the same for all states of a map, and computed
once. A robot changes at most four windows of the convolution, and S maps of one kind
differ from the windows that most of them have in common in a few windows more. So a
state's output is that of the common windows, and a correction for each window that
differs.

Dimensions: S maps, L windows of a map, B states, D windows of a state that may differ
from the common ones, F filters, U outputs of the layer after the convolution, N robots,
C cells of a map.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from ddqn_planner import compiled as compiling
from ddqn_planner.model.networks import ROBOT, window_cells
from ddqn_planner.training.double_dqn import NextQ, Q, ReplayBuffer, Transitions
from ddqn_planner.training.environment import GridVectorEnvironment
from ddqn_planner.training.hyper_parameters import HyperParameters

Floats: TypeAlias = NDArray[np.float32]  # or float64, if the maps' backgrounds are
Integers: TypeAlias = NDArray[np.int64]
Flags: TypeAlias = NDArray[np.bool_]

# Floats are added in any order, so that a processor adds eight at once; NaN and
# infinity stay what they are. A dictionary, as a set has no fixed order.
FAST_FLOATS = {"reassoc": True, "contract": True, "arcp": True, "nsz": True}

compiled = partial(compiling.compiled, fastmath=FAST_FLOATS)
inner = partial(compiling.inner, fastmath=FAST_FLOATS)
# For functions that make no array: without counts of references.
inner_in_place = partial(inner, _nrt=False)
inlined = partial(inner_in_place, forceinline=True)

# Adam's decay rates of both moments, and ε, as torch has them.
BETA_1 = 0.9
BETA_2 = 0.999
EPSILON = np.float32(1e-8)
SMALLEST_MEAN = np.float32(1e-30)  # of a gradient: a smaller one moves no weight
# Windows that the steps of one call evaluate, so that it returns within milliseconds.
WINDOWS_OF_A_CALL = 5_000


class Windows(NamedTuple):
    """The 3x3 windows that the convolution sees on S maps, and of B states."""

    common: Floats  # (L, 9): without a robot, as most maps have it
    by_map: Floats  # (S, L, 9): without a robot, as each map has it
    # The windows of map 0 that are not the common ones, those of map 1, ...: the ones
    # of map s lie from first_differing[s] to before first_differing[s + 1].
    differing: Integers
    first_differing: Integers  # (S + 1,)
    shape: tuple[int, int]  # (H, W) of the maps
    # The windows of each state that are not the common ones: those of state n lie from
    # first_changed[n] to before first_changed[n + 1].
    changed: Integers  # (B * D,): their numbers, 0 to L - 1
    first_changed: Integers  # (B + 1,)
    patch: Floats  # (B * D, 9): their cells
    convolved: Floats  # (B * D, F): before ReLU, by the network that was evaluated last


class Network(NamedTuple):
    """The weights of the paper's network, and what it computed last.

    The network of gradients has the gradients by these in their places.
    """

    weights: Floats  # all weights that follow, up to `last_bias`, in a row
    kernel: Floats  # (9, F)
    kernel_bias: Floats  # (F,)
    layer: Floats  # (F * L, U): the layer after the convolution
    layer_bias: Floats  # (U,)
    last: Floats  # (U, 8); empty without a hidden layer: then U is 8
    last_bias: Floats  # (8,), or empty
    common_feature: Floats  # (L, F): convolution of the common windows, after ReLU
    common_output: Floats  # (U,): of the layer after the convolution, for these
    output: Floats  # (B, U): of this layer, for each state
    q: Floats  # (B, 8); without a hidden layer, this is `output`
    # 8 zeros where U is 8, else empty: a loop whose end is known is twice as fast.
    eight: tuple[int, ...]


class Settings(NamedTuple):
    """The hyper-parameters that compiled functions need."""

    gamma: float
    learning_rate: float
    learning_starts: int
    update_interval: int
    target_interval: int
    epsilon_start: float
    epsilon_end: float
    epsilon_steps: int
    max_episode_steps: int


class Game(NamedTuple):
    """What moves lead to, see `GridVectorEnvironment`."""

    legal: Flags  # (S, 8, C)
    rewards: Floats  # (S, 8, C)
    next_cell: Integers  # (8, C)
    goal: Integers  # (S,)


class Robots(NamedTuple):
    """The states of N robots, see `GridVectorEnvironment`."""

    scenario: Integers  # (N,)
    cell: Integers  # (N,)
    action: Integers  # (N,)
    episode_steps: Integers  # (N,)
    visited: Integers  # (N, max_episode_steps + 1)
    total_reward: NDArray[np.float64]  # (N,)
    terminated: Flags  # (N,)
    truncated: Flags  # (N,)


class Learning(NamedTuple):
    """The networks θ and θ⁻, what they learn from, and all buffers of an update."""

    settings: Settings
    windows: Windows
    online: Network
    target: Network
    replay: Transitions  # the whole replay buffer
    batch: Transitions  # what an update draws from it
    next_q: NextQ  # of the batch; parts of `online` and `target`
    gradient: Network
    mean: Floats  # Adam's first moment of the gradient, as `Network.weights`
    square: Floats  # its second moment


class Counters(NamedTuple):
    """What has been done since the training began."""

    steps: int  # of the environment
    updates: int
    replayed: int  # transitions that were put into the replay buffer


class Training(NamedTuple):
    """All that `play` changes."""

    game: Game
    learning: Learning
    robots: Robots


def training_of(
    parts: Sequence[dict[str, Floats]],
    environment: GridVectorEnvironment,
    replay: ReplayBuffer,
    next_q_of: Callable[[Q, Q], NextQ],
) -> Training:
    """Return the arrays of a training, which share their memory with its objects.

    `parts` are the tensors of θ, of θ⁻ and of Adam's two moments.
    """
    parameters = environment.parameters
    slopes = {name: np.zeros_like(tensor) for name, tensor in parts[0].items()}
    states = max(parameters.batch_size, parameters.environments)
    windows, networks = networks_of(
        environment.background, environment.shape, [*parts, slopes], states
    )
    online, target, mean, square, gradient = networks
    learning = Learning(
        settings=_settings(parameters),
        windows=windows,
        online=online,
        target=target,
        replay=replay.transitions,
        batch=ReplayBuffer(parameters.batch_size).transitions,
        next_q=next_q_of(online.q, target.q),
        gradient=gradient,
        mean=mean.weights,
        square=square.weights,
    )
    robots = Robots(
        scenario=environment.scenario,
        cell=environment.cell,
        action=np.zeros_like(environment.cell),
        episode_steps=environment.steps,
        visited=environment.visited,
        total_reward=environment.total_reward,
        terminated=environment.terminated,
        truncated=environment.truncated,
    )
    game = Game(
        environment.legal, environment.rewards, environment.next_cell, environment.goal
    )
    return Training(game, learning, robots)


def _settings(parameters: HyperParameters) -> Settings:
    return Settings(**{name: getattr(parameters, name) for name in Settings._fields})


def networks_of(
    background_SC: Floats,
    shape: tuple[int, int],
    parts: Sequence[dict[str, Floats]],
    states: int,
) -> tuple[Windows, list[Network]]:
    """Return networks that evaluate up to so many states at once.

    Parameters
    ----------
    background_SC
        What the maps, of shape (H, W), show without a robot. All floats get its type.
    parts
        The tensors of each network by name; they become parts of `Network.weights`.
    """
    filters = len(parts[0]["convolution.bias"])
    windows = _windows_of(background_SC, shape, filters, states)
    return windows, [_network_of(tensors, windows, states) for tensors in parts]


def _windows_of(
    background_SC: Floats, shape: tuple[int, int], filters: int, states: int
) -> Windows:
    outside = np.pad(background_SC, [(0, 0), (0, 1)])  # cells outside a map are 0
    by_map = outside[:, window_cells(shape)]  # (S, L, 9)
    common = np.sort(by_map, axis=0)[len(by_map) // 2]  # the median of each cell
    scenario, differing = np.nonzero((by_map != common).any(axis=2))
    first_differing = np.searchsorted(scenario, np.arange(len(by_map) + 1))
    # Four windows at most show the robot.
    changed_windows = states * (4 + int(np.diff(first_differing).max()))
    return Windows(
        common=common,
        by_map=by_map,
        differing=differing,
        first_differing=first_differing,
        shape=shape,
        changed=np.zeros(changed_windows, np.int64),
        first_changed=np.zeros(states + 1, np.int64),
        patch=_zeros((changed_windows, 9), background_SC),
        convolved=_zeros((changed_windows, filters), background_SC),
    )


def _network_of(tensors: dict[str, Floats], windows: Windows, states: int) -> Network:
    arrays = [_inputs_first(tensor) for tensor in tensors.values()]
    has_hidden_layer = len(tensors) > 4
    if not has_hidden_layer:
        arrays += [_zeros((0, 8), windows.common), _zeros((0,), windows.common)]
    weights = np.concatenate(
        [array.ravel() for array in arrays], dtype=windows.common.dtype
    )
    ends = np.cumsum([array.size for array in arrays])
    layers = [
        row.reshape(array.shape)
        for row, array in zip(np.split(weights, ends[:-1]), arrays, strict=True)
    ]
    for name, layer in zip(list(tensors), layers, strict=False):
        tensors[name] = layer.T.reshape(tensors[name].shape)
    kernel, kernel_bias, layer, layer_bias, last, last_bias = layers
    units = layer_bias.size
    output = _zeros((states, units), windows.common)
    return Network(
        weights=weights,
        kernel=kernel,
        kernel_bias=kernel_bias,
        layer=layer,
        layer_bias=layer_bias,
        last=last,
        last_bias=last_bias,
        common_feature=_zeros((len(windows.common), kernel_bias.size), windows.common),
        common_output=_zeros((units,), windows.common),
        output=output,
        q=_zeros((states, 8), windows.common) if has_hidden_layer else output,
        eight=() if has_hidden_layer else (0,) * 8,
    )


def _inputs_first(tensor: Floats) -> Floats:
    """Return a tensor of weights as (inputs, outputs), or of biases as it is."""
    is_convolution = tensor.ndim == 4
    weights: Floats = tensor.reshape(-1, 9).T if is_convolution else tensor.T
    return weights


def _zeros(shape: tuple[int, ...], like: Floats) -> Floats:
    """Return zeros of an array's type."""
    return np.zeros(shape, like.dtype)


@inner_in_place
def put(values: Floats, array: Floats) -> None:
    """Copy values into an array (N,)."""
    for n in range(array.size):
        array[n] = values[n]


@inner_in_place
def add(values: Floats, array: Floats) -> None:
    """Add values to an array (N,)."""
    for n in range(array.size):
        array[n] += values[n]


@inlined
def relu(value: np.float32) -> np.float32:
    """Return a value, or 0 if it is less."""
    return max(value, np.float32(0))


@inner_in_place
def look(network: Network, windows: Windows) -> None:
    """Compute what a network makes of the common windows, after its weights changed."""
    feature = network.common_feature
    output = network.common_output
    window_count, filters = feature.shape
    convolve(network.kernel, network.kernel_bias, windows.common, window_count, feature)
    put(network.layer_bias, output)
    for f in range(filters):
        for window in range(window_count):
            activation = relu(feature[window, f])
            feature[window, f] = activation
            if activation != 0:
                row = f * window_count + window
                for u in range(len(network.eight) or output.size):
                    output[u] += activation * network.layer[row, u]


@inner_in_place
def convolve(
    kernel: Floats, bias: Floats, patch: Floats, patch_count: int, convolved: Floats
) -> None:
    """Compute the convolution of the first so many patches, before ReLU."""
    for row in range(patch_count):
        for f in range(bias.size):
            convolved[row, f] = bias[f]
        for position in range(9):
            cell = patch[row, position]
            if cell != 0:  # most are free
                for f in range(bias.size):
                    convolved[row, f] += cell * kernel[position, f]


@inner_in_place
def evaluate(
    network: Network, windows: Windows, scenario: Integers, cell: Integers
) -> None:
    """Compute Q, in `network.q`, of robots in cells (B,) of maps (B,)."""
    see(windows, scenario, cell)
    changed_count = windows.first_changed[cell.size]
    convolve(
        network.kernel,
        network.kernel_bias,
        windows.patch,
        changed_count,
        windows.convolved,
    )
    for n in range(cell.size):
        put(network.common_output, network.output[n])
        for row in range(windows.first_changed[n], windows.first_changed[n + 1]):
            correct_output(network, windows, n, row)
        if len(network.eight) == 0:
            apply_last_layer(network, n)


@inlined
def correct_output(network: Network, windows: Windows, n: int, row: int) -> None:
    """Add to the output for state n what a changed window's features differ by."""
    window = windows.changed[row]
    window_count, filters = network.common_feature.shape
    output = network.output
    # Most windows have the same features as before, as most filters are off.
    difference = np.float32(0)
    for f in range(filters):
        feature = relu(windows.convolved[row, f])
        difference += abs(feature - network.common_feature[window, f])
    if difference == 0:
        return
    for f in range(filters):
        change = relu(windows.convolved[row, f]) - network.common_feature[window, f]
        if change != 0:
            weight_row = f * window_count + window
            for u in range(len(network.eight) or network.common_output.size):
                output[n, u] += change * network.layer[weight_row, u]


@inlined
def apply_last_layer(network: Network, n: int) -> None:
    """Compute Q of state n from the output of the hidden layer before ReLU."""
    put(network.last_bias, network.q[n])
    for u in range(network.common_output.size):
        if network.output[n, u] > 0:  # most are not
            for action in range(8):
                network.q[n, action] += network.output[n, u] * network.last[u, action]


@inner_in_place
def see(windows: Windows, scenario: Integers, cell: Integers) -> None:
    """Cut out the changed windows of maps (B,) with robots in cells (B,)."""
    changed = windows.changed
    first_changed = windows.first_changed
    height, width = windows.shape
    end = 0
    for n in range(cell.size):
        y, x = divmod(cell[n], width)
        # The window (row, column) has its centre in the cell (2 * column, 2 * row).
        for row in range(y // 2, min((y + 1) // 2, (height - 1) // 2) + 1):
            for column in range(x // 2, min((x + 1) // 2, (width - 1) // 2) + 1):
                window = row * ((width + 1) // 2) + column
                cut(windows, scenario[n], window, end)
                robot = 3 * (y + 1 - 2 * row) + x + 1 - 2 * column
                windows.patch[end, robot] = ROBOT
                end += 1
        end_with_robot = end
        first = windows.first_differing[scenario[n]]
        for index in range(first, windows.first_differing[scenario[n] + 1]):
            window = windows.differing[index]
            is_cut = False
            for number in range(first_changed[n], end_with_robot):
                is_cut |= changed[number] == window
            if not is_cut:
                cut(windows, scenario[n], window, end)
                end += 1
        first_changed[n + 1] = end


@inlined
def cut(windows: Windows, scenario: int, window: int, number: int) -> None:
    """Make a map's window without a robot the changed window of this number."""
    windows.changed[number] = window
    for position in range(9):  # a copy of a slice takes three times as long
        cell = windows.by_map[scenario, window, position]
        windows.patch[number, position] = cell


@compiled
def play(
    training: Training,
    exploration: Generator,
    sampling: Generator,
    counters: Counters,
    until: int,
) -> Counters:
    """Make steps until an episode ends, until step `until`, or for some milliseconds."""
    game, learning, robots = training
    settings = learning.settings
    steps, updates, replayed = counters
    look(learning.online, learning.windows)
    look(learning.target, learning.windows)
    robot_count = robots.cell.size
    rounds = max(1, WINDOWS_OF_A_CALL // len(learning.online.common_feature))
    until = min(until, steps + robot_count * rounds)
    has_ended = False
    while steps < until and not has_ended:
        choose_actions(learning, robots, exploration, steps)
        has_ended = move_robots(game, learning, robots, replayed)
        replayed += robot_count
        intervals = steps // settings.update_interval
        steps += robot_count
        updates_due = steps // settings.update_interval - intervals
        if steps > settings.learning_starts:
            for _ in range(updates_due):
                updates += 1
                update(learning, sampling, updates, replayed)
    return Counters(steps, updates, replayed)


@inner
def choose_actions(
    learning: Learning, robots: Robots, exploration: Generator, steps: int
) -> None:
    """Choose the best action by the online network; with probability ε, any action."""
    settings = learning.settings
    share = min(steps / settings.epsilon_steps, 1.0)
    epsilon = settings.epsilon_start + share * (
        settings.epsilon_end - settings.epsilon_start
    )
    robot_count = robots.cell.size
    for n in range(robot_count):
        robots.action[n] = exploration.integers(0, 8)
    evaluate(learning.online, learning.windows, robots.scenario, robots.cell)
    for n in range(robot_count):
        if exploration.random() >= epsilon:
            robots.action[n] = learning.online.q[n].argmax()


@inner_in_place
def move_robots(game: Game, learning: Learning, robots: Robots, replayed: int) -> bool:
    """Move each robot once, remember the move, and return if an episode ended."""
    settings = learning.settings
    replay = learning.replay
    has_ended = False
    for n in range(robots.cell.size):
        scenario = robots.scenario[n]
        action = robots.action[n]
        cell = robots.cell[n]
        legal = game.legal[scenario, action, cell]
        reward = game.rewards[scenario, action, cell]
        next_cell = game.next_cell[action, cell] if legal else cell
        robots.episode_steps[n] += 1
        steps = robots.episode_steps[n]
        terminated = not legal or next_cell == game.goal[scenario]
        truncated = not terminated and steps >= settings.max_episode_steps
        has_ended |= terminated or truncated
        slot = (replayed + n) % replay.cell.size
        replay.scenario[slot] = scenario
        replay.action[slot] = action
        replay.cell[slot] = cell
        replay.reward[slot] = reward
        replay.next_cell[slot] = next_cell
        replay.discount[slot] = 0.0 if terminated else settings.gamma
        robots.terminated[n] = terminated
        robots.truncated[n] = truncated
        robots.total_reward[n] += reward
        robots.cell[n] = next_cell
        robots.visited[n, steps] = next_cell
    return has_ended


@inner
def update(
    learning: Learning, sampling: Generator, updates: int, replayed: int
) -> None:
    """Make the Double DQN update of this number, see `double_dqn_gradient`."""
    settings = learning.settings
    windows = learning.windows
    online = learning.online
    target = learning.target
    replay = learning.replay
    batch = learning.batch
    gradient = learning.gradient
    batch_size = batch.cell.size
    for n in range(batch_size):
        slot = sampling.integers(0, min(replayed, replay.cell.size))
        batch.scenario[n] = replay.scenario[slot]
        batch.cell[n] = replay.cell[slot]
        batch.action[n] = replay.action[slot]
        batch.next_cell[n] = replay.next_cell[slot]
        batch.reward[n] = replay.reward[slot]
        batch.discount[n] = replay.discount[slot]
    evaluate(online, windows, batch.scenario, batch.next_cell)
    evaluate(target, windows, batch.scenario, batch.next_cell)
    for n in range(batch_size):
        next_action = learning.next_q.selection[n].argmax()
        next_value = learning.next_q.evaluation[n, next_action]
        # From here on the reward is y, the target of Q(s, a).
        batch.reward[n] += batch.discount[n] * next_value
    evaluate(online, windows, batch.scenario, batch.cell)
    gradient.q[:] = 0
    for n in range(batch_size):
        action = batch.action[n]
        error = online.q[n, action] - batch.reward[n]
        gradient.q[n, action] = 2 * error / batch_size
    differentiate(online, windows, gradient, batch_size)
    adam(
        online.weights,
        gradient.weights,
        learning.mean,
        learning.square,
        settings.learning_rate,
        updates,
    )
    look(online, windows)
    if updates % settings.target_interval == 0:
        put(online.weights, target.weights)
        look(target, windows)


@inner_in_place
def differentiate(
    network: Network, windows: Windows, gradient: Network, states: int
) -> None:
    """Add the gradients by all weights to those in `gradient`.

    The network evaluated these states last, and ``gradient.q`` is the gradient by their
    Q. In `gradient`, the other results hold gradients too; ``windows.convolved`` gets
    that by the convolution of the changed windows, where this was.
    """
    gradient.common_output[:] = 0
    # By the convolution of the common windows before ReLU, unlike in a network.
    gradient.common_feature[:] = 0
    for n in range(states):
        if len(network.eight) == 0:
            differentiate_last_layer(network, gradient, n)
        add(gradient.output[n], gradient.common_output)
        for row in range(windows.first_changed[n], windows.first_changed[n + 1]):
            differentiate_window(network, windows, gradient, n, row)
    differentiate_common_windows(network, gradient)
    add(gradient.common_output, gradient.layer_bias)
    add_kernel_gradient(
        gradient, windows.common, len(windows.common), gradient.common_feature
    )
    changed_count = windows.first_changed[states]
    add_kernel_gradient(gradient, windows.patch, changed_count, windows.convolved)


@inlined
def differentiate_last_layer(network: Network, gradient: Network, n: int) -> None:
    """Compute the gradients by the last layer and by its input, of state n."""
    add(gradient.q[n], gradient.last_bias)
    for u in range(network.common_output.size):
        activation = relu(network.output[n, u])
        gradient.output[n, u] = 0
        if activation > 0:
            for action in range(8):
                slope = gradient.q[n, action]
                gradient.last[u, action] += slope * activation
                gradient.output[n, u] += slope * network.last[u, action]


@inlined
def differentiate_window(
    network: Network, windows: Windows, gradient: Network, n: int, row: int
) -> None:
    """Compute the gradients of what `correct_output` adds for a changed window."""
    window = windows.changed[row]
    window_count, filters = network.common_feature.shape
    slopes = gradient.output
    for f in range(filters):
        feature = relu(windows.convolved[row, f])
        common_feature = network.common_feature[window, f]
        change = feature - common_feature
        by_feature = np.float32(0)
        # Most features are 0, with the robot and without.
        if feature != 0 or change != 0:
            weight_row = f * window_count + window
            for u in range(len(network.eight) or network.common_output.size):
                gradient.layer[weight_row, u] += change * slopes[n, u]
                by_feature += network.layer[weight_row, u] * slopes[n, u]
            if common_feature > 0:
                gradient.common_feature[window, f] -= by_feature
        windows.convolved[row, f] = by_feature if feature > 0 else np.float32(0)


@inlined
def differentiate_common_windows(network: Network, gradient: Network) -> None:
    """Add the gradients of what the common windows give all states."""
    window_count, filters = network.common_feature.shape
    slopes = gradient.common_output
    for window in range(window_count):
        for f in range(filters):
            feature = network.common_feature[window, f]
            if feature > 0:
                row = f * window_count + window
                for u in range(len(network.eight) or network.common_output.size):
                    gradient.layer[row, u] += feature * slopes[u]
                    by_feature = network.layer[row, u] * slopes[u]
                    gradient.common_feature[window, f] += by_feature


@inner_in_place
def add_kernel_gradient(
    gradient: Network, patch: Floats, patch_count: int, by_convolved: Floats
) -> None:
    """Add the gradients by kernel and bias, from that by the convolution of patches."""
    filters = gradient.kernel_bias.size
    for row in range(patch_count):
        for f in range(filters):
            gradient.kernel_bias[f] += by_convolved[row, f]
        for position in range(9):
            cell = patch[row, position]
            if cell != 0:
                for f in range(filters):
                    gradient.kernel[position, f] += cell * by_convolved[row, f]


@inner_in_place
def adam(
    weights: Floats,
    slopes: Floats,
    means: Floats,
    squares: Floats,
    learning_rate: float,
    updates: int,
) -> None:
    """Take Adam's step of this number (Kingma and Ba 2015, with ε where torch has it).

    The slopes, that is the gradient, are 0 afterwards.
    """
    step = np.float32(learning_rate / (1 - BETA_1**updates))
    root = np.float32(1 / np.sqrt(1 - BETA_2**updates))
    share_of_mean = np.float32(1 - BETA_1)
    share_of_square = np.float32(1 - BETA_2)
    for n in range(weights.size):
        slope = slopes[n]
        mean = means[n]
        mean += share_of_mean * (slope - mean)
        # Most means fade away, as few features are on: processors are slow where a
        # number is denormal.
        mean = mean if abs(mean) > SMALLEST_MEAN else np.float32(0)
        means[n] = mean
        squares[n] += share_of_square * (slope * slope - squares[n])
        weights[n] -= step * mean / (np.sqrt(squares[n]) * root + EPSILON)
        slopes[n] = 0
