"""Pose prior: mean and covariance of joint rotations, and standard deviation of their jerk.

``models/build_pose_prior.py`` makes ``models/pose_prior.npz`` from the training subjects; ``rtof-kin train``
makes one beside each lifter. Both call `rtof_kin.body.pose_prior_fit`.

A person's neutral posture: how the joints stand when the person stands in the T-pose. Pelvis tilt, bends of the spine
and the height of the clavicles differ between persons, and from the zero pose of the rig, by 5 to 20 degrees. One
camera and sensors at the ends of the spine do not show them; a reference pose does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Final, Self

import numpy as np

from rtof_kin.body import kinematics
from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array, Mask
from rtof_kin.core.checks import checked_names, freeze, indices_of, readonly
from rtof_kin.core.errors import InvalidInputError, reading
from rtof_kin.core.files.arrays import read_npz
from rtof_kin.core.resources import model_path
from rtof_kin.data.poses import PoseSequence

SPINE: Final = ("Spine", "Spine1", "Spine2", "Spine3")
CLAVICLES: Final = ("LeftShoulder", "RightShoulder")
HIPS: Final = ("LeftUpLeg", "RightUpLeg")
JOINTS: Final = (*SPINE, *CLAVICLES, *HIPS)  #: Joints of a posture
RHYTHM: Final = np.diag([0.25, 0.0, 0.15])
"""Turn of a clavicle by the turn of the arm relative to it: about x (elevation), y, z (protraction). An arm
that is lowered by 90 degrees lowers it by 20 (scapulohumeral rhythm)."""
_LEVEL, _HANGING, _UPRIGHT, _STILL = np.radians(25.0), np.radians(30.0), np.radians(20.0), 0.5
"""Largest angles: arms to the horizontal or vertical, thighs and trunk to the vertical, rad; angular speed, rad/s."""
_SHORTEST: Final = 0.2  #: Shortest of these poses, s
STOOD: Final = np.radians(3.0)  #: Standard deviation with which they tell the posture, per axis, rad
_LEAST: Final = np.radians(0.1)  #: Least standard deviation between persons, rad
_MEMORY: Final = 15.0  #: Motion that counts as one independent sample of a person's poses, s


@dataclass(frozen=True)
class NeutralPosture:
    """Rotations of some joints in the T-pose."""

    joints: tuple[str, ...]  #: K joints
    quat_wxyz: Array  #: (K, 4) rotation of each relative to its parent
    sigma: Array = field(default_factory=lambda: np.empty(0))
    """(K,) standard deviations per axis, rad; by default `STOOD`."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", checked_names("joints of the posture", self.joints))
        if not np.size(self.sigma):
            object.__setattr__(self, "sigma", np.full(len(self.joints), STOOD))
        freeze(self, "posture", quat_wxyz=(len(self.joints), 4), sigma=(len(self.joints),))
        if not np.allclose(np.linalg.norm(self.quat_wxyz, axis=-1), 1.0, atol=1e-3):
            raise InvalidInputError("posture quat_wxyz: not unit quaternions; give w, x, y, z of each joint")

    @property
    def R_parent_bone(self) -> Array:
        """(K, 3, 3) rotation of each joint relative to its parent."""
        return so3.from_quat_wxyz(self.quat_wxyz)

    @classmethod
    def of(cls, poses: PoseSequence, parents: Sequence[int], joints: Sequence[str] = JOINTS) -> Self:
        """Return the mean posture of poses. poses: (T) in the T-pose. parents: (J,) of their joints."""
        known = poses.R_world_bone[np.isfinite(poses.R_world_bone).all(axis=(1, 2, 3))]
        if len(known) == 0:
            raise InvalidInputError("posture: no frame of the T-pose is complete")
        local = kinematics.local_rotations(parents, known).mean(axis=0)
        index = [poses.names.index(joint) for joint in joints]
        return cls(tuple(joints), so3.to_quat_wxyz(so3.nearest_rotation(local[index])))


def standing_frames(poses: PoseSequence, rate_hz: float | None = None) -> Mask:
    """Return in which even frames (T,) a 21-joint person stands still: thighs and upper trunk upright, no turn."""
    R = poses.R_world_bone
    turns = so3.angle_between(R[:-1], R[1:]) * (rate_hz or poses.rate_hz)
    fast = np.nan_to_num(turns, nan=np.inf).max(axis=1) > _STILL
    still = ~np.append(fast, fast[-1:]) & ~np.append(fast[:1], fast)
    upright = R[:, [poses.names.index(n) for n in ("LeftUpLeg", "RightUpLeg", "Spine3")], 2, 2] > np.cos(_UPRIGHT)
    return np.asarray(still & upright.all(axis=1))


