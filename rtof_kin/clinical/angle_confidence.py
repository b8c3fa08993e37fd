"""Standard deviations of clinical angles, from the covariance of the rotations they are read from.

An angle's error is, to first order, linear in the small rotation vector by which the rotation of child in
parent is off; what parent and child have in common is not in that. Near a singular posture, or where an
arm hangs, the outer angles magnify it without bound: nothing is known of an angle that may be anywhere.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical import joint_coordinate_systems as jcs
from rtof_kin.clinical.angle_table import AngleTable
from rtof_kin.core import rotations as so3
from rtof_kin.data.confidence import Confidence

Array = NDArray[np.float64]
NOTHING_KNOWN = np.pi / np.sqrt(3)
"""[rad] standard deviation of an angle that is anywhere on the circle, the largest that is given."""
_STEP = 1e-5
"""[rad] of the central differences."""


def angle_sigmas(
    R: dict[str, Array], table: AngleTable, skeleton: SkeletonModel, confidence: Confidence
) -> Array:
    """Standard deviations (T, A) rad of all angles of a table, in its order.

    Args:
        R: rotations (T, 3, 3) of every joint coordinate system, as `jcs.relative_rotations` gives them.
        confidence: of the motion they are from; what is not among its pairs is NaN.
    """
    frames, columns = jcs.isb_frames(skeleton, table), []
    for joint in table.joints:
        R_bone_isb = frames[skeleton.names.index(joint.child)]
        axes = R_bone_isb.T
        if joint.side == "left":  # an axial vector in the mirror
            axes = -jcs.mirror_image(axes)
        covariance = confidence.turn(joint.parent, joint.child)
        known = np.asarray(np.isfinite(R[joint.name] + covariance).all(axis=(1, 2)))
        J = angle_rates(joint.sequence, R[joint.name][known]) @ axes
        variance = np.einsum("tai,tij,taj->ta", J, covariance[known], J)
        sigma = np.full((len(known), 3), np.nan)
        sigma[known] = np.minimum(np.sqrt(np.maximum(variance, 0.0)), NOTHING_KNOWN)
        columns.append(sigma)
    return np.concatenate(columns, axis=1)


def angle_rates(sequence: str, R: Array) -> Array:
    """Derivatives (T, 3, 3) of the three angles of rotations (T, 3, 3) by a small rotation vector e of
    ``R @ exp(e)``; by central differences.
    """
    columns = []
    for axis in np.eye(3):
        later, earlier = (jcs.decompose(sequence, R @ so3.exp(s * _STEP * axis)) for s in (1, -1))
        turned = (later - earlier + np.pi) % (2 * np.pi) - np.pi
        columns.append(turned / (2 * _STEP))
    return np.stack(columns, axis=-1)
