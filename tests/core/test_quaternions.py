"""Quaternions w x y z against SciPy, near angles 0 and pi, and their Jacobians."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rtof_kin.core import quaternions as quat

Array = NDArray[np.float64]
RNG = np.random.default_rng(0)
ANGLES = (0.0, 1e-300, 1e-12, 1e-8, 1e-5, 0.9e-3, 1.1e-3, 0.03, 1.0, 3.0, np.pi - 1e-4, np.pi - 1e-9)
angles = st.sampled_from(ANGLES) | st.floats(0.0, np.pi - 1e-9)
seeds = st.integers(0, 2**32 - 1)


def vector(seed: int, angle: float) -> Array:
    axis = np.random.default_rng(seed).normal(size=3)
    return np.asarray(angle * axis / np.linalg.norm(axis))


def random_quats(*shape: int) -> Array:
    q = RNG.normal(size=(*shape, 4))
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


def scipy(q: Array) -> Rotation:
    return Rotation.from_quat(q.reshape(-1, 4), scalar_first=True)


def test_products_and_conjugates_equal_scipy_for_any_leading_axes() -> None:
    a, b = random_quats(3, 1, 2), random_quats(5, 2)
    found = quat.multiply(a, quat.conjugate(b))
    assert found.shape == (3, 5, 2, 4)
    for i, j, k in np.ndindex(3, 5, 2):
        expected = (scipy(a[i, 0, k]) * scipy(b[j, k]).inv()).as_matrix()
        np.testing.assert_allclose(scipy(found[i, j, k]).as_matrix(), expected, atol=1e-14)
    v = RNG.normal(size=(4, 3, 3))
    for jacobian in (quat.right_jacobian, quat.right_jacobian_inverse):
        np.testing.assert_allclose(jacobian(v)[2, 1], jacobian(v[2, 1]), atol=1e-15)


@given(seed=seeds, angle=angles)
def test_exp_equals_scipy(seed: int, angle: float) -> None:
    v = vector(seed, angle)
    q = quat.exp(v)
    expected = Rotation.from_rotvec(v).as_quat(scalar_first=True)
    np.testing.assert_allclose(q, expected, atol=1e-15)
    np.testing.assert_allclose(q[1:], expected[1:], rtol=1e-12, atol=0)
    assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-15)


@given(seed=seeds, angle=angles)
def test_log_inverts_exp_for_both_signs(seed: int, angle: float) -> None:
    v = vector(seed, angle)
    q = quat.exp(v)
    np.testing.assert_allclose(quat.log(q), v, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(quat.log(-q), quat.log(q), rtol=1e-12, atol=0)
    assert np.linalg.norm(quat.log(q)) <= np.pi + 1e-12


def test_log_from_half_a_turn_on_is_the_shorter_rotation() -> None:
    v = np.array([[0.0, 0.0, np.pi + 0.3], [2 * np.pi - 0.1, 0.0, 0.0], [0.0, 2 * np.pi, 0.0]])
    expected = [[0, 0, 0.3 - np.pi], [-0.1, 0, 0], [0, 0, 0]]
    np.testing.assert_allclose(quat.log(quat.exp(v)), expected, atol=1e-12)
    for axis in np.eye(3):
        np.testing.assert_allclose(quat.log(np.array([0.0, *axis])), np.pi * axis, atol=1e-15)


def log_of_product(v: Array, d: Array) -> Array:
    return np.asarray((Rotation.from_rotvec(v) * Rotation.from_rotvec(d)).as_rotvec())


@given(seed=seeds, angle=st.sampled_from(ANGLES[:-2]) | st.floats(0.0, 3.1))
def test_inverse_right_jacobian_is_the_derivative_of_log(seed: int, angle: float) -> None:
    v, h = vector(seed, angle), 1e-6
    columns = [(log_of_product(v, h * e) - log_of_product(v, -h * e)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(quat.right_jacobian_inverse(v), np.array(columns).T, atol=1e-7)


@given(seed=seeds, angle=st.sampled_from(ANGLES[:-2]) | st.floats(0.0, 6.0))
def test_right_jacobian_is_the_derivative_of_exp(seed: int, angle: float) -> None:
    v, h = vector(seed, angle), 1e-6
    back = Rotation.from_rotvec(v).inv()
    columns = [
        ((back * Rotation.from_rotvec(v + h * e)).as_rotvec() - (back * Rotation.from_rotvec(v - h * e)).as_rotvec())
        / (2 * h)
        for e in np.eye(3)
    ]
    np.testing.assert_allclose(quat.right_jacobian(v), np.array(columns).T, atol=1e-7)


@given(seed=seeds, angle=angles)
def test_jacobians_are_inverse_and_keep_their_own_vector(seed: int, angle: float) -> None:
    v = vector(seed, angle)
    product = quat.right_jacobian(v) @ quat.right_jacobian_inverse(v)
    np.testing.assert_allclose(product, np.eye(3), atol=1e-7)
    np.testing.assert_allclose(quat.right_jacobian(v) @ v, v, atol=1e-12)
