"""Which map is planned on, whatever of maps, updates, directions and experience comes
when.

Here a message of map_msgs is a stand-in with the same fields; PyPI does not have
map_msgs.
"""

import array
import re
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from client import wait_for
from hypothesis import given
from hypothesis import strategies as st
from nav_msgs.msg import OccupancyGrid
from rclpy.parameter import Parameter
from rclpy.utilities import try_shutdown
from std_msgs.msg import Header, UInt8MultiArray

from ddqn_planner import Experience, GridMap, MoveRule, Planner
from ddqn_planner.experience import experience_file
from ddqn_planner.grid import inflate
from ddqn_planner.grid.inflation import Inflation
from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.conversions import (
    CHANGES,
    MapRules,
    bytes_message,
    grid_from_message,
    occupancy_message,
)
from ddqn_planner.nodes.diagnostics import PlannerDiagnostics
from ddqn_planner.nodes.expected_times import ExpectedTimes
from ddqn_planner.nodes.map_source import (
    BODY_PARAMETERS,
    MapSource,
)
from ddqn_planner.nodes.map_updates import values_of_update
from ddqn_planner.nodes.outcome import Outcome, RequestError
from ddqn_planner.nodes.parameters import PLANNER_PARAMETERS
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.nodes.worker import Worker
from ddqn_planner.planning import PlanRequest

EAST, WEST = 0b00111000, 0b10000011  # what lanes to the east and to the west forbid

NOTHING = 0, None  # what is used without a map to plan on

SetParameters = Callable[..., None]


@pytest.fixture(scope="module")
def node() -> Iterator[BaseNode]:
    rclpy.init(args=[])
    node = BaseNode("map_source", PLANNER_PARAMETERS)
    yield node
    node.destroy_node()
    try_shutdown()


class Source(MapSource):
    """A source of maps which has what the test gives it, and says what the planner
    would know.
    """

    def __init__(self, node: BaseNode) -> None:
        self.heard, self.worker = 0, Worker(node)
        self.changing_threads = set[int]()  # in which the diagnostics changed
        self.diagnostics = PlannerDiagnostics(node, self._change_diagnostics)
        self.now = 100.0  # seconds of its clock
        super().__init__(
            node, self.diagnostics, self.worker, self._hear, lambda: self.now
        )

    def _hear(self) -> None:
        self.heard += 1

    def _change_diagnostics(self) -> None:
        self.changing_threads.add(threading.get_ident())

    def grid(self) -> GridMap:
        future = self.ready()
        wait_for("map", future.done)
        return future.result()

    def slowness(self) -> Any:
        return self.grid().slowness

    def used(self) -> tuple[int, Any]:
        """The stamp of the map to plan on, and what it forbids: everywhere, or in each
        column.
        """
        if self.missing:
            return NOTHING
        rows = self.grid().forbidden
        assert rows is None or (rows == rows[0]).all()
        columns = [None] if rows is None else rows[0].tolist()
        return self.check().stamp.sec, columns[0] if len({*columns}) == 1 else columns

    def on_map(self, stamp: int, **changes: Any) -> tuple[int, Any]:
        self.take(map_of(stamp, **changes))
        return self.used()

    def on_directions(self, stamp: int, value: int | None = EAST) -> tuple[int, Any]:
        self.directions.take(directions_of(stamp, value))
        return self.used()


@pytest.fixture
def source(node: BaseNode) -> Source:
    return Source(node)


@pytest.fixture
def set_parameters(node: BaseNode, source: Source) -> Iterator[SetParameters]:
    changed: set[str] = set()

    def set_parameters(**values: Any) -> None:
        changed.update(values)
        for name, value in values.items():
            assert node.set_parameters([Parameter(name, value=value)])[0].successful
        source.apply_parameters({*values})

    yield set_parameters
    set_parameters(**{name: PLANNER_PARAMETERS[name].default for name in changed})


@pytest.fixture
def published(node: BaseNode) -> Iterator[None]:
    """A publisher of directions, which the node has discovered."""
    publisher = node.create_publisher(OccupancyGrid, "map_directions", LATCHED)
    wait_for("publisher", lambda: node.count_publishers("map_directions") > 0)
    yield
    node.destroy_publisher(publisher)
    wait_for(
        "end of the publisher", lambda: node.count_publishers("map_directions") == 0
    )


