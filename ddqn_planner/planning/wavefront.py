"""How least costs spread from goals over states: one algorithm for cells and for poses."""

from typing import Any, Final, NamedTuple

from ddqn_planner.planning.queues import NEXT_KEY, NONE_WAITS

NO_STATE: Final = -1

# Marks. The cost of an open state may fall; that of a closed one is the least that its
# wavefront could find. A state waits that became cheaper after it was closed, where a
# wavefront closes each state once: the next wavefront opens it again.
UNREACHED, OPEN, WAITING, CLOSED = 0, 1, 2, 3

# Why a wavefront stopped.
DONE: Final = 0  # the target's cost is known, or no path leads from it to a goal
OUT_OF_VISITS: Final = 1
QUEUE_FULL: Final = 2
NOT_CLOSABLE: Final = 3  # the next state lies where the map was not read


class Target(NamedTuple):
    """The state whose cost is asked for, and when it is known well enough."""

    state: int
    share: float  # of its cost: known if no state in the queue has a smaller key
    cost_enough: float  # or if it is no greater than this, whatever the queue holds
    most_visits: int


class Closable(NamedTuple):
    """The numbers of the states that may be closed."""

    first: int
    end: int


class Progress(NamedTuple):
    """What became of a wavefront."""

    visits: int  # states that it closed
    reason: int  # why it stopped: DONE, OUT_OF_VISITS, QUEUE_FULL or NOT_CLOSABLE
    state: int  # that is not closable, and was taken from the queue; or NO_STATE


# What differs between cells and poses, the queue and the space, is handed in when a
# wavefront is compiled: `specialised` replaces the next five functions.


def advance(queue: Any) -> int:
    """Find the next state: return NONE_WAITS, SAME_KEY or NEXT_KEY."""
    raise NotImplementedError


def take(queue: Any) -> int:
    """Take the state that `advance` found away and return it."""
    raise NotImplementedError


def is_past(queue: Any, cost: Any, target: Target) -> bool:
    """Return whether a cost of the target is known well enough by the keys that wait."""
    raise NotImplementedError


def is_full(queue: Any, space: Any) -> bool:
    """Return whether a queue may have no room for the predecessors of a state."""
    raise NotImplementedError


def expand(state: int, distance: Any, mark: Any, queue: Any, space: Any) -> None:
    """Open each state from which a step to a closed one is cheaper than it is."""
    raise NotImplementedError


def spread(
    distance: Any, mark: Any, queue: Any, target: Target, closable: Any, space: Any
) -> Progress:
    """Close states in the order of a queue, until the cost of a target is known.

    Parameters
    ----------
    distance, mark : (S,)
        The cost of each state, and whether it was reached: they change in place.
    queue : Buckets or Heap
        The open states.
    target : Target
    closable : Closable, optional
        None for all states: then numba compiles no test of it.
    space : CellSpace or PoseSpace
        What `expand` needs.
    """
    visits = 0
    while True:
        step = advance(queue)
        if step == NONE_WAITS:
            break
        # Not between states of the same key: where one of them is closed, all are, so
        # that a rollout finds the paths that are as good as each other.
        if step == NEXT_KEY:
            is_reached = mark[target.state] != UNREACHED
            if is_reached and is_past(queue, distance[target.state], target):
                break
            if visits >= target.most_visits:
                return Progress(visits, OUT_OF_VISITS, NO_STATE)
        if is_full(queue, space):
            return Progress(visits, QUEUE_FULL, NO_STATE)
        state = take(queue)
        if mark[state] != OPEN:  # it was queued twice
            continue
        if closable is not None and not closable.first <= state < closable.end:
            return Progress(visits, NOT_CLOSABLE, state)
        mark[state] = CLOSED
        visits += 1
        expand(state, distance, mark, queue, space)
    return Progress(visits, DONE, NO_STATE)
