"""The kinds of worlds that are measured: a map and a law each, as "office-waits"."""

from typing import Final

SEED: Final = 20_491  # of the first world of each kind whose law others chose
PLACES: Final = "places are slow"
WAITS: Final = "rare or goal's waits"
TURNS: Final = "turns and directions"
NOTHING: Final = "nothing is slow"
# Twenty laws were written without a look at how the library learns. The names of
# each class were sorted, and `numpy.random.default_rng(20491129).permutation` drew its
# halves, class by class in this order, before anything was measured in their worlds.
LAWS_FOR_CHOOSING: Final = {
    "aisle_pickers": PLACES,
    "shift_change": PLACES,
    "carpets": PLACES,
    "parked_carts": PLACES,
    "loading_docks": WAITS,
    "charging_docks": WAITS,
    "emergency_stops": WAITS,
    "sloped_field": TURNS,
    "outdoor_ramp": TURNS,
    "fenced_hall": NOTHING,
}
# No constant, default or method of the library is ever chosen in worlds with these
# laws. They are for the figures in the docs alone.
LAWS_FOR_FIGURES: Final = {
    "blind_corners": PLACES,
    "yard_in_rain": PLACES,
    "safety_scanner": PLACES,
    "forklift_shifts": PLACES,
    "gates_and_crossing": WAITS,
    "access_doors": WAITS,
    "lift_lobby": WAITS,
    "one_way_aisles": TURNS,
    "towed_trolley": TURNS,
    "empty_office": NOTHING,
}
STANDING_LAWS: Final = {
    "nothing": NOTHING,
    "rare_waits": WAITS,
    "docks": WAITS,
    "stops": WAITS,
}
OLD: Final = "laws of former measurements"
CLASSES: Final = {**LAWS_FOR_CHOOSING, **LAWS_FOR_FIGURES, **STANDING_LAWS}
WORLDS: Final = 34  # of each half of the laws, and seed
MAPS: Final = (
    "office",
    "warehouse",
    "rooms",
    "halls",
    "corridors",
    "blobs",
    "small_rooms",
    "maze",
)


def _on_maps(laws: dict[str, str], worlds: int) -> list[str]:
    """Return so many kinds: each law on one map, then each on another one, ..."""
    names = list(laws)
    kinds = []
    for number in range(worlds):
        turn, law = divmod(number, len(names))
        # Each turn begins two maps later, so that a law comes to other maps.
        name = MAPS[(2 * turn + law) % len(MAPS)]
        kinds.append(f"{name}-{names[law]}")
    return kinds


FOR_CHOOSING: Final = _on_maps(LAWS_FOR_CHOOSING, WORLDS)
FOR_FIGURES: Final = _on_maps(LAWS_FOR_FIGURES, WORLDS)
STANDING: Final = _on_maps(STANDING_LAWS, 12)
# Constants of the library were chosen on these, too, long before.
FORMER: Final = (
    "office-mixture",
    "small_rooms-mixture",
    "corridors-mixture",
    "rooms-discs",
    "rooms-sills",
    "rooms-noise",
    "halls-discs",
    "halls-checkerboard",
    "halls-ramps",
    "maze-discs",
    "maze-waits",
    "warehouse-crowds",
    "warehouse-gradient",
    "blobs-clearance",
    "rooms-waits",
)
FORMER_SEED: Final = 0
# The same laws on other maps.
FORMER_ON_OTHER_MAPS: Final = (
    "warehouse-discs",
    "corridors-waits",
    "rooms-clearance",
    "rooms-ramps",
    "halls-noise",
    "halls-crowds",
    "halls-gradient",
    "maze-sills",
    "maze-noise",
    "maze-checkerboard",
    "warehouse-waits",
    "warehouse-clearance",
    "blobs-noise",
    "blobs-discs",
    "blobs-ramps",
    "small_rooms-sills",
    "office-checkerboard",
    "office-crowds",
)
FORMER_ON_OTHER_MAPS_SEED: Final = 14_000
ON_FILES: Final = ("mixture", "discs", "waits", "clearance", "noise")
"""The laws on ROS maps from files."""


def law_of(kind: str) -> str:
    """Return the name of a kind's law."""
    return kind.rsplit("-", 1)[1]


def class_of(kind: str) -> str:
    """Return what is slow in worlds of a kind, in a few words."""
    return CLASSES.get(law_of(kind), OLD)


def first_seed(kind: str) -> int:
    """Return the seed of the first world of a kind."""
    if kind in FORMER:
        return FORMER_SEED
    if kind in FORMER_ON_OTHER_MAPS:
        return FORMER_ON_OTHER_MAPS_SEED
    return SEED
