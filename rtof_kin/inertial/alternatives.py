"""Which other declaration, or which constant rotation, makes physics hold on the same numbers.

The declared conversion is undone and another one made, for every combination of the choices that matter;
of those under which the laws hold, the one with the fewest changes is likely what the file means.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core import rotations as so3
from rtof_kin.core.plausibility import Check
from rtof_kin.data.imu_declaration import CHOICES, Declaration
from rtof_kin.data.imu_stream import SensorStream
from rtof_kin.inertial import gravity, turning

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
_SAMPLES = 600
"""So many, spread over the recording, tell gravity."""
_STEPS = 3000
"""So many tell the turning."""
_CLEARLY = 3.0
"""The likely declaration is so many times closer to the laws than one with as few changes."""
_FLAT = 0.01
"""Turning about a further axis is known if it has such a share of the first one's power."""
_OF_TURNING = ("angular_unit", "quaternion_order", "orientation_maps")


def redeclared(stream: SensorStream, declared: Declaration, other: Declaration) -> SensorStream:
    """The stream as it would be, had its file been declared otherwise.

    Raises:
        ShapeError: the other declaration needs an orientation, and there is none.
    """
    f, R, w = stream.f_sensor, stream.R_inertial_sensor, stream.w_sensor
    new_R = R
    if R is not None and stream.quaternion_norm is not None:
        new_R = other.rotations(declared.filed_quaternions(R))
    elif R is not None:
        new_R = other.upright(declared.filed_rotations(R))
    if f is not None:
        f = other.specific_force(declared.filed_acceleration(f, R), new_R)
    if w is not None:
        w = other.angular_velocity(declared.filed_angular_velocity(w))
    return replace(stream, f_sensor=f, R_inertial_sensor=new_R, w_sensor=w)


def likely_changes(streams: Sequence[SensorStream], declared: Declaration) -> list[Mapping[str, str]]:
    """The changes of a declaration that make the laws hold for most of the streams together.

    Args:
        streams: of one file, those that do not obey.
        declared: what they were read as.

    Returns:
        With the fewest changes, the best first; only the first where it is clearly the best. Empty where
        nothing helps.
    """
    cases = [_Case(stream, declared) for stream in streams]
    found: dict[int, list[tuple[float, Mapping[str, str]]]] = {}
    for changes in _changes(streams, declared):
        if not found or len(changes) <= min(found):
            other = declared.changed(**changes)
            excess = float(np.median([case.excess(other) for case in cases]))
            if excess <= 1:
                found.setdefault(len(changes), []).append((excess, changes))
    if not found:
        return []
    best = sorted(found[min(found)], key=lambda pair: pair[0])
    if len(best) > 1 and best[1][0] > _CLEARLY * best[0][0]:
        best = best[:1]
    return [changes for _, changes in best]


def _changes(streams: Sequence[SensorStream], declared: Declaration) -> Iterator[Mapping[str, str]]:
    """All changes of the fields that matter to what the streams hold, the fewest first."""
    held = {name for stream in streams for name in stream.holds}
    fields = []
    if "f_sensor" in held:
        fields += ["acceleration_unit"]
    if "w_sensor" in held:
        fields += ["angular_unit"]
    if "R_inertial_sensor" in held:
        fields += ["orientation_maps", "inertial_axes"]
        fields += ["gravity", "acceleration_axes"] if "f_sensor" in held else []
        if any(stream.quaternion_norm is not None for stream in streams):
            fields += ["quaternion_order"]
    every = [
        {k: v for k, v in zip(fields, values, strict=True) if v != getattr(declared, k)}
        for values in product(*(CHOICES[field] for field in fields))
    ]
    yield from sorted((changes for changes in every if changes), key=len)


