"""SO(3) on arrays: any leading batch axes, no loop over time.

A rotation matrix `R_a_b` maps coordinates in frame b to frame a: ``v_a = R_a_b @ v_b``. Inner names
cancel in a product, ``R_a_c = R_a_b @ R_b_c``.

Frame words used throughout the package:

========== =====================================================================================
world      gravity-aligned, z up, metres
root       the frame of the skeleton's root link (Hips)
bone       a segment's link frame: in the T-pose x forward, y left, z up for every segment
joint      the point where a segment begins; it carries the segment's name
sensor     the axes printed on an IMU
inertial   a sensor's own gravity-aligned reference, z up, with a heading of its own
camera     x right, y down, z forward (OpenCV)
========== =====================================================================================
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def skew(v: ArrayLike) -> Array:
    """Cross-product matrices: ``skew(a) @ b == cross(a, b)``.

    Args:
        v: vectors (..., 3).

    Returns:
        Matrices (..., 3, 3).
    """
    v = np.asarray(v, dtype=float)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def exp(rotvec: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians."""
    rotvec = np.asarray(rotvec, dtype=float)
    flat = Rotation.from_rotvec(rotvec.reshape(-1, 3)).as_matrix()
    return np.asarray(flat).reshape(*rotvec.shape[:-1], 3, 3)


def log(R: ArrayLike) -> Array:
    """Rotation vectors (..., 3) in radians, of length at most pi, of matrices (..., 3, 3)."""
    R = np.asarray(R, dtype=float)
    flat = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec()
    return np.asarray(flat).reshape(*R.shape[:-2], 3)


def angle_between(R_a: ArrayLike, R_b: ArrayLike) -> Array:
    """Angle in radians (...) of the rotation that takes one orientation to the other.

    From the chord ``|R_a - R_b|_F = 2 sqrt(2) sin(angle / 2)``, which keeps full precision near 0.
    """
    chord = np.linalg.norm(np.asarray(R_a) - np.asarray(R_b), axis=(-2, -1))
    return np.asarray(2 * np.arcsin(np.clip(chord / np.sqrt(8), 0, 1)))


def about_axis(axis: str, angle: ArrayLike) -> Array:
    """Rotations (..., 3, 3) by `angle` (...) in radians about the coordinate axis 'x', 'y' or 'z'."""
    angle = np.asarray(angle, dtype=float)
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    R = np.zeros((*angle.shape, 3, 3))
    R[..., i, i] = 1
    R[..., j, j] = R[..., k, k] = np.cos(angle)
    R[..., k, j] = np.sin(angle)
    R[..., j, k] = -R[..., k, j]
    return R


def unit(v: ArrayLike) -> Array:
    """Vectors (..., 3) divided by their norms; the zero vector stays zero."""
    v = np.asarray(v, dtype=float)
    norm = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.asarray(np.divide(v, norm, out=np.zeros_like(v), where=norm > 0))


def angle_about(axis: Array, R: Array) -> float:
    """Angle of a rotation (3, 3) about a known axis, a unit vector (3,), in [-pi, pi]."""
    sine = axis @ [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]
    return float(np.arctan2(sine, np.trace(R) - 1))


def minimal_rotation(a: ArrayLike, b: ArrayLike) -> Array:
    """The rotation with the smallest angle that turns direction a into direction b.

    Where the two are opposite the axis is arbitrary; one perpendicular to `a` is taken.
    `kinematics.swing` chooses it over time.

    Args:
        a, b: directions (..., 3); need not be unit vectors. A zero vector gives the identity.

    Returns:
        Rotations (..., 3, 3).
    """
    a, b = np.broadcast_arrays(unit(a), unit(b))
    cos = np.sum(a * b, axis=-1)
    # Rodrigues' formula loses its digits near half a turn. Past a right angle: half a turn about the
    # common normal takes a to -a, and the rest is less than a right angle.
    far = cos < 0
    cross = _cross(np.where(far[..., None], -a, a), b)
    R = cross[..., :, None] * (cross / (1 + np.abs(cos))[..., None])[..., None, :] + skew(cross)
    R += (1 - np.sum(cross**2, axis=-1) / (1 + np.abs(cos)))[..., None, None] * np.eye(3)
    if np.any(far):
        R[far] = R[far] @ _half_turn(a[far], cross[far])
    return np.asarray(R)


