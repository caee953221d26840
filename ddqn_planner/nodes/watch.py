"""A live picture without RViz: what the nodes publish, in rerun.

Everything is drawn in cells of the map, so that images and lines fit for every resolution and
origin; y points up.
"""

from __future__ import annotations

import os
import socket
import subprocess
from contextlib import suppress
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
from ddqn_planner.pictures.colours import PATH_COLOUR, value_ramp

MAP, VALUE, PLAN, EPISODE, REWARD = "map/map", "map/value", "map/plan", "map/episode", "reward"
LAYERS = (MAP, VALUE, PLAN, EPISODE)
"""From bottom to top."""

COLOURS = {PLAN: ImageColor.getrgb(PATH_COLOUR), EPISODE: ImageColor.getrgb("#edae49")}
RADII = {PLAN: rr.Radius.ui_points(4), EPISODE: rr.Radius.ui_points(2)}
"""In points of the screen, to be seen on any map; the plan is seen below an episode like it."""

UNKNOWN_GREY = 160

PORT = 9876
"""On which rerun's viewer listens."""

LOOK_PERIOD = 1.0
"""Seconds between two looks whether the viewer is there."""


class WatchNode(Node):
    """Draws the last map, value field, plan and episode, and the curve of the average reward.

    Parameters
    ----------
    planner, trainer : str
        Names of the nodes; relative ones are of this node's namespace.
    recording : rerun.RecordingStream
    """

    def __init__(self, planner: str, trainer: str, recording: rr.RecordingStream) -> None:
        super().__init__("watch")
        self._recording = recording
        self._grid: GridMap | None = None
        self._value: NDArray[np.int8] | None = None
        self._paths: dict[str, Path] = {}
        for message_type, topic, callback, quality in (
            (OccupancyGrid, "map", self._on_map, LATCHED),
            (OccupancyGrid, f"{planner}/value", self._on_value, LATCHED),
            (Path, "plan", lambda path: self._on_path(PLAN, path), LATCHED),
            (Path, f"{trainer}/episode", lambda path: self._on_path(EPISODE, path), 10),
            (Float32, f"{trainer}/average_reward", self._on_reward, 100),
        ):
            self.create_subscription(message_type, topic, callback, quality)

    def _on_map(self, message: OccupancyGrid) -> None:
        grid, values = self._read("map", message)
        if grid is None:
            return
        self._grid = grid
        shades = 255 - 2 * values.clip(0, 100).astype(np.int16)
        shades[values < 0] = UNKNOWN_GREY
        self._draw_image(MAP, shades.astype(np.uint8))
        self._draw_value()
        for entity in self._paths:
            self._draw_path(entity)

    def _on_value(self, message: OccupancyGrid) -> None:
        grid, values = self._read("value field", message)
        if grid is not None:
            self._value = values
            self._draw_value()

    def _on_path(self, entity: str, message: Path) -> None:
        self._paths[entity] = message
        self._draw_path(entity)

    def _on_reward(self, message: Float32) -> None:
        self._recording.log(REWARD, rr.Scalars(message.data))

    def _read(self, what: str, message: OccupancyGrid) -> tuple[GridMap | None, NDArray[np.int8]]:
        """Return the map and (H, W) int8 values; or no map, and say why, if it is malformed."""
        try:
            grid = grid_from_message(message)
        except ValueError as error:
            self.get_logger().warning(f"the {what} is not drawn: {error}")
            return None, np.empty((0, 0), np.int8)
        return grid, np.frombuffer(message.data, np.int8).reshape(grid.height, grid.width)

    def _draw_image(self, entity: str, colours: NDArray[np.uint8]) -> None:
        self._recording.log(entity, rr.Image(colours[::-1], draw_order=LAYERS.index(entity)))

    def _draw_value(self) -> None:
        if self._grid is None or self._value is None:
            return
        if self._value.shape != self._grid.occupancy.shape:
            # It is the last map's; the new map's is being computed.
            self._recording.log(VALUE, rr.Clear(recursive=False))
            return
        colours = np.zeros((*self._value.shape, 4), np.uint8)
        known = self._value >= 0
        colours[known, :3] = value_ramp(101)[self._value[known].clip(max=100)]
        colours[known, 3] = 255
        self._draw_image(VALUE, colours)

    def _draw_path(self, entity: str) -> None:
        if self._grid is None:
            return
        positions = [pose.pose.position for pose in self._paths[entity].poses]
        points = cell_coordinates(self._grid, np.array([(p.x, p.y) for p in positions]))
        points[:, 1] = self._grid.height - points[:, 1]
        strips = rr.LineStrips2D(
            [points] if positions else [],
            radii=RADII[entity],
            colors=COLOURS[entity],
            draw_order=LAYERS.index(entity),
        )
        self._recording.log(entity, strips)


