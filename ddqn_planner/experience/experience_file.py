"""The files that hold experience, and the bytes that tell others of drives."""

from __future__ import annotations

import hashlib
import io
import math
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.experience.fleet import RobotEvidence, Version
from ddqn_planner.experience.places import (
    FARTHEST,
    LEAST_WEIGHT,
    NOISE,
    SUMS,
    Int64,
    Places,
)
from ddqn_planner.experience.prior import FEATURES
from ddqn_planner.grid.arguments import MAX_SLOWNESS

MAX_FILE_BYTES = 2**27  # a larger file is refused before it is read
VERSION = 5
TURNLESS_VERSION = 4  # of 0.6.0, without turns and with a prior of other features
LOG_VERSION = 3  # of one robot, with the logarithms of slowness alone
FIRST_VERSION = 1  # until 0.4.0; 2 was never released
MOST = 1e12  # no sum of what drives showed is greater: seconds, weights or squares


# The dimensions of each value of a robot's evidence and of its places, and the least
# and the greatest number that can be true.
RANGES = {
    **dict.fromkeys(("driven", "faded"), (0, 0, MOST)),
    **dict.fromkeys(SUMS, (1, 0, MOST)),
    # Logarithms, and what follows from them, may be negative.
    **dict.fromkeys(("sum_of_log", "errors", "surprises", "turns"), (1, -MOST, MOST)),
    "version": (1, 0, math.inf),
    "prior": (1, -100, 100),  # no feature of a map raises the log slowness by more
    "position": (2, -FARTHEST, FARTHEST),
    # Rounding may change a sum a little.
    "slowness": (1, 0.5 / MAX_SLOWNESS, 2 * MAX_SLOWNESS),
}
OLD_FEATURES = 7  # of priors until version 0.6, which say nothing of today's features
# The arrays with a row for each robot, in the order of `RobotEvidence`.
VALUES = "identities", "robots", "versions", "driven", "faded", "priors", "turns"

Arrays = Mapping[str, NDArray[Any]]


class Content(NamedTuple):
    """What a file or a message holds."""

    options: Sequence[float]  # in the order of `Experience.options`
    # Of each robot, first that of the own robot. In a message: drives of the own robot.
    members: Sequence[RobotEvidence]
    # In a message: of the fleet before these drives, see `Fleet.state`. None in a file.
    state: int | None = None


def content_to_bytes(content: Content) -> bytes:
    """Return the bytes of a file: an .npz file of named arrays.

    Each value has one array, with a row for each of R robots. The places of all robots
    stand one after another, and so do the errors and the surprises.
    """
    *values, places, errors, surprises = zip(*content.members, strict=True)
    parts = places, errors, surprises
    square = np.concatenate([part.square for part in places])  # (N, 2)
    sums = [list(part.sums().values()) for part in places]  # (len(SUMS), n) each
    arrays: dict[str, Any] = {
        "version": VERSION,
        "options": content.options,
        **dict(zip(VALUES, values, strict=True)),
        "counts": np.transpose([list(map(len, part)) for part in parts]),  # (R, 3)
        "errors": np.concatenate(errors),
        "surprises": np.concatenate(surprises),
        # Columns that hardly change from row to row are compressed to a few bytes.
        "squares": np.diff(square, axis=0, prepend=np.int32(0)).T,  # (2, N) int32
        "sums": np.concatenate(sums, axis=1).astype(np.float32),  # (len(SUMS), N)
    }
    if content.state is not None:
        arrays["state"] = content.state
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def content_from_bytes(data: bytes) -> Content:
    """Return what a file of these bytes holds; an exception if it holds no experience.

    Broken bytes make zipfile and NumPy raise many kinds of errors.
    """
    arrays = _unpacked(data)
    version = int(arrays["version"])
    options: list[float] = arrays["options"].astype(np.float64).tolist()
    if version in (VERSION, TURNLESS_VERSION):
        members = _members(arrays, side=options[1] / 2)
    elif version in (FIRST_VERSION, LOG_VERSION):
        # Copies of an old file are the evidence of the same robot.
        identity = hashlib.sha256(data).hexdigest()[:32]
        members = [_old_evidence(arrays, options, identity)]
    else:
        remedy = "let those who write and read it have one version of ddqn_planner"
        raise ValueError(f"it has version {version}, not {VERSION}; {remedy}")
    for robot in members:
        _check(robot)
    state = int(arrays["state"]) if "state" in arrays else None
    return Content(options, members, state)


