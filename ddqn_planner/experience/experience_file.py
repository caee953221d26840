"""The files that hold experience, and the bytes that tell others of changes."""

from __future__ import annotations

import hashlib
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.experience.fleet import Change, RobotEvidence, Version
from ddqn_planner.experience.places import (
    FARTHEST,
    LEAST_WEIGHT,
    NOISE,
    SUMS,
    Float64,
    Int64,
    Places,
)
from ddqn_planner.experience.prior import FEATURES
from ddqn_planner.grid.arguments import MAX_SLOWNESS

MAX_FILE_BYTES = 2**27  # a larger file is refused before it is read
VERSION = 4
LOG_VERSION = 3  # of one robot, with the logarithms of slowness alone
FIRST_VERSION = 1  # until 0.4.0; 2 was never released
LOG_RANGE = -math.log(MAX_SLOWNESS), math.log(MAX_SLOWNESS)
MOST = 1e12  # no sum of what drives showed is greater: seconds, weights or squares
MOST_OF_PRIOR = 100.0  # so much no feature of a map raises the log slowness

Arrays = Mapping[str, NDArray[Any]]


class Content(NamedTuple):
    """What a file holds."""

    options: list[float]  # in the order of `Experience.options`
    members: list[RobotEvidence]  # of each robot; first that of the own robot


class Changes(NamedTuple):
    """Changes of one evidence, one after another."""

    state: int  # of the fleet before the first change, see `Fleet.state`
    changes: list[Change]


class Seen(Protocol):
    """What one or more drives showed."""

    @property
    def places(self) -> Places:
        """The sums over places."""

    @property
    def errors(self) -> Float64:
        """The errors of drives, (D,)."""

    @property
    def surprises(self) -> Float64:
        """The surprises of drives, (D,)."""


class Part(NamedTuple):
    """What the arrays of a file hold of one `Seen`."""

    places: Places
    errors: Float64
    surprises: Float64


def content_to_bytes(content: Content) -> bytes:
    """Return the bytes of a file, an .npz file of named arrays."""
    members = content.members
    arrays: dict[str, Any] = {
        "version": VERSION,
        "options": content.options,
        "robots": [robot.robot for robot in members],  # (R,) for R robots
        "identities": [robot.identity for robot in members],
        "versions": [robot.version for robot in members],  # (R, 2)
        "driven": [robot.driven for robot in members],
        "faded": [robot.faded for robot in members],
        "priors": [robot.prior for robot in members],  # (R, FEATURES)
        **_arrays_of(members),
    }
    return _packed(arrays)


def changes_to_bytes(state: int, changes: Sequence[Change]) -> bytes:
    """Return the bytes of one or more changes of evidence; see `Changes`."""
    return _packed(
        {
            "version": VERSION,
            "state": state,
            "tokens": [change.token for change in changes],  # (K,) for K changes
            "shares": [change.share for change in changes],
            "seconds": [change.seconds for change in changes],
            **_arrays_of(changes),
        }
    )


def content_from_bytes(data: bytes) -> Content:
    """Return what a file of these bytes holds; an exception if it holds no experience.

    Broken bytes make zipfile and NumPy raise many kinds of errors.
    """
    arrays = _unpacked(data)
    version = int(arrays["version"])
    if version not in (FIRST_VERSION, LOG_VERSION, VERSION):
        raise ValueError(f"it has version {version}, not {VERSION}")
    options: list[float] = arrays["options"].astype(np.float64).tolist()
    side = options[1] / 2
    if version == VERSION:
        members = _members(arrays, side)
    else:
        # Copies of an old file are the evidence of the same robot.
        identity = hashlib.sha256(data).hexdigest()[:32]
        members = [_old_evidence(version, arrays, options, identity)]
    return Content(options, members)


def changes_from_bytes(data: bytes, side: float) -> Changes:
    """Return the changes of which these bytes tell; an exception if there are none.

    `side` is that of a place, metres. Broken bytes make zipfile and NumPy raise many
    kinds of errors.
    """
    arrays = _unpacked(data)
    version = int(arrays["version"])
    if version != VERSION:
        raise ValueError(f"it has version {version}, not {VERSION}")
    parts = _parts(arrays, side)
    tokens: list[int] = arrays["tokens"].tolist()
    shares: list[float] = arrays["shares"].tolist()
    seconds: list[float] = arrays["seconds"].tolist()
    if not all(0 < share <= 1 for share in shares):
        raise ValueError("its shares cannot be true")
    if not all(0 <= spent <= MOST for spent in seconds):
        raise ValueError("its seconds cannot be true")
    if not all(0 <= token < 2**63 for token in tokens):
        raise ValueError("its tokens cannot be true")
    changes = [
        Change(token, share, spent, *part)
        for token, share, spent, part in zip(
            tokens, shares, seconds, parts, strict=True
        )
    ]
    return Changes(int(arrays["state"]), changes)


