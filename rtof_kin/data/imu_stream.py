"""Samples of inertial sensors in SI units: `SensorStream` of one sensor, `SensorLog` of a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from datetime import datetime, timedelta
from enum import Enum
from itertools import chain
from pathlib import Path
from typing import Any, Final, Literal, Self, get_args, get_type_hints

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import checked_names, checked_times, freeze, indices_of, shared
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.core.over_time import OverTime, Stream
from rtof_kin.data.imu import GRAVITY_WORLD, STANDARD_GRAVITY, ImuSequence

AccelerationUnit = Literal["m/s2", "g", "mg"]
Gravity = Literal["included", "removed"]
AccelerationAxes = Literal["sensor", "inertial"]
AngularUnit = Literal["rad/s", "deg/s"]
QuaternionOrder = Literal["wxyz", "xyzw"]
OrientationMaps = Literal["sensor to inertial", "inertial to sensor"]
InertialAxes = Literal["z up", "z down", "y up"]
_METRES = {"m/s2": 1.0, "g": STANDARD_GRAVITY, "mg": STANDARD_GRAVITY / 1000}
_UPRIGHT: dict[str, Array] = {
    "z up": np.eye(3),
    "z down": np.diag([1.0, -1.0, -1.0]),
    "y up": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}
"""Rotations from the reference axes to axes with z up."""


@dataclass(frozen=True)
class Declaration:
    """Units and conventions of a file. The defaults are those of this package.

    A format has a declaration, which the user may change; `rtof_kin.inertial.physics` checks it against the data.
    """

    acceleration_unit: AccelerationUnit = "m/s2"
    gravity: Gravity = "included"  #: 'included': 9.81 upwards at rest. 'removed': 0 at rest.
    acceleration_axes: AccelerationAxes = "sensor"
    """Axes of accelerations; 'inertial': those of the sensor's own reference."""
    angular_unit: AngularUnit = "rad/s"
    quaternion_order: QuaternionOrder = "wxyz"
    orientation_maps: OrientationMaps = "sensor to inertial"
    """Direction of the orientation; 'sensor to inertial' is R_inertial_sensor."""
    inertial_axes: InertialAxes = "z up"  #: 'z up': ENU, NWU. 'z down': NED. 'y up': as in computer graphics.
    rate_hz: float | None = None  #: Sampling rate, Hz; None: from time stamps or the header

    def __post_init__(self) -> None:
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                raise UnknownNameError(name.replace("_", " "), [str(getattr(self, name))], choices)
        if self.rate_hz is not None and not 0 < self.rate_hz < 1e5:
            raise InvalidInputError(f"rate_hz is {self.rate_hz:g}; give a positive number of samples per second")

    def changed(self, **values: Any) -> Self:
        """Return the declaration with other values of some fields. values: by field; None leaves it unchanged.
        `UnknownNameError`: an unknown field or value.
        """
        known = [f.name for f in fields(self)]
        unknown = [name for name in values if name not in known]
        if unknown:
            raise UnknownNameError("field of a declaration", unknown, known)
        return replace(self, **{k: v for k, v in values.items() if v is not None})

    def rotations(self, quaternions: Array) -> Array:
        """Return R_inertial_sensor (T, 3, 3), reference with z up; NaN where not finite or zero. quaternions: (T, 4) of
        the file, of any norm.
        """
        order = [0, 1, 2, 3] if self.quaternion_order == "wxyz" else [3, 0, 1, 2]
        quat_wxyz = np.asarray(quaternions, dtype=np.float64)[..., order]
        with np.errstate(over="ignore"):
            norm = np.linalg.norm(quat_wxyz, axis=-1)
        known = np.isfinite(norm) & (norm > 0)
        return self.upright(so3.known_from_quat_wxyz(np.where(known[..., None], quat_wxyz, np.nan)))

    def upright(self, R: Array) -> Array:
        """Return R_inertial_sensor (..., 3, 3), reference with z up; R: (..., 3, 3) rotation matrices of the file."""
        if self.orientation_maps == "inertial to sensor":
            R = np.swapaxes(R, -1, -2)
        return _UPRIGHT[self.inertial_axes] @ R

    def specific_force(self, acceleration: Array, R_inertial_sensor: Array | None = None) -> Array:
        """Return f_sensor (T, 3), m/s^2. `InvalidInputError`: it is required and not given.

        Args:
            acceleration: (T, 3) of the file.
            R_inertial_sensor: (T, 3, 3) from `rotations`; required if gravity was removed or axes are inertial.
        """
        a = np.asarray(acceleration, dtype=np.float64) * _METRES[self.acceleration_unit]
        if self.gravity == "included" and self.acceleration_axes == "sensor":
            return a
        if R_inertial_sensor is None:
            raise InvalidInputError(
                f"accelerations with gravity {self.gravity}, in {self.acceleration_axes} axes, are of no "
                "use without an orientation; log the raw accelerometer, or orientation beside it"
            )
        if self.acceleration_axes == "inertial":
            in_world: Array = a @ _UPRIGHT[self.inertial_axes].T
        else:
            in_world = np.einsum("tij,tj->ti", R_inertial_sensor, a)
        if self.gravity == "removed":
            in_world = in_world - GRAVITY_WORLD
        f: Array = np.einsum("tji,tj->ti", R_inertial_sensor, in_world)
        return f

    def angular_velocity(self, rate: Array) -> Array:
        """Return w_sensor (T, 3), rad/s; rate: (T, 3) of the file."""
        factor = np.pi / 180 if self.angular_unit == "deg/s" else 1.0
        return np.asarray(rate, dtype=np.float64) * factor

    # --- inverse: numbers of the file ------------------------------------------------------------

    def filed_rotations(self, R_inertial_sensor: Array) -> Array:
        """Invert `upright`: return the rotation matrices (..., 3, 3) of the file; R_inertial_sensor: (..., 3, 3)."""
        R: Array = _UPRIGHT[self.inertial_axes].T @ R_inertial_sensor
        return np.swapaxes(R, -1, -2) if self.orientation_maps == "inertial to sensor" else R

    def filed_quaternions(self, R_inertial_sensor: Array) -> Array:
        """Invert `rotations`: return unit quaternions (T, 4) of the file, up to sign; R_inertial_sensor: (T, 3, 3)."""
        quat = so3.known_to_quat_wxyz(self.filed_rotations(R_inertial_sensor))
        return quat if self.quaternion_order == "wxyz" else quat[..., [1, 2, 3, 0]]

    def filed_acceleration(self, f_sensor: Array, R_inertial_sensor: Array | None = None) -> Array:
        """Invert `specific_force`: return the accelerations (T, 3) of the file; f_sensor: (T, 3) m/s^2.
        R_inertial_sensor: (T, 3, 3), see `specific_force`.
        """
        if self.gravity == "included" and self.acceleration_axes == "sensor":
            return f_sensor / _METRES[self.acceleration_unit]
        if R_inertial_sensor is None:
            raise InvalidInputError("accelerations of these axes were made with an orientation; give it")
        a: Array = np.einsum("tij,tj->ti", R_inertial_sensor, f_sensor)
        if self.gravity == "removed":
            a = a + GRAVITY_WORLD
        if self.acceleration_axes == "inertial":
            a = a @ _UPRIGHT[self.inertial_axes]
        else:
            a = np.einsum("tji,tj->ti", R_inertial_sensor, a)
        return a / _METRES[self.acceleration_unit]

    def filed_angular_velocity(self, w_sensor: Array) -> Array:
        """Invert `angular_velocity`: return the angular velocities (T, 3) of the file; w_sensor: (T, 3) rad/s."""
        return w_sensor / self.angular_velocity(np.ones(1))


