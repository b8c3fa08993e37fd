"""The lifting stage: keypoints to 3D poses in world."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Protocol

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.observability import WHOLE, levels_by_points
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import ViewError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence, Provenance, valid_positions

if TYPE_CHECKING:
    from lifting.predict import LiftedPoses


class LifterLike(Protocol):
    """Estimator of 3D joints from keypoints, such as `lifting.predict.Lifter`.

    One with an attribute `prior` brings the pose prior of the later stages.
    """

    def predict(
        self,
        keypoints: KeypointSequence,
        joint_offsets: Array | None = None,
        *,
        bone_imus: BoneImuSequence | None = None,
        floor_height: float | None = None,
    ) -> LiftedPoses:
        """Estimate poses in world for every frame, with orientations where the lifter has them.

        Args:
            joint_offsets: (J, 3) m of the skeleton. floor_height: z of the floor in world, m.
        """


@cache
def shipped_lifter() -> LifterLike:
    """Return the shipped lifter, read once."""
    from lifting.predict import Lifter

    return Lifter.load()


@dataclass(frozen=True)
class Lifted:
    """Result of the lifting stage."""

    poses: PoseSequence
    """Orientations follow from positions where the lifter gives none."""
    R_world_bone: Array
    """(T, J, 3, 3) orientations that the lifter gives itself; NaN where it gives none."""
    sigma_m: Array
    """(T, J, 2) standard deviations across and along the camera's ray (`lifting.predict.LiftedPoses`), m; NaN
    where unknown, and of several cameras."""


def lift(
    keypoints: KeypointSequence,
    skeleton: SkeletonModel,
    lifter: LifterLike | None = None,
    bone_imus: BoneImuSequence | None = None,
    floor_height: float | None = None,
) -> Lifted:
    """Lift a video.

    Args:
        skeleton: the subject's. lifter: default: the shipped one. floor_height: z of the floor in world, m.

    Raises:
        ViewError: a lifted pose is behind the camera.
    """
    lifter = lifter or shipped_lifter()
    result = lifter.predict(keypoints, skeleton.joint_offsets, bone_imus=bone_imus, floor_height=floor_height)
    p = np.asarray(result.p_world_joint)
    depth = keypoints.camera.to_camera(p)[..., 2]
    if np.any(depth <= 0):
        frame = int(np.argwhere(depth <= 0)[0][0])
        raise ViewError(f"lifted pose of frame {frame} is behind the camera; check its extrinsics")
    R = kinematics.rotations_from_positions(skeleton.parents, skeleton.joint_offsets, p)
    joints = keypoints.select(skeleton.names)
    bridged = ~np.asarray(result.seen)
    provenance = np.where(joints.seen, Provenance.CAMERA, Provenance.PRIOR)
    provenance[bridged] = Provenance.BRIDGED
    poses = PoseSequence(
        times=keypoints.times,
        p_world_joint=p,
        R_world_bone=np.where(np.isfinite(result.R_world_bone), result.R_world_bone, R),
        names=skeleton.names,
        provenance=provenance.astype(np.uint8),
        valid=valid_positions(provenance, keypoints.times, skeleton.parents),
        orientation_observed=~bridged[:, None] & (levels_by_points(skeleton, joints) == WHOLE),
        sigma_rad=result.sigma_rad,
    )
    return Lifted(poses, result.R_world_bone, result.sigma_m)
