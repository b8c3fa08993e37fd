"""Properties of the likelihood that hold for any prior, and headings from movement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from inertial_support import free, walking

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.inertial.likelihood import (
    MotionLikelihood,
    SegmentMotion,
    even_times,
    own_headings,
    seen_bones,
    segment_motions,
    shared_heading,
    wrapped,
)
from rtof_kin.inertial.pose_calibration import pose_rotations

WORN = free(("L_UpLeg", "L_LowLeg", "Pelvis"), seed=2)
IMUS = WORN.truth.apply(WORN.imus)
MOTIONS = list(segment_motions(IMUS))
THIGH, SHANK, PELVIS = MOTIONS
R_POSE = pose_rotations("N", WORN.skeleton)[WORN.skeleton.index(*WORN.truth.joints)]
LIKELIHOOD = MotionLikelihood(SkeletonModel.default())


def test_the_heading_of_the_world_is_irrelevant_without_a_camera() -> None:
    R = so3.about_axis("z", 1.3)
    assert LIKELIHOOD.pair(THIGH.turned(R), SHANK.turned(R)) == pytest.approx(LIKELIHOOD.pair(THIGH, SHANK))
    assert LIKELIHOOD.single(THIGH.turned(R)) == pytest.approx(LIKELIHOOD.single(THIGH))
    seen = seen_bones(WORN.poses, WORN.skeleton, even_times(IMUS))
    np.testing.assert_allclose(np.linalg.norm(seen["Hips"], axis=-1), 1.0)
    watching = MotionLikelihood(WORN.skeleton, seen=seen)
    assert watching.single(PELVIS) > watching.single(PELVIS.turned(so3.about_axis("z", np.pi / 2))) + 1


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_turned_sensors_are_less_likely(axis: str) -> None:
    wrong = SHANK.moved("LeftLeg", so3.about_axis(axis, np.pi / 2), SHANK.p_bone_sensor)
    assert LIKELIHOOD.pair(THIGH, SHANK) > LIKELIHOOD.pair(THIGH, wrong) + 10


def test_a_static_posture_has_little_weight() -> None:
    zero = np.zeros((600, 3))
    still = [
        replace(m, R_world_bone=np.tile(m.R_world_bone[:1], (600, 1, 1)), w_world=zero, a_world=zero) for m in MOTIONS
    ]
    assert LIKELIHOOD.pair(*still[:2]) == pytest.approx(0.0, abs=0.5)


def test_accelerations_distinguish_the_shanks() -> None:
    walk = walking(sensors=("L_UpLeg", "L_LowLeg", "R_LowLeg"))
    thigh, left, right = segment_motions(walk.truth.apply(walk.imus))
    likelihood = MotionLikelihood(walk.skeleton)
    assert likelihood.pair(thigh, left) > likelihood.pair(thigh, replace(right, joint="LeftLeg")) + 20


def misread(angles: np.ndarray) -> list[SegmentMotion]:
    """The motions with wrong headings but a correct pose."""
    turns = so3.about_axis("z", -angles)
    parts = zip(MOTIONS, R_POSE, turns, strict=True)
    return [m.moved(m.joint, R.T @ turn.T @ R, m.p_bone_sensor).turned(turn) for m, R, turn in parts]


@pytest.mark.parametrize("angle", [0.0, 1.7, -2.9])
def test_one_heading_for_all_is_found(angle: float) -> None:
    found = shared_heading(LIKELIHOOD, misread(np.full(3, angle)), R_POSE)
    assert np.degrees(np.abs(wrapped(found.angles - angle))).max() < 10
    assert found.margin > 10


def test_a_heading_for_each_is_found() -> None:
    angles = np.array([2.0, -1.0, 0.4])
    found = own_headings(LIKELIHOOD, misread(angles), R_POSE)
    off = np.degrees(np.abs(wrapped(found.angles - angles)))
    assert off[:2].max() < 12
    assert off[2] < 45  # the pelvis: no hinge of its own
