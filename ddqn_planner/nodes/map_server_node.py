"""The map server node: serves a map file, and adds the paper's static noise to it."""

from contextlib import suppress
from functools import partial
from typing import Any, Final

import numpy as np
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetMap, LoadMap
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.exceptions import NameValidationException

from ddqn_planner.grid import OCCUPIED, Cell, GridMap, MapFile, MoveRule, read_map_file
from ddqn_planner.grid.map_file import MapDataError, MapMetadataError, MapNotFoundError
from ddqn_planner.grid.noise import scatter_obstacles
from ddqn_planner.grid.oracle import shortest_path
from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.conversions import occupancy_message
from ddqn_planner.nodes.declared import Declared
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.nodes.spinning import spin_until_shutdown
from ddqn_planner.resources import PACKAGE, find_map

RESULTS: dict[type[Exception], int] = {
    FileNotFoundError: LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST,
    MapNotFoundError: LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST,
    MapDataError: LoadMap.Response.RESULT_INVALID_MAP_DATA,
    MapMetadataError: LoadMap.Response.RESULT_INVALID_MAP_METADATA,
}

# How long to wait for subscribers that do not answer, as a planner in a debugger.
DIRECTIONS_TIMEOUT = Duration(seconds=1)
NO_MAP = "no map is loaded; call load_map first"
PARAMETERS: Final = {
    "yaml_filename": Declared(
        "dilemma.yaml",
        "Path or URL of a map file, or a shipped map's name; '': none",
        read_only=True,
    ),
    "topic_name": Declared("map", "Topic of the map", read_only=True),
    "frame_id": Declared("map", "The map's frame", "not empty", read_only=True),
    "seed": Declared(0, "Seed of the new obstacles", (0, 2**63 - 1), read_only=True),
}


