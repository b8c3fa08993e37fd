"""Orientation from raw gyroscope, accelerometer and magnetometer by VQF.

Laidig and Seel, Information Fusion 91 (2023), in the library of its authors. The offline filter uses the
past and the future of each sample, the causal one only the past.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.core.packages import optional
from rtof_kin.data.imu_stream import SensorLog, SensorStream

_MOST_STEPS = 100  # of the filter for each sample
_SHORTEST_PIECE = 1.0  # [s] of samples without a longer gap, for the filter to settle


@dataclass(frozen=True)
class OrientationSettings:
    """Settings of the orientation filter."""

    magnetometer: bool | None = None  # whether it gives the heading; None: if there is one
    causal: bool = False  # whether only the past of each sample is used
    longest_bridged: float = 0.1  # [s] of a gap that is interpolated; the filter restarts after longer ones
    rate_hz: float | None = None  # [Hz] sampling rate; None: from the stream's median step

    def __post_init__(self) -> None:
        for name in ("longest_bridged", "rate_hz"):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise InvalidInputError(f"orientation {name} is {value}; it must be positive")


_INSTALL_VQF = "pip install vqf, which needs a C++ compiler on this platform"
_DEFAULT = OrientationSettings()


def with_orientation(stream: SensorStream, settings: OrientationSettings = _DEFAULT) -> SensorStream:
    """Estimate the orientation of a stream by VQF.

    Returns:
        The stream with R_inertial_sensor in a reference with z up, NaN in long gaps; without magnetometer
        its heading is arbitrary. Its notes describe the estimate.

    Raises:
        InvalidInputError: a channel is missing, or there are too few samples.
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
    for first, last in _pieces(stream.times, known, max(settings.longest_bridged, 1.5 * step)):
        rows = slice(first, last + 1)
        if stream.times[last] - stream.times[first] >= _SHORTEST_PIECE:
            R[rows] = _estimated(stream, (w, f, m), rows, known[rows], step, settings.causal)
            used.append((first, last))
    if not used:
        raise InvalidInputError(f"{where} has nowhere {_SHORTEST_PIECE:g} s of samples; record for longer")
    notes = _notes(stream.times, known, used, step, settings.causal, m is not None)
    return replace(stream, R_inertial_sensor=R, quaternion_norm=None, notes=(*stream.notes, *notes))


def log_with_orientation(
    log: SensorLog, names: Sequence[str] | None = None, settings: OrientationSettings = _DEFAULT
) -> SensorLog:
    """Estimate the orientation of sensors of a log by VQF.

    Args:
        names: of those to estimate; None: of those without orientation.

    Raises:
        UnknownNameError: unknown sensor. InvalidInputError: as in `with_orientation`.
    """
    if names is None:
        names = [stream.name for stream in log.streams if stream.R_inertial_sensor is None]
    log.select(names)
    streams = [with_orientation(s, settings) if s.name in names else s for s in log.streams]
    return replace(log, streams=tuple(streams))


def _pieces(times: Array, known: Mask, longest: float) -> list[tuple[int, int]]:
    """Return first and last sample of each stretch of known samples without longer gaps."""
    at = np.flatnonzero(known)
    if len(at) == 0:
        return []
    breaks = np.flatnonzero(np.diff(times[at]) > longest)
    firsts, lasts = at[[0, *(breaks + 1)]], at[[*breaks, len(at) - 1]]
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))


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
