"""What a learner knows of the trainer node, and the node of a learner."""

from __future__ import annotations

from collections.abc import Coroutine, Iterator
from pathlib import Path as FilePath
from typing import NamedTuple, Protocol

import numpy as np
from nav_msgs.msg import Path
from numpy.typing import NDArray
from std_msgs.msg import String, UInt8MultiArray

from ddqn_planner.files import as_path
from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.conversions import bytes_message, path_bytes
from ddqn_planner.nodes.declared import Parameters
from ddqn_planner.nodes.diagnostics import Diagnostics
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.nodes.worker import Worker
from ddqn_planner.resources import with_remedy

Float64 = NDArray[np.float64]

NO_MAP = "no map was received yet; start a map server, or set map_file"


class MapInFrame(NamedTuple):
    """A map, and the frame of its origin."""

    grid: GridMap
    frame: str


class Answer(NamedTuple):
    """The answer of a service of ``std_srvs/Trigger``."""

    success: bool
    message: str


class Recording(NamedTuple):
    """Episodes or drives of a file."""

    frame: str  # of the map that they are on
    paths: Iterator[Float64]  # (N, 2) metres each


class Learner(Protocol):
    """What learns for the node: a training in simulation, or the drives of robots."""

    def start(self) -> Answer | Coroutine[None, None, Answer]:
        """Begin to learn, or continue."""

    def stop(self) -> Answer:
        """Save, and stop learning."""

    def save(self) -> Answer:
        """Save what was learned."""

    def recorded(self, file: FilePath, map_in_frame: MapInFrame) -> Recording:
        """Return the paths of a file.

        They are taken to lie on the map given, except where the learner knows the map
        that they were recorded on.
        """

    def describe(self) -> dict[str, str]:
        """Return lines for the diagnostics."""

    def close(self) -> None:
        """Stop, and wait until everything is saved."""


class LearningNode(BaseNode):
    """The node of a learner: its map, its folder, its state, and what it publishes."""

    def __init__(self, name: str, parameters: Parameters) -> None:
        """Make a node without a learner, and the publishers of what is learned."""
        super().__init__(name, parameters)
        self.map: MapInFrame | None = None  # the last one
        self.diagnostics = Diagnostics(self)
        self.worker = Worker(self)
        self.state = "idle"  # what the learner does, for the diagnostics
        self.error = ""  # the last failure of the learner; empty since its next start
        self.save_error = ""  # why the last save failed; empty if it succeeded
        self.is_replaying = False
        # Whether the node learns from drives, and not from a training in simulation.
        self.is_driving: bool = self.value("learn_from") == "driving"
        self._product = "experience" if self.is_driving else "model"
        self._episodes = self.create_publisher(Path, "~/episode", 10)
        self._saved_files = self.create_publisher(
            String, f"~/{self._product}_saved", LATCHED
        )
        self.products = self.create_publisher(
            UInt8MultiArray, f"~/{self._product}", LATCHED
        )

    @property
    def folder(self) -> FilePath:
        """The parameter ``output_folder``."""
        return as_path(self.value("output_folder"), "output_folder").absolute()

    def fail(self, activity: str, error: Exception) -> Answer:
        """Log an error, also for the diagnostics; return a service's failed answer.

        `activity` says in words which activity failed.
        """
        message = f"{activity}: {explained(error)}"
        if message != self.error:  # the learner may try again each second
            self.get_logger().error(message)
        self.error = message
        return Answer(False, explained(error))

    def publish_product(self, data: bytes, kind: str = "") -> None:
        """Publish what was learned: the bytes of the model or the experience.

        `kind` is that of the bytes, see `bytes_message`, if they are something else.
        """
        self.products.publish(bytes_message(kind or self._product, data))

    def tell_saved(self, path: FilePath, error: str) -> None:
        """Publish the path of the file of what was learned, if it was saved.

        Parameters
        ----------
        path
            The path of the file.
        error
            Why it could not be saved; empty if it was saved. An error that lasts is
            logged once.
        """
        last_error = self.save_error
        self.save_error = error
        if error:
            if not last_error:
                self.get_logger().error(error)
            return
        if last_error:
            self.get_logger().info(f"the {self._product} is saved again")
        self._saved_files.publish(String(data=str(path)))

    def draw(self, frame: str, positions: Float64) -> None:
        """Publish an episode or a drive, unless a replay is shown.

        `positions` (N, 2) are x and y in metres, in the frame `frame`.
        """
        if not self.is_replaying:
            self.publish_episode(frame, positions)

    def publish_episode(self, frame: str, positions: Float64) -> None:
        """Publish an episode or a drive as a path.

        `positions` (N, 2) are x and y in metres, in the frame `frame`. Each pose faces
        the next position, and the last pose faces as the pose before it.
        """
        steps = np.diff(positions, axis=0)  # (N - 1, 2)
        yaw = np.arctan2(steps[:, 1], steps[:, 0])
        last_yaw = yaw[-1] if len(yaw) else 0.0
        yaw = np.append(yaw, last_yaw)  # (N,)
        self._episodes.publish(path_bytes(positions, yaw, self.header(frame)))


def explained(error: Exception) -> str:
    """Return an error in words, with a remedy for the disk and for libraries."""
    if isinstance(error, ImportError):
        return f"training needs another library: {with_remedy(error)}"
    if isinstance(error, OSError):
        return f"{error}; set output_folder to a folder that can be written"
    if isinstance(error, (ValueError, MemoryError)) and str(error):
        return str(error)
    return repr(error)
