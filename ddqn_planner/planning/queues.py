"""Two queues of states for a wavefront: a ring of buckets, and a heap."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import inlined

# What is next in a queue: no state, a state of the same key as the state before it, or
# a state of a greater key. In a ring of buckets, all states of a bucket count as of the
# same key.
NONE_WAITS, SAME_KEY, NEXT_KEY = 0, 1, 2
CHILD_BITS: Final = 2
CHILDREN: Final = 1 << CHILD_BITS  # of each entry of a heap
NEIGHBOURS: Final = 8  # of a cell: a bucket needs room for so many more states

# Places in `Buckets.cursor`. Buckets are numbered from key 0 on; where bucket n is in
# the ring is n modulo the size of the ring.
FRONT: Final = 0  # the number of the bucket that is emptied now
READ: Final = 1  # how many entries of the front bucket were popped
LAST: Final = 2  # the number of the last bucket that holds a state
TAKEN: Final = 3  # how many entries of `opened` were popped
IS_FULL: Final = 4  # 1 if a bucket may have no room for 8 more states


class Buckets(NamedTuple):
    """A ring of B buckets, each for states of about the same key (Dial 1969).

    A state whose key is less than those of the front bucket goes to that bucket.
    """

    # (K,): states that were open before the ring was made, sorted by their buckets.
    opened: NDArray[np.int32]
    opened_bucket: NDArray[np.int64]  # (K,): the number of the bucket of each of them
    bucket: NDArray[np.int32]  # (B, capacity): states; B is a power of 2
    used: NDArray[np.int64]  # (B,): how many entries of each bucket hold a state
    cursor: NDArray[np.int64]  # (5,): the numbers that change, at FRONT to IS_FULL
    per_unit: int  # buckets per unit of a key


def make_buckets(
    opened: NDArray[np.int32],
    opened_bucket: NDArray[np.int64],
    buckets: int,
    capacity: int,
    per_unit: int,
) -> Buckets:
    """Return a ring of empty buckets, and states that wait beside the ring.

    Parameters
    ----------
    opened, opened_bucket : (K,)
        The states beside the ring, sorted by the numbers of their buckets, and these
        numbers.
    buckets : int
        Buckets of the ring, a power of 2.
    capacity : int
        States for which each bucket has room.
    per_unit : int
        Buckets per unit of a key.
    """
    cursor = np.zeros(5, np.int64)
    if opened_bucket.size:
        # The front is the empty bucket before that of the first state: so the first
        # state has a greater key, and `advance_buckets` returns NEXT_KEY.
        cursor[FRONT] = opened_bucket[0] - 1
    bucket = np.empty((buckets, capacity), np.int32)
    counts = np.zeros(buckets, np.int64)  # of the states in each bucket
    return Buckets(opened, opened_bucket, bucket, counts, cursor, per_unit)


def states_in_buckets(queue: Buckets) -> NDArray[np.int32]:
    """Return the states in a queue, and some that were popped from its front bucket."""
    states_in_ring = [
        queue.bucket[place, : queue.used[place]] for place in queue.used.nonzero()[0]
    ]
    states_beside_ring = queue.opened[queue.cursor[TAKEN] :]
    return np.concatenate([states_beside_ring, *states_in_ring])


@inlined
def _place_in_ring(number: Any, queue: Any) -> Any:
    """Return the row of `queue.bucket` that holds the bucket of a number.

    It is the number modulo the size of the ring.
    """
    # The size is a power of 2, so that this takes no division. Unsigned, as numba then
    # looks for no index that counts from the end.
    return np.uint64(number & (queue.bucket.shape[0] - 1))


@inlined
def push_to_bucket(key: Any, state: Any, queue: Any) -> None:
    """Add a state with a key (a cost) to the bucket of the key, in a `Buckets`."""
    # No bucket is before the front: a state of a smaller key is added to the front.
    number = max(np.int64(key * queue.per_unit), queue.cursor[FRONT])
    place = _place_in_ring(number, queue)
    count = queue.used[place]  # states in the bucket
    queue.bucket[place, np.uint64(count)] = state
    queue.used[place] = count + 1
    if number > queue.cursor[LAST]:
        queue.cursor[LAST] = number
    if count + 1 > queue.bucket.shape[1] - NEIGHBOURS:
        queue.cursor[IS_FULL] = 1


@inlined
def advance_buckets(queue: Any) -> int:
    """Move the front on, bucket by bucket, until the front bucket holds a state.

    A bucket holds states in the ring, and beside it those of `queue.opened` that have
    its number. `queue.cursor` tells which of both were popped.

    Returns
    -------
    int
        SAME_KEY if the front bucket held a state before, NEXT_KEY if another bucket
        became the front, NONE_WAITS if no bucket holds a state.
    """
    step = SAME_KEY
    while True:
        front = queue.cursor[FRONT]
        place = _place_in_ring(front, queue)
        popped_in_ring = queue.cursor[READ]
        if popped_in_ring < queue.used[place]:
            return step
        # The first state beside the ring that was not popped.
        next_opened = queue.cursor[TAKEN]
        has_opened = next_opened < queue.opened.size
        if has_opened and queue.opened_bucket[next_opened] <= front:
            return step
        # The front bucket is empty. The ring uses its memory for a later bucket.
        step = NEXT_KEY
        queue.used[place] = 0
        queue.cursor[READ] = 0
        if front < queue.cursor[LAST]:
            queue.cursor[FRONT] = front + 1
        elif has_opened:  # all buckets of the ring are empty: skip to this state
            queue.cursor[FRONT] = queue.opened_bucket[next_opened]
        else:
            return NONE_WAITS


@inlined
def pop_from_bucket(queue: Any) -> Any:
    """Remove a state from the front bucket, which holds one, and return it.

    The states in the ring come first, then those beside it, in `queue.opened`.
    """
    place = _place_in_ring(queue.cursor[FRONT], queue)
    popped_in_ring = queue.cursor[READ]
    if popped_in_ring < queue.used[place]:
        queue.cursor[READ] = popped_in_ring + 1
        return np.int64(queue.bucket[place, np.uint64(popped_in_ring)])
    popped_beside = queue.cursor[TAKEN]
    queue.cursor[TAKEN] = popped_beside + 1
    return np.int64(queue.opened[popped_beside])


@inlined
def buckets_are_past(queue: Any, cost: Any) -> bool:
    """Return whether all keys in the buckets are greater than a cost."""
    return bool(cost * queue.per_unit < queue.cursor[FRONT])


@inlined
def has_full_bucket(queue: Any, _: Any) -> bool:
    """Return whether a bucket may have no room for the predecessors of a cell."""
    return bool(queue.cursor[IS_FULL])


class Heap(NamedTuple):
    """States by their keys: a heap of which each entry has 4 children.

    The children of entry n are 4 n + 1 to 4 n + 4, and none has a smaller key than n.
    """

    keys: NDArray[np.float32]  # (room,)
    states: NDArray[np.int64]  # (room,)
    size: NDArray[np.int64]  # (1,): how many entries hold a state


def make_heap(entries: int) -> Heap:
    """Return an empty heap with room for a number of entries."""
    return Heap(
        np.empty(entries, np.float32),
        np.empty(entries, np.int64),
        np.zeros(1, np.int64),
    )


@inlined
def push_to_heap(key: Any, state: Any, heap: Any) -> None:
    """Add a state to a `Heap`, which has room; its key is rounded to float32."""
    rounded_key = np.float32(key)
    # The state rises from the end of the heap, and each parent of a greater key moves
    # down into the place that the state leaves.
    place = heap.size[0]
    heap.size[0] = place + 1
    while place > 0:
        parent = (place - 1) >> CHILD_BITS
        if heap.keys[parent] <= rounded_key:
            break
        heap.keys[place] = heap.keys[parent]
        heap.states[place] = heap.states[parent]
        place = parent
    heap.keys[place] = rounded_key
    heap.states[place] = state


@inlined
def advance_heap(heap: Any) -> int:
    """Return NEXT_KEY if a heap holds a state, else NONE_WAITS."""
    return NEXT_KEY if heap.size[0] > 0 else NONE_WAITS


@inlined
def heap_is_past(heap: Any, cost: Any) -> bool:
    """Return whether no key in a heap is less than a cost."""
    return bool(heap.keys[0] >= cost)


@inlined
def pop_from_heap(heap: Any) -> Any:
    """Remove the state of the least key from a `Heap` that is not empty; return it."""
    size = heap.size[0] - 1
    heap.size[0] = size
    removed_state = heap.states[0]
    # The last entry sinks from the first place, and the child of the smallest key moves
    # up into the place that it leaves, as long as that key is smaller than its own.
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
    return removed_state
