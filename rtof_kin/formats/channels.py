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
        """Return what the channels hold.

        Args:
            stream: its name; of the sensor too, where labels name none.
            labels, units, types: of each channel; units and types may be empty.
            declared: fields of `Declaration`; they replace what the stream states.

        Raises:
            InvalidInputError: no sensor, an incomplete quantity, a channel twice, an unknown unit, or sensors
                of different conventions; names stream and channel.
            UnknownNameError: an unknown field or value of the declaration.
        """
        declared = {k: v for k, v in (declared or {}).items() if v is not None}
        sorted_ = _Sorted.of(stream, labels, types)
        own, stated = sorted_.stated(units)
        declaration = own.changed(**stated).changed(**declared)
        notes = [
            f"stream {stream}: its metadata states {stated[field]}, {declared[field]} is declared and taken"
            for field in stated
            if declared.get(field, stated[field]) != stated[field]
        ]
        if sorted_.left:
            notes.append(f"stream {stream}: channels left out: {_some(sorted_.left)}")
        sensors = tuple(sorted_.sensor(name, declaration) for name in sorted_.names)
        return cls(len(labels), sensors, declaration, tuple(notes))


@dataclass(frozen=True)
class _Sorted:
    """Columns of a stream by sensor, quantity and axis."""

    stream: str
    labels: tuple[str, ...]
    found: Mapping[tuple[str, str], dict[str, int]]  #: (sensor, quantity) -> axis -> column
    left: tuple[str, ...]  #: Labels that are none of these

    @classmethod
    def of(cls, stream: str, labels: Sequence[str], types: Sequence[str]) -> _Sorted:
        found: dict[tuple[str, str], dict[str, int]] = {}
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
        return cls(stream, tuple(labels), found, tuple(left))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(sensor for sensor, _ in self.found))

    def stated(self, units: Sequence[str]) -> tuple[Declaration, dict[str, str]]:
        """Return the declaration of the quantities' names, and the units of the metadata by field."""
        stated: dict[str, str] = {}
        for (_, kind), axes in self.found.items():
            for column in axes.values():
                unit = units[column].strip() if column < len(units) else ""
                field = _UNIT_OF.get(kind)
                if field is None or not unit:
                    continue
                known = _UNITS[field]
                value = next((one for one, names in known.items() if unit.lower() in names), None)
                where = f"stream {self.stream}, channel {self.labels[column]!r}"
                if value is None:
                    raise InvalidInputError(f"{where}: unknown unit {unit!r}; give {' or '.join(known)}")
                if stated.setdefault(field, value) != value:
                    raise InvalidInputError(f"{where}: is in {value}, others in {stated[field]}; give one unit")
        kinds = {self._acceleration(name) for name in self.names} - {None}
        if len(kinds) > 1:
            raise InvalidInputError(
                f"stream {self.stream}: some sensors have acceleration with gravity and some without; send all alike"
            )
        own = Declaration()
        if "free" in kinds or "linear" in kinds:
            own = Declaration(gravity="removed", acceleration_axes="inertial" if "free" in kinds else "sensor")
        return own, stated

    def _acceleration(self, sensor: str) -> str | None:
        return next((kind for kind in _ACCELERATIONS if (sensor, kind) in self.found), None)

    def sensor(self, name: str, declaration: Declaration) -> SensorChannels:
        order = "wxyz"
        quaternions = self.found.get((name, "quaternion"))
        if quaternions is not None:
            if any(axis in "0123" for axis in quaternions):
                order = "0123"
            elif declaration.quaternion_order == "xyzw":
                order = "xyzw"
        acceleration = self._acceleration(name)
        return SensorChannels(
            name,
            self._columns(name, "quaternion", order),
            None if acceleration is None else self._columns(name, acceleration, "xyz"),
            self._columns(name, "gyroscope", "xyz"),
            self._columns(name, "magnetometer", "xyz"),
        )

    def _columns(self, sensor: str, kind: str, axes: str) -> Columns | None:
        found = self.found.get((sensor, kind))
        if found is None:
            return None
        lacking = [axis for axis in axes if axis not in found]
        if lacking:
            there = ", ".join(repr(self.labels[column]) for column in found.values())
            raise InvalidInputError(
                f"stream {self.stream}, sensor {sensor}: its {kind} has channels {there} and no "
                f"{', '.join(lacking)}; send all {len(axes)}"
            )
        return np.array([found[axis] for axis in axes])


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
