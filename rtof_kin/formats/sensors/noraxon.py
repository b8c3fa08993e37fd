"""CSV of Noraxon's myoRESEARCH: MyoMotion and Ultium Motion, all sensors of a trial in one file.

Three lines about the recording (type, name, ...) may stand above the names of the columns. Cells are
separated by commas, or by semicolons where numbers have decimal commas. A sensor is named by its segment,
with the side on a limb: ``Thigh LT``. The software has had several spellings; read are ``time``, s, and

=================  =======================================================================================
accelerometer      ``Thigh Accel Sensor X LT (mG)``, ``LT Thigh Accel Sensor X (mG)``,
                   ``Thigh Accel Sensor X LT,mG``: gravity included, sensor axes
gyroscope          ``Noraxon MyoMotion-Segments-Thigh LT-Gyroscope-x (deg/s)``, ``Thigh Gyro X LT (deg/s)``
=================  =======================================================================================

Course, pitch and roll, ``Rot``, and ``Acceleration`` of segments are not read, as no document says which
rotation or axes they mean: orientation comes from the two above (`rtof_kin.inertial.orientation`). Names in
other languages than English are not known. Joint angles and muscles' signals are ignored.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import FileFormatError
from rtof_kin.data.imu_stream import Declaration, SensorLog
from rtof_kin.formats.sensors.packets import lost
from rtof_kin.formats.sensors.readings import Readings, sensor_log
from rtof_kin.formats.sensors.sensor_text import SensorTable, cells, read_table

TITLE: Final = "Noraxon CSV"
_ACCELERATION, _RATE = "acceleration", "gyroscope"
_UNITS: Final = {
    _ACCELERATION: {"mG": "mg", "G": "g", "m/s^2": "m/s2", "m/s²": "m/s2"},
    _RATE: {"deg/s": "deg/s", "°/s": "deg/s", "rad/s": "rad/s"},
}
"""Spelling of a unit in the file -> in a declaration."""
_SEGMENT: Final = r"(?P<segment>[^-,()]+?)"
_SIDE: Final = r"(?: (?P<side>[LR]T))?"
_FORMS: Final = tuple(
    re.compile(form + r"\s*(?:\((?P<unit>[^()]*)\)|,\s*(?P<unit2>.*))\s*", re.IGNORECASE)
    for form in (
        rf"(?:(?P<before>[LR]T) )?{_SEGMENT} (?P<kind>Accel Sensor|Gyro) (?P<axis>[XYZ]){_SIDE}",
        rf"(?:Noraxon )?MyoMotion-Segments-{_SEGMENT}{_SIDE}-(?P<kind>Gyroscope)-(?P<axis>[xyz])",
    )
)


class _Column(NamedTuple):
    """Meaning of a column."""

    sensor: str
    kind: str
    axis: int
    unit: str


def is_noraxon(head: str) -> bool:
    """Implement `files.Format.recognise`."""
    return any(_is_header(cells(line)) for line in head.splitlines()[:8])


def _is_header(names: Iterable[str]) -> bool:
    return any(_meaning(name) is not None for name in names)


def _meaning(name: str) -> _Column | None:
    """Return what a column holds; None for one that is not read."""
    found = next((match for form in _FORMS if (match := form.fullmatch(name.strip()))), None)
    if found is None:
        return None
    parts = found.groupdict()
    kind = _ACCELERATION if found["kind"].lower().startswith("accel") else _RATE
    side = (parts.get("before") or parts["side"] or "").upper()
    unit = (found["unit"] if found["unit"] is not None else found["unit2"]).strip()
    return _Column(f"{found['segment']} {side}".strip(), kind, "xyz".index(found["axis"].lower()), unit)


def read_noraxon(path: Path, **declared: Any) -> SensorLog:
    """Implement `files.Format.read`; a declared `rate_hz` replaces the column of times."""
    table = read_table(path, _is_header, lambda name: name.lower() == "time" or bool(_meaning(name)), True)
    columns = {name: found for name in table.names if (found := _meaning(name)) is not None}
    own = Declaration(
        acceleration_unit=_unit(path, columns, _ACCELERATION, "mg"),  # type: ignore[arg-type]
        angular_unit=_unit(path, columns, _RATE, "deg/s"),  # type: ignore[arg-type]
    )
    declaration = own.changed(**declared)
    times = _times(table, declaration.rate_hz)
    sensors = dict.fromkeys(column.sensor for column in columns.values())
    readings = [
        Readings(
            name,
            times,
            acceleration=_vectors(table, columns, name, _ACCELERATION),
            gyroscope=_vectors(table, columns, name, _RATE),
        )
        for name in sensors
    ]
    return sensor_log([path], TITLE, readings, declaration, (*table.notes, *lost(times)))


def _unit(path: Path, columns: dict[str, _Column], kind: str, usual: str) -> str:
    """Return the unit of all columns of a kind, in the words of a declaration."""
    found = {column.unit: name for name, column in columns.items() if column.kind == kind}
    units = {_UNITS[kind].get(unit): name for unit, name in found.items()}
    if None in units:
        known = ", ".join(_UNITS[kind])
        raise FileFormatError(path, f"column {units[None]!r}: its unit is not one of {known}")
    if len(units) > 1:
        raise FileFormatError(path, f"columns {' and '.join(map(repr, units.values()))} have different units")
    return next(filter(None, units), usual)


def _vectors(table: SensorTable, columns: dict[str, _Column], sensor: str, kind: str) -> Array | None:
    """Return one quantity of a sensor (T, 3); None where absent."""
    named = {c.axis: name for name, c in columns.items() if (c.sensor, c.kind) == (sensor, kind)}
    if not named:
        return None
    count = sum((c.sensor, c.kind) == (sensor, kind) for c in columns.values())
    if len(named) < 3 or count > 3:
        there = ", ".join(name for name, c in columns.items() if (c.sensor, c.kind) == (sensor, kind))
        raise FileFormatError(table.path, f"{kind} of {sensor} needs x, y and z once each; there is {there}")
    return table.columns(*(named[axis] for axis in range(3)))


def _times(table: SensorTable, rate_hz: float | None) -> Array:
    if rate_hz is not None:
        return np.arange(len(table.values)) / rate_hz
    times = table.column("time")
    if times is None:
        raise FileFormatError(table.path, "no column time (s); export it, or declare rate_hz")
    return times
