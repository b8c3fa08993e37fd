"""Offset between the clocks of two videos of one person, from the velocities of the joints.

Both videos are lifted to 3D, each in a world of its own with z up. At every offset, the velocities of the
joints about the root are compared after the best rotation about the vertical: with

::

    H = sum_t sum_j v_1(t) v_2(t + offset)^T

the largest trace of R_z H over all headings is sqrt((H_xx + H_yy)^2 + (H_xy - H_yx)^2) + H_zz. Directions
make this sharper than speeds, and where the cameras stand has no effect.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.signal import fftconvolve

from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.poses import PoseSequence

RATE_HZ: Final = 30.0
"""[Hz] of the comparison."""
_CUTOFF_HZ: Final = 5.0
"""[Hz] Low-pass of the velocities against jitter."""
LEAST_COMMON: Final = 1.0
"""[s] Least time that both videos have in common, with `_COMMON_SHARE` of the shorter one."""
_COMMON_SHARE: Final = 0.3
_SAMPLES_HZ: Final = 10.0
"""[Hz] Independent samples of the correlation; they make its gain comparable over different overlaps."""
_APART: Final = 0.3
"""[s] Least distance of another offset."""
_RIVAL: Final = 0.75
"""Gain of another offset relative to the best, from which the offset is in doubt."""
_LEAST_CORRELATION: Final = 0.5
"""Correlation below which the two videos may not show the same motion."""
_UNSHARP: Final = 0.03
"""[s] Standard deviation of an offset found alone, from planted ones."""


@dataclass(frozen=True)
class VideoOffset:
    """How far the second video's clock is from the first one's."""

    offset: float
    """[s] to be added to the times of the second video."""
    sigma: float
    """[s] Its standard deviation."""
    correlation: float
    """Of the joints' velocities at that offset."""
    doubt: str
    """Why it may be wrong; empty where sure."""


def find_video_offset(first: PoseSequence, second: PoseSequence, around: float | None = None) -> VideoOffset:
    """Return the offset at which two lifts of one person agree.

    Args:
        first, second: (T, J) and (T', J) poses of the same joints, at even times, each in its own world.
        around: [s] search within a second of this offset only.

    Raises:
        InvalidInputError: they have too little in common at every offset.
    """
    v_1, v_2 = _velocities(first), _velocities(second)
    K, M = len(v_1), len(v_2)
    ones = fftconvolve(np.ones(K), np.ones(M))
    E_1 = fftconvolve(np.einsum("tji,tji->t", v_1, v_1), np.ones(M))
    E_2 = fftconvolve(np.ones(K), np.einsum("tji,tji->t", v_2, v_2)[::-1])
    flat_1, flat_2 = v_1.reshape(K, -1, 3), v_2[::-1].reshape(M, -1, 3)
    H = np.zeros((K + M - 1, 3, 3))
    for a in range(3):
        for b in range(3):
            if (a == 2) == (b == 2):
                H[:, a, b] = fftconvolve(flat_1[..., a], flat_2[..., b], axes=0).sum(axis=1)
    best = np.hypot(H[:, 0, 0] + H[:, 1, 1], H[:, 0, 1] - H[:, 1, 0]) + H[:, 2, 2]
    correlation = np.clip(best / np.sqrt(np.maximum(E_1 * E_2, 1e-12)), 0.0, 0.999)
    gains = -0.5 * ones / RATE_HZ * _SAMPLES_HZ * np.log1p(-(correlation**2))
    # Sample k of the convolution compares second[m] with first[k - (M - 1) + m].
    offsets = (np.arange(K + M - 1) - (M - 1)) / RATE_HZ + first.times[0] - second.times[0]
    common = max(LEAST_COMMON, _COMMON_SHARE * min(K, M) / RATE_HZ)
    gains[ones < common * RATE_HZ] = -np.inf
    if around is not None:
        gains[np.abs(offsets - around) > 1.0] = -np.inf
    if not np.isfinite(gains).any():
        raise InvalidInputError(
            f"the two videos have less than {common:.1f} s in common; record both for the whole motion"
        )
    k = int(np.argmax(gains))
    other = np.where(np.abs(offsets - offsets[k]) > _APART, gains, -np.inf)
    doubt = ""
    if correlation[k] < _LEAST_CORRELATION:
        doubt = (
            f"the joints move differently in the two videos at every offset (correlation {correlation[k]:.2f}"
            "); check that both show the same person at the same time"
        )
    elif other.max() > _RIVAL * gains[k]:
        rival = offsets[int(np.argmax(other))]
        doubt = (
            f"the motion repeats itself: an offset of {rival:+.2f} s would do nearly as well as "
            f"{offsets[k]:+.2f} s; clap or raise an arm once in view of both cameras"
        )
    return VideoOffset(_peak(offsets, gains, k), _UNSHARP, float(correlation[k]), doubt)


def _velocities(poses: PoseSequence) -> Array:
    """(K, J, 3) of the joints about the root, m/s, low-pass filtered, at `RATE_HZ`."""
    p = poses.p_world_joint - poses.p_world_joint[:, :1]
    times = np.arange(poses.times[0], poses.times[-1] + 1e-9, 1 / RATE_HZ)
    if len(times) < LEAST_COMMON * RATE_HZ:
        raise InvalidInputError(f"a video is shorter than {LEAST_COMMON:g} s; record for longer")
    even = signals.interpolate(poses.times, p[:, 1:], np.minimum(times, poses.times[-1]))
    return np.gradient(signals.low_pass(even, RATE_HZ, _CUTOFF_HZ), 1 / RATE_HZ, axis=0)


def _peak(offsets: Array, gains: Array, k: int) -> float:
    """Offset of a maximum, by a parabola through it and its neighbours."""
    if not 0 < k < len(gains) - 1 or not np.isfinite(gains[k - 1 : k + 2]).all():
        return float(offsets[k])
    return float(offsets[k] + signals.vertex(*gains[k - 1 : k + 2]) / RATE_HZ)
