"""Poses from inertial sensors alone, frame by frame: the initial guess without a camera.

A segment with a sensor has the sensor's orientation. The others have the mean posture of free motion
(`body.pose_prior`) relative to their parents; a difference to the next sensor outwards is distributed over
the joints between, in proportion to their variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence, Provenance, valid_positions


def poses_from_sensors(skeleton: SkeletonModel, bone_imus: BoneImuSequence) -> PoseSequence:
    """Compute rigid poses at the sensors' times, the root at the origin; gaps are interpolated on the geodesic. A root
    without a sensor is upright, with the mean heading of the sensors near it. `UnknownNameError`: a sensor is on an
    unknown joint; `InvalidInputError`: no sensor has data.

    Returns:
        Poses; orientations are observed where a sensor has data, and a joint has provenance IMU if the
        segment that ends in it has a sensor, else PRIOR.
    """
    joints, T = skeleton.index(*bone_imus.joints), len(bone_imus)
    seen = np.zeros((T, len(skeleton.names)), dtype=bool)
    seen[:, joints] = np.isfinite(bone_imus.R_world_bone[..., 0, 0])
    if not seen.any():
        raise InvalidInputError("bone_imus: no sensor has an orientation in any frame")
    sensed = dict[int, Array]()  # gaps interpolated on the geodesic and the ends extended
    for s, j in enumerate(joints):
        if len(known := bone_imus.times[seen[:, j]]):
            at = np.clip(bone_imus.times, known[0], known[-1])
            sensed[j] = signals.interpolate_rotations(bone_imus.times, bone_imus.R_world_bone[:, [s]], at)[:, 0]
    R = _Neutral(skeleton, sensed).orientations()
    ended = np.zeros_like(seen)
    ended[:, 1:] = seen[:, list(skeleton.parents[1:])]
    provenance = np.where(ended, Provenance.IMU, Provenance.PRIOR).astype(np.uint8)
    return PoseSequence(
        times=bone_imus.times,
        p_world_joint=kinematics.positions(skeleton.parents, skeleton.joint_offsets, np.zeros((T, 3)), R),
        R_world_bone=R,
        names=skeleton.names,
        provenance=provenance,
        valid=valid_positions(provenance, bone_imus.times, skeleton.parents),
        orientation_observed=seen,
    )


class _Neutral:
    """The mean posture of free motion, bent to sensors: joint -> orientation (T, 3, 3)."""

    def __init__(self, skeleton: SkeletonModel, sensed: dict[int, Array]) -> None:
        prior = skeleton.table.prior
        self._parents, self._sensed = skeleton.parents, sensed
        self._local = np.concatenate([np.eye(3)[None], so3.from_quat_wxyz(prior.mean_quat_wxyz)])
        variance = np.diagonal(prior.covariance).reshape(-1, 3).sum(axis=1)
        self._spread = np.concatenate([[0.0], variance])

    def orientations(self) -> Array:
        """Return R_world_bone (T, J, 3, 3)."""
        T = len(next(iter(self._sensed.values())))
        R = np.empty((T, len(self._parents), 3, 3))
        for j, parent in enumerate(self._parents):
            if j in self._sensed:
                R[:, j] = self._sensed[j]
            elif parent < 0:
                R[:, j] = self._facing()
            else:
                R[:, j] = R[:, parent] @ self._local[j] @ self._bend(j, R[:, parent])
        return R

    def _facing(self) -> Array:
        """Return an upright root (T, 3, 3): weighted mean heading of the one that each sensor implies."""
        upright = kinematics.world_rotations(self._parents, self._local)
        mean = np.zeros((2, len(next(iter(self._sensed.values())))))
        for j, R in self._sensed.items():
            yaw = so3.heading(R @ upright[j].T)
            mean += np.stack([np.cos(yaw), np.sin(yaw)]) / sum(self._spread[self._path(0, j)])
        return so3.about_axis("z", np.arctan2(mean[1], mean[0]))

    def _bend(self, joint: int, R_parent: Array) -> Array:
        """Return a joint's share (T, 3, 3), in its own frame, of the rotation to the next sensor outwards."""
        paths = [p for j in self._sensed if (p := self._path(self._parents[joint], j))[:1] == [joint]]
        if not paths:
            return np.broadcast_to(np.eye(3), R_parent.shape)
        path = min(paths, key=len)
        beyond = np.eye(3)
        for j in path[1:]:
            beyond = beyond @ self._local[j]
        expected = R_parent @ self._local[joint] @ beyond
        missing = so3.log(np.swapaxes(expected, -1, -2) @ self._sensed[path[-1]])
        share = self._spread[joint] / sum(self._spread[path])
        return so3.exp(share * missing @ beyond.T)

    def _path(self, above: int, joint: int) -> list[int]:
        path: list[int] = []
        while joint != above:
            if joint < 0:
                return []
            path.insert(0, joint)
            joint = self._parents[joint]
        return path