class MapServerNode(BaseNode):
    """Serves one map, on a latched topic and as a service, and its directions."""

    def __init__(self) -> None:
        """Make the node, load the map of the parameters, and create services."""
        super().__init__("map_server", PARAMETERS)
        self._loaded: MapFile | None = None
        self._served = OccupancyGrid()
        self._random = np.random.default_rng(self.value("seed"))
        topic = self.value("topic_name")
        # First, so that whoever receives a map knows that its directions come too.
        self._directions = self.create_publisher(
            OccupancyGrid, f"{topic}_directions", LATCHED
        )
        self._publisher = self.create_publisher(OccupancyGrid, topic, LATCHED)
        name = self.value("yaml_filename")
        if name.strip():
            self._load(name)
        else:
            self.get_logger().info(f"yaml_filename is {name!r}: {NO_MAP}")
        self.create_service(GetMap, "~/map", self._on_get_map)
        self.create_service(LoadMap, "~/load_map", self._on_load_map)
        with suppress(ImportError):
            from nav2_msgs.srv import LoadMap as Nav2LoadMap

            # The codes are the same; a name can have but one type.
            self.create_service(Nav2LoadMap, "~/load_map_nav2", self._on_load_map)
        self.create_trigger("~/scatter_obstacles", self._on_scatter_obstacles)
        self.create_trigger("~/restore_map", self._on_restore_map)

    def check_parameters(self, new: dict[str, Any]) -> None:
        """Check new values as `BaseNode` does, and whether the topic can be one."""
        super().check_parameters(new)
        topic: str = new.get("topic_name", "map")
        try:
            self.resolve_topic_name(topic)
        except (NameValidationException, RuntimeError, ValueError) as error:
            reason = str(error).splitlines()[0].rstrip(":")
            remedy = "give letters, digits, _ and /, such as map"
            raise ValueError(f"topic_name is {topic!r} ({reason}); {remedy}") from None

    def _load(self, url: str, only_below: bool = False) -> int:
        """Load a map and serve it, or log why not; return LoadMap's result code.

        Parameters
        ----------
        url
            A path or URL of a map file, or a shipped map's name.
        only_below
            Whether the map's image must lie in the folder of the map file, or below.
        """
        try:
            path = find_map(url)
            loaded = read_map_file(path, only_below)
        except Exception as error:  # anything, of a library that reads a broken file
            consequence = "no map is served"
            if self._loaded is not None:
                consequence = "the map before it stays"
            self.get_logger().error(f"cannot load {url!r}, {consequence}: {error}")
            undefined: int = LoadMap.Response.RESULT_UNDEFINED_FAILURE
            return RESULTS.get(type(error), undefined)
        self._loaded = loaded
        self._serve(loaded.values)
        height, width = loaded.values.shape
        self.get_logger().info(f"serving {path}, {width} x {height} cells")
        success: int = LoadMap.Response.RESULT_SUCCESS
        return success

    def _serve(self, values: NDArray[np.int8]) -> None:
        """Publish values as the map, after the directions of the loaded map.

        `values` is (H, W) int8, as in a map message; the map has the place of the
        loaded map.
        """
        loaded = self._loaded
        assert loaded is not None
        header = self.header(self.value("frame_id"))
        self._served = occupancy_message(
            values, loaded.resolution, loaded.origin, header
        )
        self._directions.publish(
            occupancy_message(
                loaded.forbidden, loaded.resolution, loaded.origin, header
            )
        )
        # No planner has the new map while it has the directions of the map before.
        with suppress(RuntimeError):  # a middleware that cannot tell
            self._directions.wait_for_all_acked(DIRECTIONS_TIMEOUT)
        self._publisher.publish(self._served)

    def _on_get_map(
        self, request: GetMap.Request, response: GetMap.Response
    ) -> GetMap.Response:
        """Answer with the map that is served, without cells if none is loaded."""
        if self._loaded is None:
            self.get_logger().warning(
                "asked for a map, but none is loaded: the answer is empty"
            )
        response.map = self._served
        return response

    def _on_load_map(
        self, request: LoadMap.Request, response: LoadMap.Response
    ) -> LoadMap.Response:
        """Load a map; the answer has the map, or the code of the failure."""
        response.result = self._load(request.map_url, only_below=True)
        if response.result == LoadMap.Response.RESULT_SUCCESS:
            response.map = self._served
        return response

    def _on_scatter_obstacles(self) -> tuple[bool, str]:
        """Serve the loaded map with new obstacles, without those of earlier calls.

        Obstacles fall on or beside the path of `known_path`, but not on its ends.
        Return success and a message.
        """
        loaded = self._loaded
        try:
            if loaded is None:
                raise ValueError(NO_MAP)
            grid = loaded.grid()
            move_rule, path = known_path(grid, loaded)
            noisy_grid, rejected = scatter_obstacles(
                grid, path, move_rule, self._random
            )
        except ValueError as error:
            self.get_logger().error(f"no obstacles were scattered: {error}")
            return False, str(error)
        is_new = noisy_grid.occupancy & ~grid.occupancy  # (H, W)
        self._serve(np.where(is_new, np.int8(OCCUPIED), loaded.values))
        cells = np.argwhere(is_new)[:, ::-1]  # (N, 2), x and y
        centres: list[list[float]] = grid.centres(cells).tolist()  # metres
        places = ", ".join(f"({x:.3f}, {y:.3f})" for x, y in centres)
        obstacles = f"{len(centres)} new obstacles at {places} m"
        message = f"{obstacles}; {rejected} draws thrown away"
        self.get_logger().info(message)
        return True, message

    def _on_restore_map(self) -> tuple[bool, str]:
        """Serve the loaded map without new obstacles; return success and a message."""
        if self._loaded is None:
            return False, NO_MAP
        self._serve(self._loaded.values)
        return True, "the map is as it was loaded"


def known_path(grid: GridMap, map_file: MapFile) -> tuple[MoveRule, list[Cell]]:
    """Return the safest move rule by which a path leads, and the shortest such path.

    The path leads over a grid from the start to the goal that the grid's map file
    names. A ValueError says why there is none.
    """
    start = map_file.start
    goal = map_file.goal
    if start is None or goal is None:
        remedy = (
            f"add '{PACKAGE}: {{start: [x, y], goal: [x, y]}}' in cells to its YAML"
        )
        raise ValueError(f"the map file names no start and goal; {remedy}")
    for move_rule in (MoveRule.ROBOT_SAFE, MoveRule.CORNER_CUTTING):
        path = shortest_path(grid, start, goal, move_rule)
        if path:
            return move_rule, path
    raise ValueError(
        f"no path leads from the start {start} to the goal {goal} of the map file"
    )


main = partial(spin_until_shutdown, MapServerNode, PARAMETERS)
