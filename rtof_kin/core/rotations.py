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

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from rtof_kin.core.array_types import Array, blocks_of


def skew(v: ArrayLike) -> Array:
    """Return cross-product matrices (..., 3, 3): ``skew(a) @ b == cross(a, b)``; v: (..., 3)."""
    v = np.asarray(v, dtype=float)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def exp(rotvec: ArrayLike) -> Array:
    """Return rotation matrices (..., 3, 3) of rotation vectors; rotvec: (..., 3) rad."""
    rotvec = np.asarray(rotvec, dtype=float)
    flat = Rotation.from_rotvec(rotvec.reshape(-1, 3)).as_matrix()
    return np.asarray(flat).reshape(*rotvec.shape[:-1], 3, 3)


def log(R: ArrayLike) -> Array:
    """Return rotation vectors (..., 3), rad, of length at most pi; R: (..., 3, 3)."""
    R = np.asarray(R, dtype=float)
    return np.asarray(_rotation(R).as_rotvec()).reshape(*R.shape[:-2], 3)


def angle_between(R_a: ArrayLike, R_b: ArrayLike) -> Array:
    """Return the angle (...), rad, between orientations (..., 3, 3), from the chord ``|R_a - R_b|_F = 2 sqrt(2)
    sin(angle / 2)``, which is precise near 0.
    """
    chord = np.linalg.norm(np.asarray(R_a) - np.asarray(R_b), axis=(-2, -1))
    return np.asarray(2 * np.arcsin(np.clip(chord / np.sqrt(8), 0, 1)))


def about_axis(axis: str, angle: ArrayLike) -> Array:
    """Return rotations (..., 3, 3) about a coordinate axis; angle: (...) rad."""
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
    """Return vectors (..., 3) divided by their norms; the zero vector stays zero."""
    v = np.asarray(v, dtype=float)
    norm = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.asarray(np.divide(v, norm, out=np.zeros_like(v), where=norm > 0))


def angle_of(a: Array, b: Array) -> Array:
    """Return the angle (...), rad, between directions (..., 3), precise also near 0 and pi."""
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


def angle_about(axis: Array, R: Array) -> float:
    """Return the angle of a rotation about a given axis, in [-pi, pi]; axis: (3,) unit vector. R: (3, 3)."""
    sine = axis @ [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]
    return float(np.arctan2(sine, np.trace(R) - 1))


def minimal_rotation(a: ArrayLike, b: ArrayLike) -> Array:
    """Return the rotations (..., 3, 3) of smallest angle that turn direction a into b (..., 3), of any length. For
    opposite directions an arbitrary axis perpendicular to `a` is used; `kinematics.swing` chooses it over time. A zero
    vector gives the identity.
    """
    a, b = np.broadcast_arrays(unit(a), unit(b))
    cos = np.sum(a * b, axis=-1)
    # Rodrigues' formula loses precision near 180 deg. Beyond 90 deg: a half turn about the common normal
    # takes a to -a, and the remaining angle is below 90 deg.
    far = cos < 0
    normal = cross(np.where(far[..., None], -a, a), b)
    R = normal[..., :, None] * (normal / (1 + np.abs(cos))[..., None])[..., None, :] + skew(normal)
    R += (1 - np.sum(normal**2, axis=-1) / (1 + np.abs(cos)))[..., None, None] * np.eye(3)
    if np.any(far):
        R[far] = R[far] @ _half_turn(a[far], normal[far])
    return np.asarray(R)


def cross(a: Array, b: Array) -> Array:
    """Return cross products (..., 3), four times as fast as `numpy.cross`."""
    out = np.empty_like(a)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., i] = a[..., j] * b[..., k] - a[..., k] * b[..., j]
    return out


