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
    """Position minus the one it is pulled to, m (3, n): the named prior E_P, or a foothold."""
    return p - p_prior


def pseudo_huber(squared: Matrix, delta: Matrix | float) -> Matrix:
    """Robust loss of a squared whitened residual: s near 0, ``2 delta sqrt(s)`` far out.

    ``2 delta^2 (sqrt(1 + s / delta^2) - 1)``; smooth, so that second-order solvers stay quick.
    """
    return 2 * delta**2 * (ca.sqrt(1 + squared / delta**2) - 1)


def pseudo_huber_weight(squared: Matrix, delta: Matrix | float) -> Matrix:
    """Derivative of `pseudo_huber`: the weight of the residual in a Gauss-Newton Hessian."""
    return 1 / ca.sqrt(1 + squared / delta**2)


# --- rotations, as quaternions w x y z (4, 1) ----------------------------------------------------


def quat_multiply(a: Matrix, b: Matrix) -> Matrix:
    """Product of two quaternions (4, 1): first turn by b, then by a."""
    w, v, s, u = a[0], a[1:], b[0], b[1:]
    return ca.vertcat(w * s - ca.dot(v, u), w * u + s * v + ca.cross(v, u))


def quat_conjugate(q: Matrix) -> Matrix:
    """Inverse of a unit quaternion (4, 1)."""
    return ca.vertcat(q[0], -q[1:])


def quat_matrix(q: Matrix) -> Matrix:
    """Rotation matrix (3, 3) of a unit quaternion (4, 1)."""
    w, x, y, z = (q[i] for i in range(4))
    return ca.vertcat(
        ca.horzcat(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        ca.horzcat(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        ca.horzcat(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def orientation(q: Matrix, q_measured: Matrix) -> Matrix:
    """Measured to actual orientation of a segment, in the segment's axes, rad (3, 1).

    ``2 sin(angle / 2)`` along the axis: the rotation vector where it is small, and smooth and monotone
    up to half a turn. Swing and twist are its components across and along the bone.
    """
    error = quat_multiply(quat_conjugate(q_measured), q)
    return 2 * ca.if_else(error[0] < 0, -1, 1) * error[1:]


def rotation_vector(q: Matrix, q_mean: Matrix) -> Matrix:
    """Rotation vector of a joint from its mean rotation, in the joint's axes, rad (3, 1)."""
    error = quat_multiply(quat_conjugate(q_mean), q)
    sign = ca.if_else(error[0] < 0, -1, 1)
    sine = ca.sqrt(ca.sumsqr(error[1:]) + 1e-18)
    return 2 * sign * ca.atan2(sine, sign * error[0]) / sine * error[1:]


def step_jerk(steps: Matrix, rate_hz: Matrix) -> Matrix:
    """Second difference of steps between frames, per s^3 (D, n - 2): jerk on tangent coordinates.

    Args:
        steps: (D, n) displacement (m) or rotation vector (rad) from each frame to the next.
    """
    return (steps[:, 2:] - 2 * steps[:, 1:-1] + steps[:, :-2]) * rate_hz**3


def height(p: Matrix, floor: Matrix) -> Matrix:
    """Height of a point over where it is when it stands on the floor, m (1, n)."""
    return p[2, :] - floor


def cauchy(squared: Matrix) -> Matrix:
    """Robust loss log(1 + s) of a squared whitened residual: outliers hardly count."""
    return ca.log(1 + squared)


def cauchy_weight(squared: Matrix) -> Matrix:
    """Derivative of `cauchy`."""
    return 1 / (1 + squared)