def map_of(
    stamp: int,
    frame: str = "map",
    x: float = 0.0,
    resolution: float = 0.5,
    yaw: float = 0.0,
) -> Any:
    header = Header(frame_id=frame, stamp=Time(sec=stamp))
    return occupancy_message(
        np.zeros((4, 5), np.int8), resolution, (x, 0.0, yaw), header
    )


def directions_of(stamp: int, value: int | None = EAST) -> Any:
    forbidden = None if value is None else np.full((4, 5), value, dtype=np.uint8)
    return occupancy_message(forbidden, 0.5, (0.0, 0.0, 0.0), map_of(stamp).header)


def update(**fields: Any) -> Any:
    """Return an update of 2 x 3 cells from (1, 0), or with other fields."""
    usual = {
        "header": Header(frame_id="map", stamp=Time(sec=6)),
        **{
            "x": 1,
            "y": 0,
            "width": 2,
            "height": 3,
            "data": array.array("b", range(40, 46)),
        },
    }
    return SimpleNamespace(**{**usual, **fields})


def unknown_of(grid: GridMap) -> Any:
    """Return which cells are unknown, (H, W) bool."""
    return (
        np.zeros(grid.occupancy.shape, np.bool_)
        if grid.unknown is None
        else grid.unknown
    )


PLACES, SIZES = st.integers(-8, 8), st.integers(0, 7) | st.just(2**32 - 1)


@given(PLACES, PLACES, SIZES, SIZES, st.integers(-1, 1))
def test_an_update_is_taken_if_fit(
    x: int, y: int, width: int, height: int, surplus: int
) -> None:
    data = array.array("b", range(max(min(width * height, 20) + surplus, 0)))
    fits = width * height > 0 and 0 <= x <= 5 - width and 0 <= y <= 4 - height
    sent = update(x=x, y=y, width=width, height=height, data=data)
    if fits and surplus == 0:
        expected = np.reshape(data, (height, width))
        np.testing.assert_array_equal(values_of_update(map_of(5), sent), expected)
    else:
        reason = (
            "is not inside the map of 5 x 4" if not fits else f"need {width * height}"
        )
        with pytest.raises(ValueError, match=reason):
            values_of_update(map_of(5), sent)


def test_an_update_has_the_maps_frame_and_its_stamp_or_a_later_one_or_none() -> None:
    for stamp in (Time(), Time(sec=5), Time(sec=9)):
        sent = update(header=Header(frame_id="map", stamp=stamp))
        assert values_of_update(map_of(5), sent).shape == (3, 2)
    for frame, stamp, reason in (
        *(
            ("odom", Time(sec=6), "'odom', the map's is 'map'"),
            ("", Time(sec=6), "frame is ''"),
        ),
        ("map", Time(sec=4, nanosec=999), "later than the update"),
    ):
        with pytest.raises(ValueError, match=reason):
            values_of_update(
                map_of(5), update(header=Header(frame_id=frame, stamp=stamp))
            )


def test_an_update_of_the_same_second_may_be_no_earlier_than_the_map() -> None:
    message = map_of(5)
    message.header.stamp.nanosec = 500
    for nanoseconds, is_earlier in ((499, True), (500, False), (501, False)):
        stamp = Time(sec=5, nanosec=nanoseconds)
        sent = update(header=Header(frame_id="map", stamp=stamp))
        if is_earlier:
            with pytest.raises(ValueError, match=r"5\.000000500, is later than"):
                values_of_update(message, sent)
        else:
            assert values_of_update(message, sent).shape == (3, 2)


RULES: list[dict[str, Any]] = [
    *({}, {"use_map_costs": True, "allow_unknown": True}, {"map_type": "costmap"}),
    {"map_type": "costmap", "allow_unknown": True},
    {"robot_radius": 0.8, "clearance_weight": 0.3},
]