def _half_turn(a: Array, cross: Array) -> Array:
    """Return half turns (n, 3, 3) about normals of a (n, 3), along `cross` if it is not zero."""
    helper = np.where(np.abs(a[:, :1]) < 0.9, [1.0, 0, 0], [0, 1.0, 0])
    opposite = np.linalg.norm(cross, axis=-1, keepdims=True) < 1e-12
    normal = unit(np.where(opposite, np.cross(a, helper), cross))
    normal = unit(normal - a * np.sum(a * normal, axis=-1, keepdims=True))
    return 2 * normal[:, :, None] * normal[:, None, :] - np.eye(3)


def nearest_rotation(M: ArrayLike) -> Array:
    """Return the rotations (..., 3, 3) that maximise ``trace(R^T M)`` (Kabsch 1976, Umeyama's sign). With ``M = sum_i
    w_i b_i a_i^T`` this is the weighted least-squares rotation that maps a_i to b_i.
    """
    U, _, Vt = np.linalg.svd(np.asarray(M, dtype=float))
    sign = np.sign(np.linalg.det(U @ Vt))
    U = U.copy()
    U[..., :, 2] *= sign[..., None]
    return np.asarray(U @ Vt)


def heading(R: ArrayLike) -> Array:
    """Return the angle (...), rad, of the rotation about z nearest to R; R: (..., 3, 3)."""
    R = np.asarray(R, dtype=float)
    return np.asarray(np.arctan2(R[..., 1, 0] - R[..., 0, 1], R[..., 0, 0] + R[..., 1, 1]))


def from_quat_wxyz(quat_wxyz: ArrayLike) -> Array:
    """Return rotation matrices (..., 3, 3) of quaternions; quat_wxyz: (..., 4), scalar first."""
    quat = np.asarray(quat_wxyz, dtype=float)
    flat = Rotation.from_quat(quat.reshape(-1, 4), scalar_first=True).as_matrix()
    return np.asarray(flat).reshape(*quat.shape[:-1], 3, 3)


def to_quat_wxyz(R: ArrayLike) -> Array:
    """Return quaternions (..., 4), scalar first, continuous along the first axis; R: (..., 3, 3)."""
    R = np.asarray(R, dtype=float)
    quat = np.asarray(_rotation(R).as_quat(scalar_first=True)).reshape(*R.shape[:-2], 4)
    if quat.ndim > 1 and len(quat) > 1:
        flips = np.where(np.sum(quat[1:] * quat[:-1], axis=-1, keepdims=True) < 0, -1.0, 1.0)
        quat[1:] *= np.cumprod(flips, axis=0)
    return quat


def _rotation(R: Array) -> Rotation:
    """Return SciPy's rotations of matrices (..., 3, 3); its own check of them takes ten times as long as all else."""
    flat = R.reshape(-1, 3, 3)
    return Rotation.from_matrix(flat, assume_valid=is_rotation(flat, _ROUNDING))


_ROUNDING = 1e-12  # From which on SciPy takes the nearest rotation


def _where_known(function: Callable[[Array], Array], values: Array, axes: int, shape: tuple[int, ...]) -> Array:
    """Return a function's results of a shape; NaN as a whole where the values of so many last axes are not finite."""
    known = np.isfinite(values).all(axis=tuple(range(-axes, 0)))
    out = np.full((*known.shape, *shape), np.nan)
    out[known] = function(values[known])
    return out


def known_from_quat_wxyz(quat_wxyz: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) of quaternions, scalar first; NaN as a whole where not finite."""
    return _where_known(from_quat_wxyz, quat_wxyz, 1, (3, 3))


def known_to_quat_wxyz(R: Array) -> Array:
    """Return the quaternions (..., 4), scalar first, of matrices; NaN as a whole where not finite."""
    return _where_known(to_quat_wxyz, R, 2, (4,))


def known_exp(rotvec: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3), rad; NaN as a whole where not finite."""
    return _where_known(exp, rotvec, 1, (3, 3))


