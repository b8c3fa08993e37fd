"""SkeletonModel against Pinocchio: kinematics, scaled bodies, URDF files, reports."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, InvalidInputError, RtofError, UnknownNameError
from rtof_kin.core.resources import model_path
from rtof_kin.data.poses import PoseSequence

Array = NDArray[np.float64]
DEFAULT = SkeletonModel.default()


def random_q(skeleton: SkeletonModel, frames: int, seed: int = 0, inside: bool = True) -> Array:
    """Independent configurations: inside the limits, or with any angles within three turns."""
    rng = np.random.default_rng(seed)
    q = np.tile(skeleton.t_pose(), (frames, 1))
    q[:, :3] = rng.normal(size=(frames, 3))
    q[:, 3:7] = np.roll(so3.to_quat_wxyz(so3.exp(rng.normal(size=(frames, 3)))), -1, axis=-1)
    low, high = skeleton.limits.T if inside else (-3 * np.pi, 3 * np.pi)
    q[:, 7:] = rng.uniform(low, high, (frames, skeleton.nq - 7))
    return q


def wandering_q(skeleton: SkeletonModel, frames: int, seed: int = 0) -> Array:
    """Smooth random angles over several turns, starting at zero."""
    rng = np.random.default_rng(seed)
    q = np.tile(skeleton.t_pose(), (frames, 1))
    t = np.linspace(0, 1, frames)[:, None]
    D = skeleton.nq - 7
    waves = np.sin(2 * np.pi * rng.uniform(1, 3, D) * t)
    q[:, 7:] = rng.uniform(-15, 15, D) * t + waves
    turn = so3.exp(np.array([1.0, 2.0, 8.0]) * t)
    q[:, 3:7] = np.roll(so3.to_quat_wxyz(turn), -1, axis=-1)
    q[:, :3] = np.sin(3 * t + [0, 1, 2])
    return q


def oracle(skeleton: SkeletonModel, q: Array) -> tuple[Array, Array]:
    """Link placements from Pinocchio, frame by frame."""
    model, data = skeleton.model, skeleton.model.createData()
    p, R = np.empty((len(q), len(skeleton.names), 3)), np.empty((len(q), len(skeleton.names), 3, 3))
    for t, row in enumerate(q):
        pin.framesForwardKinematics(model, data, row)
        for j, name in enumerate(skeleton.names):
            placement = data.oMf[model.getFrameId(name, pin.FrameType.BODY)]
            p[t, j], R[t, j] = placement.translation, placement.rotation
    return p, R


def assert_close(a: Any, b: Any, tolerance: float = 1e-9) -> None:
    np.testing.assert_allclose(a, b, rtol=0, atol=tolerance)


# --- skeletons ----------------------------------------------------------------------------------------


def test_shipped_skeletons_have_a_free_base_and_three_angles_per_joint() -> None:
    for skeleton, J in [(DEFAULT, 21), (SkeletonModel.human36m(), 17)]:
        assert len(skeleton.names) == len(skeleton.parents) == J
        assert skeleton.nq == 7 + 3 * (J - 1)
        assert skeleton.nv == 6 + 3 * (J - 1)
        assert len(skeleton.dof_names) == 3 * (J - 1)
        assert skeleton.joint_offsets.shape == (J, 3)
        assert not skeleton.joint_offsets.flags.writeable
    assert DEFAULT.root == "Hips"
    assert DEFAULT.index("Head", "Hips") == [6, 0]
    with pytest.raises(UnknownNameError, match=r"unknown joint 'LeftLegg'\. Did you mean 'LeftLeg'"):
        DEFAULT.index("LeftLegg")


def test_limits_are_in_the_order_of_the_dof_names(any_skeleton: SkeletonModel) -> None:
    by_name = dict(zip(any_skeleton.dof_names, any_skeleton.limits, strict=True))
    for joint in any_skeleton.table.joints:
        for dof, limits in zip(joint.dofs, joint.limits, strict=True):
            assert_close(by_name[dof.urdf], limits, 1e-11)


def test_t_pose_faces_x_with_parallel_frames_and_arms_sideways(any_skeleton: SkeletonModel) -> None:
    p, R = any_skeleton.forward_kinematics(any_skeleton.t_pose()[None])
    assert_close(R, np.broadcast_to(np.eye(3), R.shape), 0)
    assert_close(p[0, 0], 0, 0)
    by_name = dict(zip(any_skeleton.landmarks, any_skeleton.landmark_positions(p, R)[0], strict=True))
    left, right = ("LeftHand", "RightHand") if any_skeleton.name == "total_capture" else ("LWrist", "RWrist")
    assert by_name[left][1] > 0.6
    assert by_name[right][1] < -0.6
    toe, heel = (by_name[n] for n in by_name if n in ("LeftToe", "LToe", "LeftHeel", "LHeel"))
    front = max(toe[0], heel[0])
    assert front > 0.15
    assert by_name["HeadTop"][2] > 0.6


def test_n_pose_has_hanging_arms_within_the_limits(any_skeleton: SkeletonModel) -> None:
    q = any_skeleton.n_pose()
    assert not any_skeleton.check(q[None]).limit_excess.any()
    p, R = any_skeleton.forward_kinematics(q[None])
    for end in any_skeleton.landmarks:
        if end.endswith("HandEnd"):
            hand = any_skeleton.landmarks[end][0]
            j = any_skeleton.index(hand)[0]
            upper = any_skeleton.parents[any_skeleton.parents[j]]
            along = p[0, j] - p[0, upper]
            assert_close(so3.unit(along), [0, 0, -1])
            assert_close(R[0, j] @ [1.0, 0, 0], [1, 0, 0])  # thumbs forward, palms to the thighs


def test_joints_are_landmarks_and_heads_and_feet_have_more() -> None:
    assert DEFAULT.landmarks["LeftArm"][0] == "LeftArm"
    assert {"HeadTop", "Nose", "LeftEar", "RightHeel", "LeftToe", "LeftHandEnd"} <= set(DEFAULT.landmarks)
    q = random_q(DEFAULT, 4)
    p, R = DEFAULT.forward_kinematics(q)
    points = DEFAULT.landmark_positions(p, R)
    assert points.shape == (4, len(DEFAULT.landmarks), 3)
    assert_close(points[:, :21], p)
    joint, offset = DEFAULT.landmarks["Nose"]
    j = DEFAULT.index(joint)[0]
    assert_close(points[2, list(DEFAULT.landmarks).index("Nose")], p[2, j] + R[2, j] @ offset)
    assert DEFAULT.sensors["L_LowArm"][0] == "LeftForeArm"


# --- forward kinematics -------------------------------------------------------------------------------


def test_forward_kinematics_equals_pinocchio(any_skeleton: SkeletonModel) -> None:
    scaled = any_skeleton.with_offsets(any_skeleton.joint_offsets * 1.1 + 0.01)
    for skeleton in (any_skeleton, scaled):
        q = random_q(skeleton, 10, inside=False)
        p, R = skeleton.forward_kinematics(q)
        p_true, R_true = oracle(skeleton, q)
        assert_close(p, p_true, 1e-12)
        assert_close(R, R_true, 1e-12)


def test_nan_affects_only_its_frame() -> None:
    q = random_q(DEFAULT, 4)
    p_all, R_all = DEFAULT.forward_kinematics(q)
    q[1], q[2, 30] = np.nan, np.nan
    p, R = DEFAULT.forward_kinematics(q)
    assert np.isnan(R[1:3]).all()
    assert np.isnan(p[1:3, 1:]).all()
    assert_close(p[[0, 3]], p_all[[0, 3]], 0)
    assert_close(R[[0, 3]], R_all[[0, 3]], 0)
    assert DEFAULT.forward_kinematics(np.empty((0, DEFAULT.nq)))[0].shape == (0, 21, 3)


def test_configuration_of_wrong_shape_or_quaternion_norm_is_refused() -> None:
    for q, shape in ((np.zeros((3, 66)), r"\(3, 66\)"), (DEFAULT.t_pose(), r"\(67,\)")):
        with pytest.raises(InvalidInputError, match=rf"q: expected shape \(T, 67\), got {shape}"):
            DEFAULT.forward_kinematics(q)
    q = random_q(DEFAULT, 3)
    q[1, 3:7] *= 1.01
    with pytest.raises(InvalidInputError, match=r"root quaternion \(x y z w\) of frame 1 has norm 1.01"):
        DEFAULT.forward_kinematics(q)


@pytest.mark.parametrize(
    ("dof", "degrees", "joint", "moved"),
    [
        ("LeftLeg_y", 90, "LeftFoot", [-0.396, 0, 0.396]),
        ("RightLeg_y", 90, "RightFoot", [-0.396, 0, 0.396]),
        ("LeftUpLeg_y", -90, "LeftLeg", [0.396, 0, 0.396]),
        ("RightUpLeg_y", -90, "RightLeg", [0.396, 0, 0.396]),
        ("RightForeArm_z", 90, "RightHand", None),
        ("LeftForeArm_z", -90, "LeftHand", None),
        ("Spine_y", 30, "Head", None),
    ],
)
def test_signs_of_knee_hip_elbow_and_trunk(dof: str, degrees: float, joint: str, moved: list[float] | None) -> None:
    q = DEFAULT.t_pose()
    before = DEFAULT.forward_kinematics(q[None])[0][0]
    q[7 + DEFAULT.dof_names.index(dof)] = np.radians(degrees)
    found = (DEFAULT.forward_kinematics(q[None])[0][0] - before)[DEFAULT.index(joint)[0]]
    if moved is None:
        assert found[0] > 0.2  # forwards
    else:
        assert_close(found, moved)


# --- other bodies -------------------------------------------------------------------------------------


def test_bone_lengths_are_changed_by_name() -> None:
    new = DEFAULT.with_bone_lengths({"LeftLeg": 0.5, "Neck": 0.3})
    assert new.bone_lengths["LeftLeg"] == pytest.approx(0.5)
    assert new.bone_lengths["Neck"] == pytest.approx(0.3)
    assert DEFAULT.bone_lengths["LeftLeg"] == pytest.approx(0.396)
    assert_close(so3.unit(new.joint_offsets), so3.unit(DEFAULT.joint_offsets))
    others = set(DEFAULT.bone_lengths) - {"LeftLeg", "Neck"}
    assert all(new.bone_lengths[n] == DEFAULT.bone_lengths[n] for n in others)


@pytest.mark.parametrize("height", [1.0, 1.5, 2.1])
def test_height_is_reached_with_the_same_proportions(any_skeleton: SkeletonModel, height: float) -> None:
    new = any_skeleton.with_height(height)
    assert new.height == pytest.approx(height, abs=1e-12)
    assert_close(new.joint_offsets / height, any_skeleton.joint_offsets / any_skeleton.height)


def test_mass_and_sex_change_the_segment_masses() -> None:
    heavy = DEFAULT.with_mass(100.0, "male")
    assert pin.computeTotalMass(heavy.model) == pytest.approx(100.04)
    assert pin.computeTotalMass(DEFAULT.model) == pytest.approx(75 * 0.99995 + 0.04)
    thighs = [
        DEFAULT.with_mass(60.0, sex).model.inertias[DEFAULT.model.getJointId("LeftUpLeg_z")].mass
        for sex in ("male", "female")
    ]
    assert thighs == pytest.approx([60 * 0.1416, 60 * 0.1478])


def test_some_offsets_can_be_given_by_name() -> None:
    new = DEFAULT.with_offsets({"LeftUpLeg": [0.01, 0.1, -0.02]})
    assert_close(new.joint_offsets[DEFAULT.index("LeftUpLeg")[0]], [0.01, 0.1, -0.02])
    assert_close(np.delete(new.joint_offsets, 18, axis=0), np.delete(DEFAULT.joint_offsets, 18, axis=0))
    rooted = DEFAULT.with_offsets(DEFAULT.joint_offsets + [[0.1, 0, 0]] * (np.arange(21) == 0)[:, None])
    assert_close(rooted.joint_offsets, DEFAULT.joint_offsets, 0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.with_offsets(np.zeros((20, 3))), r"joint_offsets: expected shape \(21"),
        (lambda s: s.with_offsets({"Tail": [0, 0, 1]}), "unknown joint 'Tail'"),
        (lambda s: s.with_offsets({"Head": [0, 0]}), r"joint offset: expected shape \(3\)"),
        (lambda s: s.with_offsets({"Head": [0, 0, np.nan]}), "offset of Head is not finite"),
        (lambda s: s.with_offsets({"Head": [0, 0, 0]}), "that ends at Head has no length"),
        (lambda s: s.with_offsets(s.joint_offsets * 1e-9), "ends at Spine has no length"),
        (lambda s: s.with_bone_lengths({"Hips": 0.4}), "unknown bone 'Hips'"),
        (lambda s: s.with_bone_lengths({"Head": 0.0}), "Head: 0.0 m is not a positive"),
        (lambda s: s.with_bone_lengths({"Head": -1}), "Head: -1 m is not a positive"),
        (lambda s: s.with_bone_lengths({"Head": np.inf}), "bone length of Head: inf m"),
        (lambda s: s.with_height(178), "height: 178 m .*; give metres"),
        (lambda s: s.with_height(np.nan), "height: nan m"),
        (lambda s: s.with_mass(-5), "mass: -5 kg .*; give kilograms"),
        (lambda s: s.with_mass(70, "f"), "sex: 'f' is not male, female or None"),
        (lambda s: s.check(np.zeros((2, 3))), r"q: expected shape \(T, 67\)"),
        (lambda s: s.inverse_kinematics(np.zeros((2, 17, 3))), r"p: expected shape \(T, 21"),
        (
            lambda s: s.inverse_kinematics(np.zeros((2, 21, 3)), np.zeros((1, 21, 3, 3))),
            r"R: expected shape \(2, 21, 3, 3\), got \(1, 21, 3, 3\)",
        ),
        (
            lambda s: s.inverse_kinematics(np.zeros((1, 21, 3)), np.ones((1, 21, 3, 3))),
            "R: contains a matrix that is not a rotation",
        ),
        (lambda s: s.orientation_observed(("Tail",)), "unknown joint 'Tail'"),
    ],
)
def test_invalid_bodies_and_arrays_are_refused(change: Callable[[SkeletonModel], Any], message: str) -> None:
    with pytest.raises(RtofError, match=message):
        change(DEFAULT)


# --- URDF files ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1])
def test_personal_urdf_is_read_back_as_the_same_body(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    person = DEFAULT.with_offsets(DEFAULT.joint_offsets * rng.uniform(0.8, 1.2, (21, 1)))
    path = tmp_path / "person.urdf"
    path.write_text(person.to_urdf())
    back = SkeletonModel.from_urdf(path)
    assert_close(back.joint_offsets, person.joint_offsets, 1e-12)
    q = random_q(person, 3)
    assert_close(back.forward_kinematics(q)[0], person.forward_kinematics(q)[0], 1e-11)
    assert back.height == pytest.approx(person.height, abs=1e-9)
    for name, (joint, offset) in person.landmarks.items():
        assert back.landmarks[name][0] == joint
        assert_close(back.landmarks[name][1], offset, 1e-11)
    for name, (_, lever) in person.sensors.items():
        assert_close(back.sensors[name][1], lever, 1e-11)
    for a, b in zip(back.model.inertias, person.model.inertias, strict=True):
        assert_close(a.toDynamicParameters(), b.toDynamicParameters(), 1e-9)


def test_urdf_keeps_its_own_limits_and_masses(tmp_path: Path) -> None:
    text = DEFAULT.with_mass(90.0).to_urdf()
    path = tmp_path / "edited.urdf"
    path.write_text(text.replace('upper="2.87979326579"', 'upper="2"'))
    back = SkeletonModel.from_urdf(path)
    assert back.limits[back.dof_names.index("LeftLeg_y")][1] == 2.0
    assert pin.computeTotalMass(back.model) == pytest.approx(90 * 0.99995 + 0.04)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<robot", "<robit", "not a readable URDF"),
        ("Spine_y", "Rumpf_y", "there is no joint Spine_y in it"),
        ("Head_x", "Kopf_x", "the joint Kopf_x has another parent, place or axis than in the skeleton table"),
        (
            '<axis xyz="0 1 0" />',
            '<axis xyz="0 -1 0" />',
            "another parent, place or axis than in the skeleton table; give the table that",
        ),
        ('rpy="0 0 0" />\n    <axis', 'rpy="0 0 0.1" />\n    <axis', "has another parent, place or axis"),
    ],
)
def test_other_urdf_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "other.urdf"
    text = DEFAULT.to_urdf()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(FileFormatError, match=f"other.urdf: .*{message}"):
        SkeletonModel.from_urdf(path)


def test_missing_urdf_or_one_of_another_table_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"no\.urdf: there is no such file"):
        SkeletonModel.from_urdf(tmp_path / "no.urdf")
    with pytest.raises(FileFormatError, match=r"human36m\.urdf: there is no joint Spine1_y in it"):
        SkeletonModel.from_urdf(model_path("human36m.urdf"))
    with pytest.raises(InvalidInputError, match=r"URDF and skeleton table differ in the joints .*Head_x"):
        SkeletonModel(DEFAULT.table, DEFAULT.to_urdf().replace("Head_x", "Kopf_x"))


# --- inverse kinematics -------------------------------------------------------------------------------


def test_forward_of_inverse_kinematics_reproduces_poses(any_skeleton: SkeletonModel) -> None:
    p, R = any_skeleton.forward_kinematics(random_q(any_skeleton, 200, inside=False))
    q = any_skeleton.inverse_kinematics(p, R)
    p_again, R_again = any_skeleton.forward_kinematics(q)
    assert_close(p_again, p)
    assert_close(R_again, R)


def test_smooth_angles_are_recovered_over_turns_and_singular_postures(any_skeleton: SkeletonModel) -> None:
    q = wandering_q(any_skeleton, 1500)
    assert any_skeleton.check(q).singular[:, 1:].any(axis=0).sum() > 10  # joints that pass one
    assert (np.ptp(q[:, 7:], axis=0) > 2 * np.pi).sum() > 20
    found = any_skeleton.inverse_kinematics(*any_skeleton.forward_kinematics(q))
    assert_close(found[:, 7:], q[:, 7:], 1e-8)
    assert np.abs(np.diff(found[:, 3:7], axis=0)).max() < 0.1


def test_poses_are_exact_at_a_singular_posture() -> None:
    q = np.tile(DEFAULT.t_pose(), (4, 1))
    q[:, 7 + DEFAULT.dof_names.index("LeftArm_y")] = [1.4, np.pi / 2, np.pi / 2, 1.7]
    q[:, 7 + DEFAULT.dof_names.index("LeftArm_z")] = 0.4
    p, R = DEFAULT.forward_kinematics(q)
    p_again, R_again = DEFAULT.forward_kinematics(DEFAULT.inverse_kinematics(p, R))
    assert_close(p_again, p)
    assert_close(R_again, R)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_each_frame_takes_the_branch_nearest_to_the_previous_frame(seed: int) -> None:
    """Brute force over both branches and whole turns, for motion of any roughness."""
    rng = np.random.default_rng(seed)
    R = np.tile(np.eye(3), (30, 21, 1, 1))
    step = so3.exp(rng.normal(size=(30, 21, 3)) * rng.uniform(0.1, 1.5))
    for t in range(1, 30):
        R[t] = R[t - 1] @ step[t]
    angles = DEFAULT.inverse_kinematics(np.zeros((30, 21, 3)), R)[:, DEFAULT._q_index]
    for t in range(1, 30):
        a, before = angles[t], angles[t - 1]
        other = np.stack([a[:, 0] + np.pi, np.pi - a[:, 1], a[:, 2] + np.pi], -1)
        for candidate in (a, other):
            turns = np.round((before - candidate) / (2 * np.pi))
            distance = np.linalg.norm(candidate + 2 * np.pi * turns - before, axis=-1)
            assert np.all(np.linalg.norm(a - before, axis=-1) <= distance + 1e-9)


def test_frames_with_nan_give_nan_rows_and_the_branch_is_kept() -> None:
    q = wandering_q(DEFAULT, 300)
    p, R = DEFAULT.forward_kinematics(q)
    p[100], R[101, 7], R[102] = np.nan, np.nan, np.nan
    found = DEFAULT.inverse_kinematics(p, R)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(found).any(axis=1)), [100, 101, 102])
    assert np.isnan(found[100:103]).all()
    known = np.isfinite(found).all(axis=1)
    assert_close(found[known, 7:], q[known, 7:], 1e-8)
    nothing = DEFAULT.inverse_kinematics(np.full((3, 21, 3), np.nan))
    assert nothing.shape == (3, 67)
    assert np.isnan(nothing).all()
    assert DEFAULT.inverse_kinematics(np.empty((0, 21, 3))).shape == (0, 67)


def test_positions_alone_are_reproduced_and_twist_follows_the_parent(motion: Motion) -> None:
    skeleton, p = motion.skeleton, motion.poses.p_world_joint
    q = skeleton.inverse_kinematics(p)
    p_again, R = skeleton.forward_kinematics(q)
    # Positions fix the trunk by two children each; its neck and clavicles are not one rigid triple.
    one_child = [j for j in range(21) if skeleton.parents.count(j) == 1 and skeleton.parents[j] >= 0]
    for j in one_child:
        child = skeleton.parents.index(j)
        assert_close(so3.unit(p_again[:, child] - p_again[:, j]), so3.unit(p[:, child] - p[:, j]), 1e-9)
        turn = so3.log(R[:, j] @ np.swapaxes(R[:, skeleton.parents[j]], -1, -2))
        before = R[:, skeleton.parents[j]] @ skeleton.joint_offsets[child]
        between = so3.unit(before) + so3.unit(p[:, child] - p[:, j])
        assert np.abs(np.sum(turn * so3.unit(between), axis=-1)).max() < 1e-7
    for leaf in skeleton.index("Head", "LeftHand", "RightFoot"):
        assert_close(R[:, leaf], R[:, skeleton.parents[leaf]])
    # Rigid triples (Hips, Spine3) make the positions come back exactly, whatever the twist.
    assert_close(p_again, p)


def test_orientations_are_observed_by_several_children_or_a_sensor() -> None:
    seen = DEFAULT.orientation_observed()
    assert [n for n, o in zip(DEFAULT.names, seen, strict=True) if o] == ["Hips", "Spine3"]
    seen = DEFAULT.orientation_observed(("LeftForeArm", "Head"))
    assert [n for n, o in zip(DEFAULT.names, seen, strict=True) if o] == ["Hips", "Spine3", "Head", "LeftForeArm"]
    human36m = SkeletonModel.human36m()
    seen = human36m.orientation_observed()
    assert [n for n, o in zip(human36m.names, seen, strict=True) if o] == ["Hip", "Thorax"]


# --- reports ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("turns", [0, 1, -2])
def test_postures_within_five_degrees_of_singular_are_flagged(side: int, turns: int) -> None:
    q = np.tile(DEFAULT.t_pose(), (5, 1))
    degrees = np.array([84.9, 85.1, 90.0, 94.9, 95.1])
    q[:, 7 + DEFAULT.dof_names.index("LeftArm_y")] = side * np.radians(degrees) + 2 * np.pi * turns
    q[:, 7 + DEFAULT.dof_names.index("LeftArm_z")] = np.pi / 2  # an outer angle flags nothing
    singular = DEFAULT.check(q).singular
    j = DEFAULT.index("LeftArm")[0]
    np.testing.assert_array_equal(singular[:, j], [False, True, True, True, False])
    assert singular.sum() == 3


def test_limit_violations_are_reported_and_nothing_is_clipped() -> None:
    q = np.tile(DEFAULT.n_pose(), (4, 1))
    knee = 7 + DEFAULT.dof_names.index("LeftLeg_y")
    hip = 7 + DEFAULT.dof_names.index("RightUpLeg_y")
    q[:, knee] = np.radians([-12.0, 0.0, 165.0, 170.0])
    q[1, hip] = np.radians(-141.0)
    report = DEFAULT.check(q)
    assert_close(report.limit_excess[:, knee - 7], np.radians([2.0, 0, 0, 5.0]))
    worst = dict(zip(report.dof_names, report.limit_excess.max(axis=0), strict=True))
    assert {name: value for name, value in worst.items() if value} == {
        "LeftLeg_y": pytest.approx(np.radians(5)),
        "RightUpLeg_y": pytest.approx(np.radians(1)),
    }
    assert report.dof_names == DEFAULT.dof_names
    found = DEFAULT.inverse_kinematics(*DEFAULT.forward_kinematics(q))
    assert_close(found, q)


# --- motion -------------------------------------------------------------------------------------------


def test_motion_of_poses_reproduces_them(motion: Motion) -> None:
    again = motion.skeleton.motion(motion.poses)
    assert_close(again.poses.p_world_joint, motion.poses.p_world_joint)
    assert_close(again.poses.R_world_bone, motion.poses.R_world_bone)
    np.testing.assert_array_equal(again.poses.provenance, motion.poses.provenance)
    np.testing.assert_array_equal(again.times, motion.times)
    assert_close(again.q, motion.q, 1e-8)


def test_motion_of_other_joints_or_in_another_order_is_refused(motion: Motion) -> None:
    human36m = SkeletonModel.human36m()
    with pytest.raises(UnknownNameError, match="unknown joint 'Hips'"):
        human36m.motion(motion.poses)
    names = (*motion.poses.names[1:], motion.poses.names[0])
    with pytest.raises(InvalidInputError, match="poses: need all joints, in this order: Hips, Spine, Spine1"):
        motion.skeleton.motion(replace(motion.poses, names=names))
    few = PoseSequence(motion.times[:1], np.zeros((1, 1, 3)), np.eye(3)[None, None], ("Hips",))
    with pytest.raises(InvalidInputError, match="poses: need all joints"):
        motion.skeleton.motion(few)


def test_limits_are_checked_on_equivalent_angles(skeleton: SkeletonModel) -> None:
    q = np.tile(skeleton.n_pose(), (3, 1))
    elbow = [7 + skeleton.dof_names.index(f"LeftForeArm_{axis}") for axis in "yxz"]
    inside = np.radians([10.0, 5.0, -90.0])
    q[0, elbow] = inside
    q[1, elbow] = inside + 2 * np.pi * np.array([1, 0, -1])
    q[2, elbow] = [inside[0] + np.pi, np.pi - inside[1], inside[2] - np.pi]
    assert not skeleton.check(q).limit_excess.any()