@pytest.mark.parametrize("parameters", RULES)
def test_after_updates_the_map_is_as_if_it_came_whole(
    node: BaseNode,
    source: Source,
    set_parameters: SetParameters,
    parameters: dict[str, Any],
) -> None:
    set_parameters(**parameters)
    random, whole = np.random.default_rng(0), Source(node)
    values = random.choice([0, 0, 0, 0, 20, 98, 99, 100, -1], (30, 40)).astype(np.int8)
    place = 0.5, (-1.0, 2.0, 0.3)
    source.take(occupancy_message(values, *place, map_of(1).header))
    for stamp in range(2, 12):
        height, width = random.integers(1, 12, 2).tolist()
        y, x = random.integers(30 - height), random.integers(40 - width)
        patch = random.choice([0, 0, 50, 99, 100, -1], (height, width)).astype(np.int8)
        values[y : y + height, x : x + width] = patch
        header, data = map_of(stamp).header, array.array("b", patch.tobytes())
        box = {"x": int(x), "y": int(y), "width": width, "height": height}
        source.take_update(update(header=header, data=data, **box))
        message = occupancy_message(values, *place, header)
        before = whole.grid() if stamp > 2 else None
        whole.take(message)
        rules = MapRules(**{name: node.value(name) for name in MapRules._fields})
        new = grid_from_message(message, rules)
        expected = inflate(new, *map(node.value, BODY_PARAMETERS))
        for found in (source.grid(), whole.grid()):
            assert found.fingerprint == expected.fingerprint
            assert found.origin == expected.origin
            np.testing.assert_array_equal(found.obstacles, expected.obstacles)
            np.testing.assert_array_equal(unknown_of(found), unknown_of(expected))
        assert before is None or found.patches_since(before)  # only where cells changed
        assert source.check() == header
        set_parameters(
            allow_unknown=parameters.get("allow_unknown", False)
        )  # it reads anew
        assert source.grid().same_cells(expected)
    others = ("map", (0.5, (1.0, 2.0, 0.3))), ("map", (1.0, place[1])), ("odom", place)
    for frame, moved in others:
        whole.take(occupancy_message(values, *moved, Header(frame_id=frame)))
        assert (whole.frame, whole.grid().resolution) == (frame, moved[0])
        assert whole.grid().origin == pytest.approx(moved[1])
    whole.take(occupancy_message(values, *place, Header()))
    assert "frame is ''" in whole.diagnostics.refused["map"]
    said = {"map stamp (s)": "11.000000000", "map updates applied": "10"}
    assert said.items() <= source.describe().items()


def test_refused_updates_are_counted_and_change_nothing(source: Source) -> None:
    refused = source.diagnostics.refused
    source.take_update(update())
    assert refused["map_updates"].startswith("an update came before a map")
    assert source.missing
    source.take(map_of(1))
    assert "map_updates" not in refused
    before = source.grid()
    source.take_update(update(x=40))
    assert "not inside" in refused["map_updates"]
    assert source.describe()["map updates refused"] == "2"
    assert source.grid() is before
    assert source.check() == map_of(1).header
    assert source.heard == 1
    source.take_update(update())
    assert "map_updates" not in refused
    assert source.heard == 2


@pytest.mark.usefixtures("published")
def test_an_update_of_a_map_that_waits_changes_that_map(source: Source) -> None:
    source.take(map_of(5))
    source.take_update(update(data=array.array("b", [100] * 6)))
    assert source.used() == NOTHING
    source.directions.take(directions_of(1, None))
    assert source.grid().occupancy.tolist() == 3 * [[0, 1, 1, 0, 0]] + [[0] * 5]
    assert source.check() == update().header


def test_a_costmap_is_planned_on_for_map_timeout_after_its_last_message(
    source: Source, set_parameters: SetParameters
) -> None:
    def after(seconds: float) -> str:
        source.now += seconds
        try:
            source.check()
        except RequestError as error:
            return error.status if source.missing == str(error) else "another reason"
        return source.missing

    source.take(map_of(5))
    assert after(1e6) == ""  # a map
    set_parameters(map_type="costmap")
    assert after(0) == "MAP_TIMEOUT"
    assert (
        "nothing came on /map for longer than map_timeout, 5 s; start" in source.missing
    )
    for take, message in ((source.take, map_of(5)), (source.take_update, update())):
        take(message)
        assert [after(0), after(4.9), after(0.2)] == ["", "", "MAP_TIMEOUT"]
    source.take_update(update(x=40))  # what is refused is no news
    set_parameters(robot_radius=0.4)  # nor is a parameter
    assert after(0) == "MAP_TIMEOUT"
    set_parameters(map_timeout=20.0)
    assert [after(0), after(15.0)] == ["", "MAP_TIMEOUT"]
    set_parameters(map_timeout=0.0)
    assert after(1e6) == ""


