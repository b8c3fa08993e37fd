"""The face of the tracked person cannot be recognised, and where its place is unknown nothing can."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from overlay_support import motion_with, picture_view, upright_camera

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import Provenance
from rtof_kin.view.canvas import Box
from rtof_kin.view.painter import FaceFinder, FaceRegion, pixelate
from rtof_kin.view.projected_motion import Moment, ProjectedMotion

CAMERA = upright_camera(640, 480)
HEAD = ("Head", "HeadTop", "Nose", "LeftEar", "RightEar")
NOW = Moment(3, 3, 0.0)


def finder_of(motion: Motion, uv: np.ndarray | None = None) -> FaceFinder:
    found = CAMERA.project(motion.poses.p_world_joint) if uv is None else uv
    seen = KeypointSequence(CAMERA, motion.times, found, np.ones(found.shape[:2]), motion.poses.names)
    return FaceFinder(ProjectedMotion(motion, picture_view(seen)))


@pytest.mark.parametrize("sigma", [None, 0.01, 0.05])
def test_region_contains_the_head_however_it_is_turned(skeleton: SkeletonModel, sigma: float | None) -> None:
    motion = motion_with(skeleton, 8, sigma=sigma)
    poses = motion.poses
    box = finder_of(motion).region(NOW).box
    assert box is not None
    (j,) = skeleton.index("Head")
    rng = np.random.default_rng(0)
    for turn in np.linalg.qr(rng.normal(size=(50, 3, 3)))[0]:
        turn = turn * np.sign(np.linalg.det(turn))
        for name in HEAD:  # chin and neck lie nearer to the joint than these
            p = poses.p_world_joint[3, j] + turn @ skeleton.landmarks[name][1]
            u, v = CAMERA.project(p)
            assert box.left <= u <= box.right
            assert box.top <= v <= box.bottom
    assert box.height < 480 * 0.7  # not the whole picture


def test_region_grows_with_the_uncertainty(skeleton: SkeletonModel) -> None:
    regions = [finder_of(motion_with(skeleton, 8, sigma=sigma)).region(NOW).box for sigma in (0.005, 0.05)]
    assert regions[0] is not None
    assert regions[1] is not None
    pixels_per_metre = CAMERA.K[0, 0] / 4.2
    assert regions[1].width - regions[0].width == pytest.approx(6 * 0.045 * pixels_per_metre, rel=0.15)


@pytest.mark.parametrize("how", [Provenance.BRIDGED, Provenance.PRIOR])
def test_all_is_pixelated_where_the_head_is_not_observed(skeleton: SkeletonModel, how: Provenance) -> None:
    assert finder_of(motion_with(skeleton, 8, {"Head": how})).region(NOW).box is None


def test_all_is_pixelated_outside_the_motion_and_where_the_head_is_uncertain(skeleton: SkeletonModel) -> None:
    assert finder_of(motion_with(skeleton, 8)).region(None).box is None
    assert finder_of(motion_with(skeleton, 8, sigma=0.3)).region(NOW).box is None


def test_a_frame_beside_one_without_a_head_is_pixelated_too(skeleton: SkeletonModel) -> None:
    motion = motion_with(skeleton, 8)
    provenance = motion.poses.provenance.copy()
    provenance[4, skeleton.index("Head")[0]] = Provenance.BRIDGED
    finder = finder_of(replace(motion, poses=replace(motion.poses, provenance=provenance)))
    assert finder.region(Moment(3, 3, 0.0)).box is None
    assert finder.region(Moment(1, 1, 0.0)).box is not None


def test_a_detected_head_elsewhere_widens_the_region_or_pixelates_all(skeleton: SkeletonModel) -> None:
    motion = motion_with(skeleton, 8, sigma=0.01)
    (j,) = skeleton.index("Head")
    uv = CAMERA.project(motion.poses.p_world_joint)
    before = finder_of(motion, uv).region(NOW).box
    near, far = uv.copy(), uv.copy()
    near[:, j, 0] += 40
    far[:, j, 0] += 200
    after = finder_of(motion, near).region(NOW).box
    assert before is not None
    assert after is not None
    assert after.right > before.right + 15
    assert finder_of(motion, far).region(NOW).box is None


def test_a_fast_head_is_covered_from_frame_to_frame(skeleton: SkeletonModel) -> None:
    motion = motion_with(skeleton, 8)
    moving = motion.poses.p_world_joint + 0.08 * np.arange(8)[:, None, None] * np.array([0.0, 1.0, 0.0])
    motion = replace(motion, poses=replace(motion.poses, p_world_joint=moving))
    box = finder_of(motion).region(Moment(3, 4, 0.5)).box
    assert box is not None
    (j,) = skeleton.index("Head")
    for frame in (2, 3, 4, 5):
        u, v = CAMERA.project(moving[frame, j])
        assert box.left < u < box.right
        assert box.top < v < box.bottom


def test_a_face_has_about_two_blocks_across_and_nothing_finer_is_left(skeleton: SkeletonModel) -> None:
    region = finder_of(motion_with(skeleton, 8, sigma=0.005)).region(NOW)
    assert region.box is not None
    face_px = 0.15 * CAMERA.K[0, 0] / 4.2  # a face is 0.15 m wide
    assert face_px / region.block < 2.5
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (480, 640, 3), dtype=np.uint8)
    box, before = region.box, image.copy()
    pixelate(image, region)
    outside = np.ones((480, 640), dtype=bool)
    outside[max(box.top, 0) : box.bottom, max(box.left, 0) : box.right] = False
    np.testing.assert_array_equal(image[outside], before[outside])
    inside = image[max(box.top, 0) : box.bottom, max(box.left, 0) : box.right]
    blocks = max(inside.shape[0] // region.block, 1) * max(inside.shape[1] // region.block, 1)
    assert len(np.unique(inside.reshape(-1, 3), axis=0)) <= blocks <= 36


def test_two_pictures_that_differ_only_within_blocks_become_the_same() -> None:
    rng = np.random.default_rng(2)
    image = rng.integers(0, 256, (90, 120, 3), dtype=np.uint8)
    mixed = image.copy()
    for top in range(0, 90, 30):
        for left in range(0, 120, 30):
            part = mixed[top : top + 30, left : left + 30].reshape(-1, 3)
            mixed[top : top + 30, left : left + 30] = rng.permutation(part).reshape(30, 30, 3)
    assert (image != mixed).any()
    for picture in (image, mixed):
        pixelate(picture, FaceRegion(None, 30))
    np.testing.assert_array_equal(image, mixed)


@pytest.mark.parametrize("box", [Box(-50, -60, 100, 100), Box(600, 440, 90, 90), Box(700, 10, 50, 50)])
def test_blocks_at_the_border_are_not_smaller(box: Box) -> None:
    rng = np.random.default_rng(4)
    image = rng.integers(0, 256, (480, 640, 3), dtype=np.uint8)
    before = image.copy()
    pixelate(image, FaceRegion(box, 33))
    changed = np.argwhere((image != before).any(axis=2))
    if box.left > 640:
        assert len(changed) == 0
        return
    assert len(np.unique(image[tuple(changed.T)], axis=0)) <= 4
