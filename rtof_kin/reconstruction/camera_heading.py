"""Slow drift of the heading of a camera that turns, against the sensors of the person whom it films.

A phone knows the tilt of its camera from gravity, but its heading drifts (that of the background's keyframes hardly
does). Segments seen in the image and by their sensors differ by this drift, by errors of the lifter that depend on the
pose, and by the drift of the sensors' headings, which is the same to a reconstruction. The drift is a line and a
random walk, estimated by Gaussian process regression (Rasmussen and Williams 2006, ch. 2) from means over two seconds.
Removing it mends positions in world; those relative to the root hardly change.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.camera_motion import turned
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.lift import LifterLike, lift

_log = logging.getLogger(__name__)

_PIECE: Final = 2.0  # [s] of a mean
_SIGMA_MEAN: Final = np.radians(3.0)  # of a mean over that, by realistic 2D of motion capture
_SIGMA_WALK: Final = np.radians(0.1)  # [rad/s^0.5] of the random walk


@dataclass(frozen=True)
class HeadingDrift:
    """Heading of a camera as the sensors show it, relative to its mean."""

    times: Array
    """(T,) s."""
    angle: Array
    """(T,) rad about the vertical, by which what the camera sees has to be turned."""
    sigma: Array
    """(T,) its standard deviation, rad."""

    def removed(self, keypoints: KeypointSequence) -> KeypointSequence:
        """Return the keypoints without the drift."""
        R = keypoints.camera.R_camera_world
        return turned(keypoints, R @ so3.about_axis("z", self.angle) @ R.T, keypoints.camera.undistorted())


def without_heading_drift(
    keypoints: KeypointSequence, bone_imus: BoneImuSequence, skeleton: SkeletonModel, lifter: LifterLike | None
) -> KeypointSequence:
    """Return stabilised keypoints without the drift that `Camera.heading_drift` allows for.

    Args:
        skeleton: the subject's. lifter: default: the shipped one.
    """
    found = heading_drift(lift(keypoints, skeleton, lifter).poses, bone_imus, keypoints.camera.heading_drift)
    first, last = np.degrees(found.angle[[0, -1]])
    _log.info(
        "the heading of the camera drifted by %.1f +- %.1f deg against the sensors; it is removed",
        last - first,
        np.degrees(np.hypot(*found.sigma[[0, -1]])),
    )
    return found.removed(keypoints)


def heading_drift(poses: PoseSequence, bone_imus: BoneImuSequence, sigma_rate: float) -> HeadingDrift:
    """Estimate the drift of a camera's heading.

    Args:
        poses: lifted from the image alone, in the world of the camera that stands still.
        sigma_rate: standard deviation of a steady drift, rad/s.

    Raises:
        InvalidInputError: other times, or no segment is seen by both.
    """
    if not np.array_equal(poses.times, bone_imus.times):
        raise InvalidInputError("heading drift: poses and sensors have other times; resample the sensors")
    joints = [poses.names.index(joint) for joint in bone_imus.joints]
    R = bone_imus.R_world_bone @ np.swapaxes(poses.R_world_bone[:, joints], -1, -2)
    weight = np.nan_to_num(1 / poses.sigma_rad[:, joints] ** 2, nan=1.0)
    known = np.asarray(np.isfinite(R).all(axis=(-2, -1)))
    if not known.any():
        raise InvalidInputError("heading drift: no segment is seen by the image and by a sensor")
    M = (np.where(known[..., None, None], R, 0.0) * weight[..., None, None]).sum(axis=1)
    piece = ((poses.times - poses.times[0]) // _PIECE).astype(int)
    use = [k for k in np.unique(piece) if known[piece == k].any()]
    at = np.array([poses.times[piece == k].mean() for k in use])
    heading = np.unwrap([float(so3.heading(M[piece == k].sum(axis=0))) for k in use])
    angle, sigma = _regressed(at, heading, sigma_rate)
    return HeadingDrift(poses.times, np.interp(poses.times, at, angle), np.interp(poses.times, at, sigma))


def _regressed(at: Array, heading: Array, sigma_rate: float) -> tuple[Array, Array]:
    """Return the drift (n,) less its mean, which the camera's pose has, and its standard deviation (n,)."""
    line = sigma_rate**2 * np.multiply.outer(at - at.mean(), at - at.mean())
    prior = line + _SIGMA_WALK**2 * np.minimum.outer(at - at[0], at - at[0])
    centre = np.eye(len(at)) - 1 / len(at)
    prior = centre @ prior @ centre
    gain = np.linalg.solve(prior + _SIGMA_MEAN**2 * np.eye(len(at)), prior).T
    variance = np.diag(prior - gain @ prior)
    return gain @ (centre @ heading), np.sqrt(np.maximum(variance, 0.0))
