from __future__ import annotations

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from ddqn_planner.grid import MOVES, Cell, GridMap, MoveRule, legal_moves, shortest_distances
from ddqn_planner.nodes.display import MAX_ARROWS, policy_message
from ddqn_planner.planning import QField

HEADER = Header(frame_id="map")


def exact_field(grid: GridMap, goal: Cell) -> QField:
    """Return a field whose policy goes down the exact distances."""
    distances = np.pad(
        shortest_distances(grid, goal, MoveRule.ROBOT_SAFE), 1, constant_values=np.inf
    )
    beside = [np.roll(distances, (-dy, -dx), (0, 1))[1:-1, 1:-1] for dx, dy in MOVES]
    lengths = np.hypot(*MOVES.T).reshape(-1, 1, 1)
    return QField(
        goal,
        -(np.array(beside) + lengths).astype(np.float32),
        legal_moves(grid.occupancy, MoveRule.ROBOT_SAFE),
    )


def arrows_of(marker: Marker) -> np.ndarray:
    """Return (arrows, 6, 2): the ends of shaft and barbs, metres."""
    return np.array([(point.x, point.y) for point in marker.points]).reshape(-1, 6, 2)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (-1.0, 2.0, 0.7), (3.0, 0.0, -2.5)])
def test_each_free_cell_except_the_goal_has_its_greedy_arrow(
    small_values: np.ndarray, origin: tuple[float, float, float]
) -> None:
    grid = GridMap.from_occupancy_values(small_values, 0.5, origin)
    field = exact_field(grid, (5, 5))
    (marker,) = policy_message(field, grid, HEADER).markers
    assert (marker.type, marker.action) == (Marker.LINE_LIST, Marker.ADD)
    assert marker.header.frame_id == "map"
    assert marker.pose.orientation.w == 1.0
    assert marker.scale.x > 0
    assert marker.color.a > 0
    found = {}
    for shaft_tail, tip, *barbs in arrows_of(marker):
        cell = grid.world_to_cell(*(shaft_tail + tip) / 2)
        assert (shaft_tail + tip) / 2 == pytest.approx(grid.cell_to_world(cell))
        found[cell] = np.subtract(tip, shaft_tail)
        assert barbs[0] == pytest.approx(tip)
        assert barbs[2] == pytest.approx(tip)
        # A barb lies behind the tip, and the two are mirrored.
        sides = np.cross(
            np.append(found[cell], 0), np.append([barbs[1] - tip, barbs[3] - tip], [[0], [0]], 1)
        )
        assert sides[0, 2] == pytest.approx(-sides[1, 2])
        assert max((barbs[1] - tip) @ found[cell], (barbs[3] - tip) @ found[cell]) < 0
    assert set(found) == set(grid.free_cells()) - {(5, 5)}
    for (x, y), direction in found.items():
        dx, dy = MOVES[field.policy[y, x]]
        ahead = np.subtract(grid.cell_to_world((x + dx, y + dy)), grid.cell_to_world((x, y)))
        assert direction / np.linalg.norm(direction) == pytest.approx(ahead / np.linalg.norm(ahead))


def test_a_new_message_replaces_the_old_one_and_none_deletes_it() -> None:
    free, walled = GridMap(np.zeros((3, 3), bool)), GridMap(np.ones((3, 3), bool))
    (shown,) = policy_message(exact_field(free, (1, 1)), free, HEADER).markers
    lost = QField((1, 1), np.zeros((8, 3, 3), np.float32), np.zeros((8, 3, 3), bool))
    (empty,) = policy_message(lost, walled, HEADER).markers
    assert (shown.ns, shown.id) == (empty.ns, empty.id)
    assert empty.action == Marker.DELETE
    assert len(empty.points) == 0


@pytest.mark.parametrize("shape", [(100, 100), (384, 576), (1, 30000)])
def test_large_maps_have_no_more_arrows_than_the_bound(shape: tuple[int, int]) -> None:
    grid = GridMap(np.zeros(shape, bool), 0.05)
    q = np.random.default_rng(0).random((8, *shape), np.float32)
    field = QField((0, 0), q, legal_moves(grid.occupancy, MoveRule.ROBOT_SAFE))
    message = policy_message(field, grid, HEADER)
    arrows = arrows_of(message.markers[0])
    assert MAX_ARROWS / 2 <= len(arrows) <= MAX_ARROWS
    assert len(serialize_message(message)) > 24 * 6 * len(arrows)