def reference_pose(poses: PoseSequence) -> tuple[slice, tuple[str, ...]] | None:
    """Return the first frames of evenly spaced 21-joint poses in which the person stands still with level arms (the
    T-pose), else with hanging ones, and the joints whose posture they show; None without.

    How much hanging arms lower the clavicles differs by 9 degrees between persons, so that they do not show these.
    """
    height = poses.R_world_bone[:, [poses.names.index(name) for name in ("LeftArm", "RightArm")], 2, 1] * (1, -1)
    still, least = standing_frames(poses), _SHORTEST * poses.rate_hz
    for arms, joints in ((np.abs(height) < np.sin(_LEVEL), JOINTS), (height < -np.cos(_HANGING), (*SPINE, *HIPS))):
        for start, stop in signals.runs(still & arms.all(axis=1)):
            if stop - start >= least:
                return slice(start, stop), joints
    return None


def posture_from_t_pose(poses: PoseSequence, parents: Sequence[int]) -> NeutralPosture | None:
    """Return the posture of the first T-pose of evenly spaced 21-joint poses, with `parents` (J,); else None."""
    found = reference_pose(poses)
    return NeutralPosture.of(poses[found[0]], parents) if found is not None and found[1] == JOINTS else None


@dataclass(frozen=True)
class PosePrior:
    """Gaussian of the rotation vectors of all joints about their mean rotations."""

    joints: tuple[str, ...]  #: J joint names, root first
    mean_quat_wxyz: Array  #: (J - 1, 4) mean rotation of each joint except the root relative to its parent
    covariance: Array  #: (3 (J - 1), 3 (J - 1)) of log(mean^-1 rotation), rad^2
    sigma_jerk: Array  #: (J,) standard deviation of the rotational jerk of joints (root: in world), rad/s^3
    sigma_root_jerk: float  #: Standard deviation of the jerk of the root position, m/s^3
    covariance_about_posture: Array | None = None
    """The same for a person whose neutral posture is known, about the mean that `about` gives; None where
    only the whole covariance is known."""

    def __post_init__(self) -> None:
        J = len(self.joints)
        size = 3 * (J - 1)
        freeze(self, "prior", mean_quat_wxyz=(J - 1, 4), sigma_jerk=(J,))
        if not np.allclose(np.linalg.norm(self.mean_quat_wxyz, axis=-1), 1.0, atol=1e-6):
            raise InvalidInputError("prior mean_quat_wxyz: not unit quaternions")
        for name in ("covariance", "covariance_about_posture"):
            if getattr(self, name) is None:
                continue
            freeze(self, "prior", **{name: (size, size)})
            value = getattr(self, name)
            symmetric = np.allclose(value, value.T, rtol=0, atol=1e-9)
            if not symmetric or np.linalg.eigvalsh(value)[0] < -1e-9:
                raise InvalidInputError(f"prior {name}: not symmetric and positive semidefinite")
        sigmas = np.append(self.sigma_jerk, self.sigma_root_jerk)
        if not np.all((sigmas > 0) & (sigmas < np.inf)):
            raise InvalidInputError("prior: the standard deviations of jerk must be positive and finite")

    @classmethod
    def load(cls, joints: Sequence[str], path: str | Path | None = None) -> PosePrior:
        """Load a prior, by default the shipped one; `FileFormatError` for a file that is no prior of these joints."""
        path = Path(path or model_path("pose_prior.npz"))
        arrays = read_npz(path)
        with reading(path, f"no pose prior of {len(joints)} joints ({{}})", KeyError, InvalidInputError):
            return cls.from_arrays(joints, arrays)

    @classmethod
    def from_arrays(cls, joints: Sequence[str], arrays: Mapping[str, Array]) -> PosePrior:
        """Return the prior of `arrays`; KeyError or `InvalidInputError` where one is missing or wrong."""
        return cls(
            tuple(joints),
            arrays["mean_quat_wxyz"],
            arrays["covariance"],
            arrays["sigma_jerk"],
            float(readonly("prior sigma_root_jerk", arrays["sigma_root_jerk"], ())),
            arrays.get("covariance_about_posture"),
        )

    def arrays(self) -> dict[str, Array]:
        """Return everything but the names of the joints, by field."""
        found = {field.name: getattr(self, field.name) for field in fields(self)[1:]}
        return {name: np.asarray(value) for name, value in found.items() if value is not None}

    @property
    def between_and_within(self) -> tuple[Array, Array] | None:
        """Covariance of persons' means about this one, and of poses about their person's: (3 (J - 1), 3 (J - 1)) each;
        None where unknown.
        """
        within = self.covariance_about_posture
        if within is None:
            return None
        values, axes = np.linalg.eigh(self.covariance - within)
        return np.asarray(axes * np.maximum(values, _LEAST**2) @ axes.T), within

    def about(self, posture: NeutralPosture) -> PosePrior:
        """Return the prior of a person whose neutral posture is known with its standard deviations.

        Where a take begins with a T-pose, the bends of the spine there are those of its median; arms hang
        in the mean, which lowers the clavicles by the `RHYTHM` of the two; hips are flexed from the
        person's T-pose as from anybody's. So a posture y is a measurement of the person's mean b (Gauss-Markov):
        with the covariances B between persons, W about their own and S of the posture, b = B (B + S)^-1 y, and poses
        have the covariance W + B - B (B + S)^-1 B. Where B is unknown, b = y and the covariance stays.
        """
        mean, spread = so3.from_quat_wxyz(self.mean_quat_wxyz), self.between_and_within
        pairs = zip(posture.joints, posture.R_parent_bone, strict=True)
        told = np.array([R @ self._after_t_pose(mean, joint) for joint, R in pairs])  # of the joints of the posture
        index = [self.joints.index(joint) - 1 for joint in posture.joints]
        if spread is None:
            mean[index] = told
            return replace(self, mean_quat_wxyz=so3.to_quat_wxyz(mean))
        between, within = spread
        y = so3.log(np.swapaxes(mean[index], -1, -2) @ told).ravel()
        rows = np.ravel([3 * j + np.arange(3) for j in index])
        noise = np.diag(np.repeat(posture.sigma**2, 3))
        gain = np.linalg.solve(between[np.ix_(rows, rows)] + noise, between[rows]).T
        return replace(
            self,
            mean_quat_wxyz=so3.to_quat_wxyz(mean @ so3.exp((gain @ y).reshape(-1, 3))),
            covariance=within + between - gain @ between[rows],
            covariance_about_posture=None,
        )

    def _after_t_pose(self, mean: Array, joint: str) -> Array:
        """Rotation (3, 3) from that of a joint in the T-pose to its mean."""
        if joint in CLAVICLES:
            arm = self.joints.index(joint.replace("Shoulder", "Arm")) - 1
            return so3.exp(RHYTHM @ so3.log(mean[arm]))
        return mean[self.joints.index(joint) - 1] if joint in HIPS else np.eye(3)

    def posture_of(self, local: Array, seconds: float, sigma: Array) -> NeutralPosture | None:
        """Return the neutral posture that a person's poses tell without the prior; None where the covariance between
        persons is unknown.

        A motion tells the mean of its own poses: it is one independent sample in `_MEMORY` seconds of the person's,
        and correlated limbs tell what of it is the activity.

        Args:
            local: (T, J - 1, 3, 3) rotations of joints relative to their parents. seconds: duration of the motion.
            sigma: (J - 1, 3) standard deviations of constant errors of these, about their axes, rad; of poses that were
                estimated with this prior.
        """
        mean, spread = so3.from_quat_wxyz(self.mean_quat_wxyz), self.between_and_within
        if spread is None:
            return None
        between, within = spread
        share = np.clip(1 - sigma.ravel() ** 2 / np.diagonal(self.covariance), 0.01, 1.0)  # not of the prior
        y = so3.log(np.swapaxes(mean, -1, -2) @ local).mean(axis=0).ravel() / share
        noise = within * (_MEMORY / seconds) + np.diag(sigma.ravel() ** 2 / share)
        gain = np.linalg.solve(between + noise, between).T
        b, after = gain @ y, between - gain @ between
        rotations, sigmas = list[Array](), list[float]()
        for joint in JOINTS:  # each alone, without its prior
            j = self.joints.index(joint) - 1
            own = slice(3 * j, 3 * j + 3)
            information = np.linalg.inv(after[own, own]) - np.linalg.inv(between[own, own])
            told = np.linalg.solve(information, np.linalg.solve(after[own, own], b[own]))
            right = self._after_t_pose(mean, joint)
            rotations.append(mean[j] @ so3.exp(told) @ right.T)
            shared = len(SPINE) if joint in SPINE else 1  # the bend of the spine, told once
            sigmas.append(float(np.sqrt(shared * np.trace(np.linalg.inv(information)) / 3)))
        return NeutralPosture(JOINTS, so3.to_quat_wxyz(np.array(rotations)), np.array(sigmas))

    def precision(self, joints: Sequence[str], inflation: float, least: float) -> Array:
        """Return the inverse covariance (3A, 3A) of the rotations of some joints; `joints`: A names, without the root;
        `least`: standard deviation added in quadrature, rad.
        """
        index = [i - 1 for i in indices_of("joint of the pose prior", joints, self.joints)]
        rows = (3 * np.repeat(index, 3) + np.tile(range(3), len(index))).astype(int)
        covariance = self.covariance[np.ix_(rows, rows)] * inflation**2
        return np.asarray(np.linalg.inv(covariance + np.eye(len(rows)) * least**2))


def has_prior(skeleton: str) -> bool:
    """Return whether a prior is shipped for a skeleton."""
    return skeleton == "total_capture"


@cache
def shipped_prior(joints: tuple[str, ...]) -> PosePrior:
    """Return the shipped prior, read once."""
    return PosePrior.load(joints)
