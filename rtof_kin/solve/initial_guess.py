"""Initial guess of a recording: poses with the root on its rays and with unobserved intervals bridged.

A fragment without any landmark has no information about the position and speed of the root except its initial guess. So
segments turn as their sensors measure (`inertial.initial_poses`), the root follows standing feet and accelerations
(`inertial.root_path`), and the differences from the observed poses at the two ends of an interval are distributed over
it.

SF2, single-frame sensor fusion: inertial-guided inverse kinematics (the paper's Algorithm 1). A rotation belongs to the
segment that begins at its joint, so a sensor on the forearm corrects the bone ForeArm -> Hand; the angle theta is
between the rest bone turned by the sensor and the observed bone; children keep their own observed directions when a
parent is replaced. Unlike the paper, sensor and observation are weighed by their variances where both are known: with
good detections the lift is the better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence, Provenance, valid_positions
from rtof_kin.inertial.initial_poses import poses_from_sensors
from rtof_kin.inertial.initial_poses import refit_root as refitted
from rtof_kin.inertial.root_path import path_through_gaps


@dataclass(frozen=True)
class InertialGuidedIKSettings:
    """How the observed bone and the sensor are combined.

    By default they are weighed by inverse variances where the observation states its standard deviation
    (`PoseSequence.sigma_rad`); elsewhere the sensor's orientation is used.
    """

    threshold: float | None = None
    """theta_t [rad], as in the paper: where sensor and observed bone differ by more, the sensor's orientation is used;
    else the observed direction with the sensor's twist. 0: always the sensor, pi: never."""
    sigma_sensor: float = np.radians(2.5)
    """[rad] of a sensor's segment where neither is given. Only its ratio to the observation's counts: a lifter's own
    are half of its errors on other rigs, and so is this of usual sensors'."""

    def __post_init__(self) -> None:
        if self.threshold is not None and not 0 <= self.threshold <= np.pi:
            raise InvalidInputError(f"threshold: {self.threshold} rad is outside [0, pi]")
        if not self.sigma_sensor > 0:
            raise InvalidInputError(f"sigma_sensor: {self.sigma_sensor} rad must be positive")


class InertialGuidedIK:
    """Corrects poses frame by frame with the orientations of IMUs; bone lengths are the skeleton's."""

    def __init__(self, skeleton: SkeletonModel, settings: InertialGuidedIKSettings | None = None) -> None:
        self.skeleton = skeleton
        self.settings = settings or InertialGuidedIKSettings()

    def refine(
        self, poses: PoseSequence, bone_imus: BoneImuSequence | None = None, R_observed: Array | None = None
    ) -> PoseSequence:
        """Return rigid poses, limb directions corrected by the sensors, root positions unchanged.
        `UnknownNameError`: poses or sensors of another skeleton; `ShapeError`: other joints.

        Args:
            poses: (T, J) positions of this skeleton's joints. Frames with NaN stay NaN.
            bone_imus: any subset of segments, at any times; NaN leaves the observed bone unchanged.
            R_observed: (T, J, 3, 3) orientations observed by a lifter, NaN where missing: of segments with one bone the
                twist is used, of others all. (An average with orientations from positions, whose hips and shoulders err
                alike, is worse: upper trunk 9.6 in place of 9.2 degrees, pelvis 15.8 in place of 13.5.)
        """
        R, sensed = self._rotations(poses, bone_imus, R_observed)
        parents, offsets = self.skeleton.parents, self.skeleton.joint_offsets
        p = kinematics.positions(parents, offsets, poses.p_world_joint[:, 0], R)
        return self._posed(poses, p, R, sensed)

    def orient(self, poses: PoseSequence, bone_imus: BoneImuSequence | None = None) -> PoseSequence:
        """Return the poses with the orientations of `refine`, by any subset of sensors at any times; positions stay."""
        R, sensed = self._rotations(poses, bone_imus, None)
        return self._posed(poses, poses.p_world_joint, R, sensed)

    def _rotations(
        self, poses: PoseSequence, bone_imus: BoneImuSequence | None, R_observed: Array | None
    ) -> tuple[Array, Mask]:
        """R_world_bone (T, J, 3, 3), and which segments have sensor data, (T, J)."""
        self.skeleton.check_joints(poses.names)
        p = poses.p_world_joint
        known = np.isfinite(p).all(axis=(1, 2))
        R, R_imu = np.full((2, *p.shape[:2], 3, 3), np.nan)
        if bone_imus is not None:
            joints = self.skeleton.index(*bone_imus.joints)
            if not np.array_equal(bone_imus.times, poses.times):
                bone_imus = bone_imus.resample(poses.times)
            R_imu[:, list(joints)] = bone_imus.R_world_bone
        R_seen = np.full_like(R, np.nan) if R_observed is None else R_observed
        R[known] = self._solve(p[known], R_seen[known], R_imu[known], poses.sigma_rad[known])
        return R, np.isfinite(R_imu[:, :, 0, 0])

    def _posed(self, poses: PoseSequence, p: Array, R: Array, sensed: Mask) -> PoseSequence:
        """The poses with positions and orientations, with sensor data where `sensed`."""
        provenance, valid = self._provenance(poses.provenance, sensed), poses.valid
        if poses.provenance.any():
            valid = valid_positions(provenance, poses.times, self.skeleton.parents)
        return replace(
            poses,
            p_world_joint=p,
            R_world_bone=R,
            provenance=provenance,
            valid=valid,
            sigma_rad=np.where(sensed, np.nan, poses.sigma_rad),
            orientation_observed=sensed | poses.orientation_observed,
        )

    def _solve(self, p: Array, R_seen: Array, R_imu: Array, sigma: Array) -> Array:
        parents, offsets = self.skeleton.parents, self.skeleton.joint_offsets
        R, root = np.empty((*p.shape[:2], 3, 3)), np.broadcast_to(np.eye(3), (len(p), 3, 3))
        for j, parent in enumerate(parents):
            has, sensed = (np.isfinite(matrices[:, j, 0, 0]) for matrices in (R_seen, R_imu))
            by_sensor = sensed.all() and len(kinematics.children_of(parents, j)) == 1  # whose twist is the bone's
            if not by_sensor:
                if not has.all():
                    R_parent = root if parent < 0 else R[:, parent]
                    R[:, j] = kinematics.segment_rotation(parents, offsets, j, p, R_parent)
                R[has, j] = self._swung(j, p[has], R_seen[has, j])
            if sensed.any():
                own = (p[sensed], R[sensed, j], R_imu[sensed, j], sigma[sensed, j])
                R[sensed, j] = self._correct(j, *own)
        return R

    def _swung(self, joint: int, p: Array, R: Array) -> Array:
        """An orientation (T, 3, 3) of a segment turned so that its bone has the observed direction."""
        children = kinematics.children_of(self.skeleton.parents, joint)
        if len(children) != 1:
            return R
        rest = self.skeleton.joint_offsets[children[0]]
        return kinematics.swing(R, rest, p[:, children[0]] - p[:, joint])

    def _correct(self, joint: int, p: Array, R_observed: Array, R_imu: Array, sigma: Array) -> Array:
        """Orientation (T, 3, 3) of a segment from observation, with its sigma (T,), rad, and sensor."""
        children = kinematics.children_of(self.skeleton.parents, joint)
        if not children:
            return R_imu
        if len(children) == 1:
            R_observed = self._swung(joint, p, R_imu)  # the sensor's twist
        s = self.settings
        if s.threshold is not None:
            beyond = so3.angle_between(R_observed, R_imu) > s.threshold
            return np.where(beyond[:, None, None], R_imu, R_observed)
        share = np.nan_to_num(s.sigma_sensor**2 / (s.sigma_sensor**2 + sigma**2))
        turn = so3.log(np.swapaxes(R_imu, -1, -2) @ R_observed)
        return np.asarray(R_imu @ so3.exp(share[:, None] * turn))

    def _provenance(self, before: NDArray[np.uint8], sensed: Mask) -> NDArray[np.uint8]:
        """Provenance with the IMU for joints whose parent's segment has a sensor."""
        out = before.copy()
        for j, parent in enumerate(self.skeleton.parents):
            if parent >= 0:
                by_imu = sensed[:, parent]
                camera = before[:, j] == Provenance.CAMERA
                out[by_imu & camera, j] = Provenance.CAMERA_AND_IMU
                out[by_imu & (before[:, j] < Provenance.IMU), j] = Provenance.IMU
        return out