def cell_coordinates(grid: GridMap, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 2) places in cells of (N, 2) positions in metres; 0.5 is a cell's centre."""
    x, y, yaw = grid.origin
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    cells: NDArray[np.float64] = (positions.reshape(-1, 2) - (x, y)) @ turn / grid.resolution
    return cells


def open_viewer() -> subprocess.Popen[bytes] | None:
    """Start rerun's viewer, unless one listens already; it stays when this process ends."""
    with socket.socket() as connection:
        if connection.connect_ex(("127.0.0.1", PORT)) == 0:
            return None
    command = [str(FilePath(rerun_cli.__file__).with_name("rerun")), "--port", str(PORT)]
    # As rerun.spawn does it, which does not say whether the viewer lives.
    environment = {**os.environ, "RERUN_APP_ONLY": "true"}
    viewer = subprocess.Popen(command, env=environment, start_new_session=True)
    # Most that fail do so at once; to one that is gone rerun tries to connect for ten seconds.
    with suppress(subprocess.TimeoutExpired):
        viewer.wait(LOOK_PERIOD)
    look_at(viewer)
    return viewer


def look_at(viewer: subprocess.Popen[bytes]) -> None:
    """End the node with its viewer: OSError if that has failed."""
    if viewer.poll():
        raise OSError(
            f"rerun's viewer ended with {viewer.returncode}, see above; it needs a display: start "
            "this on a desktop, or write a recording by --save FILE"
        )
    if viewer.returncode == 0:
        try_shutdown()


def watch(planner: str, trainer: str, file: FilePath | None) -> int:
    """Show what the nodes publish until SIGINT or SIGTERM.

    Parameters
    ----------
    planner, trainer : str
        Names of the nodes.
    file : Path, optional
        Where to write a recording; without one the viewer is opened.

    Returns
    -------
    int
        Exit code, see `spin_until_shutdown`.

    Raises
    ------
    OSError
        If the file cannot be written, or there is no viewer.
    """
    recording = rr.RecordingStream("ddqn_planner")
    blueprint = rrb.Blueprint(
        rrb.Vertical(
            rrb.Spatial2DView(origin="map", name="Map, value field, plan, episode"),
            rrb.TimeSeriesView(origin=REWARD, name="Average reward of a step"),
            row_shares=[3, 1],
        ),
        collapse_panels=True,
    )

    def make_node() -> WatchNode:
        # Only now: a signal that came before rclpy took it would leave half a file.
        try:
            if file is None:
                viewer = open_viewer()
                recording.connect_grpc(default_blueprint=blueprint)
            else:
                viewer = None
                file.parent.mkdir(parents=True, exist_ok=True)
                recording.save(file, default_blueprint=blueprint)
        except RuntimeError as error:
            raise OSError(f"rerun cannot show it: {error}; give another --save FILE") from None
        node = WatchNode(planner, trainer, recording)
        if viewer is not None:
            node.create_timer(LOOK_PERIOD, lambda: look_at(viewer))
        return node

    try:
        return spin_until_shutdown(make_node)
    finally:
        recording.disconnect()
