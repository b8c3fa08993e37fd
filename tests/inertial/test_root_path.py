"""The root's path of planted walks and jumps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.root_path import Contacts, RootPath, contact_points, detect_contacts, root_path

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
WALK, STANDS = planted.walking(BODY, 6.0)
LEGS = ("Hips", "LeftUpLeg", "RightUpLeg", "LeftLeg", "RightLeg")
FEET = ("LeftFoot", "RightFoot")
IMUS, ROOT = planted.bone_imus(BODY, WALK.poses, LEGS), WALK.poses.p_world_joint[:, 0]


def errors(path: RootPath, p_root: Array) -> Array:
    """(T, 3) m, relative to the first frame."""
    return np.asarray((path.p_world - path.p_world[0]) - (p_root - p_root[0]))


def test_planted_feet_give_the_path_of_a_walk() -> None:
    path = root_path(WALK.poses, IMUS, Contacts(FEET, STANDS), BODY, 0.08)
    assert np.abs(errors(path, ROOT)).max() < 0.005
    np.testing.assert_allclose(path.p_world[0, :2], 0.0, atol=1e-5)
    np.testing.assert_allclose(path.p_world[:, 2], WALK.poses.p_world_joint[:, 0, 2], atol=0.005)


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_detected_feet_give_a_path_with_little_drift(noise: float) -> None:
    imus = planted.bone_imus(BODY, WALK.poses, LEGS, acceleration=noise)
    contacts = detect_contacts(WALK.poses, imus, BODY)
    path = root_path(WALK.poses, imus, contacts, BODY, 0.08)
    walked = float(ROOT[-1, 0] - ROOT[0, 0])
    assert np.linalg.norm(errors(path, ROOT)[-1]) < 0.02 * walked


def test_accelerations_determine_the_path_in_flight() -> None:
    """A jump forward: 0.6 m in half a second, 0.3 m high."""
    poses = planted.upright(BODY, 120).poses
    t = np.arange(120) / 60 - 0.75
    s = np.clip(t / 0.5, 0, 1)
    x, z = 0.6 * s**3 * (10 - 15 * s + 6 * s**2), 0.3 * 64 * (s * (1 - s)) ** 3
    jump = np.stack([x, 0 * t, z], axis=1)
    there = replace(poses, p_world_joint=poses.p_world_joint + jump[:, None])
    imus = planted.bone_imus(BODY, there, LEGS)
    standing = np.tile(((t <= 0) | (t >= 0.5))[:, None], (1, 2))
    path = root_path(poses, imus, Contacts(FEET, standing), BODY, 0.08)
    assert np.abs(errors(path, there.p_world_joint[:, 0])).max() < 0.02


def test_without_foot_sensors_the_root_stays_over_the_origin() -> None:
    poses = WALK.poses
    path = root_path(poses, IMUS, Contacts((), np.zeros((len(poses), 0))), BODY, 0.5)
    assert np.all(path.p_world == path.p_world[0])
    np.testing.assert_array_equal(path.p_world[0, :2], 0.0)
    assert np.isnan(path.sigma).all()
    lowest = (poses.p_world_joint[0] - poses.p_world_joint[0, 0])[:, 2].min()
    assert path.p_world[0, 2] + lowest == pytest.approx(0.5)


def test_without_contacts_the_lower_foot_bounds_the_drift() -> None:
    path = root_path(WALK.poses, IMUS, Contacts(FEET, STANDS & False), BODY, 0.08)
    error = errors(path, ROOT)
    assert np.linalg.norm(error[-1, :2]) < 0.1 * np.ptp(WALK.poses.p_world_joint[:, 0, 0])
    assert np.abs(error[:, 2]).max() < 0.05
    assert path.sigma[-1] < 3.0  # decimetres a second, not metres


def test_drift_grows_with_distance_and_with_squared_flight_time() -> None:
    path = root_path(WALK.poses, IMUS, Contacts(FEET, STANDS), BODY, 0.08)
    assert np.all(np.diff(path.sigma) >= 0)
    assert path.sigma[0] == 0.0
    assert path.sigma[-1] == pytest.approx(0.05 * 0.8 * 6.0, rel=0.05)
    standing = planted.upright(BODY, 120).poses
    still = planted.bone_imus(BODY, standing, LEGS)
    for seconds, expected in ((0.5, 0.5 / 2 * 0.5**2), (1.0, 0.5 / 2)):
        on = np.ones((120, 2), dtype=bool)
        on[30 : 30 + round(60 * seconds)] = False
        found = root_path(standing, still, Contacts(FEET, on), BODY, 0.08)
        assert found.sigma[-1] == pytest.approx(expected, rel=0.1)


def test_missing_accelerations_are_ignored() -> None:
    a = np.array(IMUS.a_world)
    a[50:80, 1] = np.nan
    path = root_path(WALK.poses, replace(IMUS, a_world=a), Contacts(FEET, STANDS), BODY, 0.08)
    assert np.abs(errors(path, ROOT)).max() < 0.01


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


def test_contact_points_are_at_the_ankle() -> None:
    feet = WALK.poses.p_world_joint[:, BODY.index("LeftFoot", "RightFoot")]
    places = contact_points(Contacts(("LeftFoot", "RightFoot"), STANDS), feet, 0.08).p_world
    np.testing.assert_allclose(places[STANDS], feet[STANDS], atol=1e-6)
    assert np.isnan(places[~STANDS]).all()
