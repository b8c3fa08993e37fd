"""Poses from sensors alone: exact for segments with sensors, the mean posture elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.data.poses import PoseSequence, Provenance
from rtof_kin.inertial.initial_poses import poses_from_sensors, refit_root

BODY = SkeletonModel.default()
TRUTH = planted.human(BODY, 60).poses


def test_segments_with_sensors_are_exact_and_bones_rigid() -> None:
    imus = planted.bone_imus(BODY, TRUTH, planted.LIMBS)
    poses = poses_from_sensors(BODY, imus)
    index = BODY.index(*planted.LIMBS)
    np.testing.assert_allclose(poses.R_world_bone[:, index], imus.R_world_bone, atol=1e-9)
    bones = poses.p_world_joint[:, 1:] - poses.p_world_joint[:, list(BODY.parents[1:])]
    lengths = np.linalg.norm(BODY.joint_offsets[1:], axis=1)
    np.testing.assert_allclose(np.linalg.norm(bones, axis=2), np.tile(lengths, (60, 1)), atol=1e-9)
    np.testing.assert_array_equal(poses.p_world_joint[:, 0], 0.0)


def test_only_segments_with_data_are_observed() -> None:
    imus = planted.bone_imus(BODY, TRUTH, ("LeftLeg", "Hips"))
    R = np.array(imus.R_world_bone)
    R[10:20, 0] = np.nan
    poses = poses_from_sensors(BODY, replace(imus, R_world_bone=R))
    (leg, foot, hips, spine, arm) = BODY.index("LeftLeg", "LeftFoot", "Hips", "Spine", "LeftArm")
    assert not poses.orientation_observed[10:20, leg].any()
    assert poses.orientation_observed[20:, leg].all()
    assert not poses.orientation_observed[:, [spine, arm, foot]].any()
    assert (poses.provenance[20:, foot] == Provenance.IMU).all()
    assert (poses.provenance[10:20, foot] == Provenance.PRIOR).all()
    assert (poses.provenance[:, spine] == Provenance.IMU).all()
    assert (poses.provenance[:, [arm, hips]] == Provenance.PRIOR).all()
    assert np.isfinite(poses.R_world_bone).all()
    R[10:20] = np.nan
    valid = poses_from_sensors(BODY, replace(imus, times=10 * imus.times, R_world_bone=R)).valid
    np.testing.assert_array_equal(np.flatnonzero(~valid.any(axis=1)), np.arange(10, 20))


def test_gaps_are_interpolated_on_the_geodesic() -> None:
    imus = planted.bone_imus(BODY, TRUTH, ("Hips",))
    R = np.array(imus.R_world_bone)
    R[:5] = R[30:40] = R[55:] = np.nan
    got = poses_from_sensors(BODY, replace(imus, R_world_bone=R)).R_world_bone[:, 0]
    np.testing.assert_allclose(got[0], R[5, 0], atol=1e-9)
    np.testing.assert_allclose(got[-1], R[54, 0], atol=1e-9)
    whole = so3.angle_between(R[29, 0], R[40, 0])
    assert so3.angle_between(R[29, 0], got[34]) == pytest.approx(whole * 5 / 11, rel=1e-6)


def test_segments_between_sensors_share_the_rotation() -> None:
    turn = so3.about_axis("z", np.radians(40.0))
    imus = planted.bone_imus(BODY, TRUTH, ("Hips", "Spine3"))
    neutral = poses_from_sensors(BODY, planted.bone_imus(BODY, TRUTH, ("Hips",)))
    R = np.stack([neutral.R_world_bone[:, 0], neutral.R_world_bone[:, 4] @ turn], axis=1)
    got = poses_from_sensors(BODY, replace(imus, R_world_bone=R)).R_world_bone
    trunk = BODY.index("Spine", "Spine1", "Spine2", "Spine3")
    off = np.degrees(so3.angle_between(got[:, trunk], neutral.R_world_bone[:, trunk]))
    assert (np.diff(off, axis=1) > 1).all()
    np.testing.assert_allclose(off[:, -1], 40.0, atol=1e-6)


def test_a_root_without_a_sensor_is_upright_with_the_thighs_heading() -> None:
    standing = planted.upright(BODY, 4).poses
    for yaw in np.radians([0.0, 100.0, -170.0]):
        turned = replace(standing, R_world_bone=so3.about_axis("z", yaw) @ standing.R_world_bone)
        poses = poses_from_sensors(BODY, planted.bone_imus(BODY, turned, ("LeftUpLeg", "RightUpLeg")))
        np.testing.assert_allclose(poses.R_world_bone[:, 0, 2, 2], 1.0, atol=1e-12)
        expected = so3.about_axis("z", float(so3.heading(turned.R_world_bone[0, 0])))
        assert np.degrees(so3.angle_between(poses.R_world_bone[0, 0], expected)) < 12.0


def test_sensors_without_data_or_segment_are_refused() -> None:
    imus = planted.bone_imus(BODY, TRUTH, ("Hips",))
    with pytest.raises(InvalidInputError, match="no sensor has an orientation"):
        poses_from_sensors(BODY, replace(imus, R_world_bone=np.full_like(imus.R_world_bone, np.nan)))
    with pytest.raises(UnknownNameError, match="Tail"):
        poses_from_sensors(BODY, replace(imus, joints=("Tail",)))


Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def truth() -> Motion:
    return planted.moving(BODY, 12)


def moved(poses: PoseSequence, by: Array) -> PoseSequence:
    return replace(poses, p_world_joint=poses.p_world_joint + by)


def offsets(seed: int = 0) -> Array:
    """(12, 1, 3) m, the root wrong by some 20 cm."""
    return np.random.default_rng(seed).normal(size=(12, 1, 3)) * 0.2


def test_the_minimum_equals_scipys_with_cauchy_loss(truth: Motion) -> None:
    # The re-weighted normal equations solve sum 4 log(1 + r^2 / 4) + |shift|^2 / sigma_depth^2.
    seen = planted.keypoints(truth.poses, sigma_px=5.0)
    start, camera = moved(truth.poses, offsets(1)), planted.camera()
    out = refit_root(start, seen, sigma_px=8.0, sigma_depth=0.2, iterations=40)
    for t in (0, 7):

        def residuals(shift: Array, t: int = t) -> Array:
            r = (camera.project(start.p_world_joint[t] + shift) - seen.uv_px[t]) / 8.0
            # r (log(1 + s / 4) 4 / s)^(1/2) has the Cauchy loss as its square.
            s = np.sum(r**2, axis=-1, keepdims=True)
            return np.concatenate([(r * np.sqrt(4 * np.log1p(s / 4) / s)).ravel(), shift / 0.2])

        peer = least_squares(residuals, np.zeros(3), xtol=1e-14, ftol=1e-14, gtol=1e-14)
        shift = (out.p_world_joint - start.p_world_joint)[t, 0]
        np.testing.assert_allclose(shift, peer.x, atol=1e-5)


def test_noise_does_not_bias_the_depth() -> None:
    truth = planted.moving(BODY, 400).poses
    seen = planted.keypoints(truth, sigma_px=10.0)
    shift = (refit_root(truth, seen, sigma_depth=100.0, iterations=6).p_world_joint - truth.p_world_joint)[:, 0]
    # 80 mm per frame, so 4 mm in the mean of 400; linear equations are biased by 50 mm.
    assert abs((shift @ planted.camera().R_camera_world[2]).mean()) < 0.015


def test_frames_without_keypoints_are_unchanged(truth: Motion) -> None:
    start = moved(truth.poses, 0.5 * offsets())
    every = planted.keypoints(truth.poses)
    out, whole = refit_root(start, planted.unseen(every, slice(3, 6))), refit_root(start, every)
    np.testing.assert_array_equal(out.p_world_joint[3:6], start.p_world_joint[3:6])
    np.testing.assert_array_equal(out.p_world_joint[6:], whole.p_world_joint[6:])
    before = planted.mpjpe_mm(start.p_world_joint, truth.poses.p_world_joint)
    assert planted.mpjpe_mm(whole.p_world_joint, truth.poses.p_world_joint) < 0.6 * before
    fixed = refit_root(start, every, sigma_depth=1e-6)
    np.testing.assert_allclose(fixed.p_world_joint, start.p_world_joint, atol=1e-6)


def test_distortion_is_modelled_and_other_landmarks_are_ignored(truth: Motion) -> None:
    straight, start = planted.keypoints(truth.poses), moved(truth.poses, offsets())
    lens: Camera = replace(straight.camera, distortion=np.array([-0.2, 0.05, 0.001, -0.002, 0.0]))
    bent = replace(straight, camera=lens, uv_px=lens.project(truth.poses.p_world_joint))
    expected = refit_root(start, straight).p_world_joint
    np.testing.assert_allclose(refit_root(start, bent).p_world_joint, expected, atol=1e-5)
    out = refit_root(start, replace(straight, names=(*straight.names[:-1], "Nose")))
    same = refit_root(start, planted.unseen(straight, slice(None), 20))
    np.testing.assert_array_equal(out.p_world_joint, same.p_world_joint)
    shift = out.p_world_joint - start.p_world_joint
    np.testing.assert_allclose(shift, np.broadcast_to(shift[:, :1], shift.shape), atol=1e-12)


def test_a_second_camera_gives_the_depth(truth: Motion) -> None:
    side = Camera.looking_at([0.5, -4.0, 1.2], [0.0, 0.0, 1.0], focal_px=900.0)
    first = planted.keypoints(truth.poses, sigma_px=5.0)
    uv = side.project(truth.poses.p_world_joint)
    second = replace(first, camera=side, uv_px=uv + 5.0 * np.random.default_rng(1).normal(size=uv.shape))
    start = moved(truth.poses, offsets())
    one, two = refit_root(start, first), refit_root(start, first, (second,))
    errors = [planted.mpjpe_mm(p.p_world_joint, truth.poses.p_world_joint) for p in (one, two)]
    assert errors[1] < 0.15 * errors[0]
    np.testing.assert_allclose(
        refit_root(start, planted.unseen(first, slice(None)), (second,)).p_world_joint,
        refit_root(start, second).p_world_joint,
        atol=1e-6,
    )
