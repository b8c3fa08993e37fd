"""Orientation from raw gyroscope, accelerometer and magnetometer by VQF.

Laidig and Seel, Information Fusion 91 (2023), in the library of its authors. The offline filter uses the
past and the future of each sample, the causal one only the past.

Axes of a phone, with the screen towards the viewer: x to the right, y up, z out of the screen, as Android and iOS
define them; the camera at its back looks along -z.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import scipy

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.packages import optional
from rtof_kin.data.camera_motion import CameraMotion
from rtof_kin.data.imu_stream import SensorLog, SensorStream

_MOST_STEPS = 100  # of the filter for each sample
_LONGEST_BRIDGED = 0.1  # [s] of a gap that is interpolated; the filter restarts after longer ones
_SHORTEST_PIECE = 1.0  # [s] of samples without a longer gap, for the filter to settle


@dataclass(frozen=True)
class OrientationSettings:
    """Settings of the orientation filter."""

    magnetometer: bool | None = None  # whether it gives the heading; None: if there is one
    causal: bool = False  # whether only the past of each sample is used
    rate_hz: float | None = None  # [Hz] sampling rate; None: from the stream's median step

    def __post_init__(self) -> None:
        if self.rate_hz is not None and not 0 < self.rate_hz < np.inf:
            raise InvalidInputError(f"orientation rate_hz is {self.rate_hz}; it must be positive")


_INSTALL_VQF = "pip install vqf, which needs a C++ compiler on this platform"
_DEFAULT = OrientationSettings()


def with_orientation(stream: SensorStream, settings: OrientationSettings = _DEFAULT) -> SensorStream:
    """Estimate the orientation of a stream by VQF: R_inertial_sensor in a reference with z up, NaN in long gaps;
    without magnetometer its heading is arbitrary. Its notes describe the estimate. `InvalidInputError`: a channel is
    missing, or there are too few samples.
    """
    f, w, m = stream.f_sensor, stream.w_sensor, stream.m_sensor
    where = f"sensor {stream.name}"
    if f is None or w is None:
        lacking = "accelerometer" if f is None else "gyroscope"
        raise InvalidInputError(f"{where} has no {lacking}, which an orientation is estimated from; log it")
    if m is not None and (settings.magnetometer is False or not np.isfinite(m).all(axis=1).any()):
        m = None
    if settings.magnetometer and m is None:
        raise InvalidInputError(f"{where} has no magnetometer; let orientation do without it")
    known = np.asarray(np.isfinite([f, w]).all(axis=(0, 2)))
    step = 1 / (settings.rate_hz or stream.rate_hz)
    R = np.full((len(stream), 3, 3), np.nan)
    used = []
    at = np.flatnonzero(known)
    breaks = np.flatnonzero(np.diff(stream.times[at]) > max(_LONGEST_BRIDGED, 1.5 * step)) + 1
    for piece in np.split(at, breaks) if len(at) else ():  # without longer gaps
        first, last = int(piece[0]), int(piece[-1])
        rows = slice(first, last + 1)
        if stream.times[last] - stream.times[first] >= _SHORTEST_PIECE:
            R[rows] = _estimated(stream, (w, f, m), rows, known[rows], step, settings.causal)
            used.append((first, last))
    if not used:
        raise InvalidInputError(f"{where} has nowhere {_SHORTEST_PIECE:g} s of samples; record for longer")
    notes = _notes(stream.times, known, used, step, settings.causal, m is not None)
    return replace(stream, R_inertial_sensor=R, quaternion_norm=None, notes=(*stream.notes, *notes))


def log_with_orientation(log: SensorLog, settings: OrientationSettings = _DEFAULT) -> SensorLog:
    """Estimate the orientation of the sensors of a log that have none by VQF; errors as `with_orientation`."""
    streams = [with_orientation(s, settings) if s.R_inertial_sensor is None else s for s in log.streams]
    return replace(log, streams=tuple(streams))


def _estimated(
    stream: SensorStream,
    measured: tuple[Array, Array, Array | None],
    rows: slice,
    known: Mask,
    step: float,
    causal: bool,
) -> Array:
    """Return the orientation (T, 3, 3) of one piece; the filter needs equal steps."""
    times = stream.times[rows]
    count = int((times[-1] - times[0]) / step) + 2
    if count > _MOST_STEPS * len(times):
        problem = f"{1 / step:g} Hz is far above its samples' rate; set rate_hz"
        raise InvalidInputError(f"sensor {stream.name}: {problem}")
    even = times[0] + step * np.arange(count)
    w, f = (_interpolated(times[known], one[rows][known], even) for one in measured[:2])
    m = measured[2]
    if m is not None:
        seen = np.isfinite(m).all(axis=1)  # of the whole stream: the field changes slowly
        m = _interpolated(stream.times[seen], m[seen], even)
    vqf = optional("vqf", "", "the orientation of a raw sensor", _INSTALL_VQF)
    out = vqf.VQF(step).updateBatch(w, f, m) if causal else vqf.offlineVQF(w, f, m, step)
    R = so3.from_quat_wxyz(out["quat6D" if m is None else "quat9D"])
    return signals.interpolate_rotations(even, R[:, None], times)[:, 0]


def _interpolated(times: Array, values: Array, at: Array) -> Array:
    """Return linear interpolation (T', 3) with the ends extended."""
    return np.ascontiguousarray(np.stack([np.interp(at, times, v) for v in values.T], axis=1))


def _notes(
    times: Array, known: Mask, pieces: Sequence[tuple[int, int]], step: float, causal: bool, has_field: bool
) -> tuple[str, ...]:
    sources = "gyroscope, accelerometer and magnetometer"
    if not has_field:
        sources = "gyroscope and accelerometer: its heading is arbitrary and drifts"
    notes = [f"orientation by VQF ({'causal' if causal else 'offline'}) from {sources}"]
    steps = np.concatenate([np.diff(times[a : b + 1][known[a : b + 1]]) for a, b in pieces])
    gaps = steps[steps > 1.5 * step]
    if len(gaps):
        notes.append(f"{len(gaps)} gaps of up to {gaps.max():.3f} s were bridged by linear interpolation")
    if len(pieces) > 1:
        starts = ", ".join(f"{times[a]:.2f}" for a, _ in pieces[1:6])
        relation = "" if has_field else "; headings before and after are not related"
        again = f"{len(pieces) - 1} time" + "s" * (len(pieces) > 2)
        notes.append(f"the filter was restarted {again}, at {starts} s{relation}")
    return tuple(notes)


_BACK: Final = np.diag([1.0, -1.0, -1.0])
HELD: Final = {
    "portrait": _BACK,
    "landscape left": so3.about_axis("z", -np.pi / 2) @ _BACK,
    "landscape right": so3.about_axis("z", np.pi / 2) @ _BACK,
    "upside down": so3.about_axis("z", np.pi) @ _BACK,
}
"""R_camera_phone by how the phone is held; *left*: with the top of the phone to the left of who films."""
_SIGMA: Final = np.radians(0.5)  # of the tilt that gravity gives a phone in motion
_DRIFT: Final = np.radians(0.1)  # [rad/s] of the heading: offset of a phone's gyroscope
_RATE: Final = 100.0  # [Hz] at which angular velocities are compared
_LEAST_OVERLAP: Final = 2.0  # [s]
_CLEAR: Final = 0.6  # correlation of the angular velocities below which their match is doubtful


@dataclass(frozen=True)
class GyroscopeMatch:
    """Where a gyroscope belongs on the clock of a video."""

    held: str  # How the phone was held, a key of `HELD`
    offset: float  # s, to be added to the gyroscope's times
    correlation: float  # Of the angular velocities of both, at most 1
    doubt: str = ""  # Why the match may be wrong; empty where it is clear


def held_of_gravity(stream: SensorStream) -> str:
    """Return how a phone was held, from gravity: the key of `HELD` whose image is the most upright; portrait where it
    has no accelerometer.
    """
    if stream.f_sensor is None:
        return "portrait"
    up = np.nanmean(stream.f_sensor, axis=0)
    return min(HELD, key=lambda held: float(HELD[held][1] @ up))


def motion_of_gyroscope(stream: SensorStream, R_camera_phone: Array) -> CameraMotion:
    """Return the turning of a camera that a sensor is fixed to by R_camera_phone (3, 3) of `HELD`. With an
    accelerometer the orientation is that of `with_orientation` without magnetometer, and up is known; else angular
    velocities are summed. A slow drift of the heading remains either way. `InvalidInputError`: there is neither, or
    there are too few samples.
    """
    R, up = stream.R_inertial_sensor, None
    if R is None and stream.w_sensor is None:
        raise InvalidInputError(f"sensor {stream.name} has no gyroscope; a camera's turning needs one")
    if R is None and stream.f_sensor is not None:
        R = with_orientation(stream, OrientationSettings(magnetometer=False)).R_inertial_sensor
    tilt_known = R is not None
    R = _summed(stream) if R is None else R
    R_inertial_camera = R @ R_camera_phone.T
    first = R_inertial_camera[np.flatnonzero(np.isfinite(R_inertial_camera).all(axis=(1, 2)))[0]]
    if tilt_known:
        up = first[2]
    return CameraMotion(stream.times, first.T @ R_inertial_camera, _SIGMA, up, _DRIFT)


def _summed(stream: SensorStream) -> Array:
    """Return rotations (T, 3, 3) from the sensor to its first axes by its angular velocity."""
    w = stream.w_sensor
    assert w is not None
    w = signals.interpolate(stream.times, w, stream.times)
    known = np.isfinite(w).all(axis=1)
    if known.sum() < 2:
        raise InvalidInputError(f"sensor {stream.name}: its gyroscope has no samples")
    middle = np.nan_to_num((w[1:] + w[:-1]) / 2)
    steps = so3.exp(middle * np.diff(stream.times)[:, None])
    R = np.empty((len(w), 3, 3))
    R[0] = np.eye(3)
    for t, step in enumerate(steps):
        R[t + 1] = R[t] @ step
    R[~known] = np.nan
    return R


def match_to_image(stream: SensorStream, image: CameraMotion) -> GyroscopeMatch:
    """Find how a phone was held and the time between its clock and the video's: angular velocities of both are
    correlated over all lags with an overlap of two seconds. `InvalidInputError`: no gyroscope, or less than two seconds
    of either.
    """
    if stream.w_sensor is None:
        raise InvalidInputError(f"sensor {stream.name} has no gyroscope; a camera's turning needs one")
    known = np.isfinite(image.R_first_camera).all(axis=(1, 2))
    times, R = image.times[known], image.R_first_camera[known]
    step = np.diff(times)
    w_image = so3.log(np.swapaxes(R[:-1], -1, -2) @ R[1:]) / step[:, None]
    a, start_a = _even((times[1:] + times[:-1]) / 2, w_image)
    b, start_b = _even(stream.times, stream.w_sensor)
    least = round(_LEAST_OVERLAP * _RATE)
    if min(len(a), len(b)) < least:
        raise InvalidInputError(f"camera motion: video and gyroscope need {_LEAST_OVERLAP:g} s at least")
    score, lags = _correlation(a, b, least)
    best = {held: int(np.argmax(values)) for held, values in score.items()}
    held = max(best, key=lambda name: float(score[name][best[name]]))
    i, values = best[held], score[held]
    three = values[max(i - 1, 0) : i + 2]
    fine = np.clip(signals.vertex(*three), -1, 1) if len(three) == 3 else 0.0
    top = float(values[i])
    doubt = ""
    if top < _CLEAR:
        doubt = (
            "the turning of the camera in the image and that of the gyroscope agree badly (correlation "
            f"{top:.2f}); is it the file of this video?"
        )
    offset = start_a - start_b + (lags[i] + fine) / _RATE
    return GyroscopeMatch(held, float(offset), top, doubt)


def _correlation(a: Array, b: Array, least: int) -> tuple[dict[str, Array], Array]:
    """Return lags, and normalised correlations of a (n, 3) with turned b (m, 3) by how the phone is held."""
    lags = np.arange(-(len(b) - 1.0), len(a))
    C = np.array([[scipy.signal.correlate(a[:, i], b[:, j], method="fft") for j in range(3)] for i in range(3)])
    count = scipy.signal.correlate(np.ones(len(a)), np.ones(len(b)), method="fft")
    energy_a = scipy.signal.correlate((a**2).sum(axis=1), np.ones(len(b)), method="fft")
    energy_b = scipy.signal.correlate(np.ones(len(a)), (b**2).sum(axis=1), method="fft")
    # Far fewer turns than usual would make chance matches look good.
    floor = [0.05 * np.mean((x**2).sum(axis=1)) * count for x in (a, b)]
    norm = np.sqrt(np.maximum(energy_a, floor[0]) * np.maximum(energy_b, floor[1]))
    norm = np.where(count >= least - 0.5, np.maximum(norm, 1e-12), np.inf)
    return {held: np.einsum("ij,ijl->l", R, C) / norm for held, R in HELD.items()}, lags


def _even(times: Array, w: Array) -> tuple[Array, float]:
    """Return samples (n, 3) at `_RATE`, 0 in gaps, and the time of the first."""
    at = np.arange(times[0], times[-1], 1 / _RATE)
    return np.nan_to_num(signals.interpolate(times, w, at, 0.3)), float(times[0])


def with_gravity(image: CameraMotion, stream: SensorStream, match: GyroscopeMatch) -> CameraMotion:
    """Return the turning by the image with up from a phone's accelerometer."""
    gyroscope = motion_of_gyroscope(stream, HELD[match.held]).shifted(match.offset)
    if gyroscope.up_first is None:
        return image
    R = signals.interpolate_rotations(gyroscope.times, gyroscope.R_first_camera[:, None], image.times)[:, 0]
    up = image.R_first_camera @ np.swapaxes(R, -1, -2) @ gyroscope.up_first
    return replace(image, up_first=so3.unit(np.nanmean(up, axis=0)))
