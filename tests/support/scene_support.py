"""A planted motion on the disk for the viewer: a person who glides along x."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from measurements_support import write_measurements

from rtof_kin.body.motion_file import MOTION, write_motion
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.camera import Camera
from rtof_kin.data.confidence import WORLD, Confidence
from rtof_kin.data.keypoints import KeypointSequence, Measurements
from rtof_kin.data.poses import PoseSequence, Provenance
from rtof_kin.formats.measurements_file import MEASUREMENTS

RATE = 50.0
SPEED = 1.0  # m/s along x
SIGMA = (0.01, 0.02, 0.03)  # m, of positions along the axes of world
SENSORS = {"thigh": "LeftUpLeg", "arm": "RightForeArm"}
BENT = np.radians(40.0)  # of the right knee at all times


def walking(frames: int = 120, start: float = 2.0, shaking: float = 0.0) -> Motion:
    """A stiff person who glides along x with a bent knee, each joint observed by camera and IMU.

    All angles are shaken by a standard deviation, rad.
    """
    skeleton = SkeletonModel.default()
    times = start + np.arange(frames) / RATE
    q = np.tile(skeleton.n_pose(), (frames, 1))
    q[:, 0], q[:, 2] = SPEED * (times - start), 0.95
    q[:, 7 + skeleton.dof_names.index("RightLeg_y")] = BENT
    q[:, 7:] += shaking * np.random.default_rng(0).normal(size=q[:, 7:].shape)
    p, R = skeleton.forward_kinematics(q)
    shape = p.shape[:2]
    observed = np.full(shape, True)
    poses = PoseSequence(
        times, p, R, skeleton.names, np.full(shape, Provenance.CAMERA_AND_IMU), observed, observed, observed
    )
    covariance = np.tile(np.diag(np.square(SIGMA)), (*shape, 1, 1))
    relative = covariance.copy()
    relative[:, 0] = 0.0
    pairs = ((WORLD, "Hips"), ("RightUpLeg", "RightLeg"))
    turns = np.tile(np.eye(3) * np.radians(2.0) ** 2, (frames, len(pairs), 1, 1))
    confidence = Confidence(times, skeleton.names, covariance, relative, pairs, turns)
    return Motion(skeleton, q, poses, skeleton.check(q), confidence)


def with_provenance(motion: Motion, joint: str, kinds: list[Provenance]) -> Motion:
    """The motion with these provenances of a joint in its first frames, its orientation unobserved."""
    poses, j = motion.poses, motion.skeleton.index(joint)[0]
    provenance, observed = np.array(poses.provenance), np.array(poses.orientation_observed)
    provenance[: len(kinds), j] = kinds
    observed[: len(kinds), j] = False
    poses = replace(poses, provenance=provenance, orientation_observed=observed, direction_observed=observed)
    return replace(motion, poses=poses)


def camera() -> Camera:
    """Beside the path, looking across it; its principal point is not in the middle."""
    found = Camera.looking_at([1.0, -4.0, 1.2], [1.0, 0.0, 1.0], 900.0, 1280, 720)
    K = found.K.copy()
    K[:2, 2] += 30.0, -20.0
    return replace(found, K=K)


def measured(motion: Motion, cameras: int = 1, truth: bool = True) -> Measurements:
    """What the motion was computed from: exact points, sensors of a known mounting, a truth 0.1 m off."""
    poses, skeleton = motion.poses, motion.skeleton
    uv = camera().project(poses.p_world_joint)
    view = KeypointSequence(camera(), poses.times, uv, np.ones(uv.shape[:2]), skeleton.names)
    joints = skeleton.index(*SENSORS.values())
    mounting = so3.exp(np.array([[0.3, 0.0, 0.0], [0.0, 0.5, 0.0]]))
    shifted = poses.p_world_joint + np.array([0.0, 0.1, 0.0])
    known = PoseSequence(poses.times, shifted, poses.R_world_bone, poses.names) if truth else None
    return Measurements(
        poses.times,
        (view,) * cameras,
        tuple(SENSORS),
        tuple(SENSORS.values()),
        poses.R_world_bone[:, joints] @ mounting,
        mounting,
        np.array([[0.05, 0.0, -0.2], [0.0, -0.1, 0.03]]),
        known,
        (),
        0.02,
    )


def written(folder: Path, motion: Motion, measurements: Measurements | None = None) -> Path:
    """The output folder of a motion."""
    folder.mkdir(parents=True, exist_ok=True)
    write_motion(folder / MOTION, motion, mode="rtof")
    if measurements is not None:
        write_measurements(folder / MEASUREMENTS, measurements)
    (folder / "summary.json").write_text(
        '{"recording": "glide <b>", "verdict": {"grade": "fail", "headline": "planted & bad"}}'
    )
    return folder
