"""Each residual against NumPy's formula, its derivative against finite differences, its unit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
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
def test_residual_equals_numpy(name: str) -> None:
    symbolic, numeric = CASES[name]
    np.testing.assert_allclose(np.array(symbolic(ca.DM(P))), numeric(P), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_derivative_equals_finite_differences(name: str) -> None:
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


@given(residual=st.floats(0, 1e4), delta=st.floats(0.1, 10))
def test_pseudo_huber_lies_below_the_square_and_below_its_asymptote(residual: float, delta: float) -> None:
    value = float(energies.pseudo_huber(ca.DM(residual**2), delta))
    assert value <= residual**2 + 1e-9
    assert value <= 2 * delta * residual + 1e-9
    assert value >= -1e-12


@given(squared=st.floats(0.0, 1e3), delta=st.floats(0.1, 10))
def test_pseudo_hubers_weight_is_its_derivative(squared: float, delta: float) -> None:
    s = ca.SX.sym("s")
    slope = ca.Function("slope", [s], [ca.gradient(energies.pseudo_huber(s, delta), s)])
    weight = float(energies.pseudo_huber_weight(ca.DM(squared), delta))
    assert weight == pytest.approx(float(slope(squared)), rel=1e-9)
