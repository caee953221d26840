"""Ten laws of what makes robots slow in hospitals, hotels and offices."""

import itertools
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from driving_laws import Door, Float64, Law, MakeLaw, Stand
from driving_maps import gates
from numpy.typing import NDArray
from random_maps import Random

from ddqn_planner.grid import (
    Cell,
    GridMap,
    MoveRule,
    clearance,
    shortest_distances,
    shortest_path,
)

Bool = NDArray[np.bool_]
RULE: Final = MoveRule.ROBOT_SAFE
MINUTE: Final = 60.0  # seconds
HOUR: Final = 3600.0  # seconds


def shift_change(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Staff and visitors fill the way from the entrance to the farthest ward.

    The way is 1 to 2.5 m wide, and 1.05 to 1.3 times as slow while it is quiet. Every 1
    to 3 hours, at shift changes, meals and visits, 0.8 to 3 is added for 15 to 40
    minutes: most in the middle of that time.
    """
    entrance = stations[int(random.integers(len(stations)))]
    way = _way(grid, entrance, stations, random.uniform(1.0, 2.5))
    quiet = np.where(way, random.uniform(1.05, 1.3), 1.0)
    crowd = way * random.uniform(0.8, 3.0)
    crowdedness = _draw_busy_times((1.0, 3.0), (15.0, 40.0), random)
    return Law(slowness=lambda clock: quiet + crowd * crowdedness(clock))


def blind_corners(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Robots may only creep at 4 to 14 corners behind which people may come.

    Each zone reaches 0.75 to 1.75 m from its corner. In it the speed limit is 0.3 to
    0.75 of the nominal speed: slowness 1.3 to 3.3.
    """
    slowness = np.ones(grid.occupancy.shape)
    corners = np.argwhere(_corners(grid.occupancy))
    for y, x in random.permutation(corners)[: random.integers(4, 15)].tolist():
        zone = _metres_to([(x, y)], grid) <= random.uniform(0.75, 1.75)
        limit = random.uniform(0.3, 0.75)
        slowness[zone] = np.maximum(slowness[zone], 1 / limit)
    return Law(slowness=lambda clock: slowness)


def carpets(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Lay 4 to 10 carpets in a hotel, and metal thresholds in half of its doors.

    A carpet has sides of 3 to 9 m and is barely slow: 1.1 to 1.35; every fifth one has
    a deep pile: 1.5 to 2. Wheels go over a threshold at slowness 1.8 to 3.5.
    """
    slowness = np.ones(grid.occupancy.shape)
    for _ in range(random.integers(4, 11)):
        carpet = _draw_rectangle(grid, 3.0, 9.0, random)
        is_deep = random.random() < 0.2
        drag = random.uniform(1.5, 2.0) if is_deep else random.uniform(1.1, 1.35)
        slowness[carpet] = np.maximum(slowness[carpet], drag)
    for rows, columns in gates(grid, random):
        slowness[rows, columns] = random.uniform(1.8, 3.5)
    return Law(slowness=lambda clock: slowness)


def parked_carts(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Nurses and housekeepers leave 6 to 16 carts along the walls, and fetch them.

    A robot squeezes past a cart, within 0.7 to 1.3 m, at slowness 2.5 to 8. Each cart
    comes back to its place every 20 to 90 minutes, for 20 to 80 % of this time.
    """
    metres_to_wall = clearance(grid.occupancy) * grid.resolution
    along_walls = np.argwhere(~grid.occupancy & (metres_to_wall <= 0.75))
    places = random.permutation(along_walls)[: random.integers(6, 17)]
    count = len(places)
    carts = np.ones((count, *grid.occupancy.shape))
    for cart, (y, x) in zip(carts, places.tolist(), strict=True):
        beside = _metres_to([(x, y)], grid) <= random.uniform(0.7, 1.3)
        cart[beside] = random.uniform(2.5, 8.0)
    period = random.uniform(20 * MINUTE, 90 * MINUTE, count)
    parked = period * random.uniform(0.2, 0.8, count)
    phase = period * random.random(count)

    def slowness(clock: float) -> Float64:
        is_parked = (clock + phase) % period < parked
        worst: Float64 = carts[is_parked].max(axis=0, initial=1.0)
        return worst

    return Law(slowness)


def empty_office(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Nothing is slow in an office after hours: smooth floors, and all doors open."""
    slowness = np.ones(grid.occupancy.shape)
    return Law(slowness=lambda clock: slowness)


def lift_lobby(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """One or two stations are lifts, before which people queue and robots wait.

    The lobby reaches 2 to 4.5 m on foot from the lift, where slowness is 1.4 to 2.8,
    and less farther away. Who comes within 0.75 m of the lift waits for its cabin: with
    a chance of 25 to 60 %, for 5 to 15 seconds at least and 25 to 75 at most.
    """
    slowness = np.ones(grid.occupancy.shape)
    doors = []
    count = min(int(random.integers(1, 3)), len(stations))
    for lift in random.permutation(len(stations))[:count]:
        metres = _metres_on_foot(grid, stations[lift])
        nearness = np.maximum(0.0, 1 - metres / random.uniform(2.0, 4.5))
        slowness = np.maximum(slowness, 1 + nearness * random.uniform(0.4, 1.8))
        wait = Stand(
            random.uniform(0.25, 0.6), random.uniform(5, 15), random.uniform(25, 75)
        )
        doors.append(Door(metres <= 0.75, wait))
    return Law(slowness=lambda clock: slowness, doors=doors)


def access_doors(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Most doors open by themselves, some have worn sensors, and some need a badge.

    Of the doors, 60 % always take 2 to 4 seconds at least and 4 to 9 at most to open.
    20 % have sensors that miss the robot with a chance of 5 to 25 %: for 5 to 10
    seconds at least and 15 to 35 at most. The last 20 % are security doors, which open
    late with a chance of 0.5 to 3 %: by 20 to 40 seconds at least and 50 to 90 at most.
    All are narrow: slowness 1.1 to 1.4.
    """
    slowness = np.ones(grid.occupancy.shape)
    doors = []
    for rows, columns in gates(grid, random):
        cells = np.zeros(grid.occupancy.shape, dtype=np.bool_)
        cells[rows, columns] = True
        slowness[cells] = random.uniform(1.1, 1.4)
        doors.append(Door(cells, _draw_door_opening(random)))
    return Law(slowness=lambda clock: slowness, doors=doors)


def charging_docks(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Robots charge at all stations, and slow down as their battery runs low.

    They back out of a dock for 3 to 5 seconds at least and 6 to 12 at most. Contacts
    miss with a chance of 10 to 40 %, and docking again takes 8 to 15 seconds at least
    and 20 to 45 at most. Within 0.8 to 1.6 m of a dock, slowness is 1.5 to 3.5. A
    charge lasts 1 to 3 hours; after 40 to 70 % of it, drives take longer and longer:
    1.1 to 1.4 times as long at last.
    """
    is_near = _metres_to(stations, grid) <= random.uniform(0.8, 1.6)
    slowness = np.where(is_near, random.uniform(1.5, 3.5), 1.0)
    charge = random.uniform(1.0, 3.0) * HOUR
    phase = random.uniform(0.0, charge)
    strong = random.uniform(0.4, 0.7)  # share of a charge at full speed
    weakest = random.uniform(0.1, 0.4)

    def battery(clock: float) -> float:
        used = (clock + phase) % charge / charge
        return 1 + weakest * max(0.0, used - strong) / (1 - strong)

    return Law(
        slowness=lambda clock: slowness,
        at_start=Stand(1.0, random.uniform(3, 5), random.uniform(6, 12)),
        at_goal=Stand(
            random.uniform(0.1, 0.4), random.uniform(8, 15), random.uniform(20, 45)
        ),
        whole_drive=battery,
    )


def towed_trolley(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Tow a meal trolley, which turns slowly and must not touch walls.

    A turn by 45 degrees takes 0.5 to 1.8 seconds. Slowness is 1.3 to 2.2 within 0.25 m
    of a wall, and falls to 1 at 0.6 to 1.25 m. Staff halt the robot to take trays, for
    10 to 25 seconds at least and 30 to 60 at most: with a chance of 0.05 to 0.3 % in
    each metre, which is 1 to 6 % in a drive of 20 m.
    """
    metres_to_wall = clearance(grid.occupancy) * grid.resolution
    care = np.interp(metres_to_wall, [0.25, random.uniform(0.6, 1.25)], [1.0, 0.0])
    slowness = 1 + care * random.uniform(0.3, 1.2)
    halt = Stand(
        random.uniform(0.0005, 0.003), random.uniform(10, 25), random.uniform(30, 60)
    )
    return Law(
        slowness=lambda clock: slowness,
        turn_seconds=random.uniform(0.5, 1.8),
        stop=halt,
    )


def outdoor_ramp(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Lead a ramp in the open from one building up to the next.

    It has sides of 4 to 10 m. Driving up adds 0.3 to 1.2 to the slowness; both ways
    are 1.05 to 1.25 times as slow. In showers of 10 to 40 minutes, every 1 to 3 hours,
    the wet ramp adds 0.2 to 0.8.
    """
    ramp = _draw_rectangle(grid, 4.0, 10.0, random)
    direction = random.uniform(0.0, 2 * np.pi)
    climb = random.uniform(0.3, 1.2) * np.array([np.cos(direction), np.sin(direction)])
    dry = np.where(ramp, random.uniform(1.05, 1.25), 1.0)
    wet = ramp * random.uniform(0.2, 0.8)
    rain = _draw_busy_times((1.0, 3.0), (10.0, 40.0), random)
    return Law(
        slowness=lambda clock: dry + wet * rain(clock), uphill=ramp[..., None] * climb
    )


def _metres_to(cells: Sequence[Cell], grid: GridMap) -> Float64:
    """Return the distance of each cell to the nearest of some, as the crow flies."""
    is_one = np.zeros(grid.occupancy.shape, dtype=np.bool_)
    x, y = np.transpose(cells)
    is_one[y, x] = True
    return clearance(is_one) * grid.resolution


def _metres_on_foot(grid: GridMap, cell: Cell) -> Float64:
    """Return the length of the shortest way from each cell, infinite without one."""
    return shortest_distances(grid, cell, RULE) * grid.resolution


def _way(grid: GridMap, entrance: Cell, stations: Sequence[Cell], width: float) -> Bool:
    """Mark the shortest way from the entrance to the farthest station, `width` wide."""
    x, y = np.transpose(stations)
    metres = _metres_on_foot(grid, entrance)[y, x]
    # Stations to which no way leads count as nearest.
    ward = stations[int(np.where(np.isfinite(metres), metres, -1.0).argmax())]
    way = shortest_path(grid, entrance, ward, RULE)
    return _metres_to(way, grid) <= width / 2


def _corners(occupancy: Bool) -> Bool:
    """Mark the cells of walls round which a way may bend by 90 degrees or more."""
    free = np.pad(~occupancy, 1)
    is_corner = np.zeros_like(occupancy)
    for up, left in itertools.product((0, 2), (0, 2)):
        rows = slice(up, up + occupancy.shape[0])
        columns = slice(left, left + occupancy.shape[1])
        is_corner |= free[rows, columns] & free[rows, 1:-1] & free[1:-1, columns]
    return is_corner & occupancy


def _draw_rectangle(
    grid: GridMap, shortest: float, longest: float, random: Random
) -> Bool:
    """Draw a rectangle with sides of so many metres round a free cell."""
    centre = random.choice(np.argwhere(~grid.occupancy))
    sides = random.uniform(shortest, longest, 2) / grid.resolution
    first = np.maximum(np.rint(centre - sides / 2), 0).astype(np.int64)
    end = np.rint(centre + sides / 2).astype(np.int64)
    rectangle = np.zeros(grid.occupancy.shape, dtype=np.bool_)
    rectangle[first[0] : end[0], first[1] : end[1]] = True
    return rectangle


def _draw_busy_times(
    hours: tuple[float, float], minutes: tuple[float, float], random: Random
) -> Callable[[float], float]:
    """Draw how often something comes, in hours, and for how long, in minutes.

    The result tells of the clock how strong it is: 0, and up to 1 in the middle.
    """
    period = random.uniform(*hours) * HOUR
    phase = random.uniform(0.0, period)
    half = random.uniform(*minutes) * MINUTE / 2

    def strength(clock: float) -> float:
        return max(0.0, 1 - abs((clock + phase) % period - half) / half)

    return strength


def _draw_door_opening(random: Random) -> Stand:
    """Draw how one door opens: by itself, with a worn sensor, or by a badge."""
    kind = random.random()
    if kind < 0.6:
        return Stand(1.0, random.uniform(2, 4), random.uniform(4, 9))
    if kind < 0.8:
        return Stand(
            random.uniform(0.05, 0.25), random.uniform(5, 10), random.uniform(15, 35)
        )
    return Stand(
        random.uniform(0.005, 0.03), random.uniform(20, 40), random.uniform(50, 90)
    )


LAWS: Final[dict[str, MakeLaw]] = {
    "shift_change": shift_change,
    "blind_corners": blind_corners,
    "carpets": carpets,
    "parked_carts": parked_carts,
    "empty_office": empty_office,
    "lift_lobby": lift_lobby,
    "access_doors": access_doors,
    "charging_docks": charging_docks,
    "towed_trolley": towed_trolley,
    "outdoor_ramp": outdoor_ramp,
}
