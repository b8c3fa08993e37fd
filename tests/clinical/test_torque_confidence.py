"""Derivatives of inverse dynamics against finite differences; gains of errors against a Monte Carlo."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.body_dynamics import UNKNOWN, BodyDynamics, ErrorSpectrum, error_gains
from rtof_kin.clinical.range_of_motion import CUTOFF_HZ, smoothed

Array = NDArray[np.float64]
BODY = SkeletonModel.default().with_mass(75.0)
STEP = 1e-3  # [s]


def state(size: float, motion: Array, error: Array) -> tuple[Array, Array, Array]:
    """q, v and a at time 0 of a smooth motion with a smooth error of a size; both (nv, 3), Taylor's terms."""
    times = STEP * np.arange(-2, 3)
    powers = np.stack([np.ones(5), times, times**2 / 2])
    rows = []
    for x, e in zip((motion @ powers).T, size * (error @ powers).T, strict=True):
        q = pin.integrate(BODY.model, pin.neutral(BODY.model), np.concatenate([np.zeros(3), x[3:]]))
        R = pin.Quaternion(q[3:7]).toRotationMatrix() @ pin.exp3(e[3:6])
        rows.append(np.concatenate([x[:3] + e[:3], pin.Quaternion(R).coeffs(), q[7:] + e[6:]]))
    v = [pin.difference(BODY.model, rows[k - 1], rows[k + 1]) / (2 * STEP) for k in (1, 2, 3)]
    return rows[2], v[1], (v[2] - v[0]) / (2 * STEP)


@pytest.mark.parametrize("carries", [UNKNOWN, 0, 1])
def test_derivatives_are_those_of_a_motion_with_a_planted_error(carries: int) -> None:
    rng = np.random.default_rng(0)
    scales = np.array([1.0, 3.0, 30.0])
    motion, error = (rng.normal(size=(BODY.nv, 3)) * scales for _ in range(2))
    body = BodyDynamics(BODY)

    def rows(size: float) -> Array:
        found = body.at(*state(size, 0.4 * motion, error), carries)
        return np.concatenate([found.tau[6:], found.wrench])

    numeric = (rows(1e-5) - rows(-1e-5)) / 2e-5
    S = body.derivatives(*state(0.0, 0.4 * motion, error), carries)
    linear = S.value @ error[:, 0] + S.velocity @ error[:, 1] + S.acceleration @ error[:, 2]
    np.testing.assert_allclose(linear, numeric, atol=5e-4 * np.abs(numeric).max())


def test_gains_are_those_of_random_errors_through_the_filter() -> None:
    rate_hz, spectrum = 60.0, ErrorSpectrum(0.7, 0.12)
    times = np.arange(241) / rate_hz
    fast = np.exp(-0.5 * ((times[:, None] - times) / spectrum.seconds) ** 2)
    root = np.linalg.cholesky(fast + 1e-9 * np.eye(len(times)))
    rng = np.random.default_rng(1)
    errors = np.sqrt(spectrum.share) * root @ rng.normal(size=(len(times), 4000))
    errors += np.sqrt(1 - spectrum.share) * rng.normal(size=4000)
    value = smoothed(errors, rate_hz, CUTOFF_HZ)
    velocity = np.gradient(value, times, axis=0)
    acceleration = np.gradient(velocity, times, axis=0)
    x, v, a = value[120], velocity[120], acceleration[120]
    found = [x @ x, v @ v, a @ a, x @ a]
    np.testing.assert_allclose(np.array(found) / 4000, error_gains(rate_hz, spectrum), rtol=0.1)
