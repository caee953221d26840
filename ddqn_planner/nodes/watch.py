"""A live picture without RViz: draws in rerun what the nodes publish.

Everything is drawn in cells of the map, with y upwards, so that images and lines fit together for
every resolution and origin.
"""

from __future__ import annotations

import os
import socket
import subprocess
from contextlib import suppress
from functools import partial
from pathlib import Path as FilePath

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import rerun_cli
from nav_msgs.msg import OccupancyGrid, Path
from numpy.typing import NDArray
from PIL import ImageColor
from rclpy.node import Node
from rclpy.utilities import try_shutdown
from std_msgs.msg import Float32

from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.conversions import grid_from_message
from ddqn_planner.nodes.runtime import LATCHED, spin_until_shutdown
from ddqn_planner.pictures.colours import EPISODE_COLOUR, PATH_COLOUR, value_ramp

MAP, VALUE, PLAN, EPISODE, REWARD = "map/map", "map/value", "map/plan", "map/episode", "reward"
LAYERS = (MAP, VALUE, PLAN, EPISODE)
"""From bottom to top."""

LINES = {PLAN: (PATH_COLOUR, 4), EPISODE: (EPISODE_COLOUR, 2)}
"""Colour, and radius in points of the screen: a plan shows on both sides of an equal episode."""

UNKNOWN_GREY = 160

PORT = 9876
"""The viewer of rerun listens here."""

LOOK_PERIOD = 1.0
"""Seconds between two checks that the viewer still runs."""


class WatchNode(Node):
    """Draws the last map, value field, plan and episode, and the curve of the average reward.

    The names of the planner node and the trainer node are relative to this node's namespace.
    """

    def __init__(self, planner: str, trainer: str, recording: rr.RecordingStream) -> None:
        super().__init__("watch")
        self._recording = recording
        self._grid: GridMap | None = None
        self._value: NDArray[np.int8] | None = None
        self._paths: dict[str, Path] = {}
        subscribe = self.create_subscription
        subscribe(OccupancyGrid, "map", self._on_map, LATCHED)
        subscribe(OccupancyGrid, f"{planner}/value", self._on_value, LATCHED)
        subscribe(Path, "plan", partial(self._on_path, PLAN), LATCHED)
        subscribe(Path, f"{trainer}/episode", partial(self._on_path, EPISODE), 10)
        subscribe(Float32, f"{trainer}/average_reward", self._on_reward, 100)

    def _on_map(self, message: OccupancyGrid) -> None:
        if (read := self._read("map", message)) is None:
            return
        self._grid, values = read
        shades = 255 - 2 * values.clip(0, 100).astype(np.int16)
        shades[values < 0] = UNKNOWN_GREY
        self._draw_image(MAP, shades.astype(np.uint8))
        self._draw_value()
        for entity in self._paths:
            self._draw_path(entity)

    def _on_value(self, message: OccupancyGrid) -> None:
        if (read := self._read("value field", message)) is not None:
            self._value = read[1]
            self._draw_value()

    def _on_path(self, entity: str, message: Path) -> None:
        self._paths[entity] = message
        self._draw_path(entity)

    def _on_reward(self, message: Float32) -> None:
        self._recording.log(REWARD, rr.Scalars(message.data))

    def _read(self, what: str, message: OccupancyGrid) -> tuple[GridMap, NDArray[np.int8]] | None:
        """Return the map and its (H, W) values; None if it is malformed, and log why."""
        try:
            grid = grid_from_message(message)
        except ValueError as error:
            self.get_logger().warning(f"the {what} is not drawn: {error}")
            return None
        return grid, np.frombuffer(message.data, np.int8).reshape(grid.occupancy.shape)

    def _draw_image(self, entity: str, colours: NDArray[np.uint8]) -> None:
        self._recording.log(entity, rr.Image(colours[::-1], draw_order=LAYERS.index(entity)))

    def _draw_value(self) -> None:
        if self._grid is None or self._value is None:
            return
        if self._value.shape != self._grid.occupancy.shape:
            # The field belongs to the last map; the new map's field is still being computed.
            self._recording.log(VALUE, rr.Clear(recursive=False))
            return
        # Cells without a value, -1, take the last colour, which is transparent.
        ramp = np.pad(value_ramp(101), ((0, 1), (0, 1)), constant_values=255)
        ramp[-1] = 0
        self._draw_image(VALUE, ramp[self._value.clip(-1, 100)])

    def _draw_path(self, entity: str) -> None:
        if self._grid is None:
            return
        x, y, yaw = self._grid.origin
        points = [pose.pose.position for pose in self._paths[entity].poses]
        # Complex numbers as points: to turn is to multiply.
        metres = np.array([complex(p.x - x, p.y - y) for p in points])
        cells = metres * np.exp(-1j * yaw) / self._grid.resolution
        strip = np.stack([cells.real, self._grid.height - cells.imag], axis=1)
        colour, radius = LINES[entity]
        lines = rr.LineStrips2D(
            [strip] if points else [],
            radii=rr.Radius.ui_points(radius),
            colors=ImageColor.getrgb(colour),
            draw_order=LAYERS.index(entity),
        )
        self._recording.log(entity, lines)


