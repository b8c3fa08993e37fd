"""OpenSim's coordinates of the skeleton: names, signs, ranges and values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, ShapeError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.opensim_coordinates import coordinate_values, coordinates


def values_of(skeleton: SkeletonModel, **angles: float) -> dict[str, float]:
    """Coordinates of the T-pose with some revolutes turned, rad."""
    q = skeleton.t_pose()
    for name, angle in angles.items():
        q[7 + skeleton.dof_names.index(name)] = angle
    return posed(skeleton, q)


def posed(skeleton: SkeletonModel, q: np.ndarray) -> dict[str, float]:
    p, R = skeleton.forward_kinematics(q[None])
    poses = PoseSequence(np.zeros(1), p, R, skeleton.names)
    found, values = coordinate_values(MotionSequence(skeleton, q[None], poses, skeleton.check(q[None])))
    return {c.name: v for c, v in zip(found, values[0].tolist(), strict=True)}


def test_there_is_one_for_every_degree_of_freedom_and_each_has_a_name(any_skeleton: SkeletonModel) -> None:
    found = coordinates(any_skeleton.table)
    assert len({c.name for c in found}) == len(found) == any_skeleton.nv
    assert [c.name for c in found[:6]] == [
        "pelvis_tilt", "pelvis_list", "pelvis_rotation", "pelvis_tx", "pelvis_ty", "pelvis_tz"
    ]  # fmt: skip
    assert {c.joint for c in found} == set(any_skeleton.names)
    assert all(c.range[0] < 0 < c.range[1] for c in found)


def test_signs_are_opensims(skeleton: SkeletonModel) -> None:
    assert values_of(skeleton, RightUpLeg_y=-0.5)["hip_flexion_r"] == 0.5
    assert values_of(skeleton, LeftUpLeg_x=-0.2)["hip_adduction_l"] == 0.2
    assert values_of(skeleton, RightLeg_y=1.1)["knee_angle_r"] == 1.1
    assert values_of(skeleton, LeftForeArm_z=-1.3)["elbow_flex_l"] == 1.3
    assert values_of(skeleton, Spine_y=0.3)["lumbar_extension"] == -0.3
    assert values_of(skeleton, RightArm_x=0.4)["RightArm_x"] == 0.4  # OpenSim has no such angle


def test_a_range_is_turned_round_with_the_sign(skeleton: SkeletonModel) -> None:
    found = {c.name: c for c in coordinates(skeleton.table)}
    np.testing.assert_allclose(np.degrees(found["hip_flexion_r"].range), [-60, 140])
    np.testing.assert_allclose(np.degrees(found["knee_angle_r"].range), [-10, 165])


def test_the_pelvis_is_in_a_ground_with_y_up_and_z_on_the_right(skeleton: SkeletonModel) -> None:
    q = skeleton.t_pose()
    q[:3] = [1.0, 2.0, 3.0]
    found = posed(skeleton, q)
    assert (found["pelvis_tx"], found["pelvis_ty"], found["pelvis_tz"]) == (1.0, 3.0, -2.0)
    for axis, angle, name in (("y", 0.3, "pelvis_tilt"), ("x", 0.2, "pelvis_list"),
                              ("z", 0.4, "pelvis_rotation")):  # fmt: skip
        q[3:7] = np.roll(so3.to_quat_wxyz(so3.about_axis(axis, angle)), -1)
        # Bending forward turns about y, the left; OpenSim's tilt is positive backward.
        assert posed(skeleton, q)[name] == pytest.approx(-angle if axis == "y" else angle)


def test_a_person_who_turns_round_and_round_has_a_continuous_heading(skeleton: SkeletonModel) -> None:
    q = np.tile(skeleton.t_pose(), (200, 1))
    heading = np.linspace(0, 15, 200)
    q[:, 3:7] = np.roll(so3.to_quat_wxyz(so3.about_axis("z", heading)), -1, axis=-1)
    p, R = skeleton.forward_kinematics(q)
    poses = PoseSequence(np.arange(200) / 60, p, R, skeleton.names)
    _, values = coordinate_values(MotionSequence(skeleton, q, poses, skeleton.check(q)))
    np.testing.assert_allclose(values[:, 2], heading, atol=1e-9)


def test_an_unknown_frame_is_refused(motion: MotionSequence) -> None:
    q = np.array(motion.q)
    q[5] = np.nan
    with pytest.raises(ShapeError, match="frame 5 is not known"):
        coordinate_values(replace(motion, q=q))


def test_a_name_that_stands_twice_in_the_table_is_refused(skeleton: SkeletonModel) -> None:
    joints = list(skeleton.table.joints)
    joints[2] = replace(joints[2], dofs=joints[1].dofs)
    table = replace(skeleton.table, joints=tuple(joints))
    with pytest.raises(InvalidInputError, match="OpenSim coordinates: lumbar_bending.* more than once"):
        coordinates(table)
