"""Two queues of states for a wavefront: a ring of buckets, and a heap."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import inlined

# What a queue finds: no state, a state of the same key as the one before, or one of a
# greater key. In a ring of buckets, all states of a bucket count as of the same key.
NONE_WAITS, SAME_KEY, NEXT_KEY = 0, 1, 2
CHILD_BITS: Final = 2
CHILDREN: Final = 1 << CHILD_BITS  # of each entry of a heap

# The numbers of a ring of buckets that change; buckets are not wrapped.
FRONT: Final = 0  # the bucket that is emptied now
READ: Final = 1  # entries of that bucket that were taken
LAST: Final = 2  # no bucket behind this one holds a state
TAKEN: Final = 3  # entries of `opened` that were taken
IS_FULL: Final = 4  # 1 if a bucket may have no room for 8 more states


class Buckets(NamedTuple):
    """A ring of B buckets, each for states of about the same key (Dial 1969).

    A state whose key is less than those of the front bucket goes to that bucket.
    """

    opened: NDArray[np.int32]  # (K,): the states that were open before, sorted
    opened_bucket: NDArray[np.int64]  # (K,): the bucket of each
    bucket: NDArray[np.int32]  # (B, capacity); B is a power of 2
    used: NDArray[np.int64]  # (B,): how many entries of each bucket hold a state
    cursor: NDArray[np.int64]  # (5,): the numbers that change, by the names above
    per_unit: int  # buckets per unit of a key


def make_buckets(
    opened: NDArray[np.int32],
    opened_bucket: NDArray[np.int64],
    buckets: int,
    capacity: int,
    per_unit: int,
) -> Buckets:
    """Return a ring of some buckets with room for `capacity` states each, all empty.

    The open states are sorted by their buckets.
    """
    cursor = np.zeros(5, np.int64)
    if opened_bucket.size:
        cursor[FRONT] = opened_bucket[0] - 1  # a bucket without states
    bucket = np.empty((buckets, capacity), np.int32)
    used = np.zeros(buckets, np.int64)
    return Buckets(opened, opened_bucket, bucket, used, cursor, per_unit)


def states_in_buckets(queue: Buckets) -> NDArray[np.int32]:
    """Return the states that wait, and some that were taken from the front bucket."""
    waiting = [
        queue.bucket[number, : queue.used[number]] for number in queue.used.nonzero()[0]
    ]
    return np.concatenate([queue.opened[queue.cursor[TAKEN] :], *waiting])


@inlined
def push_to_bucket(key: Any, state: Any, queue: Any) -> None:
    """Add a state."""
    number = max(np.int64(key * queue.per_unit), queue.cursor[FRONT])
    # The size of the ring is a power of 2, so that wrapping takes no division. Unsigned,
    # as numba then looks for no index that counts from the end.
    wrapped = np.uint64(number & (queue.bucket.shape[0] - 1))
    used = queue.used[wrapped]
    queue.bucket[wrapped, np.uint64(used)] = state
    queue.used[wrapped] = used + 1
    if number > queue.cursor[LAST]:
        queue.cursor[LAST] = number
    if used + 1 > queue.bucket.shape[1] - 8:
        queue.cursor[IS_FULL] = 1


@inlined
def advance_buckets(queue: Any) -> int:
    """Move the front to the next bucket that holds a state, if the front bucket is empty.

    Return NONE_WAITS, SAME_KEY if the front bucket held one, or NEXT_KEY.
    """
    step = SAME_KEY
    while True:
        front = queue.cursor[FRONT]
        wrapped = np.uint64(front & (queue.bucket.shape[0] - 1))
        if queue.cursor[READ] < queue.used[wrapped]:
            return step
        taken = queue.cursor[TAKEN]
        if taken < queue.opened.size and queue.opened_bucket[taken] <= front:
            return step
        step = NEXT_KEY
        queue.used[wrapped] = 0
        queue.cursor[READ] = 0
        if front < queue.cursor[LAST]:
            queue.cursor[FRONT] = front + 1
        elif taken < queue.opened.size:
            queue.cursor[FRONT] = queue.opened_bucket[taken]
        else:
            return NONE_WAITS


@inlined
def take_from_bucket(queue: Any) -> Any:
    """Take a state of the front bucket away and return it; there is one."""
    wrapped = np.uint64(queue.cursor[FRONT] & (queue.bucket.shape[0] - 1))
    read = queue.cursor[READ]
    if read < queue.used[wrapped]:
        queue.cursor[READ] = read + 1
        return np.int64(queue.bucket[wrapped, np.uint64(read)])
    taken = queue.cursor[TAKEN]
    queue.cursor[TAKEN] = taken + 1
    return np.int64(queue.opened[taken])


@inlined
def buckets_are_past(cost: Any, queue: Any) -> bool:
    """Return whether all keys are greater than a cost."""
    return bool(cost * queue.per_unit < queue.cursor[FRONT])


@inlined
def has_full_bucket(queue: Any) -> bool:
    """Return whether there may be no room for the predecessors of a cell."""
    return bool(queue.cursor[IS_FULL])


class Heap(NamedTuple):
    """States by their keys, which may fall: a heap of which each entry has 4 children."""

    keys: NDArray[np.float32]
    states: NDArray[np.int64]
    size: NDArray[np.int64]  # (1,): how many entries are used


def make_heap(entries: int) -> Heap:
    """Return an empty heap with room for some entries."""
    return Heap(
        np.empty(entries, np.float32),
        np.empty(entries, np.int64),
        np.zeros(1, np.int64),
    )


@inlined
def push_to_heap(key: Any, state: Any, heap: Any) -> None:
    """Add a state; keys are rounded to float32."""
    rounded = np.float32(key)
    place = heap.size[0]
    heap.size[0] = place + 1
    while place > 0:
        parent = (place - 1) >> CHILD_BITS
        if heap.keys[parent] <= rounded:
            break
        heap.keys[place] = heap.keys[parent]
        heap.states[place] = heap.states[parent]
        place = parent
    heap.keys[place] = rounded
    heap.states[place] = state


@inlined
def advance_heap(heap: Any) -> int:
    """Return NEXT_KEY if a state waits, or else NONE_WAITS."""
    return NEXT_KEY if heap.size[0] > 0 else NONE_WAITS


@inlined
def pop_from_heap(heap: Any) -> Any:
    """Take the state of the least key away and return it; there is one."""
    size = heap.size[0] - 1
    heap.size[0] = size
    first_state = heap.states[0]
    # The last entry moves to the first place, and from there down past smaller ones.
    key = heap.keys[size]
    state = heap.states[size]
    place = 0
    while True:
        smallest_place = place
        smallest_key = key
        first_child = (place << CHILD_BITS) + 1
        for child in range(first_child, min(first_child + CHILDREN, size)):
            if heap.keys[child] < smallest_key:
                smallest_place = child
                smallest_key = heap.keys[child]
        if smallest_place == place:
            break
        heap.keys[place] = smallest_key
        heap.states[place] = heap.states[smallest_place]
        place = smallest_place
    heap.keys[place] = key
    heap.states[place] = state
    return first_state
