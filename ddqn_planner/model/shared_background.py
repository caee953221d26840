"""The paper's network, compiled: what all states of a map share is computed once.

A robot changes at most four windows of the convolution; S maps of one kind differ from what most of
them show in a few windows more. C = cells of a map, L = windows, F = filters, U = outputs of the
layer after the convolution.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner import compiled as compiling

Floats = NDArray[np.floating[Any]]
Integers = NDArray[np.int64]

# Sums in any order, so that eight are added at once; NaN and infinity as ever.
compiled = partial(
    compiling.compiled, fastmath={"reassoc", "contract", "arcp", "nsz"}, error_model="numpy"
)


class Windows(NamedTuple):
    """What the convolution sees of the maps without a robot."""

    common: Floats  # (L, 9): each window as most maps have it
    own: Floats  # (S, L, 9): as each map has it
    differing: Integers  # the windows of map 0 that are not the common ones, those of map 1, ...
    ends: Integers  # (S + 1,): those of map s are from ends[s] to before ends[s + 1]
    seeing: Integers  # (C, 4): the windows in which a cell lies, -1 for none
    place: Integers  # (C, 4): where in them it lies, 0 to 8
    robot: float  # what a cell with the robot shows


class Network(NamedTuple):
    """A module's tensors in its own memory, and what it makes of the common windows."""

    kernel: Floats  # (F, 9)
    kernel_bias: Floats  # (F,)
    layer: Floats  # (F * L, U)
    layer_bias: Floats  # (U,)
    last: Floats  # (8, U), empty without a hidden layer: then U is 8
    last_bias: Floats
    turned: Floats  # (9, F): the kernel, in the order of its use
    before: Floats  # (L, F): the convolution before ReLU
    after: Floats  # (L, F): after it
    output: Floats  # (U,): of the layer after the convolution
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
    seeing, place = np.full((2, cells, 4), -1)
    for window, at in np.ndindex(cut_L9.shape):
        if (cell := cut_L9[window, at]) < cells:
            free = np.argmin(seeing[cell])
            seeing[cell, free], place[cell, free] = window, at
    return Windows(common, own, differing, ends, seeing, place, robot)


def network_of(arrays: Sequence[Floats], windows: int) -> Network:
    """Return the network of a model's tensors, in their order; they share its memory."""
    kernel, kernel_bias, layer, layer_bias, *last = arrays
    last = last or [np.zeros((0, 0), kernel.dtype), np.zeros(0, kernel.dtype)]
    filters, units = len(kernel), len(layer_bias)
    shapes = (9, filters), (windows, filters), (windows, filters), units
    features: Any = (np.zeros(shape, kernel.dtype) for shape in shapes)
    eight = (0,) * 8 if not last[0].size else ()
    own = kernel.reshape(-1, 9), kernel_bias, layer.T, layer_bias, *last, *features
    return Network._make([*own, eight])


@compiled
def q_of_cells(network: Any, windows: Any, scenario: int, q: Any) -> None:
    """Compute Q (8, C) of a robot in each cell of a map."""
    look(network, windows)
    most = 4 + windows.differing.size
    changed, patch = np.empty(most, np.int64), np.empty((most, 9), windows.own.dtype)
    before = np.empty((most, network.after.shape[1]), network.after.dtype)
    output, q_of_cell = np.empty_like(network.output), np.empty(8, network.output.dtype)
    for cell in range(q.shape[1]):
        found = changes(windows, scenario, cell, changed, patch)
        evaluate(network, changed, patch, found, before, output, q_of_cell)
        for action in range(8):
            q[action, cell] = q_of_cell[action]


@compiled
def look(network: Any, windows: Any) -> None:
    """Compute what a network makes of the common windows."""
    before, after, output = network.before, network.after, network.output
    count, filters = before.shape
    for f in range(filters):
        for at in range(9):
            network.turned[at, f] = network.kernel[f, at]
    for window in range(count):
        convolve(network, windows.common, window, before, window)
        for f in range(filters):
            after[window, f] = max(before[window, f], np.float32(0))
    for u in range(output.size):
        output[u] = network.layer_bias[u]
    for f in range(filters):
        for window in range(count):
            feature = after[window, f]
            if feature != 0:
                for u in range(len(network.eight) or output.size):
                    output[u] += feature * network.layer[f * count + window, u]


@compiled
def convolve(network: Any, patch: Any, number: int, before: Any, row: int) -> None:
    """Compute the convolution of a window, a row of `patch`, into a row of `before`."""
    filters = network.kernel_bias.size
    for f in range(filters):
        before[row, f] = network.kernel_bias[f]
    for at in range(9):
        seen = patch[number, at]
        if seen != 0:
            for f in range(filters):
                before[row, f] += seen * network.turned[at, f]


@compiled
def changes(windows: Any, scenario: int, cell: int, changed: Any, patch: Any) -> int:
    """Cut the windows that are not the common ones on a map with a robot; return how many."""
    count = 0
    while count < 4 and windows.seeing[cell, count] >= 0:
        changed[count] = windows.seeing[cell, count]
        for at in range(9):
            patch[count, at] = windows.own[scenario, changed[count], at]
        patch[count, windows.place[cell, count]] = windows.robot
        count += 1
    with_robot = count
    for number in range(windows.ends[scenario], windows.ends[scenario + 1]):
        window = windows.differing[number]
        is_new = True
        for other in range(with_robot):
            is_new &= changed[other] != window
        if is_new:
            changed[count] = window
            for at in range(9):
                patch[count, at] = windows.own[scenario, window, at]
            count += 1
    return count


@compiled
def evaluate(
    network: Any, changed: Any, patch: Any, count: int, before: Any, output: Any, q: Any
) -> None:
    """Compute Q (8,) of a state, the output (U,), and the convolution of its changed windows."""
    windows, filters = network.after.shape
    for u in range(len(network.eight) or output.size):
        output[u] = network.output[u]
    for number in range(count):
        convolve(network, patch, number, before, number)
        window = changed[number]
        for f in range(filters):
            change = max(before[number, f], np.float32(0)) - network.after[window, f]
            if change != 0:
                for u in range(len(network.eight) or output.size):
                    output[u] += change * network.layer[f * windows + window, u]
    for action in range(8):
        q[action] = output[action] if len(network.eight) else network.last_bias[action]
        if not len(network.eight):
            for u in range(output.size):
                q[action] += max(output[u], np.float32(0)) * network.last[action, u]
