"""Axes of joints from angular velocities: of a hinge between two sensors, of one sensor's turning."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError

Array = NDArray[np.float64]
LEAST_RATE = 0.4
"""Root mean square turning, rad/s, from which on a movement has an axis."""
_ROBUST_RATE = 0.3
_STARTS = 6


@dataclass(frozen=True)
class HingeAxis:
    """The axis of a hinge, in the axes of the two sensors beside it; its sign in each is arbitrary."""

    axis_1: Array
    """(3,) unit vector in the first sensor's axes."""
    axis_2: Array
    """(3,) the same axis in the second's."""
    residual: float
    """Root mean square disagreement of the two, rad/s."""


def hinge_axis(w_1: ArrayLike, w_2: ArrayLike, planar: float = 0.1) -> HingeAxis:
    """The axis that two segments share, from the angular velocities of sensors on them.

    Minimises ``|w_1 x j_1| - |w_2 x j_2|`` over unit vectors j_1 and j_2 (Seel, Schauer, Raisch 2012:
    what is left of both across the axis has the same length), with a robust loss and from several starts.
    Where all turning is in one plane that tells nothing; so a second term asks for as little turning
    across the axis as may be, since to bend a joint is mostly to turn about it.

    Args:
        w_1, w_2: (T, 3) rad/s in each sensor's own axes, at the same instants; NaN where missing.
        planar: weight of the second term; little where both segments turn in all directions, 1 where they
            mostly do about the hinge.

    Raises:
        CalibrationError: there are fewer than ten instants, or a sensor hardly turns.
    """
    a, b = np.asarray(w_1, dtype=float), np.asarray(w_2, dtype=float)
    known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    a, b = a[known], b[known]
    if len(a) < 10:
        raise CalibrationError(
            f"hinge: there are {len(a)} instants at which both sensors measured; ten are needed"
        )
    if max(rms_rate(a), rms_rate(b)) < LEAST_RATE:
        raise CalibrationError(
            f"hinge: the sensors turn by {max(rms_rate(a), rms_rate(b)):.2g} rad/s only; bend the joint more"
        )

    def disagreement(axes: Array) -> Array:
        j_1, j_2 = so3.unit(axes[:3]), so3.unit(axes[3:])
        across = [np.linalg.norm(np.cross(w, j), axis=-1) for w, j in ((a, j_1), (b, j_2))]
        return np.concatenate([across[0] - across[1], planar * across[0], planar * across[1]])

    rng = np.random.default_rng(0)
    starts = [np.concatenate([principal_axis(a)[0], principal_axis(b)[0]])]
    starts += list(rng.standard_normal((_STARTS - 1, 6)))
    fits = [least_squares(disagreement, s, loss="soft_l1", f_scale=_ROBUST_RATE) for s in starts]
    best = min(fits, key=lambda fit: float(fit.cost)).x
    residual = rms_rate(disagreement(best)[: len(a), None])
    return HingeAxis(so3.unit(best[:3]), so3.unit(best[3:]), residual)


def principal_axis(w: ArrayLike) -> tuple[Array, float]:
    """The axis (3,) about which a sensor turns most, of angular velocities (T, 3), and its share of all
    turning in squares; its sign is arbitrary.
    """
    rates = np.asarray(w, dtype=float)
    rates = rates[np.isfinite(rates).all(axis=1)]
    values, vectors = np.linalg.eigh(rates.T @ rates)
    return vectors[:, 2], float(values[2] / max(values.sum(), 1e-12))


def rms_rate(values: Array) -> float:
    """Root mean square length of vectors (T, d), of those that are finite."""
    finite = values[np.isfinite(values).all(axis=-1)]
    return float(np.sqrt(np.mean(np.sum(finite**2, axis=-1)))) if len(finite) else 0.0