def _arrays_of(parts: Sequence[Seen]) -> dict[str, Any]:
    """Return the arrays from which `_parts` makes K parts again.

    All places stand one after another, and so do the errors and the surprises.
    """
    places = [part.places for part in parts]
    square = np.concatenate([part.square for part in places])  # (N, 2)
    sums = [
        np.concatenate([getattr(part, name) for part in places]) for name in SUMS
    ]  # (N,) each
    return {
        "counts": [
            (len(part.places), len(part.errors), len(part.surprises)) for part in parts
        ],  # (K, 3)
        "errors": np.concatenate([part.errors for part in parts]),
        "surprises": np.concatenate([part.surprises for part in parts]),
        # Columns that hardly change from row to row are compressed to a few bytes.
        "squares": np.diff(square, axis=0, prepend=np.int32(0)).T,  # (2, N) int32
        "offsets": np.concatenate([part.offset for part in places]).T,  # (2, N) uint8
        "sums": np.array(sums, np.float32),  # (len(SUMS), N)
    }


def _parts(arrays: Arrays, side: float) -> list[Part]:
    """Return the K parts whose arrays a file holds; a ValueError if they are wrong."""
    counts: Int64 = arrays["counts"].astype(np.int64, casting="same_kind")  # (K, 3)
    square = np.cumsum(arrays["squares"].T, axis=0, dtype=np.int32)  # (N, 2)
    offset = arrays["offsets"].T.astype(np.uint8, casting="same_kind")
    sums = arrays["sums"].astype(np.float64, casting="same_kind")
    errors = arrays["errors"].astype(np.float64, casting="same_kind")
    surprises = arrays["surprises"].astype(np.float64, casting="same_kind")
    totals = [len(square), len(errors), len(surprises)]
    if (counts < 0).any() or counts.sum(axis=0).tolist() != totals:
        raise ValueError("its counts cannot be true")
    # (K - 1,) each: the first row of each part but the first.
    rows, rows_of_errors, rows_of_surprises = np.cumsum(counts, axis=0)[:-1].T
    places = [
        Places(
            **dict(zip(SUMS, sums_of_part, strict=True)),
            side=side,
            square=square_of_part,
            offset=offset_of_part,
        )
        for sums_of_part, square_of_part, offset_of_part in zip(
            np.split(sums, rows, axis=1),
            np.split(square, rows),
            np.split(offset, rows),
            strict=True,
        )
    ]
    columns = (
        places,
        np.split(errors, rows_of_errors),
        np.split(surprises, rows_of_surprises),
    )
    parts = [Part(*column) for column in zip(*columns, strict=True)]
    for part in parts:
        _check(part)
    return parts


def _check(part: Part) -> None:
    """Raise a ValueError if a part of a file cannot be true."""
    places = part.places
    columns = places.sums()
    values = [*columns.values(), part.errors, part.surprises]
    are_finite = all(np.isfinite(array).all() for array in values)
    # Logarithms may be negative; all other sums are 0 or more.
    are_positive = all(
        (array >= 0).all() for name, array in columns.items() if name != "sum_of_log"
    )
    are_small = all((np.abs(array) <= MOST).all() for array in values)
    # Of places that did not fade away. Rounding may change a sum a little.
    is_there = places.weight > LEAST_WEIGHT
    slowness = places.sum_of_slowness[is_there] / places.weight[is_there]
    is_slow_enough = slowness > 0.5 / MAX_SLOWNESS
    is_fast_enough = slowness < 2 * MAX_SLOWNESS
    has_speeds = (is_slow_enough & is_fast_enough).all()
    is_near = (np.abs(places.position) <= FARTHEST).all()
    is_possible = are_finite and are_positive and are_small and has_speeds
    if not (is_possible and is_near and places.are_in_order()):
        raise ValueError("its evidence cannot be true")


