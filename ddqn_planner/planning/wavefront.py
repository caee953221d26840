"""How least costs spread from goals over states: one algorithm, for cells and poses."""

from typing import Any, Final, NamedTuple

import numpy as np

from ddqn_planner.compiled import inlined
from ddqn_planner.planning.queues import NEXT_KEY, NONE_WAITS

# Marks. The cost of an open state may fall; that of a closed one is the least that its
# wavefront could find. A state waits that became cheaper after it was closed, where a
# wavefront closes each state once: the next wavefront opens it again.
UNREACHED, OPEN, WAITING, CLOSED = 0, 1, 2, 3

# Why a wavefront stopped.
DONE: Final = 0  # the target's cost is known, or no path leads from it to a goal
OUT_OF_VISITS: Final = 1
QUEUE_FULL: Final = 2


class Target(NamedTuple):
    """The state whose cost is asked for, and when a wavefront toward it may stop."""

    state: int
    # How many states, from this one on, count as one: the least of their costs does.
    states: int
    # The cost of the state is known well enough once all states in the queue have a
    # greater key than this share of it (1 for exact costs),
    share: float
    # or once it is no greater than this.
    cost_enough: float
    most_visits: int  # how many states may be closed


class Progress(NamedTuple):
    """What became of a wavefront."""

    visits: int  # how many states it closed
    reason: int  # why it stopped: DONE, OUT_OF_VISITS or QUEUE_FULL


# What differs between cells and poses, the queue and the space, is handed in when a
# wavefront is compiled: `specialised` replaces the next five functions.


def advance(queue: Any) -> int:
    """Move a queue on to its next state, which stays in the queue.

    Return NONE_WAITS, SAME_KEY or NEXT_KEY (see `queues`).
    """
    raise NotImplementedError


def pop(queue: Any) -> int:
    """Remove the state to which `advance` moved a queue, and return it."""
    raise NotImplementedError


def is_past(queue: Any, cost: Any) -> bool:
    """Return whether all keys in a queue are too great to make a cost smaller."""
    raise NotImplementedError


def is_full(queue: Any, space: Any) -> bool:
    """Return whether a queue may have no room for the predecessors of a state."""
    raise NotImplementedError


def expand(state: int, distance: Any, mark: Any, queue: Any, space: Any) -> None:
    """Lower the cost of each state that reaches a goal more cheaply by way of `state`.

    `state` was just closed. Each state whose cost in `distance` falls is marked as open
    and queued.
    """
    raise NotImplementedError


@inlined
def _least_cost(target: Target, distance: Any, mark: Any) -> float:
    """Return the least cost found from the states of a target; infinite without one."""
    cost = np.inf
    for state in range(target.state, target.state + target.states):
        if mark[state] != UNREACHED:
            cost = min(cost, distance[state])
    return cost


def spread(
    distance: Any, mark: Any, queue: Any, target: Target, space: Any
) -> Progress:
    """Close states in the order of a queue, until the cost of a target is known.

    The cost of a state is that of a path from the state to a goal: a wavefront grows
    from the goals toward the target.

    Parameters
    ----------
    distance : (S,) float
        The least cost found for each of S states; changes in place. It has no meaning
        for states that are UNREACHED.
    mark : (S,) uint8
        UNREACHED, OPEN, WAITING or CLOSED for each state; changes in place.
    queue : Buckets or Heap
        The open states. A state may be in it more than once.
    target : Target
        A state, when its cost is known well enough, and how many states may be closed.
    space : CellSpace or Search
        The map, as `expand` needs it.

    Returns
    -------
    Progress
        How many states were closed, and why the wavefront stopped.
    """
    visits = 0
    while True:
        step = advance(queue)
        if step == NONE_WAITS:
            break
        # The wavefront stops only between two keys: of the states of one key, all are
        # closed or none. So a rollout may choose among all paths of the same cost.
        if step == NEXT_KEY:
            cost = _least_cost(target, distance, mark)
            is_known = cost <= target.cost_enough or is_past(queue, cost * target.share)
            if cost < np.inf and is_known:
                break
            if visits >= target.most_visits:
                return Progress(visits, OUT_OF_VISITS)
        if is_full(queue, space):
            return Progress(visits, QUEUE_FULL)
        state = pop(queue)
        # A state that is not open was queued more than once and closed before, or its
        # cost was taken back by a repair.
        if mark[state] != OPEN:
            continue
        mark[state] = CLOSED
        visits += 1
        expand(state, distance, mark, queue, space)
    return Progress(visits, DONE)