# Directions: no path may go the wrong way, whatever is late


@pytest.mark.usefixtures("published")
def test_the_first_map_waits_for_directions_that_are_published(source: Source) -> None:
    assert source.on_map(1) == NOTHING
    assert "directions were not received on /map_directions yet" in source.missing
    assert not source.heard
    assert source.on_directions(1) == (1, EAST)
    assert source.heard == 1
    assert not source.diagnostics.refused


@pytest.mark.usefixtures("published")
def test_a_map_waits_a_second_for_a_publisher_that_sends_nothing(
    source: Source,
) -> None:
    for stamp, age in ((1, 0.0), (2, 0.5), (3, 0.49)):  # a live map
        source.now += age
        assert source.on_map(stamp) == NOTHING
        assert source.is_settling
    source.now += 0.02
    source.use_waiting_map()
    assert source.used() == (3, None)
    assert not source.is_settling
    assert source.on_map(4) == (4, None)  # it does not wait again


def test_each_new_publisher_is_awaited_for_a_second_whoever_was_awaited_before(
    node: BaseNode, source: Source
) -> None:
    for stamp in (1, 2):
        publisher = node.create_publisher(OccupancyGrid, "map_directions", LATCHED)
        wait_for("publisher", lambda: node.count_publishers("map_directions") > 0)
        before = source.used()
        assert source.on_map(stamp) == before
        assert source.is_settling
        node.destroy_publisher(publisher)  # it has sent nothing
        wait_for(
            "end of the publisher", lambda: node.count_publishers("map_directions") == 0
        )
        assert source.used() == (stamp, None)
        assert not source.is_settling
        source.now += 10.0


@pytest.mark.usefixtures("published")
def test_a_map_that_waits_is_read_by_the_parameters_of_now(
    source: Source, set_parameters: SetParameters
) -> None:
    message = map_of(1)
    message.data[0] = 50
    source.take(message)
    set_parameters(occupied_threshold=40)
    assert source.used() == NOTHING
    source.directions.take(directions_of(1, None))
    assert source.grid().occupancy.sum() == 1


def test_a_value_that_ros_accepts_above_a_range_is_the_greatest_of_the_range(
    source: Source, set_parameters: SetParameters
) -> None:
    source.take(map_of(1))
    set_parameters(robot_radius=0.8, clearance_weight=1.0)
    expected = source.grid()
    set_parameters(clearance_weight=1.0 + 1e-7)
    assert source.grid().fingerprint == expected.fingerprint


def test_the_map_of_another_map_server_waits_for_its_directions(
    node: BaseNode, source: Source
) -> None:
    source.on_directions(1)
    assert source.on_map(1) == (1, EAST)
    publisher = node.create_publisher(OccupancyGrid, "map_directions", LATCHED)
    try:
        wait_for("publisher", lambda: node.count_publishers("map_directions") > 0)
        assert source.on_map(2) == (1, EAST)
        assert source.diagnostics.refused["map"]
        set_before = source.heard
        source.apply_parameters({"robot_radius"})  # the map in use stays
        assert source.used() == (1, EAST)
        assert source.heard > set_before
        assert source.on_directions(2, WEST) == (2, WEST)
        assert not source.diagnostics.refused
    finally:
        node.destroy_publisher(publisher)
        wait_for(
            "end of the publisher", lambda: node.count_publishers("map_directions") == 0
        )
    assert source.on_map(3) == (3, WEST)  # those of a map server that ended stay


