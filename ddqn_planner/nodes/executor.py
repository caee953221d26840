"""The executor of the nodes."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.task import Task
from rclpy.waitable import NumberOfEntities

# What a wait set waits for, as it calls them, and where a node has them.
KINDS = {
    "subscription": "subscriptions",
    "guard_condition": "guards",
    "timer": "timers",
    "client": "clients",
    "service": "services",
}
PARTS = "_tasks", "_tasks_lock", "_guard", "_take_waitable", *(f"_take_{kind}" for kind in KINDS)


def new_executor() -> SingleThreadedExecutor:
    """Return the nodes' executor, or rclpy's own where that has other parts inside."""
    ours = NodeExecutor()
    return ours if all(hasattr(ours, part) for part in PARTS) else SingleThreadedExecutor()


class NodeExecutor(SingleThreadedExecutor):
    """Runs one node as rclpy's executor does, and waits for it at a fraction of the cost."""

    # rclpy's makes a wait set each time that it waits, and wakes itself after each callback.
    _has_changed = True  # the node has other entities than the wait set

    def wake(self) -> None:
        """Wait for what the node has now."""
        self._has_changed = True
        super().wake()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait until something is ready, and run it."""
        self._wait()
        has_ended = True
        while has_ended:  # others may have awaited what is done now
            for task, *_ in self._tasks:  # also those that begin meanwhile
                task()
                task.result()  # or the exception of its callback
            with self._tasks_lock:
                left = [it for it in self._tasks if not (it[0].done() or it[0].cancelled())]
                has_ended, self._tasks = len(left) < len(self._tasks), left

    def _look_at_node(self) -> None:
        self._has_changed, (node,) = False, self.get_nodes()
        self._waitables = [*node.waitables]
        self._entities = {
            (kind, entity.handle.pointer): entity
            for kind, entities in KINDS.items()
            for entity in getattr(node, entities)
        }
        kinds = ["guard_condition", *(kind for kind, _ in self._entities)]  # one is the executor's
        counts = [it.get_num_entities() for it in self._waitables]
        count = sum(counts, NumberOfEntities(*map(kinds.count, KINDS)))
        sizes = (getattr(count, name) for name in count.__slots__)
        self._wait_set = rclpy_implementation.WaitSet(*sizes, self.context.handle)

    def _wait(self) -> None:
        """Wait until something is ready, and begin to call it."""
        if self._has_changed:
            self._look_at_node()
        wait_set = self._wait_set
        waitables = [it for it in self._waitables if it.callback_group.can_execute(it)]
        wait_set.clear_entities()
        wait_set.add_guard_condition(self._guard.handle)
        for (kind, _), entity in self._entities.items():
            if entity.callback_group.can_execute(entity):
                getattr(wait_set, f"add_{kind}")(entity.handle)
        for waitable in waitables:
            waitable.add_to_wait_set(wait_set)
        wait_set.wait(-1)
        ready: list[Any] = [(it, self._take_waitable) for it in waitables if it.is_ready(wait_set)]
        for kind in KINDS:
            take = getattr(self, f"_take_{kind}")
            found = (self._entities.get((kind, at)) for at in wait_set.get_ready_entities(kind))
            ready += [(entity, take) for entity in found if entity]
        # Not by `create_task`, which would wake the executor.
        self._tasks.extend((Task(self._execute, each, executor=self), None, None) for each in ready)

    async def _execute(self, entity: Any, take: Callable[[Any], Any]) -> None:
        """Call an entity's callback, unless another of its group runs, or the node has changed."""
        group = entity.callback_group
        if self._has_changed or not group.beginning_execution(entity):
            if take == self._take_guard_condition:  # all else is still ready when it waits again
                with suppress(InvalidHandle):  # it was destroyed
                    entity.trigger()
            return
        try:
            if execute := take(entity):
                await execute()
        finally:
            group.ending_execution(entity)
