"""Samples of calibrated sensors, kept for a few seconds and evaluated at the times of frames.

Orientation is interpolated on the geodesic, and extrapolated at the last angular velocity over a frame.
Acceleration is a weighted mean of the samples around a frame. The weights are the impulse response of what a
recording gets, a zero-phase low-pass and the triangle of +-1 frame (`BoneImuSequence.resample`); samples that
have not arrived yet are left out of the mean.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Final

import numpy as np

from rtof_kin.core import quaternions as quat
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Index
from rtof_kin.core.errors import UnknownNameError
from rtof_kin.data.imu import GRAVITY_WORLD, ImuCalibration

_LONGEST_GAP: Final = 0.1  # [s] between samples that is interpolated
_REACH: Final = 0.08  # [s] of the impulse response to either side
_STEP: Final = 0.001  # [s] of its table
_LEAST_SHARE: Final = 0.4  # of the response that samples must cover
_CAPACITY: Final = 1024  # samples of a sensor


class SensorBuffer:
    """The newest samples of S sensors.

    Attributes:
        joints: S segments. levers: (S, 3) positions of the sensors in them, m.
        newest: (S,) time of the newest sample of each, s; -inf before the first one.
        changed: earliest time whose values changed since `clean`, s.
    """

    def __init__(
        self, calibration: ImuCalibration, joints: tuple[str, ...], rate_hz: float, cutoff_hz: float | None
    ) -> None:
        """Begin empty. `cutoff_hz`: of the accelerations' low-pass; None for none."""
        self.joints = joints
        rows = [calibration.joints.index(joint) for joint in joints]
        self._calibration = calibration
        self._row = {calibration.sensors[row]: s for s, row in enumerate(rows)}
        self._R_world_inertial = calibration.R_world_inertial[rows]
        self._R_sensor_bone = calibration.R_sensor_bone[rows]
        self.levers = calibration.p_bone_sensor[rows]
        S = len(joints)
        self._count = np.zeros(S, dtype=int)
        self._times = np.full((S, _CAPACITY), np.inf)
        self._quat, self._a = np.zeros((S, _CAPACITY, 4)), np.zeros((S, _CAPACITY, 3))
        self._quat[..., 0] = 1.0
        self._fresh: list[tuple[int, int, Array, Array]] = []  # rotations and accelerations not converted yet
        self._heading, self._mounting = np.zeros(S), np.tile([1.0, 0.0, 0.0, 0.0], (S, 1))
        self._frame = 1 / rate_hz
        self._response = _response(rate_hz, cutoff_hz)
        self.newest = np.full(S, -np.inf)
        self.changed = np.inf

    def add(self, sensor: str, time: float, R_inertial_sensor: Array, f_sensor: Array) -> None:
        """Take a sample; those without an orientation are left out, as are further ones of the same time.

        `time`: s. R_inertial_sensor: (3, 3). f_sensor: (3,) m/s^2; NaN where missing. `UnknownNameError`: the sensor is
        not calibrated.
        """
        s = self._row.get(sensor)
        if s is None:
            if sensor in self._calibration.sensors:
                return  # on a segment that is not used
            raise UnknownNameError("sensor", [sensor], self._calibration.sensors)
        if not np.isfinite(R_inertial_sensor).all():
            return
        n = self._count[s]
        if n == _CAPACITY:
            n = self._halve(s)
        i = int(n)
        if n and time <= self._times[s, n - 1]:
            i = int(np.searchsorted(self._times[s, :n], time))
            if self._times[s, i] == time:
                return
            self._convert()
            for array in (self._times, self._quat, self._a):
                array[s, i + 1 : n + 1] = array[s, i:n]
        self._times[s, i] = time
        self._fresh.append((s, i, R_inertial_sensor, f_sensor))
        self._count[s] = n + 1
        self.newest[s] = max(self.newest[s], time)
        self.changed = min(self.changed, time)

    def clean(self) -> float:
        """Return the earliest time whose values have changed since the last call, s."""
        changed, self.changed = self.changed - _REACH, np.inf
        return changed

    def correct(self, heading: Mapping[str, float], R_mounting: Mapping[str, Array]) -> None:
        """Rotate what `at` returns from now on.

        `heading`: segment -> rotation about world's z, rad. R_mounting: segment -> (3, 3) in its axes.
        """
        for s, joint in enumerate(self.joints):
            self._heading[s] = heading.get(joint, 0.0)
            if joint in R_mounting:
                self._mounting[s] = so3.to_quat_wxyz(R_mounting[joint])

    def at(self, times: Array, *, corrected: bool = True) -> tuple[Array, Array, Array, Array]:
        """Return quaternions (F, S, 4) and whether known (F, S), accelerations (F, S, 3) and whether known.

        `times`: (F,) of frames, s. corrected: as `correct` asks for.
        """
        self._convert()
        S, F = len(self.joints), len(times)
        after = np.empty((S, F), dtype=int)
        for s, count in enumerate(self._count.tolist()):
            after[s] = self._times[s, :count].searchsorted(times)
        q, known = self._orientations(after, times)
        a, moved = self._accelerations(after, times)
        if corrected and (self._heading.any() or (self._mounting[:, 1:] != 0).any()):
            half = np.zeros((S, 1, 4))
            half[:, 0, 0], half[:, 0, 3] = np.cos(self._heading / 2), np.sin(self._heading / 2)
            q = quat.multiply(half, quat.multiply(q, self._mounting[:, None]))
            a = np.einsum("sij,sfj->sfi", so3.about_axis("z", self._heading), a)
        return q.swapaxes(0, 1), known.T, a.swapaxes(0, 1), moved.T

    def _orientations(self, after: Index, times: Array) -> tuple[Array, Array]:
        own = np.arange(len(after))[:, None]
        last = np.maximum(self._count[:, None] - 1, 1)
        right = np.clip(after, 1, last)
        left = right - 1
        begin, end = self._times[own, left], self._times[own, right]
        enough = self._count[:, None] > 1
        with np.errstate(invalid="ignore"):
            share = np.where(enough, (times - begin) / np.where(enough, end - begin, 1.0), 0.0)
            beyond = np.where(after > last, times - end, 0.0)
            before = np.where(after == 0, begin - times, 0.0)
            known = enough & (end - begin <= _LONGEST_GAP) & (beyond <= 1.2 * self._frame) & (before <= 1e-9)
        q0, q1 = self._quat[own, left], self._quat[own, right]
        turn = quat.log(quat.multiply(quat.conjugate(q0), q1))
        return quat.multiply(q0, quat.exp(np.where(known, share, 0.0)[..., None] * turn)), known

    def _accelerations(self, after: Index, times: Array) -> tuple[Array, Array]:
        own = np.arange(len(after))[:, None, None]
        rates = self._rates()
        around = int(np.ceil(_REACH * min(float(rates.max(initial=60.0)), 400.0))) + 1
        index = after[..., None] + np.arange(-around, around)
        there = (index >= 0) & (index < self._count[:, None, None])
        index = np.clip(index, 0, _CAPACITY - 1)
        a = self._a[own, index]
        there &= np.isfinite(a).all(axis=-1)
        with np.errstate(invalid="ignore"):
            apart = np.where(there, np.abs(self._times[own, index] - times[:, None]), np.inf)
        inside = np.minimum(np.round(np.minimum(apart, 1.0) / _STEP), len(self._response) - 1).astype(int)
        weight = self._response[inside]
        total = weight.sum(axis=-1)
        # Samples evenly spaced over the whole response would sum to the rate.
        known = total > _LEAST_SHARE * rates[:, None]
        mean = np.einsum("sfk,sfki->sfi", weight, np.where(there[..., None], a, 0.0))
        return np.where(known[..., None], mean / np.where(known, total, 1.0)[..., None], 0.0), known

    def _rates(self) -> Array:
        """(S,) Hz, over the last samples; 60 before there are some."""
        n = self._count
        own, back = np.arange(len(n)), np.maximum(n - 60, 0)
        many = n > 4
        with np.errstate(invalid="ignore"):
            span = np.where(many, self._times[own, np.maximum(n - 1, 0)] - self._times[own, back], 1.0)
        return np.where(many, (n - 1 - back) / np.maximum(span, 1e-6), 60.0)

    def _convert(self) -> None:
        """Convert the newest samples to quaternions and accelerations in world, all at once."""
        if self._fresh:
            s, i, R_inertial_sensor, f = map(list, zip(*self._fresh, strict=True))
            R = self._R_world_inertial[s] @ np.array(R_inertial_sensor)
            self._quat[s, i] = so3.to_quat_wxyz(R @ self._R_sensor_bone[s])
            self._a[s, i] = (R @ np.array(f)[:, :, None])[..., 0] + GRAVITY_WORLD
            self._fresh.clear()

    def _halve(self, s: int) -> int:
        self._convert()
        half = _CAPACITY // 2
        for array in (self._times, self._quat, self._a):
            array[s, :half] = array[s, half:]
        self._times[s, half:] = np.inf
        self._count[s] = half
        return half


@cache
def _response(rate_hz: float, cutoff_hz: float | None) -> Array:
    """Impulse response (n,) of low-pass and triangle at distances of `_STEP`, 1/s; the last one is 0."""
    count = round(4 * _REACH / _STEP)
    t = (np.arange(2 * count + 1) - count) * _STEP
    values = np.maximum(1 - np.abs(t) * rate_hz, 0.0) * rate_hz
    if cutoff_hz is not None:
        values = signals.low_pass(values, 1 / _STEP, cutoff_hz)
    out = values[count : count + round(_REACH / _STEP) + 1].copy()
    out[-1] = 0.0
    return np.asarray(out)