@pytest.mark.parametrize("map_type", ["map", "costmap"])
def test_directions_hold_where_they_overlap_a_map_whatever_the_stamps(
    source: Source, set_parameters: SetParameters, map_type: str
) -> None:
    set_parameters(map_type=map_type)
    source.on_directions(1)
    assert source.on_map(7, x=1.0) == (7, [EAST] * 3 + [0] * 2)
    assert source.on_map(8, x=-1.5) == (8, [0] * 3 + [EAST] * 2)
    assert source.on_map(8, x=-1.3) == (
        8,
        [0] * 3 + [EAST] * 2,
    )  # by the cells' centres
    assert source.on_map(9, resolution=0.25) == (9, EAST)
    source.take(map_of(9, resolution=1.0))
    forbidden: Any = source.grid().forbidden
    assert forbidden.tolist() == 2 * [[EAST] * 3 + [0] * 2] + 2 * [[0] * 5]
    for x in (50.0, 1e30, -1e30, 1e308, -1e308):
        assert source.on_map(9, x=x) == (9, None)
    source.on_map(10)
    source.heard = 0
    for stamp, value in (
        (3, WEST),
        (20, None),
        (4, WEST),
        (21, 0),
    ):  # also older than the map
        assert source.on_directions(stamp, value) == (10, value or None)
    assert source.heard == 4
    assert not source.diagnostics.refused


def test_directions_are_required_once(
    source: Source, set_parameters: SetParameters
) -> None:
    set_parameters(require_directions=True)
    assert source.on_map(1) == NOTHING
    assert "or set require_directions to false" in source.missing
    for required, used in ((False, (1, None)), (True, NOTHING)):
        set_parameters(require_directions=required)
        assert source.used() == used
    assert source.on_map(2) == NOTHING
    assert source.on_directions(1) == (2, EAST)
    assert source.on_map(3) == (3, EAST)


OTHERS = [
    ({"frame": "odom"}, "frame is 'map', the map's is 'odom'"),
    ({"yaw": 0.1}, "one yaw"),
]


LOGGED_PROBLEM = r"\[(WARN|ERROR)\]"


def test_why_a_map_waits_for_directions_is_logged_once(
    source: Source, set_parameters: SetParameters, capfd: Any
) -> None:
    def logged() -> list[str]:
        """Return the warnings and errors that were logged since the last call."""
        lines = capfd.readouterr().err.splitlines()
        return [
            line.partition("]: ")[2] for line in lines if re.match(LOGGED_PROBLEM, line)
        ]

    def reasons_for(*changes: dict[str, Any]) -> list[str]:
        """Return what is logged while maps come for 3 s, and then none for 2 s."""
        logged()
        for stamp in range(10, 16):
            source.on_map(stamp, **changes[stamp % len(changes)])
            assert "map" in source.diagnostics.refused
            source.now += 0.5
        source.now += 2.0
        source.use_waiting_map()
        return logged()

    set_parameters(require_directions=True)
    (late,) = reasons_for({})
    assert late.startswith("map refused: the map's directions were not received on ")
    assert source.on_directions(1) == (15, EAST)
    (frames,) = reasons_for({"frame": "odom"})
    assert frames.startswith("map refused: ")
    assert (
        "their frame is 'map', the map's is 'odom'; give both one frame, or set"
        in frames
    )
    (turned,) = reasons_for({"yaw": 0.1}, {"yaw": 0.2})
    assert "give both one yaw, or set require_directions to false" in turned
    assert source.on_map(20) == (20, EAST)
    # Directions that come moments after their map are no reason to warn.
    logged()
    assert source.on_map(21, frame="odom") == (20, EAST)
    source.now += 0.5
    source.use_waiting_map()
    assert source.on_map(22) == (22, EAST)
    source.now += 5.0
    assert source.on_map(23, frame="odom") == (22, EAST)
    assert not logged()
    source.now += 1.0
    source.use_waiting_map()
    assert len(logged()) == 1


@pytest.mark.parametrize(("changes", "reason"), OTHERS)
def test_directions_that_cannot_hold_are_named_or_their_map_is_refused(
    source: Source, set_parameters: SetParameters, changes: dict[str, Any], reason: str
) -> None:
    assert source.on_map(2, **changes) == (2, None)
    assert source.on_directions(1) == (2, None)
    assert reason in source.diagnostics.refused["one-way zones"]
    set_parameters(require_directions=True)
    assert source.used() == NOTHING
    assert reason in source.missing
    assert source.on_map(3) == (3, EAST)
    assert not source.diagnostics.refused
    assert source.on_map(4, **changes) == (3, EAST)
    assert reason in source.diagnostics.refused["map"]
    assert source.on_directions(4, None) == (4, None)
    assert not source.diagnostics.refused
    source.on_directions(5)
    set_parameters(require_directions=False)
    assert source.used() == (4, None)
    assert reason in source.diagnostics.refused["one-way zones"]
    assert source.on_map(5) == (5, EAST)
    assert not source.diagnostics.refused


