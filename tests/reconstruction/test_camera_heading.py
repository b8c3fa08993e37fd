"""Slow drift of a camera's heading, planted and recovered against sensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction.camera_evidence import heading_drift

T, RATE = 900, 15.0
TIMES = np.arange(T) / RATE
RATE_SIGMA = np.radians(0.1)
JOINTS = ("LeftArm", "RightArm", "LeftLeg")


def seen_and_sensed(drift: Array, seed: int = 0) -> tuple[PoseSequence, BoneImuSequence]:
    """Segments of a lifter whose errors last for a second, in the world of a camera that drifts."""
    rng = np.random.default_rng(seed)
    R = so3.exp(rng.normal(size=(T, 3, 3)))
    slow = np.repeat(rng.normal(size=(T // 15, 3, 3)), 15, axis=0)
    R_lifted = so3.about_axis("z", -drift)[:, None] @ so3.exp(np.radians(6) * slow) @ R
    poses = PoseSequence(TIMES, np.zeros((T, 3, 3)), R_lifted, JOINTS)
    return poses, BoneImuSequence(
        times=TIMES, R_world_bone=R, a_world=np.zeros((T, 3, 3)), joints=JOINTS, p_bone_sensor=np.zeros((3, 3))
    )


@pytest.mark.parametrize("per_minute", [-15.0, 0.0, 6.0])
def test_planted_drift_is_found_within_its_sigma(per_minute: float) -> None:
    drift = np.radians(per_minute / 60 * (TIMES - TIMES.mean()))
    found = heading_drift(*seen_and_sensed(drift), RATE_SIGMA)
    off = np.degrees(found.angle - drift)
    assert np.abs(off).max() < 2.5
    assert np.mean(np.abs(off) < 2 * np.degrees(found.sigma)) > 0.9
    assert 0.5 < np.degrees(found.sigma).mean() < 2.0
    assert found.angle.mean() == pytest.approx(0, abs=1e-9)


def test_drift_is_removed_from_keypoints() -> None:
    camera = Camera.looking_at([4.0, 1.0, 1.5], [0.0, 0.0, 1.0], 900.0)
    points = np.random.default_rng(1).uniform(-0.5, 1.2, (T, 4, 3))
    drift = np.radians(10.0 / 60 * (TIMES - TIMES.mean()))
    turned = so3.about_axis("z", -drift)
    about = camera.center_world
    uv = camera.project(np.einsum("tij,tlj->tli", turned, points - about) + about)
    keypoints = KeypointSequence(camera, TIMES, uv, np.ones((T, 4)), tuple("abcd"))
    found = replace(heading_drift(*seen_and_sensed(drift), RATE_SIGMA), angle=drift)
    np.testing.assert_allclose(found.removed(keypoints).uv_px, camera.project(points), atol=1e-6)


def test_other_times_and_nothing_in_common_are_refused() -> None:
    poses, imus = seen_and_sensed(np.zeros(T))
    with pytest.raises(InvalidInputError, match="other times"):
        heading_drift(poses, imus.resample(TIMES[::2]), RATE_SIGMA)
    unknown = replace(poses, R_world_bone=np.full_like(poses.R_world_bone, np.nan))
    with pytest.raises(InvalidInputError, match="no segment is seen"):
        heading_drift(unknown, imus, RATE_SIGMA)
