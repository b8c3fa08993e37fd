"""Errors of a motion over time, as far as they are known: for velocities and accelerations.

A `Confidence` has the covariance C of the errors in each frame. How fast an error changes is not in it, and
that decides about accelerations: a bias of 10 degrees has none, a ripple of 1 degree at 3 Hz 6 rad/s^2. So
every error is modelled as a stationary process with the autocovariance ::

    C [(1 - s) + s exp(-t^2 / (2 l^2))]

that is a constant part and a smooth fast one with a share s of the variance and a correlation time l
(`ErrorSpectrum`). ``python -m benchmarks dynamics --corpus DIR --fit`` fits s and l of six groups to the
errors of torques and of the wrench in reconstructions of the validation people (realistic 2D; 0, 8 and 10
sensors), so that stated and actual root mean squares agree; the force is weighted to be stated too large
rather than too small, and l is held near 0.12 s. `torque_confidence` says what held-out people get.

Errors of all segments together: the turn of each segment in world is a linear function of its parent's and
an independent rest, both from the stated covariances of the parent, the child, and the one in the other. Of
all joint distributions with these covariances this one assumes least (maximum entropy). The position of the
root is independent of the turns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from scipy.linalg import toeplitz

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical.range_of_motion import CUTOFF_HZ, smoothed
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.confidence import WORLD, Confidence


@dataclass(frozen=True)
class ErrorSpectrum:
    """How fast errors change."""

    share: float
    """s, of the variance that is not constant."""
    seconds: float
    """l, standard deviation of the Gaussian autocorrelation, s."""


SPECTRA: Final = {
    "position": ErrorSpectrum(0.13, 0.16),
    "trunk": ErrorSpectrum(0.23, 0.14),
    "arm": ErrorSpectrum(0.91, 0.13),
    "hand": ErrorSpectrum(1, 0.047),
    "leg": ErrorSpectrum(1, 0.13),
    "foot": ErrorSpectrum(1, 0.098),
}
"""Of the root's position and of the turns of segments, by group."""
GROUPS: Final = {"upper arm": "arm", "forearm": "arm", "hand": "hand", "thigh": "leg", "shank": "leg", "foot": "foot"}
"""De Leva's segment -> group; all others are the trunk."""
UNOBSERVED: Final = 0.35
"""[rad] standard deviation of a joint without a covariance: the segment is kept in line with its parent."""
_SINGULAR: Final = 0.09
"""Smallest singular value of the axes of three revolutes, a posture within 5 degrees of a singular one."""
_IMPULSE: Final = 2.0
"""[s] on either side of an impulse in which the filter's response is computed."""
_CLOSEST: Final = 0.999
"""Largest correlation of the turns of a segment and its parent."""


@dataclass(frozen=True)
class PoseErrors:
    """Factors of the covariances of errors of the configuration, by independent causes."""

    factors: Array
    """(K, nv, n): root position in world, m; root turn in its own axes, rad; revolutes, rad."""
    groups: tuple[str, ...]
    """(n,) group in `SPECTRA` of each cause."""

    def gains(self, rate_hz: float) -> Array:
        """Return `error_gains` (n, 4) of the causes.

        Args:
            rate_hz: of the motion, Hz.
        """
        by_group = {group: error_gains(rate_hz, SPECTRA[group]) for group in set(self.groups)}
        return np.array([by_group[group] for group in self.groups])


@lru_cache(maxsize=64)
def error_gains(rate_hz: float, spectrum: ErrorSpectrum) -> Array:
    """Return what becomes of an error of unit variance that is filtered and differentiated as a motion is.

    Args:
        rate_hz: of the motion, Hz.

    Returns:
        (4,) variances of the error, 1, of its first derivative, 1/s^2, and of its second, 1/s^4, and the
        covariance of the error and its second derivative, 1/s^2. The first derivative is uncorrelated with
        both, as in every stationary process.
    """
    half = int(np.ceil(_IMPULSE * rate_hz))
    times = np.arange(-half, half + 1) / rate_hz
    impulse = (np.arange(len(times)) == half).astype(float)
    value = smoothed(impulse, rate_hz, CUTOFF_HZ)
    velocity = np.gradient(value, times)
    responses = np.stack([value, velocity, np.gradient(velocity, times)])
    fast = toeplitz(np.exp(-0.5 * ((times - times[0]) / spectrum.seconds) ** 2))
    products = responses @ fast @ responses.T * spectrum.share
    return np.array([products[0, 0] + 1 - spectrum.share, products[1, 1], products[2, 2], products[0, 2]])