def open_viewer() -> subprocess.Popen[bytes] | None:
    """Start rerun's viewer, unless one listens already; it keeps running after this process."""
    with socket.socket() as connection:
        if connection.connect_ex(("127.0.0.1", PORT)) == 0:
            return None
    command = [str(FilePath(rerun_cli.__file__).with_name("rerun")), "--port", str(PORT)]
    # As rerun.spawn does it, but that does not tell whether the viewer runs.
    environment = {**os.environ, "RERUN_APP_ONLY": "true"}
    viewer = subprocess.Popen(command, env=environment, start_new_session=True)
    # A viewer that fails mostly fails at once, and connecting to none would take ten seconds.
    with suppress(subprocess.TimeoutExpired):
        viewer.wait(LOOK_PERIOD)
    check_viewer(viewer)
    return viewer


def check_viewer(viewer: subprocess.Popen[bytes]) -> None:
    """Stop the node if the viewer was closed; raise OSError if it has failed."""
    if viewer.poll():
        raise OSError(
            f"rerun's viewer ended with {viewer.returncode}, see above; it needs a display: start "
            "this on a desktop, or write a recording by --save FILE"
        )
    if viewer.returncode == 0:
        try_shutdown()


def watch(planner: str, trainer: str, file: FilePath | None) -> int:
    """Show what the nodes publish until SIGINT or SIGTERM; return the exit code.

    Without a file for a recording, a viewer is opened. See `WatchNode` for the names.

    Raises
    ------
    OSError
        If the file cannot be written, or there is no viewer.
    """
    recording = rr.RecordingStream("ddqn_planner")
    blueprint = rrb.Blueprint(
        rrb.Vertical(
            rrb.Spatial2DView(origin="map", name="Map, value field, plan, episode"),
            rrb.TimeSeriesView(origin=REWARD, name="Average reward per step"),
            row_shares=[3, 1],
        ),
        collapse_panels=True,
    )

    def make_node() -> WatchNode:
        # Opened here: a signal before rclpy handles signals would leave half a file.
        viewer = None
        try:
            if file is None:
                viewer = open_viewer()
                recording.connect_grpc(default_blueprint=blueprint)
            else:
                file.parent.mkdir(parents=True, exist_ok=True)
                recording.save(file, default_blueprint=blueprint)
        except RuntimeError as error:
            raise OSError(f"rerun cannot show it: {error}; give another --save FILE") from None
        node = WatchNode(planner, trainer, recording)
        if viewer is not None:
            node.create_timer(LOOK_PERIOD, lambda: check_viewer(viewer))
        return node

    try:
        return spin_until_shutdown(make_node)
    finally:
        recording.disconnect()
