"""What the channels of a stream hold, by their names: readings of inertial sensors, or detected points.

A label is a quantity and an axis, with a sensor's name before it where the stream has several: ``acc_x``,
``pelvis_qw``, ``Pelvis.quat_w``, ``L_LowArm/acc_x``. Case and separators (``_ . / : -``, space) are free.

=============  ==================================================  =========================================
quantity       names                                               meaning unless declared otherwise
=============  ==================================================  =========================================
quaternion     q, quat, quaternion, ori, orientation; w, x, y, z   sensor to a reference with z up
               or 0, 1, 2, 3                                       numbers are in the declared order
acceleration   a, f, acc, accel, accelerometer, acceleration,      specific force in sensor axes, m/s^2
               specific_force
free           freeacc, free_acceleration                          without gravity, axes of the reference
linear         linacc, linear_acceleration, user_acceleration      without gravity, sensor axes
gyroscope      w, g, gyr, gyro, gyroscope, angular_velocity        rad/s, sensor axes
magnetometer   m, mag, magnetometer                                any unit
=============  ==================================================  =========================================
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu_stream import Declaration
from rtof_kin.formats.sensors.readings import Readings

_S: Final = r"[\s_./:-]"  #: Separators within a label
_ACCELERATIONS: Final = ("acceleration", "free", "linear")
"""Quantities that an acceleration comes from, in order of preference."""
_KINDS: Final = {
    "quaternion": r"q|quat|quaternion|ori|orientation",
    "free": rf"free{_S}?acc(?:el|eleration)?",
    "linear": rf"(?:lin|linear|user){_S}?acc(?:el|eleration)?",
    "acceleration": rf"a|f|acc|accel|accelerometer|acceleration|specific{_S}?force",
    "gyroscope": rf"w|g|gyr|gyro|gyroscope|angular{_S}?(?:velocity|rate)",
    "magnetometer": r"m|mag|magnetometer|magnetic(?:{_S}?field)?",
}
_GROUP: Final = "|".join(f"(?P<{kind}>{names})" for kind, names in _KINDS.items())
_LABEL: Final = re.compile(rf"(?:(?P<sensor>.+?){_S}+)??(?:{_GROUP}){_S}?(?P<axis>[wxyz0-3])", re.IGNORECASE)
_TYPE: Final = re.compile(_GROUP, re.IGNORECASE)
_AXIS: Final = re.compile(rf"(?:(?P<sensor>.+?){_S}+)??(?P<axis>[wxyz0-3])", re.IGNORECASE)
_UNITS: Final = {
    "acceleration_unit": {
        "m/s2": ("m/s2", "m/s^2", "m/s²", "m/s/s", "m/s**2", "ms-2", "m s-2", "meters_per_second_squared"),
        "g": ("g", "gee", "g0"),
        "mg": ("mg", "millig", "milli-g"),
    },
    "angular_unit": {
        "rad/s": ("rad/s", "rad s-1", "radians/s", "radians/second", "radians_per_second", "rps"),
        "deg/s": ("deg/s", "°/s", "dps", "deg s-1", "degrees/s", "degrees/second", "degrees_per_second"),
    },
}
"""Field of `Declaration` -> its values -> their spellings in metadata."""
_UNIT_OF: Final = {
    "acceleration": "acceleration_unit",
    "free": "acceleration_unit",
    "linear": "acceleration_unit",
    "gyroscope": "angular_unit",
}
_POINT_ENDINGS: Final = {"_u_px": "x", "_v_px": "y", "_x": "x", "_y": "y", "_z": "", "_presence": ""} | dict.fromkeys(
    ("_confidence", "_visibility", "_score", "_likelihood", "_c", "_v"), "c"
)
POINT_ENDINGS: Final = tuple(_POINT_ENDINGS)  #: Endings of the names of a point's columns
_NUMBERED_POINT: Final = re.compile(r"(x|y|z|v|c|visibility|confidence|score|presence)_?(\d{1,4})")
_PIXELS: Final = ("", "px", "pixel", "pixels")

Columns = NDArray[np.intp]


@dataclass(frozen=True)
class SensorChannels:
    """Columns of one sensor; None where the stream lacks the quantity."""

    name: str
    quaternions: Columns | None  #: (4,) in the declared order
    acceleration: Columns | None  #: (3,)
    gyroscope: Columns | None  #: (3,)
    magnetometer: Columns | None  #: (3,)

    def readings(self, times: Array, values: Array) -> Readings:
        """Return this sensor's readings of the stream's values (T, C) at times (T,), s."""
        acceleration, gyroscope, magnetometer, quaternions = (
            None if columns is None else np.asarray(values[:, columns], dtype=float)
            for columns in (self.acceleration, self.gyroscope, self.magnetometer, self.quaternions)
        )
        return Readings(self.name, times, acceleration, gyroscope, magnetometer, quaternions)


@dataclass(frozen=True)
class StreamChannels:
    """Inertial sensors of one stream."""

    count: int  #: Number of channels
    sensors: tuple[SensorChannels, ...]
    declaration: Declaration  #: Units and conventions of the numbers
    notes: tuple[str, ...]  #: Remarks for the user, in sentences

    @classmethod
    def of(
        cls,
        stream: str,
        labels: Sequence[str],
        units: Sequence[str] = (),
        types: Sequence[str] = (),
        declared: Mapping[str, Any] | None = None,
    ) -> StreamChannels:
        """Return what the channels hold. `InvalidInputError`: no sensor, an incomplete quantity, a channel twice, an
        unknown unit, or sensors of different conventions; names stream and channel. `UnknownNameError`: an unknown
        field or value of the declaration.

        Args:
            stream: its name; of the sensor too, where labels name none.
            labels, units, types: of each channel; units and types may be empty.
            declared: fields of `Declaration`; they replace what the stream states.
        """
        declared = {k: v for k, v in (declared or {}).items() if v is not None}
        found, left = _by_quantity(stream, labels, types)
        stated = _stated_units(stream, labels, units, found)
        names = dict.fromkeys(sensor for sensor, _ in found)
        of = {name: next((kind for kind in _ACCELERATIONS if (name, kind) in found), None) for name in names}
        kinds = set(of.values()) - {None}
        if len(kinds) > 1:
            raise InvalidInputError(
                f"stream {stream}: some sensors have acceleration with gravity and some without; send all alike"
            )
        own = Declaration()
        if kinds & {"free", "linear"}:
            own = Declaration(gravity="removed", acceleration_axes="inertial" if "free" in kinds else "sensor")
        declaration = own.changed(**stated).changed(**declared)
        notes = [
            f"stream {stream}: its metadata states {stated[field]}, {declared[field]} is declared and taken"
            for field in stated
            if declared.get(field, stated[field]) != stated[field]
        ]
        if left:
            notes.append(f"stream {stream}: channels left out: {_some(left)}")

        def columns(sensor: str, kind: str | None, axes: str) -> Columns | None:
            own = found.get((sensor, kind or ""))
            if own is None:
                return None
            if kind == "quaternion" and own.keys() & set("0123"):
                axes = "0123"
            lacking = [axis for axis in axes if axis not in own]
            if lacking:
                there = ", ".join(repr(labels[column]) for column in own.values())
                raise InvalidInputError(
                    f"stream {stream}, sensor {sensor}: its {kind} has channels {there} and no "
                    f"{', '.join(lacking)}; send all {len(axes)}"
                )
            return np.array([own[axis] for axis in axes])

        sensors = tuple(
            SensorChannels(
                name,
                columns(name, "quaternion", declaration.quaternion_order),
                columns(name, of[name], "xyz"),
                columns(name, "gyroscope", "xyz"),
                columns(name, "magnetometer", "xyz"),
            )
            for name in names
        )
        return cls(len(labels), sensors, declaration, tuple(notes))


_Found = dict[tuple[str, str], dict[str, int]]  # (sensor, quantity) -> axis -> column


def _by_quantity(stream: str, labels: Sequence[str], types: Sequence[str]) -> tuple[_Found, list[str]]:
    """Return the columns of a stream, and labels that are none of an inertial sensor."""
    found: _Found = {}
    left = []
    for column, label in enumerate(labels):
        meaning = _meaning(label.strip(), types[column].strip() if column < len(types) else "")
        if meaning is None:
            left.append(label)
            continue
        sensor, kind, axis = meaning
        axes = found.setdefault((sensor or stream, kind), {})
        if axis in axes:
            raise InvalidInputError(
                f"stream {stream}: channels {labels[axes[axis]]!r} and {label!r} are both {axis} of the "
                f"{kind} of {sensor or stream}; give each label once"
            )
        axes[axis] = column
    if not found:
        raise InvalidInputError(
            f"stream {stream}: no channel of an inertial sensor among {_some(labels) or 'its labels'}; "
            "label them qw, qx, qy, qz, acc_x, acc_y, acc_z, with the sensor's name before, as in "
            "pelvis_qw, where the stream has several"
        )
    return found, left


def _stated_units(stream: str, labels: Sequence[str], units: Sequence[str], found: _Found) -> dict[str, str]:
    """Return the units of the metadata by field of `Declaration`."""
    stated: dict[str, str] = {}
    for field, column in ((_UNIT_OF.get(kind), c) for (_, kind), axes in found.items() for c in axes.values()):
        unit = units[column].strip() if column < len(units) else ""
        if field is None or not unit:
            continue
        known = _UNITS[field]
        value = next((one for one, names in known.items() if unit.lower() in names), None)
        where = f"stream {stream}, channel {labels[column]!r}"
        if value is None:
            raise InvalidInputError(f"{where}: unknown unit {unit!r}; give {' or '.join(known)}")
        if stated.setdefault(field, value) != value:
            raise InvalidInputError(f"{where}: is in {value}, others in {stated[field]}; give one unit")
    return stated


def _meaning(label: str, type_: str) -> tuple[str, str, str] | None:
    """Return sensor ("" if none), quantity and axis of a channel; None where it is nothing known."""
    found = _LABEL.fullmatch(label)
    kinds = found or _TYPE.fullmatch(type_)
    found = found or _AXIS.fullmatch(label)
    if found is None or kinds is None:
        return None
    kind = next(kind for kind in _KINDS if kinds[kind])
    axis = found["axis"].lower()
    if kind != "quaternion" and axis not in "xyz":
        return None
    return found["sensor"] or "", kind, axis


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")


@dataclass(frozen=True)
class PointChannels:
    """Detected points of one stream."""

    count: int  #: Number of channels
    names: tuple[str, ...]  #: L names
    uv: Columns  #: (L, 2) columns, px
    confidence: Columns  #: (L,) columns; -1 where the stream has none

    @classmethod
    def of(cls, stream: str, labels: Sequence[str], units: Sequence[str] = ()) -> PointChannels:
        """Return what the channels hold: ``<landmark>_x``, ``_y`` in px, and ``_confidence``; units may be empty.
        `InvalidInputError`: no point, one without x or y, a channel twice, or coordinates not in px.
        """
        found: dict[str, dict[str, int]] = {}
        for column, label in enumerate(labels):
            point, part = point_part(label) or ("", "")
            where = f"stream {stream}, channel {label!r}"
            if not part:
                continue
            if part in found.setdefault(point, {}):
                raise InvalidInputError(f"{where}: a second {part} of {point}; give each label once")
            unit = units[column].strip() if column < len(units) else ""
            if part in "xy" and unit.lower() not in _PIXELS:
                raise InvalidInputError(f"{where}: unit {unit!r}; send coordinates in px")
            found[point][part] = column
        found = {point: parts for point, parts in found.items() if parts.keys() & {"x", "y"}}
        for point, parts in found.items():
            lacking = [part for part in "xy" if part not in parts]
            if lacking:
                raise InvalidInputError(f"stream {stream}, point {point}: no channel {point}_{lacking[0]}")
        if not found:
            raise InvalidInputError(
                f"stream {stream}: no points among {_some(labels) or 'its labels'}; label channels "
                "<landmark>_x, <landmark>_y, <landmark>_confidence"
            )
        uv = np.array([[parts["x"], parts["y"]] for parts in found.values()])
        return cls(len(labels), tuple(found), uv, np.array([parts.get("c", -1) for parts in found.values()]))

    def points(self, values: Array) -> tuple[Array, Array]:
        """Return uv_px (T, L, 2), NaN where unseen, and confidence (T, L) in [0, 1], 0 where unseen, of values
        (T, C).
        """
        uv = np.array(values[:, self.uv], dtype=float)
        confidence = np.where(self.confidence < 0, 1.0, values[:, self.confidence]).clip(0, 1)
        missing = ~np.isfinite(uv).all(axis=-1) | ~(confidence > 0)
        uv[missing], confidence[missing] = np.nan, 0.0
        return uv, confidence


def point_part(label: str) -> tuple[str, str] | None:
    """Return the point of a column and its part: x, y, c, or '' if unused; None where it is of no point."""
    numbered = _NUMBERED_POINT.fullmatch(label.strip().lower())
    if numbered:
        part = numbered[1]
        return str(int(numbered[2])), part if part in "xy" else "" if part in ("z", "presence") else "c"
    for ending, part in _POINT_ENDINGS.items():
        if label.strip().lower().endswith(ending):
            return label.strip()[: -len(ending)], part
    return None
