"""The pose in a picture is the projected motion at the right instant, with honest provenance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from overlay_support import motion_with, picture_view, upright_camera

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.data.camera import Camera, CameraTurning
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import Provenance
from rtof_kin.view.blocks import BLOCK
from rtof_kin.view.projected_motion import (
    Moment,
    PictureView,
    ProjectedMotion,
    limb_ends,
    shown_provenance,
    virtual_view,
)


def seen_by(motion: Motion, camera: Camera, offset: float = 0.0) -> KeypointSequence:
    uv = camera.project(motion.poses.p_world_joint)
    return KeypointSequence(
        camera, motion.times, uv, np.ones(uv.shape[:2]), motion.poses.names, own_times=motion.times + offset
    )


def view_of(motion: Motion, camera: Camera, offset: float = 0.0) -> PictureView:
    return picture_view(seen_by(motion, camera, offset))


@pytest.fixture(scope="module")
def camera() -> Camera:
    return replace(upright_camera(640, 480), distortion=np.array([-0.2, 0.05, 0.001, -0.002, 0.0]))


def test_pose_is_the_projection_of_the_frame_or_between_two(motion: Motion, camera: Camera) -> None:
    projected = ProjectedMotion(motion, view_of(motion, camera, offset=5.0))
    truth = camera.project(motion.poses.p_world_joint)
    moment = projected.moment(5.0 + float(motion.times[7]))
    assert moment is not None
    pose = projected.pose(moment)
    np.testing.assert_allclose(pose.uv_px[:21], truth[7], atol=1e-6)
    assert pose.time == pytest.approx(motion.times[7])
    between = projected.moment(5.0 + float(0.25 * motion.times[7] + 0.75 * motion.times[8]))
    assert between is not None
    middle = projected.pose(between)
    np.testing.assert_allclose(middle.uv_px[:21], 0.25 * truth[7] + 0.75 * truth[8], atol=1e-6)
    assert middle.time == pytest.approx(0.25 * motion.times[7] + 0.75 * motion.times[8])
    np.testing.assert_allclose(projected.detected(between), 0.25 * truth[7] + 0.75 * truth[8], atol=1e-6)


def test_poses_are_those_of_their_frames_where_one_part_of_the_motion_ends(
    skeleton: SkeletonModel, camera: Camera
) -> None:
    motion = motion_with(skeleton, BLOCK + 20, sigma=0.01, way=0.3)
    projected = ProjectedMotion(motion, view_of(motion, camera))
    truth = camera.project(motion.poses.p_world_joint)
    for before in (BLOCK - 2, BLOCK - 1, BLOCK, BLOCK + 18):
        moment = Moment(before, before + 1, 0.25)
        expected = 0.75 * truth[before] + 0.25 * truth[before + 1]
        np.testing.assert_allclose(projected.pose(moment).uv_px[:21], expected, atol=1e-6)
        np.testing.assert_allclose(projected.detected(moment), expected, atol=1e-6)
        assert projected.covariance_px(before + 1) is not None


def test_there_is_no_pose_outside_the_motion_in_its_gaps_and_where_it_is_unknown(
    skeleton: SkeletonModel, camera: Camera
) -> None:
    motion = motion_with(skeleton, 20)
    p = np.array(motion.poses.p_world_joint)
    p[12] = np.nan
    times = motion.times + np.where(np.arange(20) >= 6, 0.2, 0.0)  # a gap between frames 5 and 6
    poses = replace(motion.poses, p_world_joint=p, times=times)
    motion = replace(motion, poses=poses)
    projected = ProjectedMotion(motion, view_of(motion, camera))
    step = 1 / 60
    assert projected.moment(-0.5 * step) == Moment(0, 0, 0.0)
    assert projected.moment(-0.9 * step) is None
    assert projected.moment(float(times[-1]) + 0.9 * step) is None
    assert projected.moment(float(times[5]) + 0.1) is None
    assert projected.moment(float(times[5])) == Moment(5, 5, 0.0)
    assert projected.moment(float(times[12])) is None
    assert projected.moment(float(times[11]) + 0.4 * step) is None


def test_provenance_is_the_weaker_and_unreliable_positions_count_as_unobserved(
    skeleton: SkeletonModel, camera: Camera
) -> None:
    how = {"RightLeg": Provenance.BRIDGED, "LeftFoot": Provenance.PRIOR, "LeftHand": Provenance.IMU}
    motion = motion_with(skeleton, 4, how)
    provenance = motion.poses.provenance.copy()
    provenance[2, 0] = Provenance.CAMERA_AND_IMU
    motion = replace(motion, poses=replace(motion.poses, provenance=provenance))
    projected = ProjectedMotion(motion, view_of(motion, camera))
    pose = projected.pose(Moment(2, 3, 0.5))
    shown = dict(zip(projected.names, map(Provenance, pose.provenance.tolist()), strict=True))
    assert shown["RightLeg"] is Provenance.BRIDGED
    assert shown["LeftFoot"] is Provenance.PRIOR
    assert shown["LeftToe"] is Provenance.PRIOR  # never better than its joint
    assert shown["LeftHand"] is Provenance.IMU
    assert shown["Hips"] is Provenance.CAMERA
    invalid = replace(motion.poses, valid=np.zeros_like(motion.poses.valid))
    assert shown_provenance(replace(motion, poses=invalid)).max() == Provenance.PRIOR
    unknown = replace(motion.poses, provenance=np.zeros_like(provenance))
    shown_then = shown_provenance(replace(motion, poses=unknown))
    assert set(np.unique(shown_then)) == {Provenance.CAMERA}


def test_what_nobody_observed_is_not_drawn(skeleton: SkeletonModel, camera: Camera) -> None:
    motion = motion_with(skeleton, 4, {"LeftFoot": Provenance.PRIOR})
    provenance, valid = motion.poses.provenance.copy(), motion.poses.valid.copy()
    provenance[1], valid[2] = Provenance.PRIOR, False
    provenance[3] = Provenance.BRIDGED  # out of sight: where it was last seen there is no person
    motion = replace(motion, poses=replace(motion.poses, provenance=provenance, valid=valid))
    projected = ProjectedMotion(motion, view_of(motion, camera))
    drawn = [np.isfinite(projected.pose(Moment(i, i, 0.0)).uv_px).all(axis=1) for i in range(4)]
    seen = dict(zip(projected.names, drawn[0], strict=True))
    assert not seen["LeftFoot"]
    assert seen["LeftLeg"]
    assert seen["Hips"]
    assert not any(frame.any() for frame in drawn[1:])
    assert Provenance.PRIOR not in projected.provenances


def test_ends_of_limbs_are_drawn_as_observed_only_if_their_orientation_is(
    skeleton: SkeletonModel, camera: Camera
) -> None:
    assert set(limb_ends(skeleton)) == {"HeadTop", "RightHandEnd", "LeftHandEnd", "RightToe", "LeftToe"}
    assert len(limb_ends(SkeletonModel.human36m())) == 5
    motion = motion_with(skeleton, 3)
    unseen = np.array(motion.poses.orientation_observed)
    unseen[:, skeleton.index("RightFoot")] = False
    motion = replace(motion, poses=replace(motion.poses, orientation_observed=unseen))
    projected = ProjectedMotion(motion, view_of(motion, camera))
    shown = dict(zip(projected.names, projected.pose(Moment(1, 1, 0.0)).provenance, strict=True))
    assert shown["RightToe"] == Provenance.PRIOR
    assert shown["LeftToe"] == Provenance.CAMERA
    assert {projected.names[b] for a, b in projected.bones if projected.names[a] == "Head"} == {"HeadTop"}


def test_covariance_in_the_picture_is_that_of_projected_samples(skeleton: SkeletonModel, camera: Camera) -> None:
    motion = motion_with(skeleton, 3, sigma=0.01)
    assert motion.confidence is not None
    root = np.diag([0.05, 0.01, 0.02]) + 0.01
    covariance = np.tile(root @ root.T, (3, 21, 1, 1))
    motion = replace(motion, confidence=replace(motion.confidence, position_covariance=covariance))
    found = ProjectedMotion(motion, view_of(motion, camera)).covariance_px(1)
    assert found is not None
    rng = np.random.default_rng(3)
    j = skeleton.index("RightHand")[0]
    samples = motion.poses.p_world_joint[1, j] + rng.normal(size=(40_000, 3)) @ root.T
    np.testing.assert_allclose(found[j], np.cov(camera.project(samples).T), rtol=0.05, atol=1.0)


def test_a_view_of_another_size_keeps_pixel_centres(motion: Motion, camera: Camera) -> None:
    view = view_of(motion, camera)
    half = view.scaled(0.5, (320, 240), view.video_times)
    frames = np.array([2, 3])
    p = motion.poses.p_world_joint[frames]
    np.testing.assert_allclose(half.project(p, frames), (view.project(p, frames) + 0.5) / 2 - 0.5)
    np.testing.assert_allclose(half.in_video(frames), (view.in_video(frames) + 0.5) / 2 - 0.5)
    assert (half.camera.width_px, half.camera.height_px) == (320, 240)


def test_the_pose_follows_a_camera_that_turned(motion: Motion, camera: Camera) -> None:
    """Seen by the turned camera itself, with its lens, instead of through the still one's pixels."""
    still = replace(camera.undistorted(), stabilised=True)
    angles = np.linspace(-0.2, 0.3, len(motion.times))
    R_still_camera = so3.about_axis("y", angles) @ so3.about_axis("z", np.full(len(angles), 0.1))
    turning = CameraTurning(replace(camera, stabilised=False), still.K, R_still_camera)
    view = picture_view(replace(seen_by(motion, still), turning=turning))
    pose = ProjectedMotion(motion, view).pose(Moment(20, 20, 0.0))
    R = R_still_camera[20].T @ still.R_camera_world
    turned = replace(camera, R_camera_world=R, t_camera_world=-R @ still.center_world)
    truth = turned.project(motion.poses.p_world_joint[20])
    np.testing.assert_allclose(pose.uv_px[:21], truth, atol=1e-6)
    assert np.abs(truth - still.project(motion.poses.p_world_joint[20])).max() > 20


@pytest.mark.parametrize("way", [0.0, 8.0])
def test_a_virtual_camera_sees_all_of_the_motion_from_the_front(
    motion: Motion, skeleton: SkeletonModel, way: float
) -> None:
    poses = motion.poses
    walked = np.linspace(0, way, len(poses))[:, None, None] * np.array([0.6, 0.8, 0.0])
    poses = replace(poses, p_world_joint=poses.p_world_joint + walked)
    view = virtual_view(replace(motion, poses=poses))
    frames = np.arange(len(poses))
    uv = view.project(poses.p_world_joint, frames)
    camera = view.camera
    assert np.isfinite(uv).all()
    assert (uv > 0).all()
    assert (uv < [camera.width_px, camera.height_px]).all()
    assert np.ptp(uv[..., 1], axis=1).max() > 0.3 * camera.height_px
    left, right = skeleton.index("LeftArm", "RightArm")
    assert (uv[:, left, 0] > uv[:, right, 0]).mean() > 0.9  # seen from the front
    assert view.in_video(frames).shape == (len(frames), 0, 2)
