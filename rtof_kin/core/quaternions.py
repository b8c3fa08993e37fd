"""Unit quaternions w x y z on arrays with any leading batch axes: state of the joint-space solver.

Elsewhere rotations are matrices; an optimiser steps on quaternions, which are easily normalised.
"""

from __future__ import annotations

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array

_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])
_LEFT = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
_SIGNS = np.array([[1.0, -1, -1, -1], [1, 1, -1, 1], [1, 1, 1, -1], [1, -1, 1, 1]])
"""Components of a, and their signs, in the matrix of the product a b with b."""


def multiply(a: Array, b: Array) -> Array:
    """Return products (..., 4): rotation by b, then by a; a, b: (..., 4)."""
    return np.asarray(np.einsum("...ij,...j->...i", a[..., _LEFT] * _SIGNS, b))


def conjugate(q: Array) -> Array:
    """Return inverses (..., 4); q: (..., 4)."""
    return np.asarray(q * _CONJUGATE)


def exp(rotvec: Array) -> Array:
    """Return quaternions (..., 4) of rotation vectors; rotvec: (..., 3) rad."""
    half = np.linalg.norm(rotvec, axis=-1, keepdims=True) / 2
    return np.concatenate([np.cos(half), np.sinc(half / np.pi) * rotvec / 2], axis=-1)


def log(q: Array) -> Array:
    """Return rotation vectors (..., 3), rad, of length at most pi; q: (..., 4)."""
    w, v = q[..., :1], q[..., 1:]
    sine = np.sqrt(np.einsum("...i,...i->...", v, v))[..., None]
    factor = np.where(sine > 1e-9, 2 * np.arctan2(sine, np.abs(w)) / np.maximum(sine, 1e-12), 2.0)
    return np.asarray(np.where(w < 0, -factor, factor) * v)


def right_jacobian_inverse(rotvec: Array) -> Array:
    """Return derivatives (..., 3, 3) of log(exp(v) exp(d)) by d at d = 0, v in rad (Sola et al. 2018, eq. 144)."""
    angle = np.linalg.norm(rotvec, axis=-1)[..., None, None]
    safe = np.maximum(angle, 1e-3)
    factor = np.where(angle > 1e-3, 1 / safe**2 - (1 + np.cos(safe)) / (2 * safe * np.sin(safe)), 1 / 12)
    K = so3.skew(rotvec)
    return np.asarray(np.eye(3) + K / 2 + factor * (K @ K))


def right_jacobian(rotvec: Array) -> Array:
    """Return derivatives (..., 3, 3) of log(exp(v)^-1 exp(v + d)) by d at d = 0, v in rad (Sola et al. 2018, eq.
    143).
    """
    angle = np.linalg.norm(rotvec, axis=-1)[..., None, None]
    safe = np.maximum(angle, 1e-3)
    first = np.where(angle > 1e-3, (1 - np.cos(safe)) / safe**2, 0.5 - angle**2 / 24)
    second = np.where(angle > 1e-3, (safe - np.sin(safe)) / safe**3, 1 / 6 - angle**2 / 120)
    K = so3.skew(rotvec)
    return np.asarray(np.eye(3) - first * K + second * (K @ K))
