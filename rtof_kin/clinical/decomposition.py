"""Angles of each joint coordinate system frame by frame, as `angles` makes clinical angles from them."""

from __future__ import annotations

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.clinical import joint_coordinate_systems as jcs
from rtof_kin.clinical.angle_confidence import angle_sigmas, turns_too_fast
from rtof_kin.clinical.angle_table import AngleTable
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.data.confidence import Confidence
from rtof_kin.data.poses import PoseSequence


class DecomposedAngles:
    """Angles, their standard deviations and too fast turns of a whole motion, added block by block.

    Attributes:
        skeleton: of the motion. table: its J joints and A angles. times: (T,) s.
        angles: (T, A) rad, not continuous over time, without signs; NaN where a segment is unknown.
        sigma: (T, A) rad; None until a block has a confidence. too_fast: (T, J) of `turns_too_fast`.
    """

    def __init__(self, skeleton: SkeletonModel, table: AngleTable, times: Array):
        """Allocate the angles.

        Args:
            times: (T,) s.
        """
        self.skeleton, self.table, self.times = skeleton, table, times
        self.angles: Array = np.full((len(times), len(table.rows)), np.nan)
        self.sigma: Array | None = None
        self.too_fast: Mask = np.zeros((len(times), len(table.joints)), dtype=np.bool_)

    def add(self, frames: slice, poses: PoseSequence, own: slice, confidence: Confidence | None) -> None:
        """Add a block.

        Args:
            poses: these and, if there is one, the next frame. own: `frames` in poses.
        """
        self.skeleton.check_joints(poses.names)
        R = jcs.relative_rotations(poses.R_world_bone, self.skeleton, self.table)
        for j, joint in enumerate(self.table.joints):
            known = np.isfinite(R[joint.name]).all(axis=(-2, -1))
            angles = np.full((len(poses), 3), np.nan)
            angles[known] = jcs.decompose(joint.sequence, R[joint.name][known])
            self.angles[frames, 3 * j : 3 * j + 3] = angles[own]
            self.too_fast[frames, j] = turns_too_fast(joint, poses.times, R[joint.name])[own]
        if confidence is not None:
            if self.sigma is None:
                self.sigma = np.full(self.angles.shape, np.nan)
            self.sigma[frames] = angle_sigmas(R, self.table, self.skeleton, confidence)[own]
