"""What is drawn of a motion: solids where the bones are, colours that never claim more than was observed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_support import SIGMA, walking, with_provenance

from rtof_kin.core import rotations as so3
from rtof_kin.data.poses import COLOURS, PoseSequence, Provenance
from rtof_kin.view.block_content import LARGEST_SEMI_AXIS, block_content, ellipsoids, segment_provenance, segment_solids
from rtof_kin.view.layers import barrel

FRAMES = 8


def test_solids_reach_from_joint_to_joint() -> None:
    motion = walking(FRAMES)
    skeleton, poses = motion.skeleton, motion.poses
    solids = segment_solids(skeleton)
    content = block_content(poses, skeleton)
    R = so3.from_quat_wxyz(content.solids_wxyz)
    for child, parent in enumerate(skeleton.parents):
        joint = skeleton.table.joints[parent]
        if parent < 0 or not np.allclose(joint.end, skeleton.joint_offsets[child], atol=1e-6):
            continue
        ends = poses.p_world_joint[:, [parent, child]]
        np.testing.assert_allclose(content.centers[:, parent], ends.mean(axis=1), atol=1e-5)
        along = so3.unit(ends[:, 1] - ends[:, 0])
        np.testing.assert_allclose(R[:, parent, :, 2], along, atol=1e-5)
        length = np.linalg.norm(ends[0, 1] - ends[0, 0])
        assert length <= 2 * solids.sizes[parent, 2] <= 1.2 * length
        assert solids.sizes[parent, 0] == pytest.approx(joint.radius, rel=0.3)


@pytest.mark.parametrize(("power", "volume"), [(2.0, 4.19), (3.0, 5.2)])
def test_meshes_are_closed_and_face_outwards(power: float, volume: float) -> None:
    mesh = barrel(power)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(volume, rel=0.08)
    assert np.abs(mesh.vertices).max() == pytest.approx(1.0)


def test_segment_has_the_colour_of_its_weaker_end() -> None:
    kinds = [Provenance.CAMERA, Provenance.IMU, Provenance.BRIDGED, Provenance.PRIOR, Provenance.NOBODY]
    motion = with_provenance(walking(FRAMES), "LeftForeArm", kinds)
    skeleton = motion.skeleton
    upper, lower = skeleton.index("LeftArm", "LeftForeArm")
    observed = np.array(motion.poses.orientation_observed)
    observed[:, [upper, lower]] = False
    poses = replace(motion.poses, orientation_observed=observed)
    found = segment_provenance(poses, skeleton)
    assert found[:5, upper].tolist() == found[:5, lower].tolist() == kinds
    assert (found[5:, [upper, lower]] == Provenance.CAMERA_AND_IMU).all()


def test_hand_without_a_point_beyond_the_wrist_is_grey_however_well_the_wrist_is_seen() -> None:
    motion = walking(FRAMES)
    hand = motion.skeleton.index("LeftHand")[0]
    flags = np.array(motion.poses.orientation_observed)
    flags[:, hand] = False
    poses = replace(motion.poses, orientation_observed=flags, direction_observed=flags)
    content = block_content(poses, motion.skeleton)
    assert tuple(content.colours[0, hand]) == COLOURS[Provenance.PRIOR]
    forearm = motion.skeleton.index("LeftForeArm")[0]
    assert tuple(content.colours[0, forearm]) == COLOURS[Provenance.CAMERA_AND_IMU]
    assert content.axes[0, hand] < content.axes[0, forearm]


def test_missing_and_doubtful_poses_are_hidden_and_faint() -> None:
    motion = walking(FRAMES)
    p, valid = np.array(motion.poses.p_world_joint), np.array(motion.poses.valid)
    p[3], valid[4] = np.nan, False
    poses = replace(motion.poses, p_world_joint=p, valid=valid)
    content = block_content(poses, motion.skeleton)
    assert not content.shown[3].any()
    assert content.shown[[2, 4]].all()
    assert (content.opacities[4] < 0.5).all()
    assert (content.opacities[2] == 1).all()
    for field in (content.centers, content.solids_wxyz, content.p_joint, content.joints_wxyz):
        assert np.isfinite(field).all()


def test_ellipsoids_are_the_95_percent_regions() -> None:
    motion = walking(FRAMES)
    assert motion.confidence is not None
    content = block_content(motion.poses, motion.skeleton, 0, motion.confidence)
    found = content.in_world
    assert found is not None
    assert content.to_root is not None
    np.testing.assert_allclose(np.sort(found.sizes[0, 3]), 2.7955 * np.array(SIGMA), rtol=1e-4)
    R = so3.from_quat_wxyz(found.quat_wxyz[0, 3])
    back = R @ np.diag((found.sizes[0, 3] / 2.7955) ** 2) @ R.T
    np.testing.assert_allclose(back, np.diag(np.square(SIGMA)), atol=1e-7)
    errors = np.random.default_rng(0).multivariate_normal(np.zeros(3), back, 20000)
    inside = np.sum((errors @ R / found.sizes[0, 3]) ** 2, axis=1) < 1
    assert inside.mean() == pytest.approx(0.95, abs=0.005)
    assert not content.to_root.sizes[:, 0].any()
    assert content.to_root.sizes[:, 1:].all()


def test_unknown_positions_have_no_ellipsoid_and_are_counted() -> None:
    covariance = np.tile(np.eye(3) * 1e-4, (2, 3, 1, 1))
    covariance[0, 1], covariance[1, 2] = np.eye(3) * LARGEST_SEMI_AXIS**2, np.nan
    found = ellipsoids(covariance, np.full((2, 3), True))
    assert found.sizes.any(axis=-1).tolist() == [[True, False, True], [True, True, False]]
    assert found.left_out.tolist() == [1, 0]


def test_poses_of_other_joints_are_drawn_as_far_as_they_go() -> None:
    motion = walking(FRAMES)
    names = motion.skeleton.names
    kept = [i for i, name in enumerate(names) if name != "Head"][::-1]
    R = np.full((FRAMES, len(kept), 3, 3), np.nan)
    poses = PoseSequence(motion.times, motion.poses.p_world_joint[:, kept], R, tuple(names[i] for i in kept))
    full = PoseSequence(
        motion.times, motion.poses.p_world_joint, np.full_like(motion.poses.R_world_bone, np.nan), names
    )
    content = block_content(poses, motion.skeleton)
    assert not content.shown[:, names.index("Head")].any()
    whole = block_content(full, motion.skeleton)
    assert whole.shown.all()
    exact = block_content(motion.poses, motion.skeleton)
    np.testing.assert_allclose(whole.centers, exact.centers, atol=0.02)
