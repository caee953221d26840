"""Ten laws of what makes robots slow in factories, warehouses, yards and on farms."""

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
import scipy.ndimage
from driving_laws import Door, Float64, Law, MakeLaw, Stand
from driving_maps import gates
from numpy.typing import NDArray

from ddqn_planner.grid import Cell, GridMap

Bool = NDArray[np.bool_]
Random = np.random.Generator
MINUTE: Final = 60.0  # seconds
HOUR: Final = 3600.0  # seconds


def _always(slowness: Float64) -> Callable[[float], Float64]:
    """Return what is as slow at all times."""
    return lambda clock: slowness


def _by_period(
    states: Sequence[Any], seconds: float, phase: float
) -> Callable[[float], Any]:
    """Return what takes one state after the other, each for so long, and repeats."""
    return lambda clock: states[int((clock + phase) // seconds) % len(states)]


def _distances(cells: Bool, grid: GridMap) -> Float64:
    """Return the metres from each cell to the next of some, infinite if none."""
    if not cells.any():
        return np.full(cells.shape, np.inf)
    distances = scipy.ndimage.distance_transform_edt(~cells)
    return np.asarray(distances * grid.resolution, dtype=np.float64)


def _disc(x: float, y: float, radius: float, grid: GridMap) -> Bool:
    """Return the cells within metres of one."""
    rows, columns = np.indices(grid.occupancy.shape)
    metres = np.hypot(columns - x, rows - y) * grid.resolution
    return np.asarray(metres <= radius)


def _terrain(sigma: float, grid: GridMap, random: Random) -> Float64:
    """Draw heights that are smooth over so many metres."""
    noise = random.normal(size=grid.occupancy.shape)
    sigma /= grid.resolution
    return np.asarray(scipy.ndimage.gaussian_filter(noise, sigma, mode="nearest"))


def _aisles(width: float, grid: GridMap) -> Bool:
    """Return the free cells into which no disc of this width in metres fits."""
    free = ~grid.occupancy
    radius = width / 2
    core = _distances(~free, grid) > radius
    return np.asarray(free & (_distances(core, grid) > radius))


def _free_cells(count: int, grid: GridMap, random: Random) -> NDArray[np.int64]:
    """Draw free cells (x, y): (count, 2)."""
    cells = np.argwhere(~grid.occupancy)[:, ::-1]
    return np.asarray(cells[random.integers(len(cells), size=count)], dtype=np.int64)


def _road(start: Cell, goal: Cell, half_width: float, grid: GridMap) -> Bool:
    """Return a road along x, then along y; walls beside it do not matter."""
    (x_0, y_0), (x_1, y_1) = start, goal
    line = np.zeros(grid.occupancy.shape, dtype=np.bool_)
    line[y_0, min(x_0, x_1) : max(x_0, x_1) + 1] = True
    line[min(y_0, y_1) : max(y_0, y_1) + 1, x_1] = True
    return np.asarray(_distances(line, grid) <= half_width)


def forklift_shifts(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Model forklifts on their roads, many or few by the shift.

    Two to four roads of 1.5 to 3.5 m join two stations each, by one corner. A robot
    behind a forklift or giving way to it takes 1.4 to 4 times as long in the day shift.
    Of what this is above 1, 40 to 80 % remains in the late shift, and 0 to 20 % at
    night. A shift lasts 1 to 8 h; in its last tenth, all forklifts stand.
    """
    traffic = np.zeros(grid.occupancy.shape)
    for _ in range(random.integers(2, 5)):
        first, last = random.integers(len(stations), size=2)
        half_width = random.uniform(0.75, 1.75)
        road = _road(stations[first], stations[last], half_width, grid)
        traffic = np.maximum(traffic, road * random.uniform(0.4, 3.0))
    shares = [1.0, random.uniform(0.4, 0.8), random.uniform(0.0, 0.2)]
    tenths = [1 + traffic * share for share in shares for _ in range(9)]
    for end in (9, 19, 29):
        tenths.insert(end, np.ones(traffic.shape))
    shift = random.uniform(1, 8) * HOUR
    phase = random.uniform(0, 3 * shift)
    return Law(slowness=_by_period(tenths, shift / 10, phase))


def aisle_pickers(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Model pickers with trolleys, who go to other shelves with each wave of orders.

    Three to seven pickers stand at 12 shelves; the k-th is 1/k as popular as the first.
    Within 1 to 2.5 m of them, but not behind racks, robots take 2.5 to 8 times as long
    in aisles under 2 m, where they cannot pass, and 1.1 to 1.6 times in the open. A
    wave takes 5 to 30 minutes, and the orders of 16 waves repeat.
    """
    free = ~grid.occupancy
    in_aisle, in_open = random.uniform(2.5, 8), random.uniform(1.1, 1.6)
    beside = np.where(_aisles(2.0, grid), in_aisle, in_open)
    shelves = _free_cells(12, grid, random)
    popularity = 1 / np.arange(1, len(shelves) + 1)
    popularity /= popularity.sum()
    pickers = int(random.integers(3, 8))
    reach = max(round(random.uniform(1.0, 2.5) / grid.resolution), 1)  # cells

    waves = []
    for _ in range(16):
        places = random.choice(len(shelves), pickers, replace=False, p=popularity)
        near = np.zeros(free.shape, dtype=np.bool_)
        near[shelves[places, 1], shelves[places, 0]] = True
        near = scipy.ndimage.binary_dilation(near, iterations=reach, mask=free)
        waves.append(np.where(near, beside, 1.0))
    wave = random.uniform(5, 30) * MINUTE
    return Law(slowness=_by_period(waves, wave, random.uniform(0, 16 * wave)))


def yard_in_rain(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Model a yard of asphalt, slabs, gravel and ruts, with potholes, in showers.

    It has 6 to 14 surfaces: asphalt (40 %), slabs (20 %: 1.1 to 1.2), gravel (25 %: 1.4
    to 2) and ruts (15 %: 2.5 to 5), and 5 to 20 potholes of 0.25 to 0.6 m radius, 3 to
    6.5 times as slow. It rains in 20 to 50 % of all spells of 20 to 120 minutes:
    puddles then cover 8 to 15 % and add 0.5 to 1.5, and all drives take 1.1 to 1.3
    times as long.
    """
    shape = grid.occupancy.shape
    rows, columns = np.indices(shape)
    count = int(random.integers(6, 15))
    y, x = random.uniform(0, 1, (2, count, 1, 1)) * np.reshape(shape, (2, 1, 1, 1))
    nearest = np.argmin(np.hypot(rows - y, columns - x), axis=0)
    kinds = random.choice(4, count, p=[0.4, 0.2, 0.25, 0.15])
    surfaces = random.uniform([1, 1.1, 1.4, 2.5], [1, 1.2, 2, 5], (count, 4))
    dry = surfaces[np.arange(count), kinds][nearest]
    for x_hole, y_hole in _free_cells(int(random.integers(5, 21)), grid, random):
        hole = _disc(x_hole, y_hole, random.uniform(0.25, 0.6), grid)
        dry[hole] = random.uniform(3, 6.5)

    hollows = _terrain(random.uniform(0.6, 1.5), grid, random)
    puddles = hollows < np.quantile(hollows, random.uniform(0.08, 0.15))
    wet = dry + puddles * random.uniform(0.5, 1.5)
    in_rain = random.uniform(1.1, 1.3)
    rains = random.random(48) < random.uniform(0.2, 0.5)
    spell = random.uniform(20, 120) * MINUTE
    phase = random.uniform(0, 48 * spell)
    return Law(
        slowness=_by_period([wet if rain else dry for rain in rains], spell, phase),
        whole_drive=_by_period(
            [in_rain if rain else 1.0 for rain in rains], spell, phase
        ),
    )


def sloped_field(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Model a farm on a hillside, with grass, and mud in its hollows.

    The hills are smooth over 2 to 4 m, and the whole field is tilted. Driving straight
    up the steepest 5 % adds 0.8 to 2.5 to the slowness. Grass takes 1.05 to 1.3 times
    as long, and mud in the lowest 8 to 20 % takes 1.5 to 4 times. Wheels dig in where a
    robot turns: 0.2 to 1 s for each 45 degrees.
    """
    hills = _terrain(random.uniform(2, 4), grid, random)
    slope = np.stack([np.gradient(hills, axis=1), np.gradient(hills, axis=0)], axis=-1)
    steepest = np.quantile(np.linalg.norm(slope, axis=-1), 0.95)
    angle, tilt = random.uniform(0, 2 * np.pi), random.uniform(0.1, 0.5)
    slope = slope / steepest + tilt * np.array([np.cos(angle), np.sin(angle)])
    slope /= np.quantile(np.linalg.norm(slope, axis=-1), 0.95)

    ground = np.full(grid.occupancy.shape, random.uniform(1.05, 1.3))
    hollow = hills < np.quantile(hills, random.uniform(0.08, 0.2))
    ground[hollow] = random.uniform(1.5, 4)
    return Law(
        slowness=_always(ground),
        uphill=slope * random.uniform(0.8, 2.5),
        turn_seconds=random.uniform(0.2, 1.0),
    )


def _draw_gate(random: Random) -> Stand | None:
    """Draw a roller door (25 %), a gate that is opened by hand (25 %), or none."""
    kind = random.random()
    if kind < 0.25:
        shortest = random.uniform(3, 7)
        return Stand(1.0, shortest, shortest + random.uniform(1, 5))
    if kind < 0.5:
        return Stand(
            random.uniform(0.2, 0.6), random.uniform(5, 15), random.uniform(20, 45)
        )
    return None


def gates_and_crossing(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Model a works with gates, and with a railway through it.

    Of the gates, 25 % are roller doors (always 3 to 12 s), 25 % are opened by hand (in
    20 to 60 % of all cases, 5 to 45 s), and the others stand open. One straight railway
    crosses the middle half of the map: in 2 to 10 % of all cases a robot stands before
    it for 20 to 90 s. Its rails, 0.5 m wide, are 1.4 to 3 times as slow.
    """
    free = ~grid.occupancy
    doors = []
    for rows, columns in gates(grid, random):
        stand = _draw_gate(random)
        if stand is not None:
            cells = np.zeros(free.shape, dtype=np.bool_)
            cells[rows, columns] = True
            doors.append(Door(cells, stand))

    rails = np.zeros(free.shape, dtype=np.bool_)
    lines = rails.T if random.random() < 0.5 else rails
    first = int(random.uniform(0.25, 0.75) * len(lines))
    lines[first : first + max(round(0.5 / grid.resolution), 1)] = True
    train = Stand(
        random.uniform(0.02, 0.1), random.uniform(20, 40), random.uniform(50, 90)
    )
    doors.append(Door(rails & free, train))
    rough = random.uniform(1.4, 3)
    return Law(slowness=_always(np.where(rails, rough, 1.0)), doors=doors)


def _ramp(dock: Cell, radius: float, grid: GridMap) -> Float64:
    """Return directions of length 1 toward a dock from within metres of it."""
    rows, columns = np.indices(grid.occupancy.shape)
    toward = np.stack([dock[0] - columns, dock[1] - rows], axis=-1)
    lengths = np.linalg.norm(toward, axis=-1, keepdims=True)
    ramp = lengths * grid.resolution <= radius
    return np.asarray(ramp * toward / np.maximum(lengths, 1))


def loading_docks(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Model docks: lorries that are unloaded, ramps, and loads handed over.

    One to five stations are docks, each with a lorry in 30 to 60 % of 30 to 120
    minutes. Meanwhile robots queue within 1.5 to 3.5 m of it, 1.5 to 3.5 times as
    slow. A third of the docks are raised: driving up to one adds 0.4 to 1.5. Handing
    over a load takes 4 to 40 s at 60 to 100 % of all goals, and 10 to 40 % of all
    starts wait 3 to 20 s for papers.
    """
    count = min(int(random.integers(1, 6)), len(stations))
    uphill = np.zeros((*grid.occupancy.shape, 2))
    queues, timetables = [], []
    for dock in random.permutation(len(stations))[:count]:
        radius = random.uniform(1.5, 3.5)
        x, y = stations[dock]
        queue = _disc(x, y, radius, grid)
        queues.append(np.where(queue, random.uniform(1.5, 3.5), 1.0))
        period = random.uniform(30, 120) * MINUTE
        timetables.append((period, random.uniform(0, period), random.uniform(0.3, 0.6)))
        if random.random() < 1 / 3:
            steep = random.uniform(0.4, 1.5)
            uphill += steep * _ramp((x, y), radius, grid)

    def slowness(clock: float) -> Float64:
        slow = np.ones(grid.occupancy.shape)
        for queue, (period, phase, share) in zip(queues, timetables, strict=True):
            if (clock + phase) % period < share * period:
                np.maximum(slow, queue, out=slow)
        return slow

    return Law(
        slowness=slowness,
        uphill=uphill,
        at_start=Stand(
            random.uniform(0.1, 0.4), random.uniform(3, 6), random.uniform(8, 20)
        ),
        at_goal=Stand(
            random.uniform(0.6, 1), random.uniform(4, 12), random.uniform(15, 40)
        ),
    )


def safety_scanner(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Model laser scanners whose fields make a robot slow beside racks.

    Within 0.4 to 0.8 m of a rack it takes 1.1 to 1.5 times as long. Within 0.5 to 1.5 m
    of the end of an aisle, which is under 1.5 to 2.5 m wide, it takes 1.4 to 3 times as
    long, for people may step out. Dust and foil stop it for 2 to 6 s, with a chance of
    0.1 to 0.8 % in each metre.
    """
    beside = _distances(grid.occupancy, grid) <= random.uniform(0.4, 0.8)
    slow = np.where(beside, random.uniform(1.1, 1.5), 1.0)
    aisles = _aisles(random.uniform(1.5, 2.5), grid)
    wide = ~(aisles | grid.occupancy)
    reach = random.uniform(0.5, 1.5)
    ends = np.maximum(_distances(aisles, grid), _distances(wide, grid)) <= reach
    slow[ends] = random.uniform(1.4, 3)
    stop = Stand(
        random.uniform(0.001, 0.008), random.uniform(2, 3), random.uniform(4, 6)
    )
    return Law(slowness=_always(slow), stop=stop)


def one_way_aisles(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Model lanes with a direction, and a main lane that has right of way.

    Parallel lanes of 1.5 to 4 m lead up and down in turn, 60 to 100 % of them with a
    rule. Against the flow, a robot gives way to all it meets, which adds 0.8 to 4 to
    the slowness. A main lane of 1.5 to 2.5 m crosses them: in 10 to 40 % of all cases a
    robot stands before it for 1 to 10 s. Turns cost 0 to 0.4 s for each 45 degrees.
    """
    rows, columns = np.indices(grid.occupancy.shape)
    along_x = random.random() < 0.5
    across, along = (rows, columns) if along_x else (columns, rows)
    width = max(round(random.uniform(1.5, 4) / grid.resolution), 1)  # cells
    lanes = (across + int(random.integers(width))) // width
    ruled = random.random(int(lanes.max()) + 1) < random.uniform(0.6, 1)
    flow = np.where(lanes % 2 == 0, 1.0, -1.0) * ruled[lanes]

    main = max(round(random.uniform(1.5, 2.5) / grid.resolution), 1)  # cells
    first = int(random.uniform(0.2, 0.8) * along.max())
    in_main = (along >= first) & (along < first + main)
    uphill = np.zeros((*grid.occupancy.shape, 2))
    against = random.uniform(0.8, 4)
    uphill[..., 0 if along_x else 1] = -against * np.where(in_main, 0.0, flow)
    give_way = Stand(
        random.uniform(0.1, 0.4), random.uniform(1, 3), random.uniform(4, 10)
    )
    return Law(
        slowness=_always(np.ones(grid.occupancy.shape)),
        uphill=uphill,
        doors=[Door(in_main & ~grid.occupancy, give_way)],
        turn_seconds=random.uniform(0, 0.4),
    )


def emergency_stops(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Model emergency stops, and a battery that sags until it is changed.

    Someone presses the button with a chance of 0.03 to 0.3 % in each metre, and the
    robot stands for 15 to 90 s. In 0.5 to 3 % of all starts a robot reports a fault,
    and stands for 20 to 80 s. A battery lasts 2 to 8 h: all drives take 1.1 to 1.6
    times as long at its end, most of it in its last third. Within 1.5 to 2.5 m of one
    or two manned machines, robots are barely slow: 1.1 to 1.25 times.
    """
    slow = np.ones(grid.occupancy.shape)
    for x, y in _free_cells(int(random.integers(1, 3)), grid, random):
        machine = _disc(x, y, random.uniform(1.5, 2.5), grid)
        slow[machine] = random.uniform(1.1, 1.25)
    lasts = random.uniform(2, 8) * HOUR
    phase = random.uniform(0, lasts)
    sag, power = random.uniform(0.1, 0.6), random.uniform(3, 5)

    def battery(clock: float) -> float:
        return float(1 + sag * ((clock + phase) % lasts / lasts) ** power)

    return Law(
        slowness=_always(slow),
        at_start=Stand(
            random.uniform(0.005, 0.03), random.uniform(20, 30), random.uniform(40, 80)
        ),
        stop=Stand(
            random.uniform(0.0003, 0.003),
            random.uniform(15, 30),
            random.uniform(40, 90),
        ),
        whole_drive=battery,
    )


def fenced_hall(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Model a hall behind a fence, of robots alone: nothing at all is slow there."""
    return Law(slowness=_always(np.ones(grid.occupancy.shape)))


LAWS: Final[dict[str, MakeLaw]] = {
    "forklift_shifts": forklift_shifts,
    "aisle_pickers": aisle_pickers,
    "yard_in_rain": yard_in_rain,
    "sloped_field": sloped_field,
    "gates_and_crossing": gates_and_crossing,
    "loading_docks": loading_docks,
    "safety_scanner": safety_scanner,
    "one_way_aisles": one_way_aisles,
    "emergency_stops": emergency_stops,
    "fenced_hall": fenced_hall,
}
