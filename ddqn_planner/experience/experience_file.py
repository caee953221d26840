"""Saves and loads experience: a NumPy archive, in which nothing is pickled."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np

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
        evidence = values["evidence"]
        if len(values["places"]) != len(evidence) or (evidence[:, [0, 2]] < 0).any():
            raise ValueError("its places and its evidence do not fit")
    except Exception as error:  # broken bytes make zipfile and NumPy raise many kinds of errors
        raise ExperienceFileError(
            f"{path}: cannot be read ({error}); give a file that `Experience.save` wrote, or "
            "delete it to begin anew"
        ) from error
    experience.evidence.restore(values["places"], evidence, float(values["driven"]))
    experience.forecasts.restore(values["noise"].tolist(), values["errors"].tolist())
    return experience
