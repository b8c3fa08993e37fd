"""Markers, tree of joints, pieces and unobserved parts of a motion."""

from __future__ import annotations

import numpy as np
import pytest

from rtof_kin.body.skeleton import Motion
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.formats.motion_views import even_times, joint_tree
from rtof_kin.formats.world_axes import UP


def test_jitter_of_stamps_is_evened_and_more_is_refused() -> None:
    times = np.arange(100) / 50
    jitter = np.random.default_rng(1).uniform(-0.00015, 0.00015, 100)
    np.testing.assert_allclose(even_times(times + jitter), times, atol=0.0002)
    times[60:] += 0.02
    with pytest.raises(InvalidInputError, match="beside even times.*resample"):
        even_times(times)


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
