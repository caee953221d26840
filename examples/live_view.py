"""Shows live in rerun what the nodes publish: map, value field, plan, episode, average reward.

    python examples/live_view.py                                  # opens rerun's viewer
    python examples/live_view.py --save run.rrd --ros-args -r __ns:=/robot

It needs `pip install rerun-sdk matplotlib`; RViz shows the same topics.
"""

import argparse
import sys
from functools import partial
from typing import Any

import numpy as np
import rerun as rr
from matplotlib.colors import LinearSegmentedColormap
from nav_msgs.msg import OccupancyGrid, Path
from PIL import ImageColor
from rclpy.node import Node
from rclpy.utilities import remove_ros_args
from std_msgs.msg import Float32

from ddqn_planner.nodes.runtime import LATCHED, spin_until_shutdown
from ddqn_planner.pictures import PATH_COLOUR, VALUE_COLOURS

COLOURS = LinearSegmentedColormap.from_list("value", VALUE_COLOURS)
# From bottom to top, in cells, y upwards: the type, the topic and its quality.
LAYERS: dict[str, tuple[Any, str, Any]] = {
    "map": (OccupancyGrid, "map", LATCHED),
    "value": (OccupancyGrid, "planner/value", LATCHED),
    "plan": (Path, "plan", LATCHED),
    "episode": (Path, "trainer/episode", 10),
}
ORDER = {name: number for number, name in enumerate(LAYERS)}
LINES = {"plan": (PATH_COLOUR, 4), "episode": ("#edae49", 2)}  # colour and radius


class LiveView(Node):
    """Draws the last map, value field, plan and episode, and the curve of the average reward."""

    def __init__(self) -> None:
        super().__init__("live_view")
        self._last: dict[str, Any] = {"map": OccupancyGrid()}
        for layer, (kind, topic, qos) in LAYERS.items():
            self.create_subscription(kind, topic, partial(self._on_message, layer), qos)
        self.create_subscription(
            Float32, "trainer/average_reward", self._on_reward, 100
        )

    def _on_message(self, layer: str, message: Any) -> None:
        self._last[layer] = message
        # What belongs to a map may come before it.
        for name in self._last if layer == "map" else [layer]:
            draw = self._draw_path if name in LINES else self._draw_image
            draw(name, self._last[name])

    def _on_reward(self, message: Float32) -> None:
        rr.log("reward", rr.Scalars(message.data))

    def _draw_image(self, name: str, message: OccupancyGrid) -> None:
        size, of_map = (
            (m.info.height, m.info.width) for m in (message, self._last["map"])
        )
        if size != of_map or not all(size):
            return
        values = np.array(message.data, dtype=np.int16).reshape(size)[::-1]
        if name == "map":
            shades = np.where(values < 0, 160, 255 - 2 * values.clip(0, 100))
            image = shades[..., None].repeat(3, axis=-1).astype(np.uint8)
        else:  # cells without a value show the map
            image = COLOURS(np.ma.masked_less(values, 0) / 100, bytes=True)
        rr.log(f"map/{name}", rr.Image(image, draw_order=ORDER[name]))

    def _draw_path(self, name: str, message: Path) -> None:
        info, (colour, radius) = self._last["map"].info, LINES[name]
        # Complex numbers as points: to turn is to multiply.
        points = [stamped.pose.position for stamped in message.poses]
        origin, rotation = info.origin.position, info.origin.orientation
        metres = np.array([complex(p.x - origin.x, p.y - origin.y) for p in points])
        turn = complex(rotation.w, -rotation.z) ** 2
        cells = metres * turn / (abs(turn) or 1.0) / (info.resolution or 1.0)
        strip = np.stack([cells.real, info.height - cells.imag], axis=1)
        style: Any = {
            "radii": rr.Radius.ui_points(radius),
            "colors": ImageColor.getrgb(colour),
        }
        lines = rr.LineStrips2D(
            [strip] if points else [], **style, draw_order=ORDER[name]
        )
        rr.log(f"map/{name}", lines)


def main() -> int:
    """Show what comes until a signal."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    rr.script_add_args(parser)
    rr.script_setup(parser.parse_args(remove_ros_args(sys.argv)[1:]), "ddqn_planner")
    try:
        return spin_until_shutdown(LiveView)
    finally:
        rr.disconnect()


if __name__ == "__main__":
    sys.exit(main())
