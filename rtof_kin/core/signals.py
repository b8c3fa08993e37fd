"""Resampling, differences and filters of signals sampled over time (first axis)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import lapack

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask, blocks_of
from rtof_kin.core.errors import InvalidInputError


def interpolate(times: Array, values: Array, at: ArrayLike, max_gap: float = np.inf) -> Array:
    """Interpolate linearly, element by element: (T', ...), NaN outside the valid samples and in gaps.

    Args:
        times: (T,) s, increasing. values: (T, ...), NaN where missing. at: (T',) s.
        max_gap: longest interval between valid samples that is interpolated, s.
    """
    at = np.asarray(at, dtype=float)
    flat = values.reshape(len(times), -1)
    out = np.full((len(at), flat.shape[1]), np.nan)
    for ok, columns in _alike(np.asarray(np.isfinite(flat))):
        t, gap = times[ok], _in_gap(times[ok], at, max_gap)
        for column in columns:
            out[:, column] = np.interp(at, t, flat[ok, column], left=np.nan, right=np.nan)
            out[gap, column] = np.nan
    return out.reshape(len(at), *values.shape[1:])


def _alike(known: Mask) -> Iterator[tuple[Mask, list[int]]]:
    """Known samples (T,) and the columns that have these, of the columns (T, n) with any."""
    columns: dict[bytes, list[int]] = {}
    for column in np.flatnonzero(known.any(axis=0)).tolist():
        columns.setdefault(known[:, column].tobytes(), []).append(column)
    for own in columns.values():
        yield known[:, own[0]], own


def _in_gap(t: Array, at: Array, max_gap: float) -> Mask:
    """Return whether each instant lies strictly between two samples further apart than `max_gap`."""
    right = np.clip(np.searchsorted(t, at), 0, len(t) - 1)
    left = np.maximum(right - 1, 0)
    between = (at > t[left]) & (at < t[right])
    return np.asarray(between & (t[right] - t[left] > max_gap * (1 + 1e-9)))


def interpolate_rotations(times: Array, R: Array, at: ArrayLike, max_gap: float = np.inf) -> Array:
    """Interpolate rotations (T, S, 3, 3) on the geodesic: (T', S, 3, 3), NaN as a whole where `interpolate` has it."""
    at = np.asarray(at, dtype=float)
    out = np.full((len(at), *R.shape[1:]), np.nan)
    for ok, sensors in _alike(np.asarray(np.isfinite(R).all(axis=(-2, -1)))):
        t, M = times[ok], R[ok][:, sensors]
        inside = np.flatnonzero((at >= t[0]) & (at <= t[-1]) & ~_in_gap(t, at, max_gap))
        for own in (inside[rows] for rows in blocks_of(len(inside))):
            right = np.clip(np.searchsorted(t, at[own]), min(1, len(t) - 1), len(t) - 1)
            left = np.maximum(right - 1, 0)
            span = np.where(right > left, t[right] - t[left], 1.0)
            share = np.clip((at[own] - t[left]) / span, 0, 1)
            step = so3.log(np.swapaxes(M[left], -1, -2) @ M[right])
            out[own[:, None], sensors] = M[left] @ so3.exp(share[:, None, None] * step)
    return out


def hat_average(times: Array, values: Array, at: ArrayLike, half_width: float, max_gap: float = np.inf) -> Array:
    """Average a signal with a triangular kernel: (T', ...), NaN outside the recording and at gaps.

    ``(x(t+h) - 2 x(t) + x(t-h)) / h^2`` equals the second derivative of x averaged with a hat of half-width
    h. The signal is piecewise linear between its samples and integrated exactly (Simpson on every piece): at
    equal rates the kernel is [1 4 1] / 6. At the ends of the recording it is truncated and renormalised.

    Args:
        times: (T,) s. values: (T, ...). at: (T',) s. half_width: h, s. max_gap: see `interpolate`.
    """
    at = np.asarray(at, dtype=float)
    low = np.searchsorted(times, at - half_width, side="right")
    high = np.searchsorted(times, at + half_width, side="left")
    count = int(np.max(high - low, initial=0))
    # Knots: corners of the kernel and all samples under it, padded to a common number.
    inner = np.minimum(low[:, None] + np.arange(count), high[:, None] - 1)
    samples = np.where(np.arange(count) < (high - low)[:, None], times[np.clip(inner, 0, None)], at[:, None])
    corners = at[:, None] + half_width * np.array([-1.0, 0.0, 1.0])
    knots = np.sort(np.concatenate([corners, samples], axis=1), axis=1)
    knots = np.clip(knots, times[0], times[-1])
    points = np.stack([knots[:, :-1], (knots[:, :-1] + knots[:, 1:]) / 2, knots[:, 1:]])
    f = interpolate(times, values, points.ravel(), max_gap).reshape(*points.shape, -1)
    hat = np.maximum(0.0, 1 - np.abs(points - at[:, None]) / half_width)[..., None]
    width = np.diff(knots, axis=1)[None, ..., None]
    simpson = np.array([1.0, 4.0, 1.0])[:, None, None, None] / 6
    # Pieces of zero width, up to rounding, may touch a gap without entering it.
    weight = simpson * width * hat
    weight[weight < 1e-9 * half_width] = 0.0
    product = np.where(weight > 0, weight * f, 0.0)
    total = weight.sum(axis=(0, 2))
    mean = product.sum(axis=(0, 2)) / np.where(total > 0, total, np.nan)
    mean[(at < times[0]) | (at > times[-1])] = np.nan
    return np.asarray(mean.reshape(len(at), *values.shape[1:]))


def derivative(values: ArrayLike, rate_hz: float, order: int) -> Array:
    """Return finite differences (T - order, ...) of samples at `rate_hz` along the first axis, times rate**order."""
    return np.asarray(np.diff(np.asarray(values, dtype=float), n=order, axis=0) * rate_hz**order)


def low_pass(values: ArrayLike, rate_hz: float, cutoff_hz: float) -> Array:
    """Apply a zero-phase Butterworth low-pass of order 2 (-3 dB of one pass at `cutoff_hz`) along the first axis,
    forwards and backwards. `InvalidInputError`: the cutoff is not below half the sampling rate.

    The signal is continued by its reflection in its ends, and was constant before. A pass is a triangular banded
    system (bilinear transform: Oppenheim & Schafer 2010, 7.2). `scipy.signal` does the same, 0.4 s after its import.
    """
    if not 0 < cutoff_hz < rate_hz / 2:
        raise InvalidInputError(f"cutoff of {cutoff_hz:g} Hz: not above 0 and below half the rate, {rate_hz:g} Hz")
    values = np.asarray(values, dtype=float)
    if values.size == 0:
        return values
    w, ends = np.tan(np.pi * cutoff_hz / rate_hz), min(len(values) - 1, int(3 * rate_hz / cutoff_hz))
    scale = 1 + np.sqrt(2) * w + w**2
    x = np.pad(values.reshape(len(values), -1).T, ((0, 0), (ends, ends)), mode="reflect", reflect_type="odd")
    band = np.empty((3, x.shape[1]), order="F")
    band.T[:] = 1, 2 * (w**2 - 1) / scale, (1 - np.sqrt(2) * w + w**2) / scale
    for _ in range(2):
        first = x[:, :1].copy()
        x -= first
        right = x * (w**2 / scale)
        right[:, 1:] += 2 * (w**2 / scale) * x[:, :-1]
        right[:, 2:] += w**2 / scale * x[:, :-2]
        x = (lapack.dtbtrs(band, right.T, uplo="L", diag="U", overwrite_b=1)[0].T + first)[:, ::-1].copy()
    return np.asarray(x[:, ends : ends + len(values)].T.reshape(values.shape))


def low_pass_known(times: Array, values: Array, cutoff_hz: float) -> Array:
    """Apply `low_pass` to each interval without NaN of values (T, n) at even times (T,), s. From half the sampling rate
    on, nothing is filtered.
    """
    rate_hz = 1 / float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    out = np.array(values, dtype=float)
    if cutoff_hz < rate_hz / 2:
        for start, stop in runs(np.isfinite(out).all(axis=1)):
            if stop - start > 3:
                out[start:stop] = low_pass(out[start:stop], rate_hz, cutoff_hz)
    return out


def vertex(before: float, most: float, after: float) -> float:
    """Return where the parabola through values at -1, 0 and 1, the middle one the largest, has its maximum."""
    return float((before - after) / (2 * min(before - 2 * most + after, -1e-9)))


def within(times: Array, start: float, stop: float) -> slice:
    """Return the samples of a closed interval; times: (T,) s, increasing. start, stop: s."""
    return slice(int(np.searchsorted(times, start)), int(np.searchsorted(times, stop, side="right")))


def runs(mask: ArrayLike) -> list[tuple[int, int]]:
    """Return half-open index ranges [start, stop) in which a mask is true; mask: (T,)."""
    padded = np.concatenate([[False], np.asarray(mask, dtype=bool), [False]])
    edges = np.flatnonzero(np.diff(padded.astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
