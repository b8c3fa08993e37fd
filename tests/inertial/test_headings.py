"""Planted headings of sensors' references are estimated from movement."""

from __future__ import annotations

import numpy as np
import pytest
from inertial_support import free

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.inertial.likelihood import (
    MotionLikelihood,
    SegmentMotion,
    own_headings,
    segment_motions,
    shared_heading,
    wrapped,
)
from rtof_kin.inertial.pose_calibration import pose_rotations

SENSORS = ("L_UpLeg", "L_LowLeg", "Pelvis")


@pytest.fixture(scope="module")
def truth() -> tuple[list[SegmentMotion], np.ndarray]:
    """Right motions, and the orientations of their segments in an N-pose."""
    worn = free(SENSORS, seed=2)
    R_pose = pose_rotations("N", worn.skeleton)[worn.skeleton.index(*worn.truth.joints)]
    return list(segment_motions(worn.truth.apply(worn.imus))), R_pose


def misread(motions: list[SegmentMotion], R_pose: np.ndarray, angles: np.ndarray) -> list[SegmentMotion]:
    """The motions with wrong headings but a correct pose."""
    out = []
    for motion, R, angle in zip(motions, R_pose, angles, strict=True):
        turn = so3.about_axis("z", -angle)
        moved = motion.moved(motion.joint, R.T @ turn.T @ R, motion.p_bone_sensor)
        out.append(moved.turned(turn))
    return out


@pytest.mark.parametrize("angle", [0.0, 1.7, -2.9])
def test_one_heading_for_all_is_found(
    angle: float, truth: tuple[list[SegmentMotion], np.ndarray], skeleton: SkeletonModel
) -> None:
    motions = misread(*truth, np.full(3, angle))
    found = shared_heading(MotionLikelihood(skeleton), motions, truth[1])
    assert np.degrees(np.abs(wrapped(found.angles - angle))).max() < 10
    assert len(set(found.angles.tolist())) == 1
    assert found.margin > 10


def test_a_heading_for_each_is_found(truth: tuple[list[SegmentMotion], np.ndarray], skeleton: SkeletonModel) -> None:
    angles = np.array([2.0, -1.0, 0.4])
    found = own_headings(MotionLikelihood(skeleton), misread(*truth, angles), truth[1])
    off = np.degrees(np.abs(wrapped(found.angles - angles)))
    assert off[:2].max() < 12
    assert off[2] < 30  # the pelvis: no hinge of its own
    assert np.all(found.sigmas > 0)


def test_angles_are_wrapped_to_half_a_turn() -> None:
    expected = [3.5 - 2 * np.pi, np.pi, np.pi, 7 - 2 * np.pi]
    np.testing.assert_allclose(wrapped([3.5, -np.pi, np.pi, 7.0]), expected)