CHOICES: Final[dict[str, tuple[str, ...]]] = {
    name: get_args(kind) for name, kind in get_type_hints(Declaration).items() if name != "rate_hz"
}
"""Values of each field of `Declaration` except the rate."""


class FaultKind(Enum):
    """Fault and treatment, as a sentence."""

    SIDES = "left and right were exchanged in the keypoints; they were exchanged back"
    SIDES_IN_DOUBT = "left and right of the keypoints may be exchanged; when that ended is unclear, so they were kept"
    SOMEBODY_ELSE = "the keypoints jumped to another person and back; they were left out"
    JUMP = "the keypoints jumped and did not come back; which person is tracked is unclear"
    UNSEEN = "nobody is seen in this gap; positions in it are bridged, or not valid"
    ENDED = "no samples: stopped, began late, or out of reach; there the motion is from the rest alone"
    STUCK = "the sensor repeated one sample; it was left out"
    SATURATED = "the accelerometer was at the end of its range; its acceleration was left out"
    DISAGREES = (
        "the sensor's orientation disagreed with the image and the other sensors, e.g. because it slipped "
        "or its heading was disturbed; it was left out"
    )
    FOREIGN = "the sensor does not move as the video shows; it was left out"


@dataclass(frozen=True)
class StreamFault:
    """A fault of a stream over an interval."""

    kind: FaultKind
    what: str  #: Segment of the sensor, or the keypoints, e.g. those of the legs.
    start: float  #: Time of the first affected sample, s
    stop: float  #: Time of the last one, s

    def __post_init__(self) -> None:
        if not self.start <= self.stop:
            raise InvalidInputError(f"stream fault: it ends at {self.stop:g} s, before {self.start:g} s")

    def __str__(self) -> str:
        return f"{self.what}, {self.start:.2f} to {self.stop:.2f} s: {self.kind.value}"