class _Case:
    """One stream and how far it is from the laws under any declaration."""

    def __init__(self, stream: SensorStream, declared: Declaration):
        self.declared = declared
        rest = gravity.at_rest(stream)
        every = max(1, len(stream) // _SAMPLES)
        self.thinned, self.rest = _part(stream, slice(None, None, every)), rest[::every]
        self.start = _part(stream, slice(_STEPS))
        self.shift = turning.delay(stream)
        self.per_metre = gravity.turning_acceleration(stream)
        self.of_turning = cache(self._of_turning)

    def excess(self, other: Declaration) -> float:
        """The largest figure of a law, as a multiple of its limit."""
        excess = self.of_turning(*(getattr(other, field) for field in _OF_TURNING))
        return max(excess, self._of_gravity(other)) if excess <= 1 else excess

    def _of_turning(self, *values: str) -> float:
        other = self.declared.changed(**dict(zip(_OF_TURNING, values, strict=True)))
        stream = redeclared(replace(self.start, f_sensor=None), self.declared, other)
        return _excess(turning.gyroscope(stream, self.shift))

    def _of_gravity(self, other: Declaration) -> float:
        stream = redeclared(self.thinned, self.declared, other)
        of_gravity = (gravity.specific_force, gravity.gravity_direction, gravity.mean_acceleration)
        checks = [law(stream, self.rest) for law in of_gravity]
        return max(map(_excess, [*checks, gravity.lever_arm(stream, self.per_metre)]))


def _part(stream: SensorStream, samples: slice) -> SensorStream:
    arrays = (*stream.holds, "times", "quaternion_norm")
    parts = {name: getattr(stream, name) for name in arrays}
    return replace(stream, **{k: v[samples] for k, v in parts.items() if v is not None})


def _excess(check: Check) -> float:
    """0 where nothing can be told."""
    return float(np.nan_to_num(check.value / check.limit))


# --- a constant rotation -------------------------------------------------------------------------


@dataclass(frozen=True)
class FixedAxes:
    """A constant change of axes that makes the orientation turn as the gyroscope does."""

    R_sensor_oriented: Array
    """(3, 3) orthogonal: from the axes whose orientation the file gives to those of the gyroscope."""
    residual: float
    """Root mean square of what is left, rad/s."""

    @property
    def mirrored(self) -> bool:
        """Whether the two differ in handedness, as of an axis with the wrong sign."""
        return bool(np.linalg.det(self.R_sensor_oriented) < 0)

    def applied(self, stream: SensorStream) -> SensorStream:
        """The stream with the orientation of the gyroscope's axes; only of axes that are not mirrored."""
        R = stream.R_inertial_sensor
        return replace(stream, R_inertial_sensor=None if R is None else R @ self.R_sensor_oriented.T)

    def __str__(self) -> str:
        nearest = np.round(self.R_sensor_oriented)
        if np.abs(self.R_sensor_oriented - nearest).max() < 0.1:
            rows = [(int(np.argmax(np.abs(row))), row) for row in nearest]
            axes = ", ".join(("-" if row[i] < 0 else "") + "xyz"[i] for i, row in rows)
            return f"the gyroscope's x, y, z are {axes} of the orientation's axes"
        if self.mirrored:
            return "the gyroscope's axes are the orientation's, mirrored and turned"
        turn = so3.log(self.R_sensor_oriented)
        x, y, z = so3.unit(turn)
        angle = np.degrees(np.linalg.norm(turn))
        return (
            f"the orientation is of axes turned against the sensor's by a constant {angle:.1f} deg about "
            f"({x:.2f}, {y:.2f}, {z:.2f})"
        )


def fixed_axes(stream: SensorStream) -> FixedAxes | None:
    """The constant orthogonal matrix that takes the orientation's rates to the gyroscope's (Wahba 1965).

    Returns:
        None where too little is known, the sensor does not turn about at least two axes, or no such
        matrix makes the two agree.
    """
    pair = turning.both_rates(stream)
    if pair is None:
        return None
    measured, expected = pair
    known: slice | Mask = slice(None)
    for _ in range(2):  # once more without what the first one does not explain
        H = measured[known].T @ expected[known]
        U, size, Vt = np.linalg.svd(H)
        if not size[1] > _FLAT * size[0]:
            return None
        R = U @ Vt if size[2] > _FLAT * size[0] else so3.nearest_rotation(H)
        off = np.linalg.norm(measured - expected @ R.T, axis=-1)
        known = off <= np.quantile(off, 0.95)
    residual = turning.trimmed_rms(measured - expected @ R.T)
    return FixedAxes(R, residual) if residual <= turning.turning_limit(expected) else None


def likely_rate(stream: SensorStream) -> float | None:
    """Samples per second under which the orientation turns as fast as the gyroscope says; None where it
    does not turn so under any.
    """
    pair = turning.both_rates(stream)
    if pair is None:
        return None
    measured, expected = pair
    scale = float(np.sum(measured * expected) / max(np.sum(expected**2), 1e-12))
    expected = scale * expected
    agree = turning.trimmed_rms(measured - expected) <= turning.turning_limit(expected)
    return scale * stream.rate_hz if agree and scale > 0 else None