def test_maps_with_equal_zones_are_compared_by_their_patches(source: Source) -> None:
    source.on_directions(1)
    source.on_map(1)
    before = source.grid()
    changed = map_of(2)
    changed.data[0] = 100
    source.take(changed)
    patches = source.grid().patches_since(before)
    assert patches
    assert len(patches) == 1


def test_malformed_directions_leave_those_before_them(source: Source) -> None:
    source.on_directions(1)
    broken = directions_of(2)
    broken.data = broken.data[:-1]
    source.directions.take(broken)
    assert "20" in source.diagnostics.refused["map_directions"]
    assert source.on_map(1) == (1, EAST)
    source.on_directions(1)
    assert "map_directions" not in source.diagnostics.refused


def test_a_worker_leaves_out_what_was_given_up_before_its_turn(node: BaseNode) -> None:
    worker, gate, made = Worker(node), threading.Event(), list[int]()
    worker.call(gate.wait)
    given_up = worker.run(made.append, 1)
    given_up.send(None)
    given_up.close()
    worker.call(made.append, 2)
    gate.set()
    worker.close()
    assert made == [2]


# Expected times

GRID = GridMap(np.zeros((40, 120), dtype=np.bool_), resolution=0.25)
PLACE = GRID.resolution, GRID.origin
MESSAGE = occupancy_message(
    np.zeros((40, 120), np.int8), *PLACE, Header(frame_id="map")
)


def message_of(experience: Experience) -> UInt8MultiArray:
    return bytes_message("experience", experience.to_bytes())


@pytest.fixture
def driven() -> UInt8MultiArray:
    """What is learned of two drives of 20 m, one at a fifth of the nominal speed."""
    experience, x = Experience(0.5), np.linspace(5, 25, 201)
    for y, speed in ((5.1, 0.1), (7.6, 0.5)):
        experience.record((x - 5) / speed, np.column_stack([x, np.full(201, y)]))
    return message_of(experience)


@pytest.fixture
def times(source: Source, driven: UInt8MultiArray) -> ExpectedTimes:
    source.times.load(driven)
    return source.times


def test_drives_are_planned_with_at_once(
    source: Source, driven: UInt8MultiArray
) -> None:
    data = bytes(driven.data)
    expected: Any = Experience.from_bytes(data).apply(GRID).slowness
    source.take(MESSAGE)
    assert source.slowness() is None
    source.heard = 0
    finished(source.times.on_message(driven))
    assert source.heard == 1
    finished(source.times.on_message(driven))  # the same again is no news
    assert source.heard == 1
    free, closed = np.zeros((2, 40, 120), np.int8)
    closed[19:22, 60:63] = 100
    for values in (free, closed, free):
        source.take(occupancy_message(values, *PLACE, MESSAGE.header))
        timed = source.grid()
        assert source.grid() is timed
        np.testing.assert_array_equal(timed.occupancy, values > 0)
        np.testing.assert_array_equal(timed.slowness, expected)
    assert expected[20, 60] > 2
    source.heard = 0
    for bad, reason in (
        (bytes_message("experience", data[:-9]), "no experience"),
        (bytes_message("model", data), "label 'ddqn_planner model 1"),
        (
            UInt8MultiArray(layout=message_of(Experience(0.5)).layout, data=data),
            "sha256",
        ),
        (UInt8MultiArray(data=data), "label ''"),
    ):
        finished(source.times.on_message(bad))
        assert reason in source.diagnostics.refused["experience"]
    assert source.heard == 0
    np.testing.assert_array_equal(source.slowness(), expected)
    finished(source.times.on_message(message_of(Experience(0.5))))
    assert source.heard == 1
    assert source.slowness() is None  # it was forgotten


