"""The paper's network, compiled: what all states of a map share is computed once.

A robot changes at most four windows of the convolution; S maps of one kind differ from what most of
them show in a few windows more. C = cells of a map, L = windows, F = filters, U = outputs of the
layer after the convolution, D = windows that may differ.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner import compiled as compiling

Floats = NDArray[np.floating[Any]]
Integers = NDArray[np.int64]

# Sums in any order, so that eight are added at once; NaN and infinity as ever.
FLAGS = {"reassoc": True, "contract": True, "arcp": True, "nsz": True}  # a set has no fixed order
compiled = partial(compiling.compiled, fastmath=FLAGS)


class Windows(NamedTuple):
    """What the convolution sees of the maps without a robot."""

    common: Floats  # (L, 9): each window as most maps have it
    own: Floats  # (S, L, 9): as each map has it
    differing: Integers  # the windows of map 0 that are not the common ones, those of map 1, ...
    ends: Integers  # (S + 1,): those of map s are from ends[s] to before ends[s + 1]
    shape: tuple[int, int]  # (H, W)
    robot: float  # what a cell with the robot shows


class Network(NamedTuple):
    """A module's weights, and what it makes of the common windows and of B states."""

    weights: Floats  # all that follow, up to `last_bias`
    kernel: Floats  # (9, F)
    kernel_bias: Floats  # (F,)
    layer: Floats  # (F * L, U)
    layer_bias: Floats  # (U,)
    last: Floats  # (U, 8), empty without a hidden layer: then U is 8
    last_bias: Floats
    before: Floats  # (L, F): the convolution before ReLU
    after: Floats  # (L, F): after it
    output: Floats  # (U,): of the layer after the convolution
    patch: Floats  # (B * D, 9): each state's windows that are not the common ones
    changed: Integers  # (B * D,): which they are
    first: Integers  # (B + 1,): those of state n are from first[n] to before first[n + 1]
    own_before: Floats  # (B * D, F): their convolution before ReLU
    own_output: Floats  # (B, U): of the layer after it
    q: Floats  # (B, 8)
    awake: NDArray[np.bool_]  # (F * L,): where a step moves the layer; (1,) without a hidden one
    windows: Windows
    eight: tuple[int, ...]  # of 8 zeros where U is 8: a known number of turns is twice as fast


def windows_of(background_SC: Floats, shape: tuple[int, int], robot: float) -> Windows:
    """Cut backgrounds of maps of shape (H, W) into windows: 3x3 cells, stride 2, padding 1."""
    cells = background_SC.shape[1]
    padded = np.pad(np.arange(cells).reshape(shape), 1, constant_values=cells)
    cut_L9 = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))[::2, ::2].reshape(-1, 9)
    background_SC = np.pad(background_SC, [(0, 0), (0, 1)])  # 0 outside the map
    own = background_SC[:, cut_L9]
    common = np.sort(background_SC, axis=0)[len(own) // 2][cut_L9]
    scenario, differing = np.nonzero((own != common).any(axis=2))
    ends = np.searchsorted(scenario, np.arange(len(own) + 1))
    return Windows(common, own, differing, ends, shape, robot)


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
    common = zeros(of_all), zeros(of_all), zeros(units), zeros((rows, 9))
    numbers = np.zeros(rows, np.int64), np.zeros(batch + 1, np.int64)
    own = zeros((rows, of_all[1])), zeros((batch, units))
    q, eight = (zeros((batch, 8)), ()) if len(tensors) > 4 else (own[1], (0,) * 8)
    awake = np.ones(1 if eight else len(parts[2]), np.bool_)
    return Network._make([weights, *parts, *common, *numbers, *own, q, awake, windows, eight])


@compiled
def look(network: Any) -> None:
    """Compute what a network makes of the common windows."""
    layer, after, output = network.layer, network.after, network.output
    count, filters = after.shape
    convolve(network.kernel, network.kernel_bias, network.windows.common, count, network.before)
    output[:] = network.layer_bias
    for f in range(filters):
        for window in range(count):
            feature = max(network.before[window, f], np.float32(0))
            after[window, f] = feature
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
                patch[end, 3 * (y + 1 - 2 * row) + x + 1 - 2 * column] = windows.robot
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