def _members(arrays: Arrays, side: float) -> list[RobotEvidence]:
    """Return the evidence of the R robots of a file, the own robot's first."""
    robots: list[str] = arrays["robots"].astype(np.str_).tolist()
    identities: list[str] = arrays["identities"].astype(np.str_).tolist()
    versions: Int64 = arrays["versions"].astype(np.int64, casting="same_kind")
    driven = arrays["driven"].astype(np.float64, casting="same_kind")
    faded = arrays["faded"].astype(np.float64, casting="same_kind")
    priors = arrays["priors"].astype(np.float64, casting="same_kind")
    is_possible = (
        len(identities) > 0
        and len(set(identities)) == len(identities)
        and all((values >= 0).all() for values in (versions, driven, faded))
        and priors.shape == (len(identities), FEATURES)
        and all((np.abs(values) <= MOST).all() for values in (driven, faded))
        and (np.abs(priors) <= MOST_OF_PRIOR).all()
    )
    if not is_possible:
        raise ValueError("its robots cannot be true")
    columns = zip(
        identities,
        robots,
        versions.tolist(),
        driven.tolist(),
        faded.tolist(),
        priors,
        _parts(arrays, side),
        strict=True,
    )
    return [
        RobotEvidence(identity, robot, Version(*version), *row, *part)
        for identity, robot, version, *row, part in columns
    ]


def _old_evidence(
    version: int, arrays: Arrays, options: list[float], identity: str
) -> RobotEvidence:
    """Return the evidence of a file of an older version.

    `options` are those of the file, in the order of `Experience.options`, and
    `identity` is to be that of the robot.
    """
    _, robot_width, half_life, _ = options
    side = robot_width / 2
    table = arrays["evidence"].astype(np.float64)
    driven = float(arrays["driven"])
    if version == FIRST_VERSION:
        table = _without_dates(table, driven, half_life)
    columns = _sums_of_logs(table)
    places = Places.at(table[:, 5:7], side, **columns)
    # The first files have neither errors nor surprises.
    no_drives = np.zeros(0)
    errors = arrays.get("errors", no_drives).astype(np.float64)
    surprises = arrays.get("surprises", no_drives).astype(np.float64)
    part = Part(places, errors, surprises)
    _check(part)
    if not 0 <= driven < math.inf or errors.ndim != 1 or surprises.ndim != 1:
        raise ValueError("its evidence cannot be true")
    no_prior = np.zeros(FEATURES)  # or a network, which is left out
    return RobotEvidence(identity, "", Version(1, 0), driven, 0.0, no_prior, *part)


def _without_dates(table: Float64, driven: float, half_life: float) -> Float64:
    """Return the table of a file of version 1 as one of version 3, (N, 7).

    Parameters
    ----------
    table : (N, 6) float64
        The columns are weight, sum of the log slowness, failures, x, y, and the seconds
        that were driven before the last visit.
    driven, half_life : float
        Seconds.
    """
    weight = table[:, 0]
    sum_of_log = table[:, 1]
    driven_before = table[:, 5]
    half_lives = (driven - driven_before) / half_life  # since the last visit
    remaining = 0.5**half_lives
    zeros = np.zeros((len(table), 3))  # no passages, waits and predictions
    position = table[:, 3:5]
    return np.column_stack(
        [weight * remaining, sum_of_log * remaining, zeros, position]
    )


def _sums_of_logs(table: Float64) -> dict[str, Float64]:
    """Return the sums of `Places` of which a file of version 3 holds a part.

    The visits are assumed to differ by NOISE, and to have passed where robots wait.

    Parameters
    ----------
    table : (N, 7) float64
        The columns are weight, sum of the log slowness, the weight of passages since a
        robot first waited near, the seconds waited, a prediction, and x and y.
    """
    weight, sum_of_log, passages, waited, _, _, _ = table.T
    mean_log = sum_of_log / np.maximum(weight, LEAST_WEIGHT)
    # The mean of a lognormal, and the squares that give the variance NOISE.
    slowness = np.exp(np.clip(mean_log, *LOG_RANGE) + NOISE / 2)
    variance = NOISE * np.maximum(weight - 1, 0)
    return {
        "weight": weight,
        "sum_of_slowness": weight * slowness,
        "sum_of_log": sum_of_log,
        "sum_of_squares": sum_of_log * mean_log + variance,
        "passages": np.maximum(passages, weight),
        "waited": waited,
    }


def _packed(arrays: Mapping[str, Any]) -> bytes:
    """Return the bytes of a compressed .npz file."""
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    return content.getvalue()


def _unpacked(data: bytes) -> dict[str, NDArray[Any]]:
    """Return the arrays in the bytes of an .npz file, by name; nothing is unpickled."""
    with np.lib.npyio.NpzFile(io.BytesIO(data)) as file:
        # A small file can claim arrays of any size.
        size = sum(entry.file_size for entry in file.zip.infolist())
        if size > MAX_FILE_BYTES:
            raise ValueError(f"it unpacks to {size} bytes, over {MAX_FILE_BYTES}")
        return dict(file)