def test_changes_are_planned_with_where_they_follow_on_what_is_known(
    source: Source,
) -> None:
    experience, x = Experience(0.5), np.linspace(5, 25, 201)
    source.take(MESSAGE)
    finished(source.times.on_message(message_of(experience)))
    messages = []
    for y in (5.1, 7.6):
        state = experience.state
        experience.record((x - 5) / 0.1, np.column_stack([x, np.full(201, y)]))
        changes = experience.changes_since(state)
        assert changes is not None
        messages.append(bytes_message(CHANGES, changes))
    source.heard = 0
    # The second message comes before the first one, and is no news when it comes again.
    for number, heard in ((1, 0), (0, 1), (1, 2), (1, 2)):
        finished(source.times.on_message(messages[number]))
        assert source.heard == heard
    assert source.diagnostics.refused == {}
    expected: Any = experience.apply(GRID).slowness
    np.testing.assert_allclose(source.slowness(), expected, rtol=0.021)
    broken = bytes_message(CHANGES, bytes(messages[1].data)[:-9])
    finished(source.times.on_message(broken))
    assert "no experience" in source.diagnostics.refused["experience"]


def test_what_another_version_sends_is_refused_in_the_same_words(
    source: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    experience = Experience(0.5)
    finished(source.times.on_message(message_of(experience)))
    state = experience.state
    experience.record_failure((5.0, 5.0))
    with monkeypatch.context() as newer:
        newer.setattr(experience_file, "VERSION", 99)
        changes = experience.changes_since(state)
        whole = message_of(experience)
    assert changes is not None
    for message in (bytes_message(CHANGES, changes), whole):
        finished(source.times.on_message(message))
        reason = source.diagnostics.refused["experience"]
        assert reason.startswith("no experience: it has version 99, not 5; let those")


def test_a_file_is_planned_with_or_refused_or_none_is_set(
    source: Source,
    driven: UInt8MultiArray,
    set_parameters: SetParameters,
    tmp_path: Path,
) -> None:
    file = tmp_path / "experience.npz"
    file.write_bytes(bytes(driven.data))
    source.take(MESSAGE)
    set_parameters(experience=str(tmp_path))
    for problem in ("", "cannot be read"):
        finished(source.times.on_message())
        assert problem in source.diagnostics.refused.get("experience", "")
        assert source.slowness()[20, 60] > 2
        file.write_bytes(bytes(driven.data)[:-9])
    set_parameters(experience="")
    finished(source.times.on_message())
    assert source.slowness() is None
    assert "experience" not in source.diagnostics.refused
    # The trainer's message counts, also if it comes again after no file was set.
    finished(source.times.on_message(driven))
    finished(source.times.on_message())
    finished(source.times.on_message(driven))
    assert source.slowness()[20, 60] > 2


def test_the_exploration_that_is_set_counts_at_once(
    source: Source, driven: UInt8MultiArray, set_parameters: SetParameters
) -> None:
    source.take(MESSAGE)
    finished(source.times.on_message(driven))
    for share in (0.1, 0.5):
        set_parameters(exploration=share)
        expected = Experience.from_bytes(bytes(driven.data)).apply(GRID, share)
        found = source.grid().exploration
        assert found is not None
        assert expected.exploration is not None
        assert found.share == share
        assert found.untimed.slowness is None
        deviation = expected.exploration.deviation
        np.testing.assert_allclose(found.deviation, deviation, rtol=1e-4)


def test_what_no_memory_was_left_for_is_refused_or_tried_again(
    source: Source, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> GridMap:
        raise MemoryError

    changed = map_of(2)
    changed.data[0] = 100
    source.take(map_of(1))
    with monkeypatch.context() as patch:
        patch.setattr(Inflation, "__call__", fail)
        with pytest.raises(MemoryError):
            source.grid()
        patch.setattr(GridMap, "with_patch", fail)
        source.take(changed)
        patch.setattr(source.times, "load", fail)
        finished(source.times.on_message())
        assert source.diagnostics.refused == dict.fromkeys(
            ("map", "experience"), "MemoryError()"
        )
    assert source.used() == (1, None)
    source.take(changed)
    assert source.used() == (2, None)


def finished(coroutine: Coroutine[None, None, Any]) -> Any:
    """Return what a coroutine returns that waits for a worker alone."""
    while True:
        try:
            coroutine.send(None)
        except StopIteration as end:
            return end.value
        time.sleep(0.001)


def test_a_map_that_grows_keeps_its_times(times: ExpectedTimes) -> None:
    before: Any = times.apply(GRID).slowness
    grown = GridMap(np.zeros((60, 150), dtype=np.bool_), 0.25, (-2.5, -1.25, 0.0))
    after: Any = times.apply(grown).slowness
    # Where robots drove: elsewhere, other walls are near now, which tells on the ends
    # of the drives, too.
    for row in (20, 30):
        np.testing.assert_allclose(
            after[row + 5, 36:104], before[row, 26:94], rtol=0.05
        )


def planned_on(grid: GridMap) -> Outcome:
    """The outcome of a request across a map with expected times."""
    planner = Planner.load("any_map")
    request = PlanRequest(grid, (22, 20), ((98, 20),), MoveRule.ROBOT_SAFE)
    plan = planner.plan(grid, request.start, request.goals[0])
    return Outcome("SUCCEEDED", "", planner, request, plan)


def test_the_expected_time_is_told_as_soon_as_the_worker_has_it(
    source: Source, driven: UInt8MultiArray
) -> None:
    threads, gate = source.changing_threads, threading.Event()
    source.take(MESSAGE)
    finished(source.times.on_message(driven))
    outcome = planned_on(source.grid())
    assert source.times.describe(outcome)
    finished(source.times.on_message())  # the file that is set: none
    assert source.times.diagnostics_of(outcome) == {}  # without drives
    finished(source.times.on_message(driven))
    assert source.grid().slowness is not None
    threads.clear()
    source.worker.call(gate.wait)  # the worker is busy
    assert source.times.diagnostics_of(outcome) == {}
    assert threads == {threading.get_ident()}  # it looks again soon
    gate.set()
    lines = wait_for("expected time", lambda: source.times.diagnostics_of(outcome))
    assert lines == source.times.describe(outcome)
    assert threads == {threading.get_ident()}  # the executor's alone
    finished(source.times.on_message())
    assert source.times.diagnostics_of(outcome) == {}


def test_the_plan_goes_round_and_its_time_is_told(times: ExpectedTimes) -> None:
    outcome = planned_on(times.apply(GRID))
    plan, request = outcome.plan, outcome.request
    assert request is not None
    told = times.describe(outcome)
    seconds = float(told["expected time (s)"])
    low, high = map(float, told["expected time, 90 % interval (s)"].split(" to "))
    assert plan.cost is not None
    assert low < seconds < high
    assert 0.95 < seconds / plan.cost < 1.05
    assert 19 / 0.5 < plan.cost < 19 / 0.2  # not straight on
    small = np.zeros((10, 10), dtype=np.bool_)
    of_old_map = GridMap(small, slowness=np.ones(small.shape), seconds_per_cell=1.0)
    for grid in (of_old_map, GRID):  # the second one is from before the drives
        older = replace(outcome, request=replace(request, grid=grid))
        assert times.describe(older) == {}


def test_a_first_map_is_waited_for_as_long_as_it_takes_on_a_loaded_machine() -> None:
    def may_come(seconds: float) -> bool:
        return RequestError("NO_MAP", "none", time.monotonic() - seconds).may_come

    assert may_come(3.0)  # as long as it took beside 14 busy processes on two cores
    assert not may_come(10.0)


def test_zones_end_with_directions_that_cannot_hold(source: Source) -> None:
    source.on_directions(1)
    assert source.on_map(2) == (2, EAST)
    elsewhere = directions_of(3)
    elsewhere.header.frame_id = "odom"
    source.directions.take(elsewhere)
    assert source.used() == (2, None)


def test_the_newest_map_waits_when_that_in_use_has_to_wait_too(
    source: Source, set_parameters: SetParameters
) -> None:
    set_parameters(require_directions=True)
    source.on_directions(1)
    assert source.on_map(1) == (1, EAST)
    assert source.on_map(2, yaw=0.1) == (1, EAST)
    elsewhere = directions_of(3)
    elsewhere.header.frame_id = "odom"
    source.directions.take(elsewhere)
    assert source.used() == NOTHING
    assert source.on_directions(4, None) == (2, None)
