"""Bones as image and sensors show them: exchanged sensors and shifted clocks are told apart."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import planted
import pytest

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.calibration.bone_images import best_exchange, bone_images, check_clocks, exchanged_sides, scan_clocks
from rtof_kin.core.checks import Verdict
from rtof_kin.data.imu import BoneImuSequence

BODY = SkeletonModel.default()
LEGS = ("LeftUpLeg", "RightUpLeg", "LeftLeg", "RightLeg")


@cache
def waved() -> Motion:
    """Somebody who moves everything, differently on either side."""
    return planted.moving(BODY, 360)


@cache
def sensed() -> BoneImuSequence:
    return planted.bone_imus(BODY, waved().poses, degrees=2.0)


def exchange(bone_imus: BoneImuSequence) -> float:
    """`best_exchange` of the segments."""
    joints = bone_imus.joints
    turns = (replace(bone_imus, joints=joints[k:] + joints[:k]) for k in range(len(joints)))
    return best_exchange(planted.keypoints(waved().poses, 3.0), turns, waved().poses, BODY)


def test_image_and_sensors_agree_where_nothing_is_wrong() -> None:
    seen = planted.keypoints(waved().poses, 3.0)
    images = bone_images(seen, sensed(), waved().poses, BODY)
    assert np.nanmax(images.by_sensor()) < 0.5
    assert check_clocks(seen, sensed(), waved().poses, BODY).verdict is Verdict.PASSED
    assert exchange(sensed()) == 0.0


def test_an_exchange_of_two_sensors_is_what_explains_the_image_better() -> None:
    joints = list(sensed().joints)
    a, b = joints.index("RightForeArm"), joints.index("LeftLeg")
    joints[a], joints[b] = joints[b], joints[a]
    wrong = replace(sensed(), joints=tuple(joints))
    assert exchange(wrong) > 2.0
    images = bone_images(planted.keypoints(waved().poses), wrong, waved().poses, BODY)
    assert set(np.argsort(-images.by_sensor())[:2].tolist()) == {a, b}


@pytest.mark.parametrize("seconds", [-1.5, 0.0, 0.74, 2.0])
def test_a_shift_of_the_clocks_is_measured(seconds: float) -> None:
    late = replace(sensed(), times=sensed().times + seconds)
    images = bone_images(planted.keypoints(waved().poses, 3.0), late, waved().poses, BODY)
    assert images is not None
    scan = scan_clocks(images)
    assert scan.best == pytest.approx(-seconds, abs=0.03)
    assert scan.rival[1] < scan.gain - 10


def test_exchanged_sides_of_a_walk_are_no_late_clock() -> None:
    walk, _ = planted.walking(BODY, 6.0)
    seen = planted.keypoints(walk.poses, 3.0)
    sensors = planted.bone_imus(BODY, walk.poses, LEGS)
    assert not check_clocks(seen, sensors, walk.poses, BODY).failed
    assert not check_clocks(seen, exchanged_sides(sensors), walk.poses, BODY).failed


def test_sensors_on_no_bone_that_is_seen_tell_nothing() -> None:
    seen = replace(planted.keypoints(waved().poses).select(["Hips", "Head"]), names=("Hips", "Head"))
    assert bone_images(seen, sensed(), waved().poses, BODY) is None
    found = check_clocks(seen, sensed(), waved().poses, BODY)
    assert found.verdict is Verdict.NOT_POSSIBLE
