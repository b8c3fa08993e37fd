"""The lifting stage: keypoints to 3D poses in world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.observability import WHOLE, levels_by_points
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
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
        """Estimate poses in world for every frame, with orientations where the lifter has them; `joint_offsets`: (J, 3)
        m of the skeleton; `floor_height`: z of the floor in world, m.
        """


@cache
def shipped_lifter() -> LifterLike:
    """Return the shipped lifter, read once."""
    from lifting.predict import Lifter

    return Lifter.load()


@dataclass(frozen=True)
class Lifted:
    """Result of the lifting stage."""

    poses: PoseSequence  #: Orientations follow from positions where the lifter gives none
    R_world_bone: Array  #: (T, J, 3, 3) orientations that the lifter gives itself; NaN where it gives none
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
    """Lift a video. `ViewError`: a lifted pose is behind the camera.

    Args:
        skeleton: the subject's. lifter: default: the shipped one. floor_height: z of the floor in world, m.
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


# Lifts of several cameras combined to one.
#
# A lifter is more certain across a camera's rays than along them. The position of each joint relative to the
# root, and of the root in world, is the weighted mean over the cameras with the inverse covariances
#
# ::
#
#     W_c = (I - d d^T) / sigma_across^2 + d d^T / sigma_along^2
#
# as weights, d the direction of the camera's ray (generalised least squares of independent estimates).
# Orientations are averaged with the inverse squares of their standard deviations.

JOINT: Final = np.array([0.03, 0.08])
"""[m] Standard deviations across and along the ray of a joint about the root where a lifter states none."""
_ROOT: Final = np.array([0.03, 0.3])  #: [m] The same of the root
_RAD: Final = 0.2  #: [rad] The same of an orientation
_UNSEEN: Final = 1e-6  #: Weight of a camera that did not see the person, relative to one that did


def fused(lifts: Sequence[Lifted], cameras: Sequence[KeypointSequence], skeleton: SkeletonModel) -> Lifted:
    """Return the lifts of cameras of one person, at the same times, as one; that of one camera as it is."""
    if len(lifts) == 1:
        return lifts[0]
    poses = lifts[0].poses
    weights = np.stack([_information(lift, seen) for lift, seen in zip(lifts, cameras, strict=True)])
    relative = np.stack([lift.poses.p_world_joint for lift in lifts])
    relative[:, :, 1:] -= relative[:, :, :1]
    right = np.einsum("ctjik,ctjk->tji", weights, relative)
    p = np.linalg.solve(weights.sum(axis=0), right[..., None])[..., 0]
    p[:, 1:] += p[:, :1]
    stated = np.stack([lift.poses.sigma_rad for lift in lifts])
    sigmas = np.where(np.isfinite(stated), stated, _RAD) / np.sqrt(np.stack([_weight(lift) for lift in lifts]))
    R_seen = _mean_rotations(np.stack([lift.R_world_bone for lift in lifts]), sigmas)
    R = kinematics.rotations_from_positions(skeleton.parents, skeleton.joint_offsets, p)
    provenance = np.stack([lift.poses.provenance for lift in lifts])
    camera = (provenance == Provenance.CAMERA).any(axis=0)
    observed = np.any([lift.poses.orientation_observed for lift in lifts], axis=0)
    known = np.isfinite(stated).any(axis=0)
    provenance = np.where(camera, Provenance.CAMERA, provenance.min(axis=0)).astype(np.uint8)
    poses = replace(
        poses,
        p_world_joint=p,
        R_world_bone=np.where(np.isfinite(R_seen), R_seen, R),
        provenance=provenance,
        valid=valid_positions(provenance, poses.times, skeleton.parents),
        orientation_observed=observed,
        sigma_rad=np.where(known, 1 / np.sqrt((1 / sigmas**2).sum(axis=0)), np.nan),
    )
    return Lifted(poses, R_seen, np.full((*p.shape[:2], 2), np.nan))


def _information(lift: Lifted, seen: KeypointSequence) -> Array:
    """(T, J, 3, 3) weights in world of the root's position, and of the others relative to it."""
    ray = so3.unit(lift.poses.p_world_joint - seen.camera.center_world)
    usual = np.tile(JOINT, (ray.shape[1], 1))
    usual[0] = _ROOT
    sigma = np.where(np.isfinite(lift.sigma_m), lift.sigma_m, usual)
    across, along = (1 / sigma[..., i, None, None] ** 2 for i in (0, 1))
    rays = ray[..., :, None] * ray[..., None, :]
    return np.asarray(_weight(lift)[..., None, None] * (across * (np.eye(3) - rays) + along * rays))


def _weight(lift: Lifted) -> Array:
    """(T, 1) 1 where the person was seen, nearly 0 where the poses are only bridged."""
    return np.where(lift.poses.valid.any(axis=1), 1.0, _UNSEEN)[:, None]


def _mean_rotations(R: Array, sigma: Array) -> Array:
    """Mean (T, J, 3, 3) of rotations (C, T, J, 3, 3) with sigmas (C, T, J); NaN where all are."""
    known = np.isfinite(R[..., 0, 0])
    weight = np.where(known, 1 / sigma**2, 0.0)[..., None, None]
    total = (weight * np.where(known[..., None, None], R, 0.0)).sum(axis=0)
    out = np.full(total.shape, np.nan)
    some = known.any(axis=0)
    out[some] = so3.nearest_rotation(total[some])
    return out
