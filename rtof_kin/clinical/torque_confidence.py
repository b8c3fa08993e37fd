"""Standard deviations of joint torques, and the covariance of the wrench from outside.

Two components, independent of each other:

* motion: the covariances of positions and turns (`Confidence`), by the course in time of `pose_errors`,
  through the low-pass and both derivatives, by Pinocchio's derivatives of inverse dynamics;
* masses: a standard deviation of `MASS_SIGMA` of the mass of each of de Leva's segments, alike on the right
  and the left, with body mass as given.

In neither: the length of bones, centres of mass, what the low-pass takes away of the motion itself (the
impact of a heel), an error of the body mass, a contact that is not known.

Measured on seven people from whom nothing was learned (``python -m benchmarks dynamics --corpus DIR``; 21
simulated recordings with realistic 2D, each with 0, 8 and 10 sensors), the root mean square stated for the
motion is that of the actual errors times

==============================  ==========  ==========  ==========
..                              no sensors  8 sensors   10 sensors
==============================  ==========  ==========  ==========
shoulder, hip, knee, ankle      1.1 to 1.3  1.0 to 1.7  1.1 to 1.6
elbow                           1.6         2.5         2.5
spine                           1.0         1.5         1.7
force from outside, horizontal  1.0 to 1.2  1.6 to 2.0  1.7 to 2.1
force from outside, vertical    0.5         1.4         1.5
==============================  ==========  ==========  ==========

and 95 % bands contain 95 to 100 % of the errors, but only 85 % of those of the vertical force where no sensor is worn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtof_kin.clinical.body_dynamics import MASS_SIGMA, BodyDynamics
from rtof_kin.clinical.pose_errors import PoseErrors
from rtof_kin.core.array_types import Array, Index

EVERY: Final = 1 / 15
"""[s] between frames in which they are computed; variances are interpolated linearly."""


@dataclass(frozen=True)
class DynamicsConfidence:
    """Variances of torques and covariances of the wrench, by component."""

    torques: Array
    """(2, n, D) variances, (N m)^2: of the motion, of the masses."""
    wrench: Array
    """(2, n, 6, 6) covariances of the wrench about the reference, N and N m."""


def node_frames(count: int, rate_hz: float) -> Index:
    """Return the frames in which the confidence is computed, the first and the last among them.

    Args:
        rate_hz: of the motion, Hz.
    """
    return np.union1d(np.arange(0, count, max(1, math.floor(EVERY * rate_hz))), [count - 1])


def dynamics_confidence(
    body: BodyDynamics,
    q: Array,
    v: Array,
    a: Array,
    carries: NDArray[np.int_],
    errors: PoseErrors | None,
    rate_hz: float,
) -> DynamicsConfidence:
    """Return the confidence in some frames.

    Args:
        body: with the subject's mass. q, v, a: (n, nq), (n, nv), (n, nv), filtered.
        carries: (n,) see `BodyDynamics.at`.
        errors: of these frames; None: the component of the motion is NaN. rate_hz: of the motion, Hz.
    """
    n, D = len(q), body.skeleton.nv - 6
    torques, wrench = np.full((2, n, D), np.nan), np.full((2, n, 6, 6), np.nan)
    gains = None if errors is None else errors.gains(rate_hz)
    for t in range(n):
        S = body.derivatives(q[t], v[t], a[t], int(carries[t]))
        if errors is not None and gains is not None:
            value, velocity, acceleration = (rows @ errors.factors[t] for rows in (S.value, S.velocity, S.acceleration))
            torques[0, t] = _products(value[:D], velocity[:D], acceleration[:D], gains)
            wrench[0, t] = _covariance(value[D:], velocity[D:], acceleration[D:], gains)
        torques[1, t] = MASS_SIGMA**2 * np.sum(S.masses[:D] ** 2, axis=1)
        wrench[1, t] = MASS_SIGMA**2 * S.masses[D:] @ S.masses[D:].T
    return DynamicsConfidence(torques, wrench)


def interpolated(nodes: Index, values: Array, count: int) -> Array:
    """Return values (2, count, ...) between nodes.

    Args:
        nodes: (n,) frames, from 0 to count - 1. values: (2, n, ...).
    """
    frames = np.arange(count)
    after = np.clip(np.searchsorted(nodes, frames), 1, max(len(nodes) - 1, 1)) if len(nodes) > 1 else frames
    if len(nodes) == 1:
        return values
    share = (frames - nodes[after - 1]) / (nodes[after] - nodes[after - 1])
    share = share.reshape(1, -1, *[1] * (values.ndim - 2))
    return np.asarray((1 - share) * values[:, after - 1] + share * values[:, after])


def _products(value: Array, velocity: Array, acceleration: Array, gains: Array) -> Array:
    """Variances (m,) of linear functions (m, n) of independent errors and their derivatives."""
    squares = value**2, velocity**2, acceleration**2, 2 * value * acceleration
    return np.asarray(sum(square @ gain for square, gain in zip(squares, gains.T, strict=True)))


def _covariance(value: Array, velocity: Array, acceleration: Array, gains: Array) -> Array:
    """Covariance (m, m) of the same."""
    out = np.asarray(
        sum((rows * gain) @ rows.T for rows, gain in zip((value, velocity, acceleration), gains.T, strict=False))
    )
    both = (value * gains[:, 3]) @ acceleration.T
    return np.asarray(out + both + both.T)
