"""Saves and loads experience: a NumPy archive, in which nothing is pickled."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.experience.drives import FARTHEST
from ddqn_planner.experience.evidence import COLUMNS
from ddqn_planner.experience.experience import Experience
from ddqn_planner.files import remove_temporaries, write_atomically

VERSION = 1
OPTIONS = ("nominal_speed", "robot_width", "half_life", "max_pause")
SHAPES = {
    "places": (None, 2),
    "evidence": (None, len(COLUMNS)),
    "driven": (),
    "noise": (2,),
    "errors": (None,),
}


class ExperienceFileError(ValueError):
    """A file that cannot be used, with the reason."""


def save(experience: Experience, path: Path) -> None:
    """Write a temporary file and rename it; see `write_atomically` for errors."""
    evidence, forecasts = experience.evidence, experience.forecasts
    content = io.BytesIO()
    np.savez(
        content,
        version=VERSION,
        options=[getattr(experience, name) for name in OPTIONS],
        places=np.array(list(evidence.number), dtype=np.int64).reshape(-1, 2),
        evidence=evidence.table,
        driven=evidence.driven,
        noise=[forecasts.square_sum, forecasts.square_weight],
        errors=np.array(forecasts.errors),
    )
    write_atomically(path, content.getvalue())
    remove_temporaries(path)


def load(path: Path) -> Experience:
    """Read a file; an ExperienceFileError says why it cannot be used."""
    try:
        with zipfile.ZipFile(path) as archive:
            broken = archive.testzip()
        if broken is not None:
            raise ValueError(f"{broken} is damaged")
        with np.load(path, allow_pickle=False) as arrays:
            values = {name: arrays[name] for name in arrays.files}
        if int(values["version"]) != VERSION:
            raise ValueError(f"it has version {values['version']}, not {VERSION}")
        options = dict(zip(OPTIONS, values["options"].tolist(), strict=True))
        experience = Experience(**options)
        for name, shape in SHAPES.items():
            array = values[name]
            right = array.ndim == len(shape) and all(
                expected in (None, size) for expected, size in zip(shape, array.shape, strict=True)
            )
            if not right or array.dtype.kind not in "if" or not np.isfinite(array).all():
                raise ValueError(f"{name} has shape {array.shape} of {array.dtype}, or no numbers")
        _check_values(values)
    except Exception as error:  # broken bytes make zipfile and NumPy raise many kinds of errors
        raise ExperienceFileError(
            f"{path}: cannot be read ({error}); give a file that `Experience.save` wrote, or "
            "delete it to begin anew"
        ) from error
    experience.evidence.restore(values["places"], values["evidence"], float(values["driven"]))
    experience.forecasts.restore(values["noise"].tolist(), values["errors"].tolist())
    return experience


def _check_values(values: dict[str, NDArray[Any]]) -> None:
    places, evidence, driven = values["places"], values["evidence"], float(values["driven"])
    unique = len(np.unique(places, axis=0))
    if places.dtype.kind != "i" or not unique == len(places) == len(evidence):
        raise ValueError("its places and its evidence do not fit")
    amount, position, time = evidence[:, [0, 2]], evidence[:, 3:5], evidence[:, 5]
    if (amount < 0).any() or (np.abs(position) > FARTHEST).any() or (time > driven).any():
        raise ValueError("its evidence cannot be true")
    if values["noise"][0] < 0 or values["noise"][1] <= 0:
        raise ValueError("its noise cannot be true")