def _members(arrays: Arrays, side: float) -> list[RobotEvidence]:
    """Return the evidence of the R robots of a file.

    `side` is that of a place, metres.
    """
    sums = arrays["sums"].astype(np.float64, casting="same_kind")
    columns = {
        **dict(zip(SUMS, sums, strict=True)),  # (N,) each
        "square": np.cumsum(arrays["squares"], axis=1, dtype=np.int32).T,  # (N, 2)
    }
    errors = arrays["errors"]
    surprises = arrays["surprises"]
    # (R, 3) each: how many places, errors and surprises a robot has, and the rows at
    # which they end.
    counts: Int64 = arrays["counts"]
    ends = np.cumsum(counts, axis=0)
    totals = [sums.shape[1], len(errors), len(surprises)]
    if (counts < 0).any() or ends[-1].tolist() != totals:
        raise ValueError("its counts cannot be true")
    # Files of TURNLESS_VERSION have none.
    arrays = {"turns": np.zeros((len(counts), 2)), **arrays}
    values = [arrays[name].tolist() for name in VALUES]
    members = []
    for robot, start, end in zip(
        zip(*values, strict=True), ends - counts, ends, strict=True
    ):
        identity, name, version, driven, faded, prior, turns = robot
        if len(prior) == OLD_FEATURES:
            prior = [0.0] * FEATURES
        of_places, of_errors, of_surprises = map(slice, start, end)
        parts = {name: column[of_places] for name, column in columns.items()}
        members.append(
            RobotEvidence(
                str(identity),
                str(name),
                Version(*version),
                driven,
                faded,
                np.array(prior),
                np.array(turns),
                Places(**parts, side=side),
                errors[of_errors],
                surprises[of_surprises],
            )
        )
    return members


def _check(robot: RobotEvidence) -> None:
    """Raise a ValueError if evidence from a file cannot be true."""
    places = robot.places
    is_there = places.weight > LEAST_WEIGHT  # else the place has faded away
    values = {
        **robot._asdict(),
        **places.sums(),
        "position": places.position,
        "slowness": places.sum_of_slowness[is_there] / places.weight[is_there],
    }
    for name, (dimensions, lowest, highest) in RANGES.items():
        array = np.asarray(values[name])
        is_possible = (array >= lowest) & (array <= highest)  # False for NaN
        if array.ndim != dimensions or not is_possible.all():
            raise ValueError(f"its {name} cannot be true")
    if len(robot.prior) != FEATURES or not places.are_in_order():
        raise ValueError("its prior or the order of its places cannot be true")
    if len(robot.turns) != 2 or robot.turns[0] < 0:
        raise ValueError("its turns cannot be true")


def _old_evidence(
    arrays: Arrays, options: Sequence[float], identity: str
) -> RobotEvidence:
    """Return the evidence of a file of an older version.

    The visits are assumed to differ by NOISE, and to have passed where robots wait.
    `options` are those of the file, in the order of `Experience.options`, and
    `identity` is to be that of the robot.
    """
    _, robot_width, half_life, _ = options
    driven = float(arrays["driven"])
    table = arrays["evidence"].astype(np.float64)
    # The first columns are weight and sum of the log slowness.
    weight, sum_of_log, *others = table.T
    if arrays["version"] == FIRST_VERSION:
        # Failures, x, y, and the seconds that were driven before the last visit.
        _, x, y, driven_before = others
        remaining = 0.5 ** ((driven - driven_before) / half_life)
        weight = weight * remaining
        sum_of_log = sum_of_log * remaining
        passages = np.zeros(len(weight))
        waited = passages
    else:
        # The weight of passages since a robot first waited near, the seconds waited, a
        # prediction, and x and y.
        passages, waited, _, x, y = others
    mean_log = sum_of_log / np.maximum(weight, LEAST_WEIGHT)
    # The mean of a lognormal, and the squares that give the variance NOISE.
    slowness = np.exp(mean_log + NOISE / 2)
    variance = NOISE * np.maximum(weight - 1, 0)
    side = robot_width / 2
    places = Places.at(
        np.column_stack([x, y]),
        side,
        weight=weight,
        sum_of_slowness=weight * slowness,
        sum_of_log=sum_of_log,
        sum_of_squares=sum_of_log * mean_log + variance,
        passages=np.maximum(passages, weight),
        waited=waited,
    )
    # What older versions expected says nothing of what this one expects: their errors,
    # surprises and networks, which predicted slowness from the map, are left out.
    return RobotEvidence.new("", side)._replace(
        identity=identity, version=Version(1, 0), driven=driven, places=places
    )


def _unpacked(data: bytes) -> dict[str, NDArray[Any]]:
    """Return the arrays in the bytes of an .npz file, by name; nothing is unpickled."""
    if not isinstance(data, (bytes, bytearray, memoryview)):
        remedy = "give the bytes that `to_bytes` or `changes_since` returned"
        raise ValueError(f"{reprlib.repr(data)} is not bytes; {remedy}")
    with np.lib.npyio.NpzFile(io.BytesIO(data)) as file:
        # A small file can claim arrays of any size.
        size = sum(entry.file_size for entry in file.zip.infolist())
        if size > MAX_FILE_BYTES:
            raise ValueError(f"it unpacks to {size} bytes, over {MAX_FILE_BYTES}")
        return dict(file)