def known_log(R: Array) -> Array:
    """Return the rotation vectors (..., 3), rad, of matrices (..., 3, 3); NaN as a whole where not finite."""
    return _where_known(log, R, 2, (3,))


def is_rotation(R: ArrayLike, tolerance: float = 1e-6) -> bool:
    """Return whether all matrices (..., 3, 3) are orthonormal and right-handed, dot and cross products of rows to
    `tolerance`; NaN is not.
    """
    flat = np.asarray(R, dtype=float).reshape(-1, 9)
    for part in map(flat.__getitem__, blocks_of(len(flat))):
        if not np.all(np.abs(part) <= 1 + tolerance):  # also if one is NaN or infinite
            return False
        x, y, z = part.T.copy().reshape(3, 3, -1)  # rows of all matrices: x cross y is z
        errors = (x * x).sum(0) - 1, (y * y).sum(0) - 1, (x * y).sum(0), cross(x.T, y.T).T - z
        if not all(np.all(np.abs(error) < tolerance) for error in errors):
            return False
    return True


# --- Euler angles: intrinsic, about three different axes in any order ----------------------------


def euler_to_matrix(order: str, angles: ArrayLike) -> Array:
    """Return the product (..., 3, 3) of rotations about three different axes by angles (..., 3), rad, in their order:
    of 'yxz' ``R = R_y(a0) R_x(a1) R_z(a2)``.
    """
    angles = np.asarray(angles, dtype=float)
    first, second, third = (about_axis(axis, angles[..., i]) for i, axis in enumerate(order))
    return np.asarray(first @ second @ third)


def matrix_to_euler(order: str, R: ArrayLike) -> Array:
    """Return the angles (..., 3), rad, of `euler_to_matrix`, the middle one in [-pi/2, pi/2]. At a singular posture
    (middle angle +-90 degrees) the first angle is 0 and the third is the whole turn.
    """
    R = np.asarray(R, dtype=float)
    i, j, k = ("xyz".index(axis) for axis in order)
    e = 1.0 if (j - i) % 3 == 1 else -1.0
    middle = np.arctan2(e * R[..., i, k], np.hypot(R[..., i, i], R[..., i, j]))
    first = np.arctan2(-e * R[..., j, k], R[..., k, k])
    singular = np.hypot(R[..., i, i], R[..., i, j]) < 1e-12
    first = np.where(singular, 0.0, first)
    # The third angle from R_first^T R is exact for any value of the first.
    c, s = np.cos(first), np.sin(first)
    row_j = c[..., None] * R[..., j, :] + e * s[..., None] * R[..., k, :]
    third = np.arctan2(e * row_j[..., i], row_j[..., j])
    return np.stack([first, middle, third], axis=-1)


def euler_near(angles: ArrayLike, reference: ArrayLike) -> Array:
    """Return the equivalent Euler angles (..., 3), rad, of three different axes that are nearest to a reference. Every
    rotation has two triples modulo whole turns: (a, b, c) and (a + pi, pi - b, c + pi).
    """
    angles, reference = np.asarray(angles, dtype=float), np.asarray(reference, dtype=float)
    turned = np.stack([angles[..., 0] + np.pi, np.pi - angles[..., 1], angles[..., 2] + np.pi], -1)

    def wrap(a: Array) -> Array:
        return np.asarray(a + 2 * np.pi * np.round((reference - a) / (2 * np.pi)))

    a, b = wrap(angles), wrap(turned)
    closer = np.sum((a - reference) ** 2, -1) <= np.sum((b - reference) ** 2, -1)
    return np.where(closer[..., None], a, b)


def euler_continuous(angles: ArrayLike) -> Array:
    """Return Euler angles (T, ..., 3), rad, of three different axes, finite, on the branch nearest to the frame before,
    unwrapped over time. The distance between the branches of two frames (see `euler_near`) is symmetric, so whether to
    change branch does not depend on the current one: the branch is the parity of the changes so far.
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