def _cross(a: Array, b: Array) -> Array:
    """Cross products (..., 3): NumPy's own takes four times as long."""
    out = np.empty_like(a)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., i] = a[..., j] * b[..., k] - a[..., k] * b[..., j]
    return out


def _half_turn(a: Array, cross: Array) -> Array:
    """Half turns (n, 3, 3) about normals of directions a (n, 3): `cross` where that is one."""
    helper = np.where(np.abs(a[:, :1]) < 0.9, [1.0, 0, 0], [0, 1.0, 0])
    opposite = np.linalg.norm(cross, axis=-1, keepdims=True) < 1e-12
    normal = unit(np.where(opposite, np.cross(a, helper), cross))
    normal = unit(normal - a * np.sum(a * normal, axis=-1, keepdims=True))
    return 2 * normal[:, :, None] * normal[:, None, :] - np.eye(3)


def nearest_rotation(M: ArrayLike) -> Array:
    """The rotation (..., 3, 3) that maximises ``trace(R^T M)`` (Kabsch 1976, Umeyama's sign).

    With ``M = sum_i w_i b_i a_i^T`` this is the weighted least-squares rotation taking a_i to b_i.
    """
    U, _, Vt = np.linalg.svd(np.asarray(M, dtype=float))
    sign = np.sign(np.linalg.det(U @ Vt))
    U = U.copy()
    U[..., :, 2] *= sign[..., None]
    return np.asarray(U @ Vt)


def heading(R: ArrayLike) -> Array:
    """Rotation about z, in radians (...), that is nearest to R (..., 3, 3)."""
    R = np.asarray(R, dtype=float)
    return np.asarray(np.arctan2(R[..., 1, 0] - R[..., 0, 1], R[..., 0, 0] + R[..., 1, 1]))


