"""Search for the declaration under which a sensor's numbers obey physics.

The declared conversion is undone and another one applied, for every combination of the relevant choices;
of those that obey the laws, the one with the fewest changes is the likeliest meaning of the file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from rtof_kin.core.plausibility import Check
from rtof_kin.data.imu_declaration import CHOICES, Declaration
from rtof_kin.data.imu_stream import SensorStream
from rtof_kin.inertial import gravity, turning

Array = NDArray[np.float64]
_SAMPLES = 600  # spread over the recording, for gravity
_STEPS = 3000  # for turning
_LEAST_FACTOR = 3.0  # between the best declaration's excess and the next one's
_OF_TURNING = ("angular_unit", "quaternion_order", "orientation_maps")


def redeclared(stream: SensorStream, declared: Declaration, other: Declaration) -> SensorStream:
    """Convert a stream as if its file had been declared otherwise.

    Args:
        stream: the sensor. declared: its declaration. other: the new one.

    Raises:
        InvalidInputError: the new declaration needs an orientation and there is none.
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
    """Return the smallest changes of a declaration under which most streams obey the laws.

    Args:
        streams: of one file, those that fail. declared: their declaration.

    Returns:
        The best first; only the best if it is clearly better; empty if no change helps.
    """
    cases = [_Case(stream, declared) for stream in streams]
    found: list[tuple[float, Mapping[str, str]]] = []
    for changes in _changes(streams, declared):
        if found and len(changes) > len(found[0][1]):
            break
        other = declared.changed(**changes)
        excess = float(np.median([case.excess(other) for case in cases]))
        if excess <= 1:
            found.append((excess, changes))
    found.sort(key=lambda pair: pair[0])
    if len(found) > 1 and found[1][0] > _LEAST_FACTOR * found[0][0]:
        found = found[:1]
    return [changes for _, changes in found]


def _changes(streams: Sequence[SensorStream], declared: Declaration) -> Iterator[Mapping[str, str]]:
    """Generate all changes of the fields that concern the streams' channels, the fewest first."""
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
    """One stream and its excess over the laws' limits under any declaration."""

    def __init__(self, stream: SensorStream, declared: Declaration):
        self._declared = declared
        every = max(1, len(stream) // _SAMPLES)
        self._thinned = _part(stream, slice(None, None, every))
        self._rest = gravity.at_rest(stream)[::every]
        self._start = replace(_part(stream, slice(_STEPS)), f_sensor=None)
        self._shift = turning.delay(stream)
        self._per_metre = gravity.turning_acceleration(stream)
        self._turning = cache(self._of_turning)

    def excess(self, other: Declaration) -> float:
        """Return the largest figure of a law as a multiple of its limit."""
        excess = self._turning(*(getattr(other, field) for field in _OF_TURNING))
        if excess > 1:
            return excess
        stream = redeclared(self._thinned, self._declared, other)
        checks = gravity.gravity_checks(stream, self._rest, self._per_metre)
        return max(excess, *map(_excess, checks))

    def _of_turning(self, *values: str) -> float:
        other = self._declared.changed(**dict(zip(_OF_TURNING, values, strict=True)))
        return _excess(turning.gyroscope(redeclared(self._start, self._declared, other), self._shift))


def _part(stream: SensorStream, samples: slice) -> SensorStream:
    parts = {name: getattr(stream, name) for name in (*stream.holds, "times", "quaternion_norm")}
    return replace(stream, **{k: v[samples] for k, v in parts.items() if v is not None})


def _excess(check: Check) -> float:
    """Return value over limit, 0 where unknown."""
    return float(np.nan_to_num(check.value / check.limit))