@dataclass(frozen=True)
class SensorStream(OverTime):
    """Samples of one sensor at its own times.

    Quantities that it does not measure are None; missing samples are NaN; lost packets are gaps of its times.
    """

    name: str
    times: Array  #: (T,) s on the file's clock, strictly increasing
    f_sensor: Array | None = None  #: (T, 3) specific force in sensor axes, m/s^2: 9.81 upwards at rest
    R_inertial_sensor: Array | None = None
    """(T, 3, 3) orientation in a reference with z up; NaN as a whole where missing."""
    w_sensor: Array | None = None  #: (T, 3) angular velocity in sensor axes, rad/s
    m_sensor: Array | None = None  #: (T, 3) magnetic field in sensor axes, in the manufacturer's unit
    quaternion_norm: Array | None = None  #: (T,) norm of the quaternions in the file; None without quaternions
    notes: tuple[str, ...] = ()  #: Remarks for the user, e.g. lost packets, estimated orientation.
    rows = ("f_sensor", "R_inertial_sensor", "w_sensor", "m_sensor", "quaternion_norm")

    def __post_init__(self) -> None:
        set_, where = object.__setattr__, f"sensor {self.name}"
        set_(self, "times", checked_times(f"{where} times", self.times))
        set_(self, "notes", tuple(self.notes))
        T = len(self.times)
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(self.rows, (T, 3))
        shapes |= {"R_inertial_sensor": (T, 3, 3), "quaternion_norm": (T,)}
        freeze(self, where, **{n: shape for n, shape in shapes.items() if getattr(self, n) is not None})

    @property
    def holds(self) -> tuple[str, ...]:
        """Names of the measured arrays."""
        names = ("f_sensor", "w_sensor", "m_sensor", "R_inertial_sensor")
        return tuple(name for name in names if getattr(self, name) is not None)

    @property
    def rate_hz(self) -> float:
        """Sampling rate, Hz, from the median step; NaN for fewer than two samples."""
        return float(1 / np.median(np.diff(self.times))) if len(self) > 1 else float("nan")

    def between(self, start: float, stop: float) -> SensorStream | None:
        """Return the samples from start to before stop; None where there are fewer than two. start, stop: s."""
        a, b = np.searchsorted(self.times, [start, stop])
        return None if b - a < 2 else replace(self[a:b], quaternion_norm=None)

    def imu(self) -> ImuSequence:
        """Return orientation and specific force for a recording. `InvalidInputError`: one of them is missing."""
        if self.R_inertial_sensor is None or self.f_sensor is None:
            missing = "orientation" if self.R_inertial_sensor is None else "acceleration"
            raise InvalidInputError(
                f"sensor {self.name} has no {missing}; orientation comes from raw gyroscope and "
                "accelerometer by rtof_kin.inertial.orientation"
            )
        return ImuSequence(self.times, self.R_inertial_sensor[:, None], self.f_sensor[:, None], (self.name,))


@dataclass(frozen=True)
class SensorLog:
    """Sensors of a file or folder."""

    path: Path
    format: str  #: Format in words
    streams: tuple[SensorStream, ...]
    declaration: Declaration  #: Units and conventions of the file
    file_notes: tuple[str, ...] = ()  #: Remarks on the file as a whole
    start_utc: datetime | None = None
    """Date and time of the earliest sample, with its zone UTC; None where the file does not state it."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "streams", tuple(self.streams))
        if self.start_utc is not None and self.start_utc.utcoffset() != timedelta(0):
            raise InvalidInputError(f"start_utc of {self.path}: {self.start_utc} is not in UTC")
        checked_names(f"sensors of {self.path}", self.names)

    @classmethod
    def of_imus(cls, imus: ImuSequence | Stream[ImuSequence], path: str | Path) -> Self:
        """Return the sensors of a recording, which are read by blocks."""
        stream = Stream.of(imus)
        names, T, start = stream.part(slice(0, 1)).names, len(stream), 0
        arrays = [(np.empty((T, 3)), np.empty((T, 3, 3))) for _ in names]
        for block in stream.blocks():
            rows = slice(start, start := start + len(block))
            for s, (f, R) in enumerate(arrays):
                f[rows], R[rows] = block.f_sensor[:, s], block.R_inertial_sensor[:, s]
        shared(*chain(*arrays))
        streams = (SensorStream(name, stream.times, *own) for name, own in zip(names, arrays, strict=True))
        return cls(Path(path), "IMUs of a recording", tuple(streams), Declaration())

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the file, then on each sensor by name."""
        own = (f"{stream.name}: {note}" for stream in self.streams for note in stream.notes)
        return (*self.file_notes, *own)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sensors."""
        return tuple(stream.name for stream in self.streams)

    def select(self, names: Sequence[str]) -> Self:
        """Return sensors in the order of `names`. `UnknownNameError`: a sensor does not exist."""
        index = indices_of("sensor", names, self.names)
        return replace(self, streams=tuple(self.streams[i] for i in index))

    def renamed(self, names: Mapping[str, str]) -> Self:
        """Rename sensors, e.g. from serial numbers to segments. `UnknownNameError`: a sensor does not exist.
        `InvalidInputError`: two would have the same name.
        """
        indices_of("sensor", list(names), self.names)
        streams = [replace(s, name=names.get(s.name, s.name)) for s in self.streams]
        return replace(self, streams=tuple(streams))
