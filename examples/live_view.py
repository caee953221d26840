"""Shows live in rerun what the nodes publish: map, value field, plan, episode, average reward.

    python examples/live_view.py                                  # opens rerun's viewer
    python examples/live_view.py --save run.rrd --ros-args -r __ns:=/robot

All is drawn in cells of the map, with y upwards. It needs `pip install rerun-sdk matplotlib`; RViz
shows the same topics.
"""

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import rclpy
import rerun as rr
from matplotlib.colors import LinearSegmentedColormap
from nav_msgs.msg import OccupancyGrid, Path
from numpy.typing import NDArray
from PIL import ImageColor
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.utilities import remove_ros_args
from std_msgs.msg import Float32

from ddqn_planner.pictures import PATH_COLOUR, VALUE_COLOURS

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
EPISODE_COLOUR = "#edae49"
COLOURS = LinearSegmentedColormap.from_list("value", VALUE_COLOURS)
LAYERS = ("map", "value", "plan", "episode")
"""From bottom to top."""


class LiveView(Node):
    """Draws the last map, value field, plan and episode, and the curve of the average reward."""

    def __init__(self) -> None:
        super().__init__("live_view")
        self._info = OccupancyGrid().info
        self._value = OccupancyGrid()
        self._paths: dict[str, Path] = {}
        subscribe = self.create_subscription
        subscribe(OccupancyGrid, "map", self._on_map, LATCHED)
        subscribe(OccupancyGrid, "planner/value", self._on_value, LATCHED)
        subscribe(Path, "plan", partial(self._on_path, "plan"), LATCHED)
        subscribe(Path, "trainer/episode", partial(self._on_path, "episode"), 10)
        subscribe(Float32, "trainer/average_reward", self._on_reward, 100)

    def _on_map(self, message: OccupancyGrid) -> None:
        self._info = message.info
        values = np.array(message.data, dtype=np.int16)
        shades = np.where(values < 0, 160, 255 - 2 * values.clip(0, 100))
        self._draw_image("map", shades[:, None].repeat(3, axis=1))
        self._draw_value()
        for name in self._paths:
            self._draw_path(name)

    def _on_value(self, message: OccupancyGrid) -> None:
        self._value = message  # it may come before its map
        self._draw_value()

    def _draw_value(self) -> None:
        info, of_map = self._value.info, self._info
        if info.width and (info.width, info.height) == (of_map.width, of_map.height):
            # Cells without a value show the map.
            shown = np.ma.masked_less(np.array(self._value.data, dtype=np.int16), 0)
            self._draw_image("value", COLOURS(shown / 100, bytes=True))

    def _on_path(self, name: str, message: Path) -> None:
        self._paths[name] = message
        self._draw_path(name)

    def _on_reward(self, message: Float32) -> None:
        rr.log("reward", rr.Scalars(message.data))

    def _draw_image(self, name: str, colours: NDArray[Any]) -> None:
        image = colours.astype(np.uint8).reshape(self._info.height, self._info.width, -1)
        rr.log(f"map/{name}", rr.Image(image[::-1], draw_order=LAYERS.index(name)))

    def _draw_path(self, name: str) -> None:
        origin, info = self._info.origin, self._info
        # Complex numbers as points: to turn is to multiply.
        points = [stamped.pose.position for stamped in self._paths[name].poses]
        metres = np.array(
            [complex(p.x - origin.position.x, p.y - origin.position.y) for p in points]
        )
        turn = complex(origin.orientation.w, -origin.orientation.z) ** 2
        cells = metres * turn / (info.resolution or 1.0)
        strip = np.stack([cells.real, info.height - cells.imag], axis=1)
        colour, radius = (PATH_COLOUR, 4) if name == "plan" else (EPISODE_COLOUR, 2)
        lines = rr.LineStrips2D(
            [strip] if points else [],
            radii=rr.Radius.ui_points(radius),
            colors=ImageColor.getrgb(colour),
            draw_order=LAYERS.index(name),
        )
        rr.log(f"map/{name}", lines)


def main(arguments: Sequence[str]) -> None:
    """Show what comes until a signal."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    rr.script_add_args(parser)
    options = parser.parse_args(remove_ros_args(arguments)[1:])
    rclpy.init(args=[*arguments])
    rr.script_setup(options, "ddqn_planner")
    try:
        rclpy.spin(LiveView())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rr.disconnect()


if __name__ == "__main__":
    main(sys.argv)
