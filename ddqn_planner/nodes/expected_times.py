"""Expected times on the planner's map: what the trainer has learned of drives."""

from collections.abc import Callable

import numpy as np
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.client import Client
from rclpy.task import Future
from std_msgs.msg import MultiArrayLayout, UInt8MultiArray
from std_srvs.srv import Trigger

from ddqn_planner.experience import Experience
from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.clocks import STEADY
from ddqn_planner.nodes.conversions import CHANGES, bytes_of, has_changes
from ddqn_planner.nodes.diagnostics import PlannerDiagnostics
from ddqn_planner.nodes.outcome import NO_REQUEST, Outcome
from ddqn_planner.nodes.quality import CHANGING
from ddqn_planner.nodes.worker import Worker

# Share of a map's cells: if more than these have changed, the experience is spread anew
# over the map, which takes long.
CHANGED_SHARE = 0.02
ASK_PERIOD = 1.0  # seconds between two requests for the trainer's experience


class ExpectedTimes:
    """Puts on maps the times that an experience expects; the trainer's or a file's."""

    def __init__(
        self,
        node: BaseNode,
        diagnostics: PlannerDiagnostics,
        worker: Worker,
        on_change: Callable[[], None],
    ) -> None:
        """Load the parameter's file, and listen to the trainer if parameters say so.

        Parameters
        ----------
        node
            The planner's node, with its parameters.
        diagnostics
            Where refused messages and files are reported.
        worker
            Loads experience and computes the time of a plan.
        on_change
            Called when maps cost other times.
        """
        self._node = node
        self._diagnostics = diagnostics
        self._worker = worker
        self._on_change = on_change
        self._experience: Experience | None = None  # in use
        # The layout of the message in which the experience came; it holds a digest.
        self._layout: MultiArrayLayout | None = None
        self._trainer: Client | None = None  # of the service that sends experience
        # Whether the trainer's last message told of changes that cannot be read, or of
        # another experience than the one in use: the planner came late, or has missed a
        # message.
        self._is_behind = False
        # The experience of the file that the parameter names, if it was loaded when
        # the parameter was set, and is not in use yet.
        self._experience_of_file: Experience | None = None
        # The map over which the experience was spread the last time.
        self._spread_map: GridMap | None = None
        # The outcome that the worker describes, and the future of its description.
        self._described = NO_REQUEST
        self._description = Future()
        group = MutuallyExclusiveCallbackGroup()  # the callback waits for the worker
        # Without a message, `on_message` uses the file.
        self._use_file = node.create_guard_condition(self.on_message, group).trigger
        if node.value("experience"):
            self._use_file()
        if node.value("follow_trainer"):
            subscription = node.create_subscription(
                UInt8MultiArray,
                "trainer/experience",
                self.on_message,
                CHANGING,
                callback_group=group,
            )
            service = f"{subscription.topic_name}/send"
            self._trainer = node.create_client(Trigger, service)
            node.create_timer(ASK_PERIOD, self._ask_if_behind, clock=STEADY)

    def use(self, experience: Experience | None) -> None:
        """Plan by the experience of the parameter's new file; None without a file."""
        self._experience_of_file = experience
        self._use_file()

    async def on_message(self, message: UInt8MultiArray | None = None) -> None:
        """Plan by a message of the trainer; without one, by the file of the parameter.

        A message or a file without experience is reported, and not used.
        """
        with self._diagnostics.receiving("experience"):
            is_new: bool = await self._worker.call(self.load, message)
            if is_new:
                self._on_change()
        if self._is_behind and message is not None:
            self._ask_if_behind()

    def _ask_if_behind(self) -> None:
        """Ask the trainer for its experience if changes of it are missing.

        A timer calls this, too, as the trainer's service may be unknown yet.
        """
        trainer = self._trainer
        if self._is_behind and trainer is not None and trainer.service_is_ready():
            trainer.call_async(Trigger.Request())

    def load(self, message: UInt8MultiArray | None = None) -> bool:
        """Use the experience of a message, or without one of the parameter's file.

        The worker calls this function.

        Returns
        -------
        bool
            False if the message is the same as the last one, or tells of changes that
            do not follow on the experience in use.

        Raises
        ------
        ValueError
            If the message or the file holds no experience.
        """
        if message is not None:
            return self._load_message(message)
        self._replace_experience(self._load_file(), layout=None)
        return True

    def _load_message(self, message: UInt8MultiArray) -> bool:
        """Use the experience of a message, or the changes of it, by the message's kind.

        See `load` for the result and the error.
        """
        kind = CHANGES if has_changes(message) else "experience"
        data = bytes_of(kind, message)
        if message.layout == self._layout:
            self._is_behind = False
            return False
        if kind == CHANGES:
            return self._apply_changes(message.layout, data)
        # If this one cannot be read, neither can the answer to another request.
        self._is_behind = False
        self._replace_experience(Experience.from_bytes(data), message.layout)
        return True

    def _replace_experience(
        self, experience: Experience | None, layout: MultiArrayLayout | None
    ) -> None:
        """Use another experience, or none, instead of the one in use.

        `layout` is that of the message in which it came; None for the one of a file.
        """
        if experience is not None and self._experience is not None:
            experience.take_posterior_from(self._experience)
        self._experience = experience
        self._layout = layout

    def _apply_changes(self, layout: MultiArrayLayout, data: bytes) -> bool:
        """Change the experience in use; False if these changes do not follow on it.

        `layout` and `data` are those of the trainer's message.
        """
        experience = self._experience
        # Until they are applied. An error says that they cannot be read.
        self._is_behind = True
        if experience is None or not experience.apply_changes(data):
            return False
        self._is_behind = False
        self._layout = layout
        return True

    def _load_file(self) -> Experience | None:
        """Return the experience of the parameter's file; None without a file.

        An experience that `use` received for the file is returned once.
        """
        file: str = self._node.value("experience")
        if not file:
            return None
        experience = self._experience_of_file
        self._experience_of_file = None
        return Experience.load(file) if experience is None else experience

    def apply(self, grid: GridMap) -> GridMap:
        """Return the map with the expected times of its cells.

        Before the first drive, `grid` itself is returned. A map with nearly the same
        obstacles as the last one gets the times that were computed on the last map.
        """
        if self._experience is None or not len(self._experience.evidence.places):
            return grid
        if self._spread_map is None or not is_like(grid, self._spread_map):
            self._spread_map = grid
        exploration: float = self._node.value("exploration")
        map_with_times = self._experience.apply(self._spread_map, exploration)
        return grid.with_times_of(map_with_times)

    def diagnostics_of(self, outcome: Outcome) -> dict[str, str]:
        """Return the diagnostics' lines about how long the robot needs for a plan.

        The worker computes them, see `describe`: it begins at the first call for an
        outcome, and the lines are empty until it has ended.
        """
        if self._experience is None:
            return {}
        if outcome is not self._described:
            self._described = outcome
            self._description = self._worker.call(self.describe, outcome)
        if not self._description.done():
            self._diagnostics.change()  # to look again soon
            return {}
        if self._description.exception():  # as when no memory is left
            return {}
        description: dict[str, str] = self._description.result() or {}
        return description

    def describe(self, outcome: Outcome) -> dict[str, str]:
        """Return how long the robot needs for a plan, as lines of the diagnostics.

        Without lines if the outcome has no path, or its map is an older one or has no
        times. The worker calls this function.
        """
        request = outcome.request
        grid = self._spread_map
        path = outcome.plan.path
        if self._experience is None or grid is None or request is None:
            return {}
        if request.grid.slowness is None or not len(path):
            return {}
        if not is_like(request.grid, grid):
            return {}
        time = self._experience.expected_time(grid, path)
        return {
            "expected time (s)": f"{time.seconds:.1f}",
            "expected time, 90 % interval (s)": f"{time.low:.1f} to {time.high:.1f}",
        }


def is_like(grid: GridMap, other: GridMap) -> bool:
    """Return whether two maps have the same cells, and nearly the same obstacles."""
    if grid.occupancy.shape != other.occupancy.shape:
        return False
    if grid.resolution != other.resolution or grid.origin != other.origin:
        return False
    changed_cells = np.count_nonzero(grid.occupancy != other.occupancy)
    return bool(changed_cells <= CHANGED_SHARE * grid.occupancy.size)
