"""What free motion says of segments that need not be neighbours, by samples of the shipped pose prior."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body import kinematics
from rtof_kin.body.pose_prior import has_prior, shipped_prior
from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.checks import readonly
from rtof_kin.core.errors import CalibrationError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FreeMotionSettings:
    """What is added to the spread of free motion, for sensors are no segments."""

    misalignment_deg: float = 12.0  # [deg] per axis, of a good calibration and soft tissue
    tilt_deg: float = 20.0  # [deg] per axis, of the root against upright
    up_sigma: float = 0.25  # [-] added to the spread of the direction of up
    turning_floor: float = 0.06  # [-] share of a turn that is about any axis


@dataclass(frozen=True)
class Pair:
    """What free motion says of the orientation of segment b against segment a."""

    R_mean: Array
    """(3, 3) mean of R_a_b"""
    precision: Array
    """(3, 3) of log(R_mean^T R_a_b), rad^-2"""
    turning_a: Array
    """(3, 3) inverse shape of the relative angular velocity in a's axes, determinant 1"""
    turning_b: Array
    """(3, 3) the same in b's axes"""


class FreeMotion:
    """Mean and spread of orientations, directions of up, and axes of turning, of one skeleton."""

    def __init__(self, skeleton: SkeletonModel, settings: FreeMotionSettings | None = None) -> None:
        """Of a skeleton and settings, the default ones where not given.

        Raises:
            CalibrationError: there is no pose prior of this skeleton.
        """
        if not has_prior(skeleton.name):
            raise CalibrationError(
                f"movement cannot be judged on the skeleton {skeleton.name}: there is no pose prior of "
                "it; use the one with 21 joints, or give the headings"
            )
        self.skeleton, self.settings = skeleton, settings or FreeMotionSettings()
        self._samples = _sampled_poses(skeleton.names, tuple(skeleton.parents), self.settings.tilt_deg)
        self._pairs: dict[tuple[str, str], Pair] = {}
        self._ups: dict[str, tuple[Array, Array]] = {}

    def up(self, joint: str) -> tuple[Array, Array]:
        """Mean (3,) and precision (3, 3) of the direction of up in a segment's axes."""
        if joint not in self._ups:
            up = self._samples[0][:, self.skeleton.names.index(joint), 2, :]
            spread = np.cov(up.T) + self.settings.up_sigma**2 * np.eye(3)
            self._ups[joint] = up.mean(axis=0), np.asarray(np.linalg.inv(spread))
        return self._ups[joint]

    def pair(self, a: str, b: str) -> Pair:
        """Of segment b against segment a."""
        if (a, b) not in self._pairs:
            i, j = self.skeleton.index(a, b)
            now, soon = (np.swapaxes(R[:, i], -1, -2) @ R[:, j] for R in self._samples)
            R_mean = so3.nearest_rotation(now.mean(axis=0))
            off = so3.log(R_mean.T @ now)
            spread = off.T @ off / len(off)
            spread += 2 * np.radians(self.settings.misalignment_deg) ** 2 * np.eye(3)
            w_b = so3.log(np.swapaxes(now, -1, -2) @ soon)
            w_a = np.einsum("nij,nj->ni", now, w_b)
            precision = np.asarray(np.linalg.inv(spread))
            shapes = self._inverse_shape(w_a), self._inverse_shape(w_b)
            self._pairs[a, b] = Pair(R_mean, precision, *shapes)
        return self._pairs[a, b]

    def _inverse_shape(self, w: Array) -> Array:
        """Inverse of the angular central Gaussian's matrix, of determinant 1, of velocities (N, 3)."""
        shape = w.T @ w
        shape = shape / np.trace(shape) + self.settings.turning_floor * np.eye(3)
        return np.asarray(np.linalg.inv(shape / np.cbrt(np.linalg.det(shape))))


@cache
def _sampled_poses(
    names: tuple[str, ...], parents: tuple[int, ...], tilt_deg: float, count: int = 4000
) -> tuple[Array, Array]:
    """R_world_bone (N, J, 3, 3) of poses of the prior with the root's heading 0, and a moment later.

    A moment later every joint has moved by a hundredth of another draw from the prior.
    """
    prior = shipped_prior(names)
    rng = np.random.default_rng(0)
    size = len(prior.covariance)
    root = np.linalg.cholesky(prior.covariance + 1e-9 * np.eye(size))
    pose, velocity = rng.standard_normal((2, count, size)) @ root.T
    tilt = rng.standard_normal((count, 1, 3)) * np.radians(tilt_deg) * np.array([1.0, 1.0, 0.0])
    out = []
    for off in (pose, pose + 0.01 * velocity):
        local = so3.from_quat_wxyz(prior.mean_quat_wxyz) @ so3.exp(off.reshape(count, -1, 3))
        all_local = np.concatenate([so3.exp(tilt), local], axis=1)
        out.append(readonly("sampled poses", kinematics.world_rotations(parents, all_local),
                            (count, len(names), 3, 3)))  # fmt: skip
    return out[0], out[1]
