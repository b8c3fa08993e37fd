"""Catalogue of residuals: (state, observation) -> vector with a unit.

Pure functions on CasADi matrices with one column per point or instant, shared by every solver. They
return plain differences; the problem that uses them divides by a sigma and weighs.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

Matrix = Any
"""casadi.SX, MX or DM; (3, n) with a point or an instant in each column unless said otherwise."""


def reprojection(p_camera: Matrix, uv_px: Matrix, K: Matrix) -> Matrix:
    """Return projected minus observed landmarks (2, n), px: the paper's E_V.

    Args:
        p_camera: (3, n) camera coordinates, m. uv_px: (2, n) undistorted pixels. K: (3, 3) px.
    """
    homogeneous: Matrix = ca.mtimes(K, p_camera)
    return ca.vertcat(*(homogeneous[i, :] / homogeneous[2, :] for i in range(2))) - uv_px


def acceleration(p: Matrix, a_world: Matrix, rate_hz: Matrix) -> Matrix:
    """Return central second difference minus measured acceleration (3, n - 2), m/s^2: E_A.

    Args:
        p: (3, n) positions of the sensor, m. a_world: (3, n - 2) m/s^2.
    """
    return (p[:, 2:] - 2 * p[:, 1:-1] + p[:, :-2]) * rate_hz**2 - a_world


def bone_vector(p_joint: Matrix, p_child: Matrix, b_world: Matrix) -> Matrix:
    """Return bone from joint to child minus the rest bone turned by the sensor (3, n), m: E_B.

    Args:
        p_joint, p_child, b_world: (3, n) m.
    """
    return p_child - p_joint - b_world


def jerk(p: Matrix, j_world: Matrix, rate_hz: Matrix) -> Matrix:
    """Return third difference minus a target (3, n - 3), m/s^3: E_S.

    Args:
        p: (3, n) m. j_world: (3, n - 3) m/s^3, zero for smoothness.
    """
    difference = p[:, 3:] - 3 * p[:, 2:-1] + 3 * p[:, 1:-2] - p[:, :-3]
    return difference * rate_hz**3 - j_world


def distance(p_a: Matrix, p_b: Matrix, length: Matrix) -> Matrix:
    """Return the distance of two points of a rigid segment minus its length (1, n), m.

    Args:
        p_a, p_b: (3, n) m. length: of the skeleton, m.
    """
    difference = p_b - p_a
    return ca.sqrt(ca.sum1(difference * difference)) - length


def position(p: Matrix, p_prior: Matrix) -> Matrix:
    """Return position minus that of a prior or a foothold (3, n), m: E_P.

    Args:
        p, p_prior: (3, n) m.
    """
    return p - p_prior


def pseudo_huber(squared: Matrix, delta: Matrix | float) -> Matrix:
    """Return the robust loss ``2 delta^2 (sqrt(1 + s / delta^2) - 1)``.

    Args:
        squared: s, squared whitened residual.
    """
    return 2 * delta**2 * (ca.sqrt(1 + squared / delta**2) - 1)


def pseudo_huber_weight(squared: Matrix, delta: Matrix | float) -> Matrix:
    """Return the derivative of `pseudo_huber` by `squared`, the weight in a Gauss-Newton Hessian."""
    return 1 / ca.sqrt(1 + squared / delta**2)


def quat_multiply(a: Matrix, b: Matrix) -> Matrix:
    """Return the product of quaternions w x y z (4, 1): first b, then a."""
    w, v, s, u = a[0], a[1:], b[0], b[1:]
    return ca.vertcat(w * s - ca.dot(v, u), w * u + s * v + ca.cross(v, u))


def quat_conjugate(q: Matrix) -> Matrix:
    """Return the inverse of a unit quaternion (4, 1)."""
    return ca.vertcat(q[0], -q[1:])


def quat_matrix(q: Matrix) -> Matrix:
    """Return the rotation matrix (3, 3) of a unit quaternion (4, 1)."""
    w, x, y, z = (q[i] for i in range(4))
    return ca.vertcat(
        ca.horzcat(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        ca.horzcat(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        ca.horzcat(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def orientation(q: Matrix, q_measured: Matrix) -> Matrix:
    """Return the error of an orientation in the segment's axes (3, 1), rad.

    ``2 sin(angle / 2)`` along the axis: smooth and monotone up to half a turn.

    Args:
        q, q_measured: unit quaternions (4, 1).
    """
    error = quat_multiply(quat_conjugate(q_measured), q)
    return 2 * ca.if_else(error[0] < 0, -1, 1) * error[1:]


def rotation_vector(q: Matrix, q_mean: Matrix) -> Matrix:
    """Return the rotation vector of a joint from its mean, in its axes (3, 1), rad.

    Args:
        q, q_mean: unit quaternions (4, 1).
    """
    error = quat_multiply(quat_conjugate(q_mean), q)
    sign = ca.if_else(error[0] < 0, -1, 1)
    sine = ca.sqrt(ca.sumsqr(error[1:]) + 1e-18)
    return 2 * sign * ca.atan2(sine, sign * error[0]) / sine * error[1:]


def step_jerk(steps: Matrix, rate_hz: Matrix) -> Matrix:
    """Return the jerk of tangent coordinates (D, n - 2), m/s^3 or rad/s^3.

    Args:
        steps: (D, n) m or rad from each frame to the next.
    """
    return (steps[:, 2:] - 2 * steps[:, 1:-1] + steps[:, :-2]) * rate_hz**3


def height(p: Matrix, floor: Matrix) -> Matrix:
    """Return the height of a point over that of standing (1, n), m.

    Args:
        p: (3, n) m. floor: height of a standing point, m.
    """
    return p[2, :] - floor


def cauchy(squared: Matrix) -> Matrix:
    """Return the robust loss log(1 + s) of a squared whitened residual s."""
    return ca.log(1 + squared)


def cauchy_weight(squared: Matrix) -> Matrix:
    """Return the derivative of `cauchy`."""
    return 1 / (1 + squared)
