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
# Absolute errors of Q, in rewards. A transition with GREATEST_ERROR or more is never
# drawn in vain. LEAST_ERROR is added to each error, so that none is left out.
GREATEST_ERROR = 10.0
LEAST_ERROR = 0.1
# Windows that the steps of one call evaluate, so that it returns within milliseconds.
WINDOWS_OF_A_CALL = 5_000


class Windows(NamedTuple):
    """The 3x3 windows that the convolution sees on S maps, and in B states.

    Window row * columns + column has its centre in the cell (2 * column, 2 * row). Its
    9 cells are in the order of rows. A window of a map "differs", and a window of a
    state is "changed", if its cells are not those of the common window of this number.
    """

    common: Floats  # (L, 9): the windows without a robot, as most maps have them
    by_map: Floats  # (S, L, 9): the windows without a robot, of each map
    # The numbers of the windows of map 0 that differ, then those of map 1, and so on.
    # Map s has differing[first_differing[s] : first_differing[s + 1]].
    differing: Integers
    first_differing: Integers  # (S + 1,)
    shape: tuple[int, int]  # (H, W) of the maps
    # The changed windows of state 0, then those of state 1, and so on. State n has the
    # rows from first_changed[n] to before first_changed[n + 1] of these three arrays.
    changed: Integers  # (B * D,): the number of the window, 0 to L - 1
    patch: Floats  # (B * D, 9): the cells of the window
    convolved: Floats  # (B * D, F): before ReLU, by the network that was evaluated last
    first_changed: Integers  # (B + 1,)


class Network(NamedTuple):
    """The weights of the paper's network, and the results that it computed last.

    A network of gradients holds in each array the gradient by that array.
    """

    weights: Floats  # (all,): the memory of the six arrays that follow
    kernel: Floats  # (9, F)
    kernel_bias: Floats  # (F,)
    layer: Floats  # (F * L, U): the layer after the convolution
    layer_bias: Floats  # (U,)
    last: Floats  # (U, 8); empty without a hidden layer: then U is 8
    last_bias: Floats  # (8,), or empty
    common_feature: Floats  # (L, F): convolution of the common windows, after ReLU
    common_output: Floats  # (U,): what `layer` makes of the common windows, before ReLU
    output: Floats  # (B, U): what `layer` makes of the windows of each state
    q: Floats  # (B, 8); without a hidden layer, this is `output`
    # 8 zeros without a hidden layer, else empty. The length of a tuple belongs to its
    # type, so that the compiler knows how long a loop over 8 outputs is: such a loop is
    # twice as fast. See `output_count`.
    eight: tuple[int, ...]


class Settings(NamedTuple):
    """The hyper-parameters that compiled functions need."""

    gamma: float
    steps: int
    learning_rate: float
    learning_rate_decay: float
    weight_decay: float
    weight_averaging: float
    priority: float
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
    # The average of θ, as `Network.weights`; empty if `weight_averaging` is 0.
    average: Floats
    # The absolute error of each transition in the replay buffer, (capacity,), when it
    # was drawn last; and the slots of the batch in this buffer, (B,).
    error: Floats
    drawn: Integers


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
    average: dict[str, Floats],
    environment: GridVectorEnvironment,
    replay: ReplayBuffer,
    next_q_of: Callable[[Q, Q], NextQ],
) -> Training:
    """Return the arrays of a training, for compiled code.

    They share their memory with all arguments: what compiled code changes, changes in
    these objects.

    Parameters
    ----------
    parts
        Four dictionaries of tensors by name: of θ, of θ⁻ and of Adam's two moments.
        Their tensors are replaced by others that share the memory of the arrays.
    average
        The same of the average of θ, or empty if there is none.
    environment, replay
        The robots and the replay buffer that `play` changes.
    next_q_of
        Takes Q of the next states by θ and by θ⁻, (B, 8) each, and returns which of
        them selects the next action and which evaluates that action.
    """
    parameters = environment.parameters
    gradients = {name: np.zeros_like(tensor) for name, tensor in parts[0].items()}
    tensors_of_networks = [*parts, gradients]
    if average:
        tensors_of_networks.append(average)
    # The networks evaluate either a batch or the states of all robots.
    states = max(parameters.batch_size, parameters.environments)
    windows, networks = networks_of(
        environment.background, environment.shape, tensors_of_networks, states
    )
    online, target, mean, square, gradient, *averaged = networks
    no_weights = _zeros((0,), environment.background)
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
        average=averaged[0].weights if averaged else no_weights,
        error=replay.error,
        drawn=np.zeros(parameters.batch_size, np.int64),
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
    """Return those hyper-parameters that are fields of `Settings`."""
    return Settings(**{name: getattr(parameters, name) for name in Settings._fields})


