"""Standing feet, against walks whose feet are planted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.root_path import Contacts, ContactSettings, Footholds, detect_contacts, footholds

BODY = SkeletonModel.default()
WALK, STANDS = planted.walking(BODY, 4.0)
SHANKS, WITH_FEET = ("LeftLeg", "RightLeg"), ("LeftLeg", "RightLeg", "LeftFoot", "RightFoot")


def lifted(poses: PoseSequence, p_root: NDArray[np.float64]) -> PoseSequence:
    return replace(poses, p_world_joint=poses.p_world_joint + p_root[:, None])


@pytest.mark.parametrize("joints", [SHANKS, WITH_FEET])
@pytest.mark.parametrize("noise", [0.0, 0.7])
def test_only_planted_feet_are_found(joints: tuple[str, ...], noise: float) -> None:
    imus = planted.bone_imus(BODY, WALK.poses, joints, acceleration=noise)
    contacts = detect_contacts(WALK.poses, imus, BODY)
    assert contacts.joints == ("LeftFoot", "RightFoot")
    wrong = contacts.standing & ~STANDS
    assert wrong.mean() < 0.03
    assert (contacts.standing & STANDS).sum() > 0.75 * STANDS.sum()
    moved = lifted(WALK.poses, planted.smooth_noise(0, (len(WALK.poses), 3), 20, 1.0))
    np.testing.assert_array_equal(detect_contacts(moved, imus, BODY).standing, contacts.standing)
    assert not detect_contacts(WALK.poses, imus, BODY, ContactSettings(shortest=1.0)).standing.any()
    assert not detect_contacts(WALK.poses[:1], imus[:1], BODY).standing.any()


def test_feet_stand_where_their_sensor_has_data() -> None:
    poses = planted.upright(BODY, 90).poses
    imus = planted.bone_imus(BODY, poses, SHANKS)
    assert detect_contacts(poses, imus, BODY).standing.all()
    a = np.array(imus.a_world)
    a[30:60, 0] = np.nan
    contacts = detect_contacts(poses, replace(imus, a_world=a), BODY)
    assert not contacts.standing[30:60, 0].any()
    assert contacts.standing[:24, 0].all()
    assert contacts.standing[:, 1].all()


def test_a_jump_has_no_contact() -> None:
    poses = planted.upright(BODY, 120).poses
    t = np.arange(120) / 60 - 0.75
    z = np.where((t > 0) & (t < 0.5), 9.81 / 2 * t * (0.5 - t), 0.0)
    poses = lifted(poses, np.stack([0 * t, 0 * t, z], axis=1))
    contacts = detect_contacts(poses, planted.bone_imus(BODY, poses, WITH_FEET), BODY)
    assert not contacts.standing[(t > 0.05) & (t < 0.45)].any()
    assert contacts.standing[(t < -0.1) | (t > 0.6)].all()


def test_a_raised_still_foot_does_not_stand() -> None:
    poses = planted.upright(BODY, 60).poses
    q = np.array(planted.upright(BODY, 60).q)
    q[:, 7 + BODY.dof_names.index("LeftLeg_y")] = 1.2
    q[:, 7 + BODY.dof_names.index("LeftUpLeg_y")] = -1.0
    p, R = BODY.forward_kinematics(q)
    poses = replace(poses, p_world_joint=p, R_world_bone=R)
    contacts = detect_contacts(poses, planted.bone_imus(BODY, poses, SHANKS), BODY)
    assert not contacts.standing[:, 0].any()
    assert contacts.standing[:, 1].all()


def test_feet_without_sensors_are_left_out_or_found_from_poses() -> None:
    poses = WALK.poses
    arms = planted.bone_imus(BODY, poses, ("LeftArm", "RightForeArm"))
    none = detect_contacts(poses, arms, BODY)
    assert none.joints == ()
    assert none.standing.shape == (len(poses), 0)
    every = detect_contacts(poses, arms, BODY, from_poses=True)
    assert every.joints == ("LeftFoot", "RightFoot")
    assert 0.2 < every.standing.mean() < 0.9
    right = planted.bone_imus(BODY, poses, ("RightLeg", "LeftUpLeg"))
    assert detect_contacts(poses, right, BODY).joints == ("RightFoot",)


def test_footholds_are_at_the_ankle() -> None:
    feet = WALK.poses.p_world_joint[:, BODY.index("LeftFoot", "RightFoot")]
    places = footholds(Contacts(("LeftFoot", "RightFoot"), STANDS), feet, 0.08).p_world
    np.testing.assert_allclose(places[STANDS], feet[STANDS], atol=1e-6)
    assert np.isnan(places[~STANDS]).all()


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: ContactSettings(window=0.0), "window"),
        (lambda: Contacts(("LeftFoot",), np.zeros((5, 2))), r"expected shape \(T, 1\)"),
        (lambda: Contacts(("LeftFoot", "LeftFoot"), np.zeros((5, 2))), "LeftFoot"),
        (lambda: Footholds(("LeftFoot",), np.full((5, 1, 3), np.inf)), "finite, or NaN as a whole"),
        (lambda: Footholds(("LeftFoot",), np.full((5, 1, 3), [0, 0, np.nan])), "NaN as a whole"),
    ],
)
def test_invalid_values_are_refused(make: object, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        make()  # type: ignore[operator]
