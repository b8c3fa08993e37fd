"""Evidence of a camera: next to nothing with the true one, the algebra of the image with a wrong one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.calibration.camera_estimate import FOCAL, PITCH, Evidence, corrected
from rtof_kin.core import rotations as so3
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.reconstruction import camera_evidence as by
from rtof_kin.reconstruction.camera_evidence import (
    Scene,
    evidence,
    heading_drift,
    heading_turned,
    standing_feet,
    walked,
)

BODY = SkeletonModel.default()
WALK, STANDS = planted.walking(BODY, 4.0, speed=0.8)
HEIGHT = 1.5
FRONT = Camera.looking_at([6.0, 0.0, HEIGHT], [1.5, 0.0, 1.0], 1250.0)
"""The person walks towards it."""


def seen(camera: Camera = FRONT, motion: Motion = WALK) -> KeypointSequence:
    poses = motion.poses
    uv = camera.project(poses.p_world_joint)
    return KeypointSequence(camera, poses.times, uv, np.ones(uv.shape[:2]), poses.names)


def scene(sensors: bool = False) -> Scene:
    joints = planted.LIMBS
    R = WALK.poses.R_world_bone[:, BODY.index(*joints)]
    a, levers = np.zeros((len(R), len(joints), 3)), np.zeros((len(joints), 3))
    imus = BoneImuSequence(WALK.times, R, a, levers, joints)
    return Scene(BODY, 0.0, standing_feet(seen(), WALK.poses, BODY), imus if sensors else None)


def of_wrong(y: NDArray[np.float64], sensors: bool = False) -> Evidence:
    """Of a camera with errors, the body as it is in the image: turned and moved with the camera."""
    wrong = corrected(FRONT, y)
    p = FRONT.to_camera(WALK.poses.p_world_joint) * [1.0, 1.0, 1.0 + y[FOCAL]]
    poses = replace(WALK.poses, p_world_joint=(p - wrong.t_camera_world) @ wrong.R_camera_world)
    return evidence(scene(sensors), replace(seen(), camera=wrong), poses, poses)


def test_feet_that_stand_are_found_in_a_walk_towards_the_camera() -> None:
    found = scene().contacts.standing
    assert found[STANDS].mean() > 0.85
    assert found[~STANDS].mean() < 0.2


def test_missing_feet_do_not_stand() -> None:
    keypoints = seen()
    uv = keypoints.uv_px.copy()
    uv[50:100, BODY.index("LeftFoot")] = np.nan
    hidden = replace(keypoints, uv_px=uv, confidence=np.isfinite(uv[..., 0]).astype(float))
    assert not standing_feet(hidden, WALK.poses, BODY).standing[50:100, 0].any()


def test_the_true_camera_has_next_to_no_evidence_against_it() -> None:
    for sensors in (False, True):
        found = of_wrong(np.zeros(5), sensors)
        assert (np.abs(found.value / found.sigma)[found.known] < 2).all()
        assert found.known[-1] == sensors  # walking needs sensors on the legs


def test_a_wrong_pitch_tilts_the_floor_and_the_body() -> None:
    """Looking further down by an angle lowers feet by their distance times it."""
    angle = 0.05
    off = of_wrong(np.array([0, angle, 0, 0, 0])).value - of_wrong(np.zeros(5)).value
    distance = np.median(FRONT.to_camera(WALK.poses.p_world_joint[:, 0])[:, 2])
    assert off[0] == pytest.approx(-angle * distance, rel=0.2)
    assert off[1] == pytest.approx(-angle, rel=0.1)
    assert abs(off[2]) < 0.005
    assert abs(off[3]) == pytest.approx(angle, rel=0.1)


def test_a_longer_focal_length_lengthens_the_path_of_the_body_but_not_its_steps() -> None:
    body, legs = walked(scene(sensors=True), FRONT, WALK.poses)
    assert body @ legs / (legs @ legs) == pytest.approx(1.0, abs=0.02)
    wrong = corrected(FRONT, 0.1 * (np.arange(5) == FOCAL))
    p = WALK.poses.p_world_joint
    far = FRONT.to_camera(p[:, 0]) * [0, 0, 0.1] @ FRONT.R_camera_world
    moved = replace(WALK.poses, p_world_joint=p + far[:, None])
    value = evidence(scene(sensors=True), replace(seen(), camera=wrong), moved, moved).value[-1]
    assert value == pytest.approx(np.log(1.1) - by.WALK.mean, abs=0.03)


def test_sensors_tell_a_tilt_of_the_body_in_the_image() -> None:
    y = 0.05 * (np.arange(5) == PITCH)
    turned = of_wrong(y, sensors=True).value - of_wrong(np.zeros(5), sensors=True).value
    np.testing.assert_allclose(np.abs(turned[3:5]), [0.05, 0.0], atol=0.003)


def test_without_a_floor_its_evidence_is_unknown() -> None:
    free = replace(scene(), floor_height=None)
    found = evidence(free, seen(), WALK.poses, WALK.poses)
    assert not found.known[:3].any()
    assert found.known[3:5].all()


def test_a_lean_is_not_a_turn_about_the_vertical() -> None:
    turned = so3.about_axis("z", 1.0)
    camera = replace(FRONT, R_camera_world=FRONT.R_camera_world @ turned.T)
    poses = replace(WALK.poses, p_world_joint=WALK.poses.p_world_joint @ turned.T)
    found = evidence(scene(), replace(seen(), camera=camera), poses, poses)
    np.testing.assert_allclose(found.value[3:5], of_wrong(np.zeros(5)).value[3:5], atol=1e-6)


def test_where_the_motion_was_used_before_only_walking_is_left() -> None:
    own = scene(sensors=True)
    before = evidence(own, seen(), WALK.poses, WALK.poses)
    after = evidence(replace(own, floor_and_tilt=False), seen(), WALK.poses, WALK.poses)
    assert before.known[:5].all()
    assert not after.known[:5].any()
    np.testing.assert_array_equal(after.value[5:], before.value[5:])


def test_posture_says_less_in_a_short_recording() -> None:
    short = evidence(scene(), seen(), WALK.poses[:60], WALK.poses)
    long = evidence(scene(), seen(), WALK.poses, WALK.poses)
    assert (short.sigma[3:5] > 1.5 * long.sigma[3:5]).all()


def test_a_sensor_on_a_segment_without_a_child_tells_no_direction() -> None:
    parts = scene(sensors=True)
    leaf = next(i for i in range(len(BODY.names)) if i not in BODY.parents)
    joints = (*parts.bone_imus.joints[:-1], BODY.names[leaf])
    leaves = replace(parts, bone_imus=replace(parts.bone_imus, joints=joints))
    found = evidence(leaves, seen(), WALK.poses, WALK.poses)
    np.testing.assert_allclose(found.value[3:5], 0.0, atol=1e-6)


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
    angle, sigma = heading_drift(*seen_and_sensed(drift), RATE_SIGMA)
    off = np.degrees(angle - drift)
    assert np.abs(off).max() < 2.5
    assert np.mean(np.abs(off) < 2 * np.degrees(sigma)) > 0.9
    assert 0.5 < np.degrees(sigma).mean() < 2.0
    assert angle.mean() == pytest.approx(0, abs=1e-9)


def test_drift_is_removed_from_keypoints() -> None:
    camera = Camera.looking_at([4.0, 1.0, 1.5], [0.0, 0.0, 1.0], 900.0)
    points = np.random.default_rng(1).uniform(-0.5, 1.2, (T, 4, 3))
    drift = np.radians(10.0 / 60 * (TIMES - TIMES.mean()))
    turned = so3.about_axis("z", -drift)
    about = camera.center_world
    uv = camera.project(np.einsum("tij,tlj->tli", turned, points - about) + about)
    keypoints = KeypointSequence(camera, TIMES, uv, np.ones((T, 4)), tuple("abcd"))
    np.testing.assert_allclose(heading_turned(keypoints, drift).uv_px, camera.project(points), atol=1e-6)


def test_other_times_and_nothing_in_common_are_refused() -> None:
    poses, imus = seen_and_sensed(np.zeros(T))
    with pytest.raises(InvalidInputError, match="other times"):
        heading_drift(poses, imus.resample(TIMES[::2]), RATE_SIGMA)
    unknown = replace(poses, R_world_bone=np.full_like(poses.R_world_bone, np.nan))
    with pytest.raises(InvalidInputError, match="no segment is seen"):
        heading_drift(unknown, imus, RATE_SIGMA)
