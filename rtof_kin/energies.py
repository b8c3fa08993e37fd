"""The catalogue of residuals: (state, observation) -> vector with a unit.

Small pure functions on CasADi matrices with one column per point or instant, shared by every solver.
They return plain differences; dividing by a sigma and weighting happen in one place, in the problem that
uses them. Each is checked against finite differences in the tests.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

Matrix = Any
"""casadi.SX, MX or DM; (3, n) with a point or an instant in each column unless said otherwise."""


def reprojection(p_camera: Matrix, uv_px: Matrix, K: Matrix) -> Matrix:
    """Projected minus observed landmarks, px (2, n): the paper's E_V with its perspective division.

    Args:
        p_camera: (3, n) camera coordinates, m. uv_px: (2, n) undistorted pixels. K: (3, 3) px.
    """
    homogeneous: Matrix = ca.mtimes(K, p_camera)
    return ca.vertcat(*(homogeneous[i, :] / homogeneous[2, :] for i in range(2))) - uv_px


def acceleration(p: Matrix, a_world: Matrix, rate_hz: Matrix) -> Matrix:
    """Central second difference minus measured acceleration, m/s^2 (3, n - 2): E_A.

    Args:
        p: (3, n) positions of the sensor at successive instants, m. a_world: (3, n - 2) m/s^2.
    """
    return (p[:, 2:] - 2 * p[:, 1:-1] + p[:, :-2]) * rate_hz**2 - a_world


def bone_vector(p_joint: Matrix, p_child: Matrix, b_world: Matrix) -> Matrix:
    """Bone from joint to child minus the rest bone turned by the sensor, m (3, n): E_B."""
    return p_child - p_joint - b_world


def jerk(p: Matrix, j_world: Matrix, rate_hz: Matrix) -> Matrix:
    """Third difference minus a target, m/s^3 (3, n - 3): E_S; a target of zero asks for smoothness."""
    difference = p[:, 3:] - 3 * p[:, 2:-1] + 3 * p[:, 1:-2] - p[:, :-3]
    return difference * rate_hz**3 - j_world


def distance(p_a: Matrix, p_b: Matrix, length: Matrix) -> Matrix:
    """Distance of two points of one rigid segment minus what it is in the skeleton, m (1, n)."""
    difference = p_b - p_a
    return ca.sqrt(ca.sum1(difference * difference)) - length


def position(p: Matrix, p_prior: Matrix) -> Matrix:
    """Position minus the one it is weakly pulled to, m (3, n): the named prior E_P."""
    return p - p_prior


def pseudo_huber(squared: Matrix, delta: float) -> Matrix:
    """Robust loss of a squared whitened residual: s near 0, ``2 delta sqrt(s)`` far out.

    ``2 delta^2 (sqrt(1 + s / delta^2) - 1)``; smooth, so that second-order solvers stay quick.
    """
    return 2 * delta**2 * (ca.sqrt(1 + squared / delta**2) - 1)


def pseudo_huber_weight(squared: Matrix, delta: float) -> Matrix:
    """Derivative of `pseudo_huber`: the weight of the residual in a Gauss-Newton Hessian."""
    return 1 / ca.sqrt(1 + squared / delta**2)