def pose_errors(skeleton: SkeletonModel, q: Array, confidence: Confidence, R: Array) -> PoseErrors:
    """Return the errors of some frames of a motion; NaN where the root has no covariance.

    Args:
        q: (K, nq). R: (K, J, 3, 3) R_world_bone.
    """
    names, parents = skeleton.names, skeleton.parents
    K, n = len(q), 3 * (len(names) + 1)
    turns: Array = np.zeros((K, len(names), 3, n))  # of each segment in world, in its own axes
    factors: Array = np.zeros((K, skeleton.nv, n))
    factors[:, :3, :3] = _root_of(confidence.position_covariance[:, 0])
    for j, name in enumerate(names):
        own, parent = slice(3 * j + 3, 3 * j + 6), parents[j]
        in_world = confidence.turn(WORLD, name)
        if parent < 0:
            turns[:, j, :, own] = factors[:, 3:6, own] = _root_of(in_world)
            continue
        R_child_parent = np.swapaxes(R[:, j], -1, -2) @ R[:, parent]
        parents_turn = R_child_parent @ turns[:, parent]
        above = R_child_parent @ confidence.turn(WORLD, names[parent]) @ np.swapaxes(R_child_parent, -1, -2)
        follows, rest = _given_parent(in_world, above, confidence.turn(names[parent], name))
        turns[:, j] = follows @ parents_turn
        turns[:, j, :, own] += rest
        rows = 6 + np.array([skeleton.dof_names.index(dof.urdf) for dof in skeleton.table.joints[j].dofs])
        factors[:, rows] = _revolutes(skeleton, j, q) @ (turns[:, j] - parents_turn)
    return PoseErrors(factors, cause_groups(skeleton))


def cause_groups(skeleton: SkeletonModel) -> tuple[str, ...]:
    """Return the group of each of the 3 (J + 1) causes: three of the root's position, three per segment."""
    segments = [max(joint.mass_shares, key=lambda share: share[1])[0] for joint in skeleton.table.joints]
    own = ["position", *(GROUPS.get(segment, "trunk") for segment in segments)]
    return tuple(group for group in own for _ in range(3))


def _given_parent(child: Array, parent: Array, relative: Array) -> tuple[Array, Array]:
    """Regression (K, 3, 3) of a segment's turn on its parent's, and the root of the rest's covariance.

    All covariances (K, 3, 3) in the child's axes. Where one is unknown the child follows its parent.
    """
    follows = np.tile(np.eye(3), (len(child), 1, 1))
    known: Mask = np.asarray(np.isfinite(relative).all(axis=(1, 2)))
    rest = _root_of(np.where(known[:, None, None], relative, UNOBSERVED**2 * np.eye(3)))
    known &= np.isfinite(child + parent).all(axis=(1, 2))
    if known.any():
        root, above = _root_of(child[known]), _root_of(parent[known])
        cross = (child[known] + parent[known] - relative[known]) / 2
        U, s, Vt = np.linalg.svd(np.linalg.solve(root, np.swapaxes(np.linalg.solve(above, cross), -1, -2)))
        s = np.minimum(s, _CLOSEST)
        correlation = (U * s[:, None]) @ Vt
        follows[known] = root @ correlation @ np.linalg.inv(above)
        rest[known] = root @ (U * np.sqrt(1 - s**2)[:, None])
    return follows, rest


def _root_of(covariance: Array) -> Array:
    """Symmetric square roots of covariances (K, 3, 3), with no eigenvalue of zero; NaN where they are NaN."""
    known = np.isfinite(covariance).all(axis=(1, 2))
    out = np.full_like(covariance, np.nan)
    values, axes = np.linalg.eigh(covariance[known])
    least = np.maximum(1e-6 * values[:, -1:], 1e-12)
    out[known] = (axes * np.sqrt(np.maximum(values, least))[:, None]) @ np.swapaxes(axes, -1, -2)
    return out


def _revolutes(skeleton: SkeletonModel, j: int, q: Array) -> Array:
    """(K, 3, 3) changes of a joint's three revolutes by a rotation vector in the child's axes.

    In a singular posture one combination of them does not turn the joint: it has no error.
    """
    joint = skeleton.table.joints[j]
    angles = q[:, [7 + skeleton.dof_names.index(dof.urdf) for dof in joint.dofs]]
    R_after, columns = np.tile(np.eye(3), (len(q), 1, 1)), []
    for axis, angle in zip(reversed(joint.axes), angles.T[::-1], strict=True):
        unit = np.eye(3)["xyz".index(axis)]
        columns.append(np.swapaxes(R_after, -1, -2) @ unit)
        R_after = so3.exp(angle[:, None] * unit) @ R_after
    turned = np.stack(columns[::-1], axis=-1)
    return np.asarray(np.linalg.pinv(turned, rcond=_SINGULAR))
