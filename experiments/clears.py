"""Measures requests right after a clear of the costmap.

How often has such a request a path, and how long does it wait?

It does what Nav2's behavior tree does: a plan fails, the costmap is cleared, and the
same request comes again at once, before the cleared costmap was published.
"""

import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from client import Client, map_message, plan_request, wait_for
from nav_msgs.srv import GetPlan
from numpy.typing import NDArray
from processes import claim_ros_domain, executable, run_script, running
from tables import table

from ddqn_planner import GridMap
from ddqn_planner.nodes.quality import LATCHED

CLEARS = 20
FREQUENCIES = (2.0, 5.0)  # Hz
SIZE = 60  # cells of a side
START, GOAL, OTHER_GOAL = (10, 30), (50, 30), (50, 10)
LETHAL = 100


class Costmap:
    """Publishes a costmap: free, or with a ring of obstacles around the start."""

    def __init__(self, client: Client, frequency: float, topic: str = "map") -> None:
        self.period, self.grid = (
            1 / frequency,
            GridMap(np.zeros((SIZE, SIZE), np.bool_), 0.1),
        )
        self.has_ring = False
        self._client, self._topic = client, topic
        self._timer = client.node.create_timer(self.period, self._publish)

    @property
    def values(self) -> NDArray[np.int8]:
        """What it publishes next, (H, W) int8."""
        values = np.zeros((SIZE, SIZE), dtype=np.int8)
        if self.has_ring:
            x, y = START
            values[y - 3 : y + 4, x - 3 : x + 4] = LETHAL
            values[y - 2 : y + 3, x - 2 : x + 3] = 0
        return values

    def _publish(self) -> None:
        message = map_message(self.values, self.grid)
        message.header.stamp = self._client.node.get_clock().now().to_msg()
        self._client.publish(self._topic, message, LATCHED)

    def close(self) -> None:
        """Publish no more."""
        self._client.run(self._client.node.destroy_timer, self._timer)


class Navigator:
    """Asks as a behavior tree does; `plan` has the number of poses of the path."""

    def __init__(self, client: Client, costmap: Costmap) -> None:
        self._client, self.costmap = client, costmap

    def plan(self, goal: tuple[int, int] = GOAL) -> int:
        """Ask for a plan; return how many poses it has."""
        request = plan_request(self.costmap.grid, START, goal)
        return len(self._client.call(GetPlan, "planner/get_plan", request).plan.poses)

    def retry_after_clear(self, delay: float) -> tuple[bool, float]:
        """Return whether the retry has a path, and the seconds until the answer.

        The first request comes so many seconds after another one saw the ring.
        """
        self.costmap.has_ring = True
        wait_for("ring", lambda: not self.plan(OTHER_GOAL))
        time.sleep(delay)
        if self.plan():
            raise RuntimeError("there is a path through the ring")
        self.costmap.has_ring = False
        began = time.monotonic()
        has_path = self.plan() > 0
        seconds = time.monotonic() - began
        wait_for("cleared costmap", self.plan)
        return has_path, seconds


@contextmanager
def planner(**parameters: Any) -> Iterator[Client]:
    """Run a planner on a costmap, and give a client of it."""
    named = {"map_type": "costmap", **parameters}
    options = [f"{name}:={value}" for name, value in named.items()]
    arguments = [part for option in options for part in ("-p", option)]
    command = executable("planner_node"), "--ros-args", *arguments
    with (
        running(*command, stderr=subprocess.DEVNULL),
        Client() as client,
    ):  # it logs each failure
        yield client


def main(arguments: Sequence[str]) -> int:
    """Print a row for each frequency; return 1 if any retry failed."""
    count, random, rows = (
        int(arguments[0]) if arguments else CLEARS,
        np.random.default_rng(0),
        [],
    )
    _claim = claim_ros_domain()
    failed = 0
    with planner() as client:
        for frequency in FREQUENCIES:
            costmap = Costmap(client, frequency)
            navigator = Navigator(client, costmap)
            wait_for("path", navigator.plan)
            retries = [
                navigator.retry_after_clear(random.uniform(0, 1 / frequency))
                for _ in range(count)
            ]
            costmap.close()
            seconds = [retry[1] for retry in retries]
            solved = sum(retry[0] for retry in retries)
            failed += count - solved
            waits = f"{1e3 * np.mean(seconds):.0f}, {1e3 * max(seconds):.0f}"
            rows.append([f"{frequency:g} Hz", f"{solved} of {count}", waits])
    print(table("costmap | retries with a path | wait, mean and longest, ms", rows))
    return int(failed > 0)


if __name__ == "__main__":
    run_script(main, {"clears": "clears of each costmap (20)"})
