"""Poses from inertial sensors alone, frame by frame: what a solver without a camera starts from.

A segment with a sensor turns as that says. The others turn against their parents as in the mean posture
of free motion (`body.pose_prior`); where that does not lead to the next sensor outwards, the joints on
the way share the difference by how much each of them usually moves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.pose_prior import shipped_prior
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.errors import ShapeError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.poses import PoseSequence, Provenance

Array = NDArray[np.float64]


def poses_from_sensors(skeleton: SkeletonModel, bone_imus: BoneImuSequence) -> PoseSequence:
    """Rigid poses at the sensors' times, the root at the origin.

    Gaps of a sensor are bridged on the geodesic, ends held. A root without a sensor is upright and faces
    where the sensors near it say. Only what a sensor says in a frame counts as observed there; a joint
    has provenance IMU where the segment that it ends has a sensor, PRIOR elsewhere.

    Raises:
        UnknownNameError: a sensor sits on no joint of the skeleton. ShapeError: no sensor says anything.
    """
    joints, T = skeleton.index(*bone_imus.joints), len(bone_imus)
    seen = np.zeros((T, len(skeleton.names)), dtype=bool)
    seen[:, joints] = np.isfinite(bone_imus.R_world_bone[..., 0, 0])
    if not seen.any():
        raise ShapeError("bone_imus: no sensor has an orientation in any frame")
    sensed = {
        j: _bridged(bone_imus.times, bone_imus.R_world_bone[:, s])
        for s, j in enumerate(joints) if seen[:, j].any()
    }  # fmt: skip
    R = _Neutral(skeleton).orientations(sensed)
    ended = np.zeros_like(seen)
    ended[:, 1:] = seen[:, list(skeleton.parents[1:])]
    p = kinematics.positions(skeleton.parents, skeleton.joint_offsets, np.zeros((T, 3)), R)
    return PoseSequence(
        times=bone_imus.times,
        p_world_joint=p,
        R_world_bone=R,
        names=skeleton.names,
        provenance=np.where(ended, Provenance.IMU, Provenance.PRIOR).astype(np.uint8),
        valid=np.broadcast_to(seen.any(axis=1, keepdims=True), seen.shape),
        orientation_observed=seen,
    )


class _Neutral:
    """The mean posture of free motion, bent to sensors.

    Attributes:
        local: (J, 3, 3) of every joint relative to its parent; the root's is the identity.
        spread: (J,) variance of each joint, rad^2.
    """

    def __init__(self, skeleton: SkeletonModel) -> None:
        prior = shipped_prior(skeleton.names)
        self.parents = skeleton.parents
        self.local = np.concatenate([np.eye(3)[None], so3.from_quat_wxyz(prior.mean_quat_wxyz)])
        variance = np.diagonal(prior.covariance).reshape(-1, 3).sum(axis=1)
        self.spread = np.concatenate([[0.0], variance])

    def orientations(self, sensed: dict[int, Array]) -> Array:
        """(T, J, 3, 3) from those of the segments with sensors (T, 3, 3)."""
        T = len(next(iter(sensed.values())))
        R = np.empty((T, len(self.parents), 3, 3))
        for j, parent in enumerate(self.parents):
            if j in sensed:
                R[:, j] = sensed[j]
            elif parent < 0:
                R[:, j] = self._facing(sensed)
            else:
                R[:, j] = R[:, parent] @ self.local[j] @ self._bend(j, R[:, parent], sensed)
        return R

    def _facing(self, sensed: dict[int, Array]) -> Array:
        """An upright root's orientation (T, 3, 3): mean heading of what each sensor would have it be."""
        upright = kinematics.world_rotations(self.parents, self.local)
        mean = np.zeros((2, len(next(iter(sensed.values())))))
        for j, R in sensed.items():
            yaw = so3.heading(R @ upright[j].T)
            mean += np.stack([np.cos(yaw), np.sin(yaw)]) / sum(self.spread[i] for i in self._path(0, j))
        return so3.about_axis("z", np.arctan2(mean[1], mean[0]))

    def _bend(self, joint: int, R_parent: Array, sensed: dict[int, Array]) -> Array:
        """A joint's share (T, 3, 3), in its own frame, of the way to the next sensor outwards."""
        paths = [path for j in sensed if (path := self._path(self.parents[joint], j))[:1] == [joint]]
        if not paths:
            return np.broadcast_to(np.eye(3), R_parent.shape)
        path = min(paths, key=len)
        beyond = np.eye(3)
        for j in path[1:]:
            beyond = beyond @ self.local[j]
        expected = R_parent @ self.local[joint] @ beyond
        missing = so3.log(np.swapaxes(expected, -1, -2) @ sensed[path[-1]])
        share = self.spread[joint] / sum(self.spread[j] for j in path)
        return so3.exp(share * missing @ beyond.T)

    def _path(self, above: int, joint: int) -> list[int]:
        """Joints from below one to another, outwards; empty where the one is not above the other."""
        path: list[int] = []
        while joint != above:
            if joint < 0:
                return []
            path.insert(0, joint)
            joint = self.parents[joint]
        return path


def _bridged(times: Array, R: Array) -> Array:
    """(T, 3, 3) without gaps: on the geodesic between what is known, the nearest beyond its ends."""
    known = times[np.isfinite(R[:, 0, 0])]
    at = np.clip(times, known[0], known[-1])
    return np.asarray(signals.interpolate_rotations(times, R[:, None], at)[:, 0])
