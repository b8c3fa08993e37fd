"""What movement says of sensors: properties that must hold whatever the prior is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from inertial_support import Worn, free, walking

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError, ShapeError
from rtof_kin.inertial.likelihood import MotionLikelihood
from rtof_kin.inertial.segment_motion import SegmentMotion, even_times, seen_bones, segment_motions

SENSORS = ("L_UpLeg", "L_LowLeg", "Pelvis", "L_LowArm")


@pytest.fixture(scope="module")
def worn() -> Worn:
    return free(SENSORS)


@pytest.fixture(scope="module")
def motions(worn: Worn) -> dict[str, SegmentMotion]:
    return {r.joint: r for r in segment_motions(worn.truth.apply(worn.imus))}


@pytest.fixture(scope="module")
def evidence(skeleton: SkeletonModel) -> MotionLikelihood:
    return MotionLikelihood(skeleton)


def test_motions_are_those_of_the_segments_at_the_rate_of_the_evidence(worn: Worn) -> None:
    times = even_times(worn.truth.apply(worn.imus))
    first = segment_motions(worn.truth.apply(worn.imus))[0]
    assert first.joint == "LeftUpLeg"
    assert len(first.w_world) == len(times) == len(worn.poses)
    true = worn.poses.R_world_bone[:, worn.skeleton.index("LeftUpLeg")[0]]
    np.testing.assert_allclose(first.R_world_bone, true, atol=1e-6)


def test_the_tree_joins_each_segment_with_what_is_nearest(evidence: MotionLikelihood) -> None:
    pairs = evidence.tree(["LeftLeg", "Hips", "LeftUpLeg", "LeftForeArm", "RightForeArm"])
    assert {("Hips", "LeftUpLeg"), ("LeftUpLeg", "LeftLeg")} <= set(pairs)
    assert len(pairs) == 4


def test_pairs_say_the_same_whichever_way_the_world_is_turned(
    evidence: MotionLikelihood, motions: dict[str, SegmentMotion]
) -> None:
    a, b = motions["LeftUpLeg"], motions["LeftLeg"]
    R = so3.about_axis("z", 1.3)
    assert evidence.pair(a.turned(R), b.turned(R)) == pytest.approx(evidence.pair(a, b))
    assert evidence.single(a.turned(R)) == pytest.approx(evidence.single(a))


@pytest.mark.parametrize("axis", ["x", "y", "z"])
@pytest.mark.parametrize("angle", [90, 180])
def test_the_truth_is_likelier_than_a_sensor_turned(
    axis: str, angle: int, evidence: MotionLikelihood, motions: dict[str, SegmentMotion]
) -> None:
    a, b = motions["LeftUpLeg"], motions["LeftLeg"]
    turn = so3.about_axis(axis, np.radians(angle))
    wrong = b.moved("LeftLeg", turn, b.p_bone_sensor)
    assert evidence.pair(a, b) > evidence.pair(a, wrong) + 10


def test_a_held_posture_weighs_little_however_long_it_is_held(
    evidence: MotionLikelihood, motions: dict[str, SegmentMotion]
) -> None:
    zero = np.zeros((600, 3))
    still = [
        SegmentMotion(m.joint, np.tile(m.R_world_bone[:1], (600, 1, 1)), zero, zero, m.p_bone_sensor)
        for m in (motions["LeftUpLeg"], motions["LeftLeg"])
    ]
    assert evidence.pair(still[0], still[1]) == pytest.approx(0.0, abs=0.5)


def test_accelerations_tell_a_shank_from_the_other_side(skeleton: SkeletonModel) -> None:
    walk = walking(sensors=("L_UpLeg", "L_LowLeg", "R_LowLeg"))
    thigh, left, right = segment_motions(walk.truth.apply(walk.imus))
    evidence = MotionLikelihood(walk.skeleton)
    swapped = replace(right, joint="LeftLeg")
    assert evidence.pair(thigh, left) > evidence.pair(thigh, swapped) + 20


def test_missing_data_are_passed_over(evidence: MotionLikelihood, motions: dict[str, SegmentMotion]) -> None:
    a, b = motions["LeftUpLeg"], motions["LeftLeg"]
    R, w, acceleration = b.R_world_bone.copy(), b.w_world.copy(), b.a_world.copy()
    R[100:140], w[100:140], acceleration[:] = np.nan, np.nan, np.nan
    holed = SegmentMotion(b.joint, R, w, acceleration, b.p_bone_sensor)
    assert np.isfinite(evidence.pair(a, holed))
    assert np.isfinite(evidence.single(holed))


def test_what_a_camera_saw_fits_the_truth_better_than_a_turned_world(
    worn: Worn, motions: dict[str, SegmentMotion]
) -> None:
    times = even_times(worn.truth.apply(worn.imus))
    seen = seen_bones(worn.poses, worn.skeleton, times)
    assert "LeftHand" not in seen
    np.testing.assert_allclose(np.linalg.norm(seen["Hips"], axis=-1), 1.0)
    watching, thigh = MotionLikelihood(worn.skeleton, seen=seen), motions["Hips"]
    turned = thigh.turned(so3.about_axis("z", np.pi / 2))
    assert watching.single(thigh) > watching.single(turned) + 1


def test_without_a_prior_nothing_is_judged_and_a_moment_is_too_short(worn: Worn) -> None:
    with pytest.raises(CalibrationError, match="there is no pose prior of it"):
        MotionLikelihood(SkeletonModel.human36m())
    with pytest.raises(ShapeError, match="0.32 s of sensor data are too short"):
        even_times(worn.truth.apply(worn.imus)[:20])
