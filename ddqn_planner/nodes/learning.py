"""What both ways to learn share: the map, the folder, episodes and their replay, diagnostics."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path as FilePath
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import OccupancyGrid, Path
from rclpy.timer import Timer

from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.conversions import grid_from_message
from ddqn_planner.nodes.parameters import OF_MAPS
from ddqn_planner.nodes.report import Refusals
from ddqn_planner.nodes.runtime import LATCHED, STEADY, BaseNode, Parameters

NO_MAP = "no map was received yet; start a map server"


class MapInFrame(NamedTuple):
    """A map, and the frame of its origin."""

    grid: GridMap
    frame: str


class LearningNode(BaseNode):
    """Node that learns on the last map, keeps what it learns in a folder, and replays episodes."""

    def __init__(self, name: str, parameters: Parameters) -> None:
        super().__init__(name, parameters)
        self.map: MapInFrame | None = None
        self.refusals = Refusals(self)
        self.state = self.error = self.save_error = ""
        self.replaying: Timer | None = None
        self.episodes = self.create_publisher(Path, "~/episode", 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_subscription(OccupancyGrid, "map", self._on_map, LATCHED)

    @property
    def folder(self) -> FilePath:
        """The parameter ``output_folder``."""
        return FilePath(self.value("output_folder")).absolute()

    def _on_map(self, message: OccupancyGrid) -> None:
        with self.refusals.taking("map"):
            grid = grid_from_message(message, *map(self.value, OF_MAPS))
            self.map = MapInFrame(grid, message.header.frame_id)
            self.get_logger().info(f"map of {grid.width} x {grid.height} cells")

    def fail(self, reason: str) -> None:
        """Log an error, and keep it for the diagnostics."""
        self.error = reason
        self.get_logger().error(reason)

    def note_saving(self, what: str, error: str) -> None:
        """Log when saving begins to fail, and when it works again (no error), not at each try."""
        before, self.save_error = self.save_error, error
        if error and not before:
            self.get_logger().error(error)
        if before and not error:
            self.get_logger().info(f"{what} saved again")

    def publish_diagnostics(
        self, what: str, values: Mapping[str, str], error: str = "", missing: str = ""
    ) -> None:
        """Publish the state, what was refused and failed, and what is still missing."""
        problems = [*self.refusals.problems(), *filter(None, [self.save_error, error])]
        level = DiagnosticStatus.WARN if missing else DiagnosticStatus.OK
        if problems:
            level = DiagnosticStatus.ERROR
        message = "; ".join(filter(None, [*problems, missing])) or self.state
        values = {"state": self.state, **values}
        self._diagnostics.publish(self.diagnostics(what, level, message, values))

    def replay(
        self, file: FilePath, episodes: Iterator[Any], draw: Callable[[Any], None], remedy: str
    ) -> tuple[bool, str]:
        """Draw the first place of each episode, its first two, and so on; see `create_trigger`."""
        frames = (places[: n + 1] for places in episodes for n in range(len(places)))
        try:
            first = next(frames, None)
        except OSError as error:
            return False, f"no recorded episodes ({error}); call ~/start first"
        if first is None:
            return False, f"{file} holds no episode to replay yet; {remedy}"
        self.stop_replay()
        draw(first)

        def step() -> None:
            try:
                draw(next(frames))
            except StopIteration:
                self.stop_replay()
            except OSError as error:
                self.stop_replay()
                self.fail(f"the replay ends: {file.name} can no longer be read ({error})")

        self.replaying = self.create_timer(self.value("replay_period"), step, clock=STEADY)
        return True, "replaying the recorded episodes on ~/episode"

    def stop_replay(self) -> str:
        """Stop a replay, and say so; return nothing if there was none."""
        timer, self.replaying = self.replaying, None
        if timer is None:
            return ""
        self.destroy_timer(timer)
        return "; the replay was stopped"


def explained(error: Exception) -> str:
    """Return what an error says; for one of the disk, also what to do."""
    if isinstance(error, OSError):
        return f"{error}; set output_folder to a folder that can be written"
    is_clear = isinstance(error, (ValueError, MemoryError)) and str(error)
    return str(error) if is_clear else repr(error)