@dataclass(frozen=True)
class InitialGuess:
    """Poses that the fragment solver and the self-calibration start from."""

    poses: PoseSequence
    """(T, J) rigid poses, the root refitted to its rays, unobserved intervals bridged by the sensors."""
    sigma_root: Array  #: (T,) m, standard deviation of the root in bridged frames; 0 where the person was observed


def initial_guess(
    start: PoseSequence,
    keypoints: KeypointSequence | None,
    bone_imus: BoneImuSequence | None,
    skeleton: SkeletonModel,
    *,
    refit_root: bool = True,
    views: Sequence[KeypointSequence] = (),
) -> InitialGuess:
    """Return the initial guess for poses of a recording.

    Args:
        start: (T, J) rigid, evenly spaced poses, usually those after SF2.
        keypoints: at the times of `start`. None, without a camera, leaves the poses unchanged.
        bone_imus: any subset of the sensors, at any times; those on shanks and feet determine the root.
        refit_root: whether the root is moved onto the rays of its landmarks.
    """
    sigma = np.zeros(len(start))
    if keypoints is None:
        return InitialGuess(start, sigma)
    if refit_root:
        start = refitted(start, keypoints, views)
    seen = np.any([k.select(skeleton.names).seen.any(axis=1) for k in (keypoints, *views)], axis=0)
    silent = bone_imus is None or not np.isfinite(bone_imus.R_world_bone).any()
    if bone_imus is None or silent or seen.all() or not seen.any():
        return InitialGuess(start, sigma)
    bone_imus = bone_imus.resample(start.times)
    sensed = poses_from_sensors(skeleton, bone_imus).R_world_bone
    start = _posed(start, ~seen, skeleton, start.p_world_joint[:, 0], _turned(start, seen, sensed))
    path = path_through_gaps(start, seen, bone_imus, skeleton)
    if path is None:
        return InitialGuess(start, sigma)
    return InitialGuess(_posed(start, ~seen, skeleton, path.p_world, start.R_world_bone), path.sigma)


def _turned(start: PoseSequence, seen: Mask, sensed: Array) -> Array:
    """Measured orientations (T, J, 3, 3) with their offset at both ends of a gap interpolated over it."""
    offset = np.swapaxes(sensed, -1, -2) @ start.R_world_bone
    offset[~seen] = np.nan
    at = np.clip(start.times, *start.times[seen][[0, -1]])
    return np.asarray(sensed @ signals.interpolate_rotations(start.times, offset, at))


def _posed(start: PoseSequence, frames: Mask, skeleton: SkeletonModel, root: Array, R: Array) -> PoseSequence:
    """Poses with other roots (T, 3) and orientations (T, J, 3, 3) in the frames chosen."""
    p = kinematics.positions(skeleton.parents, skeleton.joint_offsets, root, R)
    p = np.where(frames[:, None, None], p, start.p_world_joint)
    R = np.where(frames[:, None, None, None], R, start.R_world_bone)
    return replace(start, p_world_joint=p, R_world_bone=R)
