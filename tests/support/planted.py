"""Synthetic motion with planted sensors: the truth that tests recover."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter1d

from rtof_kin.body.kinematics import world_rotations
from rtof_kin.body.metrics import hinges
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.clinical.angles import all_observed
from rtof_kin.core import rotations as so3
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import GRAVITY_WORLD, BoneImuSequence, ImuCalibration, ImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence, Provenance
from rtof_kin.recording.recording import Recording

Array = NDArray[np.float64]
LIMBS = ("LeftArm", "RightArm", "LeftForeArm", "RightForeArm", "LeftUpLeg", "RightUpLeg", "LeftLeg", "RightLeg")
"""Segments that carry the paper's eight sensors."""
RATE_HZ = 60.0


def smooth_noise(seed: int, shape: tuple[int, ...], frames_wide: float, amplitude: float) -> Array:
    """Noise of unit-free shape (T, ...) with a memory of some frames and a given standard deviation."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(shape[0] + 400, *shape[1:]))
    out = gaussian_filter1d(noise, frames_wide, axis=0)[200:-200]
    return np.asarray(out * amplitude * np.sqrt(2 * np.sqrt(np.pi) * frames_wide))


def _motion(skeleton: SkeletonModel, q: Array, seen: bool = False) -> Motion:
    """Motion of configurations (T, nq) at `RATE_HZ`, without provenance or seen by the camera."""
    p, R = skeleton.forward_kinematics(q)
    provenance = np.full(p.shape[:2], Provenance.CAMERA if seen else Provenance.NOBODY)
    poses = PoseSequence(np.arange(len(q)) / RATE_HZ, p, R, skeleton.names, provenance)
    return Motion(skeleton, q, poses, skeleton.check(q))


def moving(skeleton: SkeletonModel, frames: int, seed: int = 0, radians: float = 0.25) -> Motion:
    """A person standing near the origin; all joints move smoothly at about 1 Hz."""
    q = np.tile(skeleton.n_pose(), (frames, 1))
    q[:, 7:] += smooth_noise(seed, (frames, skeleton.nq - 7), 15, radians)
    q[:, :3] += smooth_noise(seed + 1, (frames, 3), 40, 0.05) + np.array([0.0, 0.0, 0.95])
    turn = so3.about_axis("z", np.full(frames, 0.3)) @ so3.exp(smooth_noise(seed + 2, (frames, 3), 30, 0.1))
    q[:, 3:7] = np.roll(so3.to_quat_wxyz(turn), -1, axis=-1)
    return _motion(skeleton, q, seen=True)


def seen(skeleton: SkeletonModel, frames: int) -> Motion:
    """`moving`, with all orientations observed."""
    motion = moving(skeleton, frames)
    return replace(motion, poses=all_observed(motion.poses))


def human(skeleton: SkeletonModel, frames: int, seed: int = 0, size: float = 1.0) -> Motion:
    """A motion drawn from the pose prior, within hinges and limits; `size` in standard deviations."""
    prior = skeleton.table.prior
    root = np.linalg.cholesky(prior.covariance + 1e-12 * np.eye(len(prior.covariance)))
    rotvec = size * smooth_noise(seed, (frames, len(root)), 20, 1.0) @ root.T
    local = so3.from_quat_wxyz(prior.mean_quat_wxyz) @ so3.exp(rotvec.reshape(frames, -1, 3))
    turn = so3.exp(smooth_noise(seed + 1, (frames, 1, 3), 40, 0.15)) @ so3.about_axis("z", 0.3)
    R = world_rotations(skeleton.parents, np.concatenate([turn, local], axis=1))
    p = smooth_noise(seed + 2, (frames, 1, 3), 60, 0.1) + np.array([0.0, 0.0, 0.95])
    q = skeleton.inverse_kinematics(np.repeat(p, R.shape[1], axis=1), R)
    for j in hinges(skeleton):
        for dof in skeleton.table.joints[j].dofs:
            if not dof.clinical.endswith("flexion"):
                q[:, 7 + skeleton.dof_names.index(dof.urdf)] = 0.0
    low, high = skeleton.limits.T
    q[:, 7:] = np.clip(q[:, 7:], 0.98 * low, 0.98 * high)
    return _motion(skeleton, q, seen=True)


def standing(skeleton: SkeletonModel, frames: int) -> Motion:
    """A person frozen at the first frame of `moving`."""
    return _motion(skeleton, np.tile(moving(skeleton, 1).q, (frames, 1)))


def upright(skeleton: SkeletonModel, frames: int) -> Motion:
    """A person standing straight with hanging arms, ankles 0.08 m high."""
    q = np.tile(skeleton.n_pose(), (frames, 1))
    q[:, 2] = 0.08 - skeleton.forward_kinematics(q[:1])[0][0, :, 2].min() + q[0, 2]
    return _motion(skeleton, q)


def walking(
    skeleton: SkeletonModel, seconds: float, speed: float = 0.8, stride_s: float = 1.2
) -> tuple[Motion, NDArray[np.bool_]]:
    """Walking along x on the floor at z = 0, and a mask (T, 2) of stationary ankles, left first.

    A foot stands flat for 0.6 of a stride, its ankle 0.08 m high, and swings smoothly to the next place.
    """
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    thigh = -skeleton.joint_offsets[skeleton.index("LeftLeg")[0], 2]
    hip = skeleton.joint_offsets[skeleton.index("LeftUpLeg")[0]]
    p_root = np.stack([speed * t, 0 * t, np.full(len(t), 0.08 + 0.9 * 2 * thigh - hip[2])], axis=1)
    R = np.tile(skeleton.forward_kinematics(skeleton.n_pose()[None])[1][0], (len(t), 1, 1, 1))
    stands = np.zeros((len(t), 2), dtype=bool)
    for i, (side, late) in enumerate((("Left", 0.0), ("Right", 0.5))):
        cycle, phase = np.divmod(t / stride_s + late, 1.0)
        stands[:, i] = phase < 0.6
        s = np.clip((phase - 0.6) / 0.4, 0, 1)
        swung = s**3 * (10 - 15 * s + 6 * s**2)
        ankle_x = speed * stride_s * (cycle - late + 0.3 + swung)
        ankle_z = 0.08 + 0.1 * 64 * (s * (1 - s)) ** 3
        x, z = ankle_x - p_root[:, 0] - hip[0], p_root[:, 2] + hip[2] - ankle_z
        bend, lean = np.arccos(np.hypot(x, z) / (2 * thigh)), np.arctan2(-x, z)
        for name, angle in ((f"{side}UpLeg", lean - bend), (f"{side}Leg", lean + bend)):
            R[:, skeleton.index(name)[0]] = so3.about_axis("y", angle)
    q = skeleton.inverse_kinematics(np.repeat(p_root[:, None], R.shape[1], axis=1), R)
    return _motion(skeleton, q), stands


def camera() -> Camera:
    """One camera 4 m away at 1.5 m."""
    return Camera.looking_at([4.0, 0.6, 1.5], [0.0, 0.0, 1.0], focal_px=1250.0)


def keypoints(poses: PoseSequence, sigma_px: float = 0.0, seed: int = 7) -> KeypointSequence:
    """Projected joints with white noise."""
    cam = camera()
    rng = np.random.default_rng(seed)
    uv = cam.project(poses.p_world_joint)
    uv = uv + sigma_px * rng.normal(size=uv.shape)
    return KeypointSequence(cam, poses.times, uv, np.ones(uv.shape[:2]), poses.names)


def unseen(seen: KeypointSequence, frames: object, joints: object = slice(None)) -> KeypointSequence:
    """Keypoints with some missing."""
    uv = np.array(seen.uv_px)
    uv[frames, joints] = np.nan  # type: ignore[index]
    return replace(seen, uv_px=uv)


def bone_imus(
    skeleton: SkeletonModel,
    poses: PoseSequence,
    joints: Sequence[str] = LIMBS,
    degrees: float = 0.0,
    acceleration: float = 0.0,
    seed: int = 11,
) -> BoneImuSequence:
    """Sensors at their usual places: true orientation and central second differences, plus errors.

    Args:
        degrees: standard deviation per axis of a slow orientation error. acceleration: white noise, m/s^2.
    """
    usual: dict[str, ArrayLike] = {joint: lever for joint, lever in skeleton.sensors.values()}
    levers = np.array([usual.get(joint, (0.02, 0.03, -0.1)) for joint in joints]).reshape(-1, 3)
    index = skeleton.index(*joints)
    R = poses.R_world_bone[:, index]
    a = np.full((len(poses), len(index), 3), np.nan)
    p = poses.p_world_joint[:, index] + np.einsum("tsij,sj->tsi", R, levers)
    a[1:-1] = (p[2:] - 2 * p[1:-1] + p[:-2]) * poses.rate_hz**2
    a[[0, -1]] = a[[1, -2]] if len(a) > 2 else 0.0
    rng = np.random.default_rng(seed)
    a += acceleration * rng.normal(size=a.shape)
    error = smooth_noise(seed, (len(poses), len(index), 3), 60, np.radians(degrees))
    return BoneImuSequence(poses.times, R @ so3.exp(error), a, levers, tuple(joints))


def lifted(truth: Motion, radians: float = 0.2, metres: float = 0.15, seed: int = 5) -> Array:
    """Joint positions (T, J, 3), m, with errors of a lifter: of angles, bone lengths and root."""
    skeleton, T = truth.skeleton, len(truth.q)
    q = np.array(truth.q)
    spine = [name.startswith(("Spine", "Neck", "Thorax")) for name in skeleton.dof_names]
    q[:, 7:] += smooth_noise(seed, (T, skeleton.nq - 7), 10, radians) * np.where(spine, 0.3, 1.0)
    p, _ = skeleton.forward_kinematics(q)
    p = p + smooth_noise(seed + 1, p.shape, 10, radians / 20)
    return np.asarray(p + smooth_noise(seed + 2, (T, 1, 3), 30, metres))


def lifted_poses(truth: Motion, radians: float = 0.2, metres: float = 0.15) -> PoseSequence:
    """`lifted` as poses with the true orientations."""
    return replace(truth.poses, p_world_joint=lifted(truth, radians, metres))


class PlantedLifter:
    """A lifter that returns the truth with smooth errors, and NaN in `blind` frames.

    Orientations are those of the truth turned by `turned`, if given.
    """

    def __init__(
        self, truth: Motion, blind: slice = slice(0), turned: Array | None = None, sigma_rad: float = 0.1
    ) -> None:
        self.times, self.p = truth.times, lifted(truth)
        self.blind = blind
        self.R = np.full((*self.p.shape, 3), np.nan)
        self.sigma_rad = np.full(self.p.shape[:2], np.nan)
        if turned is not None:
            self.R = truth.poses.R_world_bone @ turned
            self.sigma_rad[:] = sigma_rad
        self.asked: list[tuple[KeypointSequence, Array | None]] = []
        self.floors: list[float | None] = []
        self.sensors: list[BoneImuSequence | None] = []

    def predict(
        self,
        keypoints: KeypointSequence,
        joint_offsets: Array | None = None,
        *,
        bone_imus: BoneImuSequence | None = None,
        floor_height: float | None = None,
    ) -> Any:
        self.asked.append((keypoints, joint_offsets))
        self.floors.append(floor_height)
        self.sensors.append(bone_imus)
        nearest = np.abs(self.times - keypoints.times[:, None]).argmin(axis=1)
        seen = np.ones(len(keypoints), dtype=bool)
        seen[self.blind] = False
        R, sigma = np.array(self.R[nearest]), np.array(self.sigma_rad[nearest])
        R[~seen], sigma[~seen] = np.nan, np.nan
        sigma_m = np.full((*sigma.shape, 2), np.nan)
        return SimpleNamespace(
            p_world_joint=self.p[nearest], seen=seen, R_world_bone=R, sigma_rad=sigma, sigma_m=sigma_m
        )


def recording(truth: Motion, sigma_px: float = 0.0, joints: Sequence[str] = LIMBS, degrees: float = 0.0) -> Recording:
    """A recording of a motion with calibrated IMUs of random mountings and headings."""
    bones = bone_imus(truth.skeleton, truth.poses, joints, degrees)
    S = len(bones.joints)
    rng = np.random.default_rng(3)
    R_world_inertial = so3.about_axis("z", rng.uniform(-3, 3, S))
    R_sensor_bone = so3.exp(rng.normal(size=(S, 3)))
    R_inertial_world = np.swapaxes(R_world_inertial, -1, -2)
    R = R_inertial_world @ bones.R_world_bone @ np.swapaxes(R_sensor_bone, -1, -2)
    R_sensor_world = np.swapaxes(R_world_inertial @ R, -1, -2)
    f = np.einsum("tsij,tsj->tsi", R_sensor_world, bones.a_world - GRAVITY_WORLD)
    names = tuple(f"imu_{joint}" for joint in bones.joints)
    calibration = ImuCalibration(names, bones.joints, R_world_inertial, R_sensor_bone, bones.p_bone_sensor)
    return Recording(
        name="planted",
        keypoints=keypoints(truth.poses, sigma_px),
        imus=ImuSequence(bones.times, R, f, names),
        calibration=calibration,
        skeleton_table=truth.skeleton.name,
        truth=truth.poses,
    )


def mpjpe_mm(p: Array, p_true: Array) -> float:
    """Mean distance, mm, of positions (..., 3) in m."""
    return float(1000 * np.linalg.norm(p - p_true, axis=-1).mean())


def root_relative_mm(p: Array, p_true: Array) -> float:
    """The same relative to the first joint."""
    return mpjpe_mm(p - p[:, :1], p_true - p_true[:, :1])
