"""Markers, tree of joints, pieces and unobserved parts of a motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtof_kin.body.skeleton import Motion
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.formats.motion_views import even_times, joint_tree, landmark_markers, pieces
from rtof_kin.formats.world_axes import UP


def with_gap(motion: Motion) -> Motion:
    """The same without a configuration in frames 20 to 22, and bridged in 40 to 44."""
    q, valid = np.array(motion.q), np.array(motion.poses.valid)
    q[20:23] = np.nan
    valid[40:45] = False
    return replace(motion, q=q, poses=replace(motion.poses, valid=valid))


def test_pieces_end_at_unknown_and_bridged_frames(motion: Motion) -> None:
    assert pieces(motion) == [(0, 60)]
    assert pieces(with_gap(motion)) == [(0, 20), (23, 40), (45, 60)]
    valid = np.array(motion.poses.valid)
    valid[:, 3] = False  # one joint is no gap of the motion
    assert pieces(replace(motion, poses=replace(motion.poses, valid=valid))) == [(0, 60)]


def test_jitter_of_stamps_is_evened_and_more_is_refused() -> None:
    times = np.arange(100) / 50
    jitter = np.random.default_rng(1).uniform(-0.00015, 0.00015, 100)
    np.testing.assert_allclose(even_times(times + jitter), times, atol=0.0002)
    times[60:] += 0.02
    with pytest.raises(InvalidInputError, match="beside even times.*resample"):
        even_times(times)


def test_markers_are_the_landmarks_where_their_joint_is_valid(motion: Motion) -> None:
    valid = np.array(motion.poses.valid)
    foot = motion.poses.names.index("RightFoot")
    valid[3:5, foot] = False
    poses = replace(motion.poses, valid=valid)
    markers = landmark_markers(replace(motion, poses=poses))
    (p_world,) = markers.blocks()
    assert markers.names == tuple(motion.skeleton.landmarks)
    np.testing.assert_array_equal(p_world[0, :21], poses.p_world_joint[0])
    gone = {n for n, p in zip(markers.names, p_world[3], strict=True) if np.isnan(p).all()}
    assert gone == {"RightFoot", "RightHeel", "RightToeBase", "RightToe"}
    toe = p_world[9, markers.names.index("RightToe")]
    arm = poses.R_world_bone[9, foot] @ motion.skeleton.landmarks["RightToe"][1]
    np.testing.assert_allclose(toe, poses.p_world_joint[9, foot] + arm, atol=1e-12)


def test_tree_reproduces_the_motion(motion: Motion) -> None:
    (tree,) = joint_tree(motion)
    p, R = tree.forward_kinematics()
    np.testing.assert_allclose(p * 0.01 @ UP["y"].T, motion.poses.p_world_joint, atol=1e-12)
    np.testing.assert_allclose(UP["y"] @ R @ UP["y"].T, motion.poses.R_world_bone, atol=1e-12)
    assert (tree.unit_m, tree.rate_hz) == (0.01, pytest.approx(60))
    ends = [tree.names[e] for e in tree.end_parents]
    assert ends == ["Head", "RightHand", "LeftHand", "RightFoot", "LeftFoot"]
    np.testing.assert_allclose(UP["y"] @ tree.end_offsets[0] * 0.01, [0, 0, 0.15], atol=1e-12)
    assert next(joint_tree(motion[:1])).rate_hz == 60
