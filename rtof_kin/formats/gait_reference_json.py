"""A reference of the gait scores as one JSON file: degrees, at 0, 2, ..., 100 % of the gait cycle.

::

    {
      "format": "gait reference", "version": 1,
      "licence": "CC-BY-4.0", "source": "who was recorded, where and how; or a citation",
      "system": "rtof_kin 0.1.0", "zero": "model", "people": 12, "unit": "deg",
      "speed_m_per_s": [1.0, 1.5], "notes": ["..."],
      "variables": {
        "pelvic_tilt": {"positive": "anterior ...", "zero": "upright ...", "mean": [51 numbers], "sd": [...]},
        ...
      },
      "curves": [
        {"person": "P01", "speed_m_per_s": 1.2, "strides": [5, 6],
         "right": {"pelvic_tilt": [51 numbers], ...}, "left": {...}}
      ]
    }

Required are all of the first block but speed and notes, and one variable. `zero` is "model" (the anatomical posture of
the model), "standing" (each person's quiet standing) or, of another system, its definition. `positive` and the zero of
a variable are for readers; the signs are those of `VARIABLES`. Unknown fields are refused.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError, InvalidInputError
from rtof_kin.core.files.section import Section
from rtof_kin.core.files.text import load_json, write_text
from rtof_kin.data.gait_reference import NAMES, SHAPE, VARIABLES, GaitReference

FORMAT: Final = "gait reference"
VERSION: Final = 1
LARGEST: Final = 256 * 2**20
"""Largest file, bytes: ten thousand people."""
_SIDES: Final = ("right", "left")
_DIGITS: Final = 6


def read_gait_reference(path: str | Path) -> GaitReference:
    """Read a reference.

    Raises:
        FileFormatError: it is none, or a field is missing or wrong, which is named. UnknownNameError: unknown
            field or variable.
    """
    path = Path(path)
    data = load_json(path, LARGEST, "a reference of gait scores, which rtof-kin gait-reference writes")
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise FileFormatError(path, f'no reference of gait scores: it begins with "format": "{FORMAT}"')
    file = Section(path, data)
    file.text("format")
    if (version := file.integer("version")) != VERSION:
        raise file.error("version", f"{version} is not known; this release reads {VERSION}")
    if (unit := file.text("unit")) != "deg":
        raise file.error("unit", f"{unit!r}; angles are in degrees: deg")
    mean, sd = _means(file.table("variables"))
    curves, people = _curves(file.tables("curves"))
    speeds = file.optional_array("speed_m_per_s", (2,))
    fields: dict[str, Any] = {name: file.text(name) for name in ("licence", "source", "system", "zero")}
    count, notes = file.integer("people"), file.optional_names("notes") or ()
    file.close()
    try:
        return GaitReference(
            mean,
            sd,
            count,
            **fields,
            curves=curves,
            **people,
            notes=notes,
            speed_range=None if speeds is None else (float(speeds[0]), float(speeds[1])),
        )
    except InvalidInputError as error:
        raise FileFormatError(path, str(error)) from error


def _means(variables: Section) -> tuple[Array, Array]:
    """Means and standard deviations (9, 51) rad; NaN for absent variables."""
    mean, sd = np.full(SHAPE, np.nan), np.full(SHAPE, np.nan)
    for v, name in enumerate(NAMES):
        if variables.has(name):
            own = variables.table(name)
            mean[v] = own.array("mean", SHAPE[1:])
            if own.has("sd"):
                sd[v] = own.array("sd", SHAPE[1:])
            for words in ("positive", "zero"):
                own.text(words, "")
            own.close()
    variables.close()
    return np.radians(mean), np.radians(sd)


def _curves(people: list[Section]) -> tuple[Array | None, dict[str, Any]]:
    """Curves (N, 2, 9, 51) rad, and names, strides and speeds of the people."""
    if not people:
        return None, {}
    curves = np.empty((len(people), 2, *SHAPE))
    names, strides, speeds = [], [], []
    for one, own in zip(curves, people, strict=True):
        names.append(own.text("person"))
        count = own.array("strides", (2,))
        strides.append((int(count[0]), int(count[1])))
        speed = own.optional_number("speed_m_per_s")
        speeds.append(math.nan if speed is None else speed)
        for s, side in enumerate(_SIDES):
            table = own.table(side)
            for v, name in enumerate(NAMES):
                one[s, v] = table.array(name, SHAPE[1:])
            table.close()
        own.close()
    return np.radians(curves), {"names": tuple(names), "strides": tuple(strides), "speeds": tuple(speeds)}


def write_gait_reference(path: str | Path, reference: GaitReference, overwrite: bool = False) -> None:
    """Write a reference, to a millionth of a degree.

    Args:
        overwrite: replace an existing file.

    Raises:
        OutputExistsError: the file exists and `overwrite` is False. WritingError: it cannot be written.
    """
    about = {name: getattr(reference, name) for name in ("licence", "source", "system", "zero", "people")}
    data: dict[str, Any] = {"format": FORMAT, "version": VERSION} | about | {"unit": "deg"}
    if reference.speed_range is not None:
        data["speed_m_per_s"] = list(reference.speed_range)
    data["notes"] = list(reference.notes)
    data["variables"] = {
        variable.name: {"positive": variable.positive, "zero": variable.zero, "mean": _degrees(mean)}
        | ({"sd": _degrees(sd)} if np.isfinite(sd).all() else {})
        for variable, mean, sd in zip(VARIABLES, reference.mean, reference.sd, strict=True)
        if np.isfinite(mean).all()
    }
    if reference.curves is not None:
        data["curves"] = [_person(reference, k) for k in range(reference.people)]
    write_text(Path(path), json.dumps(data, indent=1, allow_nan=False) + "\n", overwrite)


def _person(reference: GaitReference, k: int) -> dict[str, Any]:
    assert reference.curves is not None
    sides = zip(_SIDES, reference.curves[k], strict=True)
    strides = reference.strides[k] if reference.strides else (1, 1)
    out: dict[str, Any] = {"person": reference.names[k], "strides": list(strides)}
    if reference.speeds and math.isfinite(reference.speeds[k]):
        out["speed_m_per_s"] = round(reference.speeds[k], 4)
    return out | {
        side: {name: _degrees(curve) for name, curve in zip(NAMES, curves, strict=True)} for side, curves in sides
    }


def _degrees(curve: Array) -> list[float]:
    return [round(value, _DIGITS) for value in np.degrees(curve).tolist()]
