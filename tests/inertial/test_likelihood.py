"""Properties of the likelihood that hold for any prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from inertial_support import Worn, free, walking

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import CalibrationError, InvalidInputError
from rtof_kin.inertial.likelihood import MotionLikelihood, SegmentMotion, even_times, seen_bones, segment_motions

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
