"""Each residual against NumPy's formula, its derivative against finite differences, its unit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import planted
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from rtof_kin.solve import residuals as energies

Array = NDArray[np.float64]
RATE = 50.0
RNG = np.random.default_rng(0)
K = np.array([[1200.0, 3.0, 960.0], [0.0, 1180.0, 540.0], [0.0, 0.0, 1.0]])
P = RNG.normal(size=(3, 6)) * 0.3 + np.array([[0.0], [0.2], [4.0]])
Q = P + RNG.normal(size=(3, 6)) * 0.4
UV = RNG.normal(size=(2, 6)) * 50 + 500
ACCELERATION, JERK = RNG.normal(size=(3, 4)) * 3, RNG.normal(size=(3, 3)) * 100
LENGTH = np.full((1, 6), 0.4)


def pixels(p: Array) -> Array:
    image = K @ p
    return np.asarray(image[:2] / image[2])


CASES: dict[str, tuple[Callable[[Any], Any], Callable[[Array], Array]]] = {
    "reprojection": (lambda p: energies.reprojection(p, UV, K), lambda p: pixels(p) - UV),
    "acceleration": (
        lambda p: energies.acceleration(p, ACCELERATION, RATE),
        lambda p: np.diff(p, n=2, axis=1) * RATE**2 - ACCELERATION,
    ),
    "bone_vector_of_the_joint": (lambda p: energies.bone_vector(p, Q, P), lambda p: Q - p - P),
    "bone_vector_of_the_child": (lambda p: energies.bone_vector(Q, p, P), lambda p: p - Q - P),
    "jerk": (lambda p: energies.jerk(p, JERK, RATE), lambda p: np.diff(p, n=3, axis=1) * RATE**3 - JERK),
    "distance": (
        lambda p: energies.distance(p, Q, LENGTH),
        lambda p: np.linalg.norm(Q - p, axis=0, keepdims=True) - LENGTH,
    ),
    "position": (lambda p: energies.position(p, Q), lambda p: p - Q),
}


@pytest.mark.parametrize("name", CASES)
def test_a_residual_is_what_numpy_says(name: str) -> None:
    symbolic, numeric = CASES[name]
    np.testing.assert_allclose(np.array(symbolic(ca.DM(P))), numeric(P), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_a_residuals_derivative_agrees_with_finite_differences(name: str) -> None:
    symbolic, numeric = CASES[name]
    p = ca.SX.sym("p", *P.shape)
    J = np.array(ca.Function("J", [p], [ca.jacobian(ca.vec(symbolic(p)), ca.vec(p))])(P))
    step, columns = 1e-6, []
    for i in range(P.size):
        d = np.zeros(P.size)
        d[i] = step
        shift = d.reshape(P.shape, order="F")
        columns.append(((numeric(P + shift) - numeric(P - shift)) / (2 * step)).ravel(order="F"))
    np.testing.assert_allclose(J, np.stack(columns, axis=1), rtol=1e-6, atol=1e-6 * np.abs(J).max())


def test_a_constant_acceleration_is_matched_in_metres_per_second_squared() -> None:
    t = np.arange(9) / RATE
    a = np.array([[0.0], [2.0], [-9.81]])
    p = np.array([[1.0], [0.0], [2.0]]) + np.array([[3.0], [0.5], [0.0]]) * t + a * t**2 / 2
    residual = np.array(energies.acceleration(ca.DM(p), np.tile(a, 7), RATE))
    np.testing.assert_allclose(residual, 0, atol=1e-9)
    np.testing.assert_allclose(np.array(energies.jerk(ca.DM(p), np.zeros((3, 6)), RATE)), 0, atol=1e-6)


def test_a_constant_jerk_is_matched_in_metres_per_second_cubed() -> None:
    t = np.arange(9) / RATE
    p = np.array([[1.0], [-2.0], [6.0]]) * t**3 / 6
    residual = np.array(energies.jerk(ca.DM(p), np.tile([[1.0], [-2.0], [6.0]], 6), RATE))
    np.testing.assert_allclose(residual, 0, atol=1e-6)


def test_reprojection_is_in_pixels_and_the_cameras_own() -> None:
    cam = planted.camera()
    p = np.array([[0.1, 0.2, 1.0], [-0.4, 0.3, 1.4]])
    uv = cam.project(p).T + np.array([[1.0], [-2.0]])
    residual = np.array(energies.reprojection(ca.DM(cam.to_camera(p).T), uv, cam.K))
    np.testing.assert_allclose(residual, [[-1.0, -1.0], [2.0, 2.0]], atol=1e-9)


def test_moving_everything_along_the_rays_changes_no_reprojection() -> None:
    near = np.array(energies.reprojection(ca.DM(P), UV, K))
    far = np.array(energies.reprojection(ca.DM(2.5 * P), UV, K))
    np.testing.assert_allclose(near, far, atol=1e-9)


def test_distance_and_bone_vector_vanish_on_a_rigid_segment() -> None:
    length = np.linalg.norm(Q - P, axis=0, keepdims=True)
    np.testing.assert_allclose(np.array(energies.distance(ca.DM(P), Q, length)), 0, atol=1e-12)
    np.testing.assert_allclose(np.array(energies.bone_vector(ca.DM(P), Q, Q - P)), 0, atol=1e-12)


@given(residual=st.floats(0, 1e4), delta=st.floats(0.1, 10))
def test_pseudo_huber_lies_below_the_square_and_below_its_asymptote(residual: float, delta: float) -> None:
    value = float(energies.pseudo_huber(ca.DM(residual**2), delta))
    assert value <= residual**2 + 1e-9
    assert value <= 2 * delta * residual + 1e-9
    assert value >= -1e-12


def test_pseudo_huber_is_the_square_near_zero_and_linear_far_out() -> None:
    assert float(energies.pseudo_huber(ca.DM(1e-4), 2.0)) == pytest.approx(1e-4, rel=1e-4)
    step = [float(energies.pseudo_huber(ca.DM(r**2), 2.0)) for r in (1000.0, 1001.0)]
    assert step[1] - step[0] == pytest.approx(2 * 2.0, rel=1e-4)


@given(squared=st.floats(0.0, 1e3), delta=st.floats(0.1, 10))
def test_pseudo_hubers_weight_is_its_derivative(squared: float, delta: float) -> None:
    s = ca.SX.sym("s")
    slope = ca.Function("slope", [s], [ca.gradient(energies.pseudo_huber(s, delta), s)])
    weight = float(energies.pseudo_huber_weight(ca.DM(squared), delta))
    assert weight == pytest.approx(float(slope(squared)), rel=1e-9)