def refit_root(
    poses: PoseSequence,
    keypoints: KeypointSequence,
    views: Sequence[KeypointSequence] = (),
    *,
    sigma_px: float = 15.0,
    sigma_depth: float = 0.1,
    iterations: int = 4,
) -> PoseSequence:
    """Translate every frame's pose to minimise its reprojection error.

    Gauss-Newton on the root's translation with Cauchy weights and the given root as a weak prior. (Linear
    equations in the rays would be biased towards the camera: by 12 mm at 5 px and 4 m, 50 mm at 10 px.)

    Args:
        poses: (T, J) rigid poses. keypoints: of the same frames; landmarks that are joints are used.
        sigma_px: standard deviation of a landmark, px. sigma_depth: of the given root, m.

    Returns:
        The poses translated; frames without keypoints are unchanged.
    """
    camera = keypoints.camera
    rays = _Rays(poses, keypoints, sigma_px)
    others = [(_Rays(poses, k, sigma_px), k.camera.R_camera_world @ camera.R_camera_world.T) for k in views]
    shift = np.zeros((len(poses), 3))
    for _ in range(iterations):
        normal, right = rays.equations(shift)
        normal, right = normal + np.eye(3) / sigma_depth**2, right - shift / sigma_depth**2
        for other, R in others:
            more_normal, more_right = other.equations(shift @ R.T)
            normal, right = normal + R.T @ more_normal @ R, right + more_right @ R
        shift = shift + np.linalg.solve(normal, right[..., None])[..., 0]
    shift = np.where(np.isfinite(shift), shift, 0.0)
    return replace(poses, p_world_joint=poses.p_world_joint + (shift @ camera.R_camera_world)[:, None])


class _Rays:
    """Joints (T, J) that a camera sees, in its axes."""

    def __init__(self, poses: PoseSequence, keypoints: KeypointSequence, sigma_px: float) -> None:
        seen, camera = keypoints.select(poses.names), keypoints.camera
        p, xy = camera.to_camera(poses.p_world_joint), camera.normalise(seen.uv_px)
        ok = seen.seen & np.isfinite(p).all(axis=-1)
        self.p = np.ascontiguousarray(np.moveaxis(np.where(ok[..., None], p, 0.0), -1, 0))
        self.xy = np.ascontiguousarray(np.moveaxis(np.where(ok[..., None], xy, 0.0), -1, 0))
        self.size = ok * float(np.sqrt(camera.K[0, 0] * camera.K[1, 1])) / sigma_px

    def equations(self, shift: Array) -> tuple[Array, Array]:
        """Normal equations (T, 3, 3) and (T, 3) of a step from a shift (T, 3), m, in the camera's axes."""
        x, y, z = self.p + shift.T[..., None]
        depth = np.maximum(z, 0.3)
        # Residual of a point at depth z: focal / z (x - z x_ray), in sigmas; its derivative by the shift is
        # focal / z (1, 0, -x / z), and alike for y.
        scale, u, v = self.size / depth, -x / depth, -y / depth
        r, s = (x - z * self.xy[0]) * scale, (y - z * self.xy[1]) * scale
        weight = scale / (1 + (r**2 + s**2) / 4)
        square, r, s = weight * scale, weight * r, weight * s
        zero, diagonal = np.zeros(len(shift)), square.sum(axis=1)
        a, b = (square * u).sum(axis=1), (square * v).sum(axis=1)
        c = (square * (u**2 + v**2)).sum(axis=1)
        normal = np.stack([diagonal, zero, a, zero, diagonal, b, a, b, c], axis=1).reshape(-1, 3, 3)
        return normal, -np.stack([r.sum(axis=1), s.sum(axis=1), (r * u + s * v).sum(axis=1)], axis=1)