def networks_of(
    background_SC: Floats,
    shape: tuple[int, int],
    parts: Sequence[dict[str, Floats]],
    states: int,
) -> tuple[Windows, list[Network]]:
    """Return the windows of S maps, and a network for each dictionary of tensors.

    Parameters
    ----------
    background_SC
        What a network observes of each of S maps without a robot, a number for each of
        C cells. All floats get its type.
    shape
        (H, W) of the maps; C is H * W.
    parts
        The tensors of each network by name. Each tensor is replaced by one that shares
        the memory of `Network.weights`.
    states
        The number of states that the networks can evaluate at once.
    """
    filters = len(parts[0]["convolution.bias"])
    windows = _windows_of(background_SC, shape, filters, states)
    return windows, [_network_of(tensors, windows, states) for tensors in parts]


def _windows_of(
    background_SC: Floats, shape: tuple[int, int], filters: int, states: int
) -> Windows:
    """Return the windows of S maps, with buffers for up to `states` states.

    `background_SC` is what a network observes of each of C = H * W cells without a
    robot, `shape` is (H, W), and `filters` is F, those of the convolution.
    """
    # `window_cells` gives the number H * W to cells outside a map: they are 0.
    padded = np.pad(background_SC, [(0, 0), (0, 1)])  # (S, C + 1)
    # The memory is in the order of C for several maps as for one, by `take` and `copy`:
    # all functions would be compiled again for another order.
    by_map = np.take(padded, window_cells(shape), axis=1)  # (S, L, 9)
    common = np.sort(by_map, axis=0)[len(by_map) // 2]  # the median of each cell
    is_different = (by_map != common).any(axis=2)  # (S, L)
    # The map and the number of each window that differs, ordered by map.
    scenario, differing = np.nonzero(is_different)
    first_differing = np.searchsorted(scenario, np.arange(len(by_map) + 1))
    # At most four windows of a state show the robot; the others differ on its map.
    changed_windows = states * (4 + int(np.diff(first_differing).max()))
    return Windows(
        common=common,
        by_map=by_map,
        differing=differing.copy(),
        first_differing=first_differing,
        shape=shape,
        changed=np.zeros(changed_windows, np.int64),
        patch=_zeros((changed_windows, 9), background_SC),
        convolved=_zeros((changed_windows, filters), background_SC),
        first_changed=np.zeros(states + 1, np.int64),
    )


def _network_of(tensors: dict[str, Floats], windows: Windows, states: int) -> Network:
    """Return a network of weights, with buffers for up to `states` states.

    `tensors` are the initial weights by name, as torch shapes them: each value of the
    dictionary is replaced by a tensor that shares the network's memory. `windows` are
    those of the maps, whose dtype the network gets.
    """
    # Weights and biases of the convolution, of the layer after it, and with a hidden
    # layer those of the last layer, each with the inputs as its first axis.
    arrays = [_inputs_first(tensor) for tensor in tensors.values()]
    has_hidden_layer = len(tensors) > 4
    if not has_hidden_layer:
        arrays += [_zeros((0, 8), windows.common), _zeros((0,), windows.common)]
    weights = np.concatenate(
        [array.ravel() for array in arrays], dtype=windows.common.dtype
    )
    # Views into `weights`, of the shapes of `arrays`.
    ends = np.cumsum([array.size for array in arrays])
    layers = [
        part.reshape(array.shape)
        for part, array in zip(np.split(weights, ends[:-1]), arrays, strict=True)
    ]
    # There may be more layers than tensors: the empty ones of the last layer.
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
    """Return a tensor of weights as (inputs, outputs), or of biases as it is.

    The weights of a convolution, (F, 1, 3, 3), become (9, F).
    """
    is_convolution = tensor.ndim == 4
    weights: Floats = tensor.reshape(-1, 9).T if is_convolution else tensor.T
    return weights


def _zeros(shape: tuple[int, ...], like: Floats) -> Floats:
    """Return zeros of the type that the array `like` has."""
    return np.zeros(shape, like.dtype)


@inner_in_place
def copy_into(array: Floats, values: Floats) -> None:
    """Copy the values (N,) into an array (N,)."""
    for n in range(array.size):
        array[n] = values[n]


@inner_in_place
def add_to(array: Floats, values: Floats) -> None:
    """Add the values (N,) to an array (N,)."""
    for n in range(array.size):
        array[n] += values[n]


@inner_in_place
def scale(array: Floats, factor: np.float32) -> None:
    """Multiply an array (N,) by a factor."""
    for n in range(array.size):
        array[n] *= factor


@inner_in_place
def approach(array: Floats, values: Floats, share: np.float32) -> None:
    """Move an array (N,) by a share, 0 to 1, of its distance to the values (N,)."""
    for n in range(array.size):
        array[n] += share * (values[n] - array[n])


@inlined
def relu(value: np.float32) -> np.float32:
    """Return the value if it is positive, else 0."""
    return max(value, np.float32(0))


@inlined
def output_count(network: Network) -> int:
    """Return U, how many outputs the layer after the convolution has.

    Without a hidden layer U is 8, and the compiler knows it, see `Network.eight`.
    """
    return len(network.eight) or network.common_output.size


@inlined
def has_hidden_layer(network: Network) -> bool:
    """Return whether a network has a hidden layer; the compiler knows it."""
    return len(network.eight) == 0


@inner_in_place
def evaluate_common_windows(network: Network, windows: Windows) -> None:
    """Compute `common_feature` and `common_output` by the network's present weights.

    `common_feature` (L, F) is the convolution of the L common windows after ReLU, and
    `common_output` (U,) is the output of the layer after it, before ReLU.
    """
    feature = network.common_feature
    output = network.common_output
    window_count, filters = feature.shape
    convolve(network.kernel, network.kernel_bias, windows.common, window_count, feature)
    copy_into(output, network.layer_bias)
    for f in range(filters):
        for window in range(window_count):
            activation = relu(feature[window, f])
            feature[window, f] = activation
            if activation != 0:
                row = f * window_count + window
                for u in range(output_count(network)):
                    output[u] += activation * network.layer[row, u]


@inner_in_place
def convolve(
    kernel: Floats, bias: Floats, patch: Floats, patch_count: int, convolved: Floats
) -> None:
    """Write the convolution, before ReLU, of the first `patch_count` patches.

    `patch` (P, 9) holds the 9 cells of each of P windows, `kernel` is (9, F), `bias` is
    (F,), and `convolved` (P, F) is written.
    """
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
    """Write Q (B, 8) of B states into ``network.q``.

    State n is a robot in cell[n] on map scenario[n]; both arrays are (B,). Most 3x3
    windows of a state are the common windows, those of most maps without a robot. Their
    output must have been computed since the weights changed. It is corrected for each
    window of the state that is changed, as it shows the robot or another map. The
    changed windows, and their convolutions, are written into `windows`.
    """
    collect_changed_windows(windows, scenario, cell)
    changed_count = windows.first_changed[cell.size]
    convolve(
        network.kernel,
        network.kernel_bias,
        windows.patch,
        changed_count,
        windows.convolved,
    )
    for n in range(cell.size):
        copy_into(network.output[n], network.common_output)
        for row in range(windows.first_changed[n], windows.first_changed[n + 1]):
            correct_output(network, windows, n, row)
        if has_hidden_layer(network):  # otherwise ``network.output`` is ``network.q``
            apply_last_layer(network, n)


@inlined
def correct_output(network: Network, windows: Windows, n: int, row: int) -> None:
    """Correct the output of state n, that of the common windows, for a changed window.

    The changed window is in row `row` of `windows`, where its convolution is known. Its
    features replace those of the common window of the same number: each difference of
    a feature, times the weights of this feature, is added to ``network.output[n]``.
    """
    window = windows.changed[row]
    window_count, filters = network.common_feature.shape
    output = network.output
    # Most changed windows have the features of the common one, as most filters give 0.
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
            for u in range(output_count(network)):
                output[n, u] += change * network.layer[weight_row, u]


@inlined
def apply_last_layer(network: Network, n: int) -> None:
    """Write Q of state n from the hidden layer's output (U,) before ReLU."""
    copy_into(network.q[n], network.last_bias)
    for u in range(network.common_output.size):
        if network.output[n, u] > 0:  # most are not
            for action in range(8):
                network.q[n, action] += network.output[n, u] * network.last[u, action]


@inner_in_place
def collect_changed_windows(
    windows: Windows, scenario: Integers, cell: Integers
) -> None:
    """Write the changed windows of B states into the rows of `windows`.

    State n is a robot in cell[n] on map scenario[n]. Its changed windows are those that
    show the robot, and then those in which the map differs from the common windows.
    """
    row_count = 0  # the number of rows that have been written, and the next row
    for n in range(cell.size):
        row_count = add_windows_of_robot(windows, scenario[n], cell[n], row_count)
        row_count = add_windows_of_map(
            windows, scenario[n], windows.first_changed[n], row_count
        )
        windows.first_changed[n + 1] = row_count


@inlined
def add_windows_of_robot(
    windows: Windows, scenario: int, cell: int, row_count: int
) -> int:
    """Write the windows of map `scenario` that show a robot in cell y * W + x.

    The first window is written into row `row_count` of the changed windows; the result
    is the number of rows that are written then. The windows have 3x3 cells and the
    centres (2 * column, 2 * row), so that up to two rows and two columns of windows
    show the cell.
    """
    height, width = windows.shape
    y, x = divmod(cell, width)
    window_rows = (height + 1) // 2
    window_columns = (width + 1) // 2
    last_row = min((y + 1) // 2, window_rows - 1)
    last_column = min((x + 1) // 2, window_columns - 1)
    for row in range(y // 2, last_row + 1):
        for column in range(x // 2, last_column + 1):
            window = row * window_columns + column
            copy_window(windows, scenario, window, row_count)
            # The first cell of the window is (2 * column - 1, 2 * row - 1) of the map.
            y_in_window = y + 1 - 2 * row
            x_in_window = x + 1 - 2 * column
            windows.patch[row_count, 3 * y_in_window + x_in_window] = ROBOT
            row_count += 1
    return row_count


@inlined
def add_windows_of_map(
    windows: Windows, scenario: int, first_row: int, row_count: int
) -> int:
    """Write the windows in which map `scenario` differs from the common windows.

    The first window is written into row `row_count` of the changed windows; the result
    is the number of rows that are written then. The rows from `first_row` to before
    `row_count` hold windows that show the robot; they are not written a second time.
    """
    end_of_robot = row_count
    first = windows.first_differing[scenario]
    for index in range(first, windows.first_differing[scenario + 1]):
        window = windows.differing[index]
        is_written = False
        for row in range(first_row, end_of_robot):
            is_written |= windows.changed[row] == window
        if not is_written:
            copy_window(windows, scenario, window, row_count)
            row_count += 1
    return row_count


@inlined
def copy_window(windows: Windows, scenario: int, window: int, row: int) -> None:
    """Copy a window of map `scenario`, without a robot, into a row of changed windows.

    `window` is the number of the window, 0 to L - 1.
    """
    windows.changed[row] = window
    for position in range(9):  # a copy of a slice takes three times as long
        cell = windows.by_map[scenario, window, position]
        windows.patch[row, position] = cell


@compiled
def play(
    training: Training,
    exploration: Generator,
    sampling: Generator,
    counters: Counters,
    last_step: int,
) -> Counters:
    """Let the robots make rounds of one step each, and make the updates that fall due.

    The rounds end when an episode ends, when `last_step` steps have been made since the
    training began, or after a number of rounds that takes milliseconds.

    Parameters
    ----------
    training : Training
        Changed in place: robots, networks, replay buffer.
    exploration, sampling : Generator
        Draw the actions and the batches.
    counters : Counters
        The steps of all robots, the updates, and the transitions put into the replay
        buffer, since the training began.
    last_step : int

    Returns
    -------
    Counters
        Those after the last round.
    """
    game, learning, robots = training
    settings = learning.settings
    steps, updates, replayed = counters
    evaluate_common_windows(learning.online, learning.windows)
    evaluate_common_windows(learning.target, learning.windows)
    robot_count = robots.cell.size
    # A round takes longer, the more windows a map has.
    window_count = len(learning.windows.common)
    most_rounds = max(1, WINDOWS_OF_A_CALL // window_count)
    last_step_of_call = min(last_step, steps + robot_count * most_rounds)
    has_ended = False
    while steps < last_step_of_call and not has_ended:
        choose_actions(learning, robots, exploration, steps)
        has_ended = move_robots(game, learning, robots, replayed)
        replayed += robot_count
        # An update is due for each multiple of the interval that this round passes.
        multiples_before = steps // settings.update_interval
        steps += robot_count
        updates_due = steps // settings.update_interval - multiples_before
        if steps > settings.learning_starts:
            for _ in range(updates_due):
                updates += 1
                update(learning, sampling, Counters(steps, updates, replayed))
    return Counters(steps, updates, replayed)


@inner
def choose_actions(
    learning: Learning, robots: Robots, exploration: Generator, steps: int
) -> None:
    """Write each robot's action: with probability ε a random one, else the best by θ.

    `steps` is the number of steps that all robots have made since the training began; ε
    changes linearly over the first `epsilon_steps`. The generator `exploration` draws.
    """
    settings = learning.settings
    share = min(steps / settings.epsilon_steps, 1.0)
    change_of_epsilon = settings.epsilon_end - settings.epsilon_start
    epsilon = settings.epsilon_start + share * change_of_epsilon
    robot_count = robots.cell.size
    for n in range(robot_count):
        robots.action[n] = exploration.integers(0, 8)
    evaluate(learning.online, learning.windows, robots.scenario, robots.cell)
    for n in range(robot_count):
        if exploration.random() >= epsilon:
            robots.action[n] = learning.online.q[n].argmax()


@inner_in_place
def move_robots(game: Game, learning: Learning, robots: Robots, replayed: int) -> bool:
    """Move each robot by its action, and put the transitions into the replay buffer.

    The buffer is a ring, into which `replayed` transitions have been put before: the
    new transitions replace the oldest ones. `game` tells what moves lead to. Changes
    `robots` and ``learning.replay``, and returns whether an episode ended.
    """
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
        learning.error[slot] = GREATEST_ERROR  # so that it is drawn soon
        robots.terminated[n] = terminated
        robots.truncated[n] = truncated
        robots.total_reward[n] += reward
        robots.cell[n] = next_cell
        robots.visited[n, steps] = next_cell
    return has_ended


@inner
def update(learning: Learning, sampling: Generator, counters: Counters) -> None:
    """Draw a batch, and change θ by Adam with its gradient, see `double_dqn_gradient`.

    After each `target_interval` updates θ⁻ becomes θ.

    Parameters
    ----------
    learning : Learning
        Changed in place.
    sampling : Generator
        Draws the batch.
    counters : Counters
        Of the training; this update is counted, too.
    """
    settings = learning.settings
    windows = learning.windows
    online = learning.online
    target = learning.target
    batch = learning.batch
    gradient = learning.gradient
    batch_size = batch.cell.size
    draw_batch(learning, sampling, counters.replayed)
    evaluate(online, windows, batch.scenario, batch.next_cell)
    evaluate(target, windows, batch.scenario, batch.next_cell)
    # `next_q` are views of Q by θ or θ⁻, which select and evaluate the next action.
    for n in range(batch_size):
        next_action = learning.next_q.selection[n].argmax()
        next_value = learning.next_q.evaluation[n, next_action]
        # The reward becomes y, the target of Q(s, a).
        batch.reward[n] += batch.discount[n] * next_value
    evaluate(online, windows, batch.scenario, batch.cell)
    gradient.q[:] = 0
    for n in range(batch_size):
        action = batch.action[n]
        error = online.q[n, action] - batch.reward[n]
        gradient.q[n, action] = 2 * error / batch_size
        learning.error[learning.drawn[n]] = abs(error)
    differentiate(online, windows, gradient, batch_size)
    # The learning rate falls exponentially, see `HyperParameters.learning_rate_at`.
    share_of_steps = min(counters.steps / settings.steps, 1.0)
    decay = settings.learning_rate_decay**share_of_steps
    learning_rate = settings.learning_rate * decay
    if settings.weight_decay > 0:
        scale(online.weights, np.float32(1 - learning_rate * settings.weight_decay))
    adam(
        online.weights,
        gradient.weights,
        learning.mean,
        learning.square,
        learning_rate,
        counters.updates,
    )
    if settings.weight_averaging > 0:
        # Greater at first, so that the random weights do not stay in the average.
        share_of_new = max(settings.weight_averaging, 1 / counters.updates)
        approach(learning.average, online.weights, np.float32(share_of_new))
    evaluate_common_windows(online, windows)
    if counters.updates % settings.target_interval == 0:
        copy_into(target.weights, online.weights)
        evaluate_common_windows(target, windows)


@inlined
def chance_of(error: float, priority: float) -> float:
    """Return the chance, 0 to 1, that a drawn transition is taken, by its error.

    It is the absolute error to the power of `priority`, as a share of the greatest.
    """
    return float(min(1.0, (error + LEAST_ERROR) / GREATEST_ERROR) ** priority)


@inner
def draw_batch(learning: Learning, sampling: Generator, replayed: int) -> None:
    """Draw ``learning.batch`` from ``learning.replay``, with replacement.

    The buffer is a ring, into which `replayed` transitions have been put: it holds the
    last of them. With a `priority` of 0 all are drawn alike; else a drawn slot is drawn
    again unless chance takes it, see `chance_of`. The slots are written to `drawn`.
    """
    replay = learning.replay
    batch = learning.batch
    priority = learning.settings.priority
    count = min(replayed, replay.cell.size)  # of transitions in the buffer
    for n in range(batch.cell.size):
        slot = sampling.integers(0, count)
        if priority > 0:
            while sampling.random() > chance_of(learning.error[slot], priority):
                slot = sampling.integers(0, count)
        learning.drawn[n] = slot
        batch.scenario[n] = replay.scenario[slot]
        batch.cell[n] = replay.cell[slot]
        batch.action[n] = replay.action[slot]
        batch.next_cell[n] = replay.next_cell[slot]
        batch.reward[n] = replay.reward[slot]
        batch.discount[n] = replay.discount[slot]


@inner_in_place
def differentiate(
    network: Network, windows: Windows, gradient: Network, states: int
) -> None:
    """Add the gradient by all weights to `gradient`: backpropagation.

    Parameters
    ----------
    network, windows
        As `evaluate` has left them for as many states as `states`. The convolutions
        ``windows.convolved`` are overwritten by the gradient of the loss by them.
    gradient
        Each array is the gradient of the loss by that array of `network`. ``q`` holds
        the gradient by Q of the states; the gradients by weights and biases are added
        to, and all others are overwritten.
    states
        The number B of states.
    """
    gradient.common_output[:] = 0
    # The gradient by the convolution of the common windows before ReLU, although a
    # network has the features after ReLU in this place.
    gradient.common_feature[:] = 0
    for n in range(states):
        if has_hidden_layer(network):
            differentiate_last_layer(network, gradient, n)
        add_to(gradient.common_output, gradient.output[n])
        for row in range(windows.first_changed[n], windows.first_changed[n + 1]):
            differentiate_window(network, windows, gradient, n, row)
    differentiate_common_windows(network, gradient)
    add_to(gradient.layer_bias, gradient.common_output)
    add_kernel_gradient(
        gradient, windows.common, len(windows.common), gradient.common_feature
    )
    changed_count = windows.first_changed[states]
    add_kernel_gradient(gradient, windows.patch, changed_count, windows.convolved)


@inlined
def differentiate_last_layer(network: Network, gradient: Network, n: int) -> None:
    """Backpropagate from Q of state n through the last layer and the ReLU before it.

    `network` has evaluated the state. The gradient by the layer's weights and biases is
    added to; the gradient by the hidden layer's output before ReLU,
    ``gradient.output[n]``, is written.
    """
    add_to(gradient.last_bias, gradient.q[n])
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
    """Backpropagate from the output of state n through one of its changed windows.

    The changed window is in row `row` of `windows`. For each feature f `correct_output`
    has added (feature - common feature) times the weights of f to the output. This
    function adds the gradients by these weights and by the common window's convolution.
    ``windows.convolved[row]`` (F,), until then the convolution of the changed window
    before ReLU, is overwritten by the gradient by this convolution.
    """
    window = windows.changed[row]
    window_count, filters = network.common_feature.shape
    slopes = gradient.output  # (B, U): the gradient by the output of each state
    for f in range(filters):
        feature = relu(windows.convolved[row, f])
        common_feature = network.common_feature[window, f]
        change = feature - common_feature
        by_feature = np.float32(0)  # the gradient by `feature`
        # Most features are 0 in both windows: then this one has no gradient.
        if feature != 0 or change != 0:
            weight_row = f * window_count + window
            for u in range(output_count(network)):
                gradient.layer[weight_row, u] += change * slopes[n, u]
                by_feature += network.layer[weight_row, u] * slopes[n, u]
            if common_feature > 0:  # the derivative of ReLU is 0 elsewhere
                gradient.common_feature[window, f] -= by_feature
        windows.convolved[row, f] = by_feature if feature > 0 else np.float32(0)


@inlined
def differentiate_common_windows(network: Network, gradient: Network) -> None:
    """Backpropagate from the common output, a part of each state's output.

    Added to are the gradients by the weights of the layer after the convolution, and
    ``gradient.common_feature`` (L, F), the gradient by the convolution of the common
    windows before ReLU.
    """
    window_count, filters = network.common_feature.shape
    slopes = gradient.common_output  # (U,): the gradient by the common output
    for window in range(window_count):
        for f in range(filters):
            feature = network.common_feature[window, f]
            if feature > 0:
                row = f * window_count + window
                for u in range(output_count(network)):
                    gradient.layer[row, u] += feature * slopes[u]
                    by_feature = network.layer[row, u] * slopes[u]
                    gradient.common_feature[window, f] += by_feature


@inner_in_place
def add_kernel_gradient(
    gradient: Network, patch: Floats, patch_count: int, by_convolved: Floats
) -> None:
    """Add the gradients by the convolution's kernel (9, F) and bias (F,).

    They are those through the first `patch_count` of the windows' cells in `patch`
    (P, 9). `by_convolved` (P, F) is the gradient by the convolution of the patches.
    """
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
    """Change weights (N,) by Adam (Kingma and Ba 2015, with ε where torch has it).

    `slopes` (N,) is the gradient by the weights, and 0 afterwards. `means` and
    `squares` (N,) are its running first and second moments, changed in place. `updates`
    is the number of this update, from 1 on.
    """
    step = np.float32(learning_rate / (1 - BETA_1**updates))
    inverse_root = np.float32(1 / np.sqrt(1 - BETA_2**updates))
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
        weights[n] -= step * mean / (np.sqrt(squares[n]) * inverse_root + EPSILON)
        slopes[n] = 0
