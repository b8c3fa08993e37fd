"""Properties of the likelihood that hold for any prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from inertial_support import Worn, free, walking

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError, InvalidInputError
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

SENSORS = ("L_UpLeg", "L_LowLeg", "Pelvis", "L_LowArm")


@pytest.fixture(scope="module")
def worn() -> Worn:
    return free(SENSORS)


@pytest.fixture(scope="module")
def motions(worn: Worn) -> dict[str, SegmentMotion]:
    return {r.joint: r for r in segment_motions(worn.truth.apply(worn.imus))}


@pytest.fixture(scope="module")
def likelihood(skeleton: SkeletonModel) -> MotionLikelihood:
    return MotionLikelihood(skeleton)


def test_the_tree_joins_near_segments(likelihood: MotionLikelihood) -> None:
    pairs = likelihood.tree(["LeftLeg", "Hips", "LeftUpLeg", "LeftForeArm", "RightForeArm"])
    assert {("Hips", "LeftUpLeg"), ("LeftUpLeg", "LeftLeg")} <= set(pairs)
    assert len(pairs) == 4


def test_heading_of_the_world_is_irrelevant(likelihood: MotionLikelihood, motions: dict[str, SegmentMotion]) -> None:
    a, b = motions["LeftUpLeg"], motions["LeftLeg"]
    R = so3.about_axis("z", 1.3)
    assert likelihood.pair(a.turned(R), b.turned(R)) == pytest.approx(likelihood.pair(a, b))
    assert likelihood.single(a.turned(R)) == pytest.approx(likelihood.single(a))


@pytest.mark.parametrize("axis", ["x", "y", "z"])
@pytest.mark.parametrize("angle", [90, 180])
def test_turned_sensors_are_less_likely(
    axis: str, angle: int, likelihood: MotionLikelihood, motions: dict[str, SegmentMotion]
) -> None:
    a, b = motions["LeftUpLeg"], motions["LeftLeg"]
    turn = so3.about_axis(axis, np.radians(angle))
    wrong = b.moved("LeftLeg", turn, b.p_bone_sensor)
    assert likelihood.pair(a, b) > likelihood.pair(a, wrong) + 10


def test_a_static_posture_has_little_weight(likelihood: MotionLikelihood, motions: dict[str, SegmentMotion]) -> None:
    zero = np.zeros((600, 3))
    still = [
        SegmentMotion(m.joint, np.tile(m.R_world_bone[:1], (600, 1, 1)), zero, zero, m.p_bone_sensor)
        for m in (motions["LeftUpLeg"], motions["LeftLeg"])
    ]
    assert likelihood.pair(still[0], still[1]) == pytest.approx(0.0, abs=0.5)


def test_accelerations_distinguish_the_shanks(skeleton: SkeletonModel) -> None:
    walk = walking(sensors=("L_UpLeg", "L_LowLeg", "R_LowLeg"))
    thigh, left, right = segment_motions(walk.truth.apply(walk.imus))
    likelihood = MotionLikelihood(walk.skeleton)
    swapped = replace(right, joint="LeftLeg")
    assert likelihood.pair(thigh, left) > likelihood.pair(thigh, swapped) + 20


def test_a_camera_determines_the_heading_of_the_world(worn: Worn, motions: dict[str, SegmentMotion]) -> None:
    times = even_times(worn.truth.apply(worn.imus))
    seen = seen_bones(worn.poses, worn.skeleton, times)
    assert "LeftHand" not in seen
    np.testing.assert_allclose(np.linalg.norm(seen["Hips"], axis=-1), 1.0)
    watching, thigh = MotionLikelihood(worn.skeleton, seen=seen), motions["Hips"]
    turned = thigh.turned(so3.about_axis("z", np.pi / 2))
    assert watching.single(thigh) > watching.single(turned) + 1


def test_a_prior_and_a_second_of_data_are_required(worn: Worn) -> None:
    with pytest.raises(CalibrationError, match="there is no pose prior of it"):
        MotionLikelihood(SkeletonModel.human36m())
    with pytest.raises(InvalidInputError, match="0.32 s of sensor data are too short"):
        even_times(worn.truth.apply(worn.imus)[:20])


HEADED = ("L_UpLeg", "L_LowLeg", "Pelvis")


@pytest.fixture(scope="module")
def truth() -> tuple[list[SegmentMotion], np.ndarray]:
    """Right motions, and the orientations of their segments in an N-pose."""
    worn = free(HEADED, seed=2)
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