def from_quat_wxyz(quat_wxyz: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) with the scalar first."""
    quat = np.asarray(quat_wxyz, dtype=float)
    flat = Rotation.from_quat(quat.reshape(-1, 4), scalar_first=True).as_matrix()
    return np.asarray(flat).reshape(*quat.shape[:-1], 3, 3)


def to_quat_wxyz(R: ArrayLike) -> Array:
    """Quaternions (..., 4), scalar first, continuous along the first axis, of R (..., 3, 3)."""
    R = np.asarray(R, dtype=float)
    flat = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat(scalar_first=True)
    quat = np.asarray(flat).reshape(*R.shape[:-2], 4)
    if quat.ndim > 1 and len(quat) > 1:
        flips = np.where(np.sum(quat[1:] * quat[:-1], axis=-1, keepdims=True) < 0, -1.0, 1.0)
        quat[1:] *= np.cumprod(flips, axis=0)
    return quat


def is_rotation(R: ArrayLike, tolerance: float = 1e-6) -> bool:
    """Whether all of R (..., 3, 3) are orthonormal and right-handed to `tolerance`; NaN is not."""
    R = np.asarray(R, dtype=float)
    if not np.all(np.abs(R) <= 1 + tolerance):  # as it is where one is NaN or infinite
        return False
    x, y, z = R.reshape(-1, 9).T.copy().reshape(3, 3, -1)  # rows of all matrices: x cross y is z
    errors = (x * x).sum(0) - 1, (y * y).sum(0) - 1, (x * y).sum(0), np.cross(x, y, axis=0) - z
    return all(bool(np.all(np.abs(error) < tolerance)) for error in errors)


# --- Euler angles: intrinsic, any of the six sequences of three different axes -------------------


def euler_to_matrix(order: str, angles: ArrayLike) -> Array:
    """Product of three coordinate rotations in the order given.

    Args:
        order: three different axes, e.g. 'yxz'; ``R = R_y(a0) R_x(a1) R_z(a2)``, intrinsic.
        angles: (..., 3) in radians, in that order.

    Returns:
        Rotations (..., 3, 3).
    """
    angles = np.asarray(angles, dtype=float)
    first, second, third = (about_axis(axis, angles[..., i]) for i, axis in enumerate(order))
    return np.asarray(first @ second @ third)


def matrix_to_euler(order: str, R: ArrayLike) -> Array:
    """Angles (..., 3) of `euler_to_matrix`, the middle one in [-pi/2, pi/2].

    Within rounding of a singular posture (middle angle +-90 degrees) the first angle is set to 0 and
    the third carries the whole turn, so the product is exact there too.
    """
    R = np.asarray(R, dtype=float)
    i, j, k = ("xyz".index(axis) for axis in order)
    e = 1.0 if (j - i) % 3 == 1 else -1.0
    middle = np.arctan2(e * R[..., i, k], np.hypot(R[..., i, i], R[..., i, j]))
    first = np.arctan2(-e * R[..., j, k], R[..., k, k])
    singular = np.hypot(R[..., i, i], R[..., i, j]) < 1e-12
    first = np.where(singular, 0.0, first)
    # The third angle from R_first^T R, exact whichever value the first one took.
    c, s = np.cos(first), np.sin(first)
    row_j = c[..., None] * R[..., j, :] + e * s[..., None] * R[..., k, :]
    third = np.arctan2(e * row_j[..., i], row_j[..., j])
    return np.stack([first, middle, third], axis=-1)


def euler_near(angles: ArrayLike, reference: ArrayLike) -> Array:
    """The representative of Euler angles nearest to a reference.

    Every rotation has two triples modulo whole turns: (a, b, c) and (a + pi, pi - b, c + pi).

    Args:
        angles: (..., 3) in radians, three different axes.
        reference: (..., 3) in radians.

    Returns:
        (..., 3) in radians, the one of the family with the smallest distance to the reference.
    """
    angles, reference = np.asarray(angles, dtype=float), np.asarray(reference, dtype=float)
    turned = np.stack([angles[..., 0] + np.pi, np.pi - angles[..., 1], angles[..., 2] + np.pi], -1)

    def wrap(a: Array) -> Array:
        return np.asarray(a + 2 * np.pi * np.round((reference - a) / (2 * np.pi)))

    a, b = wrap(angles), wrap(turned)
    closer = np.sum((a - reference) ** 2, -1) <= np.sum((b - reference) ** 2, -1)
    return np.where(closer[..., None], a, b)


def euler_continuous(angles: ArrayLike) -> Array:
    """Euler angles (T, ..., 3) on the branch nearest to the frame before, unwrapped over time.

    The two branches of a rotation, see `euler_near`, are as far from each other whichever of them comes
    first, so whether to change branch between two frames does not depend on the branch one is on: the
    branch is the parity of the changes so far.

    Args:
        angles: radians, three different axes, finite.
    """
    angles = np.asarray(angles, dtype=float)
    other = np.array([1.0, -1.0, 1.0]) * angles + np.pi

    def distance(step: Array) -> Array:
        return np.asarray(np.sum((step - 2 * np.pi * np.round(step / (2 * np.pi))) ** 2, axis=-1))

    change = distance(other[1:] - angles[:-1]) < distance(angles[1:] - angles[:-1])
    start = np.zeros((1, *angles.shape[1:-1]), dtype=bool)
    on_other = np.concatenate([start, np.cumsum(change, axis=0) % 2 == 1])
    chosen = np.where(on_other[..., None], other, angles)
    return np.asarray(np.unwrap(chosen, axis=0))
