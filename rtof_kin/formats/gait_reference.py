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

A table of normal curves (CSV) gives means and standard deviations alone: columns ``variable`` (a name of
`VARIABLES`), ``percent`` of the gait cycle, ``mean`` and ``sd``, in degrees; ``sd`` may be absent or empty. Instants
from 0 to 100 % that are at most 5 % apart; others than the 51 of the scores are interpolated linearly.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import Strict

from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import indices_of
from rtof_kin.core.errors import FileFormatError, UnknownNameError, reading
from rtof_kin.core.files.input_table import ArrayOf, InputTable, Integer, Names, Number, Vector2
from rtof_kin.core.files.text import csv_rows, load_json, write_text
from rtof_kin.data.gait_reference import NAMES, PERCENT, SHAPE, VARIABLES, GaitReference

FORMAT: Final = "gait reference"
VERSION: Final = 1
LARGEST: Final = 256 * 2**20  #: Largest file, bytes: ten thousand people
_SIDES: Final = ("right", "left")
_DIGITS: Final = 6
Curve = Annotated[Array, ArrayOf(SHAPE[1])]  #: 51 numbers, deg


class VariableTable(InputTable):
    """Mean and standard deviation of a variable, deg."""

    positive: str = ""
    zero: str = ""
    mean: Curve
    sd: Curve | None = None


class PersonTable(InputTable):
    """Curves of a person by variable, deg, and what they are of."""

    person: str
    strides: Vector2
    speed_m_per_s: Number | None = None
    right: dict[str, Curve]
    left: dict[str, Curve]


class ReferenceTable(InputTable):
    """The file."""

    format: Literal["gait reference"]
    version: Literal[1]
    unit: Literal["deg"]
    licence: str
    source: str
    system: str
    zero: str
    people: Integer
    speed_m_per_s: Vector2 | None = None
    notes: Names = ()
    variables: dict[str, VariableTable] = {}
    curves: Annotated[tuple[PersonTable, ...], Strict(False)] = ()


def read_gait_reference(path: str | Path) -> GaitReference:
    """Read a reference. `FileFormatError`: it is none, or a field is missing or wrong, which is named;
    `UnknownNameError`: unknown field or variable.
    """
    path = Path(path)
    data = load_json(path, LARGEST, "a reference of gait scores, which rtof-kin gait-reference writes")
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise FileFormatError(path, f'no reference of gait scores: it begins with "format": "{FORMAT}"')
    if isinstance(variables := data.get("variables"), dict):
        indices_of(f"field in {path}, [variables]", [*variables], NAMES)
    file = ReferenceTable.of(data, path)
    mean, sd = np.full(SHAPE, np.nan), np.full(SHAPE, np.nan)
    for v, name in enumerate(NAMES):
        if name in file.variables:
            own = file.variables[name]
            mean[v] = own.mean
            if own.sd is not None:
                sd[v] = own.sd
    people: dict[str, Any] = {}
    if file.curves:
        people = {
            "curves": np.radians([[_curves(one, side) for side in _SIDES] for one in file.curves]),
            "names": tuple(one.person for one in file.curves),
            "strides": tuple((int(one.strides[0]), int(one.strides[1])) for one in file.curves),
            "speeds": tuple(math.nan if one.speed_m_per_s is None else one.speed_m_per_s for one in file.curves),
        }
    speeds = file.speed_m_per_s
    with reading(path):
        return GaitReference(
            np.radians(mean),
            np.radians(sd),
            file.people,
            licence=file.licence,
            source=file.source,
            system=file.system,
            zero=file.zero,
            **people,
            notes=file.notes,
            speed_range=None if speeds is None else (float(speeds[0]), float(speeds[1])),
        )


def _curves(person: PersonTable, side: str) -> list[Array]:
    """Return the curves of all variables of a side, deg."""
    given: dict[str, Array] = getattr(person, side)
    indices_of(f"field in {person.path}, {person.where(side)}", [*given], NAMES)
    if missing := [name for name in NAMES if name not in given]:
        raise person.error(f"{side}.{missing[0]}", f"missing; add {SHAPE[1]} numbers")
    return [given[name] for name in NAMES]


def write_gait_reference(path: str | Path, reference: GaitReference, overwrite: bool = False) -> None:
    """Write a reference, to a millionth of a degree; errors as `core.files.folder.new_file`."""
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


_COLUMNS: Final = ("variable", "percent", "mean", "sd")
_WIDEST: Final = 5.0  # largest distance of two instants, per cent
_LARGEST: Final = 16 * 2**20


def read_gait_reference_table(path: str | Path, *, negated: Collection[str] = (), **about: Any) -> GaitReference:
    """Read a table. `FileFormatError`: a cell, an instant or a variable is missing or wrong, which is named;
    `UnknownNameError`: a name in `negated` is no variable.

    Args:
        negated: variables whose sign in the table is the opposite of `VARIABLES`.
        about: fields of `GaitReference`: people, licence, source, system, zero, speed_range, notes.
    """
    if unknown := [name for name in negated if name not in NAMES]:
        raise UnknownNameError("gait variable", unknown, NAMES)
    found: dict[str, dict[float, tuple[float, float]]] = {}
    rows = csv_rows(Path(path), "a table with the columns variable, percent, mean, sd", _COLUMNS[:3], _LARGEST)
    for line, row in rows:
        if (name := row["variable"]) not in NAMES:
            raise FileFormatError(path, str(UnknownNameError("variable", [name[:60]], NAMES)), line)
        percent, middle, spread = (_number(Path(path), line, column, row) for column in _COLUMNS[1:])
        own = found.setdefault(name, {})
        if percent in own:
            raise FileFormatError(path, f"{name} at {percent:g} % occurs twice", line)
        own[percent] = middle, spread
    if not found:
        raise FileFormatError(path, "no rows below the header")
    mean, sd = np.full(SHAPE, np.nan), np.full(SHAPE, np.nan)
    for name, samples in found.items():
        sign, v = -1 if name in negated else 1, NAMES.index(name)
        curve, deviation = _curve(path, name, samples)
        mean[v], sd[v] = sign * curve, deviation
    with reading(path):
        return GaitReference(np.radians(mean), np.radians(sd), **about)


def _number(path: Path, line: int, column: str, row: dict[str, str]) -> float:
    """Number of a cell; NaN for an empty or absent standard deviation."""
    text = row.get(column, "").strip()
    if column == "sd" and not text:
        return math.nan
    try:
        value = float(text)
    except ValueError:
        value = math.inf
    if not math.isfinite(value):
        raise FileFormatError(path, f"{column}: {text[:40]!r} is not a finite number", line)
    return value


def _curve(path: str | Path, name: str, samples: dict[float, tuple[float, float]]) -> tuple[Array, Array]:
    """Mean and standard deviation (51,) of one variable, in degrees."""
    at = np.array(sorted(samples))
    if at[0] != 0 or at[-1] != 100 or np.diff(at).max() > _WIDEST:
        raise FileFormatError(
            path,
            f"{name}: {len(at)} instants from {at[0]:g} to {at[-1]:g} %; needed are those from 0 to "
            f"100 %, at most {_WIDEST:g} % apart",
        )
    values = np.array([samples[percent] for percent in at.tolist()])
    mean, sd = (np.interp(PERCENT, at, column) for column in values.T)
    return mean, sd
