"""Orientation from raw gyroscope, accelerometer and magnetometer, where a file has none or a bad one.

By VQF (Laidig and Seel, Information Fusion 91, 2023), in the library of its authors. The offline filter
sees the past and the future of each sample; the causal one the past alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from vqf import VQF, offlineVQF

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.errors import ShapeError
from rtof_kin.data.imu_stream import SensorLog, SensorStream

Array = NDArray[np.float64]
LONGEST_BRIDGED = 0.1
"""Seconds without samples across which measurements are interpolated."""
_MOST_STEPS = 100
"""For each sample the filter makes at most so many steps."""
SHORTEST_PIECE = 1.0
"""Seconds of samples without a longer gap that the filter needs at least, as it has to settle."""


@dataclass(frozen=True)
class OrientationSettings:
    """How orientation is estimated."""

    magnetometer: bool | None = None
    """Whether the magnetic field gives the heading; None: where there is one. Iron nearby turns it."""
    causal: bool = False
    """Whether only the past of each sample is used, as it would be live."""
    longest_bridged: float = LONGEST_BRIDGED
    """Longest gap between samples that is bridged, s; at a longer one the filter starts anew."""
    rate_hz: float | None = None
    """Samples per second; None: by the stream's median step."""

    def __post_init__(self) -> None:
        for name in ("longest_bridged", "rate_hz"):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise ShapeError(f"orientation {name} is {value}; it must be positive")


DEFAULT = OrientationSettings()


def with_orientation(stream: SensorStream, settings: OrientationSettings = DEFAULT) -> SensorStream:
    """A stream with orientation by VQF, instead of its own where it has one.

    Returns:
        The stream, with R_inertial_sensor in a reference with z up whose heading is arbitrary without
        magnetometer, NaN where samples are missing for long; its notes say how it was made.

    Raises:
        ShapeError: no gyroscope, accelerometer, or the magnetometer that was asked for; or nowhere
            samples enough.
    """
    f, w, m = stream.f_sensor, stream.w_sensor, stream.m_sensor
    where = f"sensor {stream.name}"
    if f is None or w is None:
        lacking = "accelerometer" if f is None else "gyroscope"
        raise ShapeError(f"{where} has no {lacking}, which an orientation is estimated from; log it")
    if settings.magnetometer is False:
        m = None
    if m is not None and not np.isfinite(m).all(axis=1).any():
        m = None
    if settings.magnetometer and m is None:
        raise ShapeError(f"{where} has no magnetometer; let orientation do without it")
    known = np.asarray(np.isfinite([f, w]).all(axis=(0, 2)))
    step = 1 / (settings.rate_hz or stream.rate_hz)
    pieces = _pieces(stream.times, known, max(settings.longest_bridged, 1.5 * step))
    R = np.full((len(stream), 3, 3), np.nan)
    used = []
    for first, last in pieces:
        rows = slice(first, last + 1)
        if stream.times[last] - stream.times[first] >= SHORTEST_PIECE:
            R[rows] = _estimated(stream, m, rows, known[rows], step, settings.causal)
            used.append((first, last))
    if not used:
        raise ShapeError(f"{where} has nowhere {SHORTEST_PIECE:g} s of samples; record for longer")
    notes = _notes(stream.times, known, used, step, settings, m is not None)
    return replace(stream, R_inertial_sensor=R, quaternion_norm=None, notes=(*stream.notes, *notes))


def log_with_orientation(
    log: SensorLog, names: Sequence[str] | None = None, settings: OrientationSettings = DEFAULT
) -> SensorLog:
    """A log in which sensors have orientation by VQF.

    Args:
        names: the sensors; those without orientation where not given.

    Raises:
        UnknownNameError: one is not there. ShapeError: as `with_orientation`.
    """
    if names is None:
        names = [stream.name for stream in log.streams if stream.R_inertial_sensor is None]
    log.select(names)
    streams = [with_orientation(s, settings) if s.name in names else s for s in log.streams]
    return replace(log, streams=tuple(streams))


def _pieces(times: Array, known: NDArray[np.bool_], longest: float) -> list[tuple[int, int]]:
    """First and last sample of each stretch in which known samples follow each other closely."""
    at = np.flatnonzero(known)
    if len(at) == 0:
        return []
    breaks = np.flatnonzero(np.diff(times[at]) > longest)
    firsts, lasts = at[[0, *(breaks + 1)]], at[[*breaks, len(at) - 1]]
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))


def _estimated(
    stream: SensorStream, m: Array | None, rows: slice, known: NDArray[np.bool_], step: float, causal: bool
) -> Array:
    """Orientation (T, 3, 3) of the samples of one piece; the filter wants equal steps."""
    assert stream.f_sensor is not None
    assert stream.w_sensor is not None
    times = stream.times[rows]
    count = int((times[-1] - times[0]) / step) + 2
    if count > _MOST_STEPS * len(times):
        raise ShapeError(f"sensor {stream.name}: {1 / step:g} Hz is far above its samples' rate; set rate_hz")
    even = times[0] + step * np.arange(count)
    f, w = (_held(times[known], one[rows][known], even) for one in (stream.f_sensor, stream.w_sensor))
    if m is not None:
        seen = np.isfinite(m).all(axis=1)  # of the whole stream: the field changes slowly
        m = _held(stream.times[seen], m[seen], even)
    out = VQF(step).updateBatch(w, f, m) if causal else offlineVQF(w, f, m, step)
    R = so3.from_quat_wxyz(out["quat6D" if m is None else "quat9D"])
    return signals.interpolate_rotations(even, R[:, None], times)[:, 0]


def _held(times: Array, values: Array, at: Array) -> Array:
    """Linear interpolation (T', 3), the ends held."""
    return np.ascontiguousarray(
        np.stack([np.interp(at, times, values[:, i]) for i in range(values.shape[1])], axis=1)
    )


def _notes(
    times: Array,
    known: NDArray[np.bool_],
    pieces: Sequence[tuple[int, int]],
    step: float,
    settings: OrientationSettings,
    has_field: bool,
) -> tuple[str, ...]:
    how = "causal" if settings.causal else "offline"
    sources = "gyroscope, accelerometer and magnetometer"
    if not has_field:
        sources = "gyroscope and accelerometer: its heading is arbitrary and drifts"
    notes = [f"orientation by VQF ({how}) from {sources}"]
    steps = np.concatenate([np.diff(times[a : b + 1][known[a : b + 1]]) for a, b in pieces])
    gaps = steps[steps > 1.5 * step]
    if len(gaps):
        notes.append(f"{len(gaps)} gaps of up to {gaps.max():.3f} s were bridged by linear interpolation")
    if len(pieces) > 1:
        starts = ", ".join(f"{times[a]:.2f}" for a, _ in pieces[1:6])
        relation = "" if has_field else "; headings before and after are not related"
        anew = f"{len(pieces) - 1} time" + "s" * (len(pieces) > 2)
        notes.append(f"the filter started anew {anew}, at {starts} s{relation}")
    return tuple(notes)
