"""OpenSim's coordinates, .mot and .sto; in `test_motion_files` OpenSim moves the model by them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import InvalidInputError, OutputExistsError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.opensim import coordinate_values, coordinates, write_mot, write_sto


def values_of(skeleton: SkeletonModel, q: np.ndarray | None = None, **angles: float) -> dict[str, float]:
    """Coordinates of a configuration, by default the T-pose with some revolutes turned, rad."""
    q = skeleton.t_pose() if q is None else q
    for name, angle in angles.items():
        q[7 + skeleton.dof_names.index(name)] = angle
    found, values = coordinate_values(moving(skeleton, q[None]))
    return {c.name: v for c, v in zip(found, values[0].tolist(), strict=True)}


def moving(skeleton: SkeletonModel, q: np.ndarray) -> Motion:
    p, R = skeleton.forward_kinematics(q)
    poses = PoseSequence(np.arange(len(q)) / 60, p, R, skeleton.names)
    return Motion(skeleton, q, poses, skeleton.check(q))


def test_every_degree_of_freedom_has_a_name(any_skeleton: SkeletonModel) -> None:
    found = coordinates(any_skeleton.table)
    assert len({c.name for c in found}) == len(found) == any_skeleton.nv
    assert [c.name for c in found[:6]] == [
        "pelvis_tilt",
        "pelvis_list",
        "pelvis_rotation",
        "pelvis_tx",
        "pelvis_ty",
        "pelvis_tz",
    ]
    assert {c.joint for c in found} == set(any_skeleton.names)
    assert all(c.range[0] < 0 < c.range[1] for c in found)


def test_signs_are_opensims(skeleton: SkeletonModel) -> None:
    assert values_of(skeleton, RightUpLeg_y=-0.5)["hip_flexion_r"] == 0.5
    assert values_of(skeleton, LeftUpLeg_x=-0.2)["hip_adduction_l"] == 0.2
    assert values_of(skeleton, RightLeg_y=1.1)["knee_angle_r"] == 1.1
    assert values_of(skeleton, LeftForeArm_z=-1.3)["elbow_flex_l"] == 1.3
    assert values_of(skeleton, Spine_y=0.3)["lumbar_extension"] == -0.3
    assert values_of(skeleton, RightArm_x=0.4)["RightArm_x"] == 0.4  # OpenSim has no such angle


def test_range_is_reversed_with_the_sign(skeleton: SkeletonModel) -> None:
    found = {c.name: c for c in coordinates(skeleton.table)}
    np.testing.assert_allclose(np.degrees(found["hip_flexion_r"].range), [-60, 140])
    np.testing.assert_allclose(np.degrees(found["knee_angle_r"].range), [-10, 165])


def test_pelvis_is_in_a_ground_with_y_up_and_z_on_the_right(skeleton: SkeletonModel) -> None:
    q = skeleton.t_pose()
    q[:3] = [1.0, 2.0, 3.0]
    found = values_of(skeleton, q)
    assert (found["pelvis_tx"], found["pelvis_ty"], found["pelvis_tz"]) == (1.0, 3.0, -2.0)
    for axis, angle, name in (("y", 0.3, "pelvis_tilt"), ("x", 0.2, "pelvis_list"), ("z", 0.4, "pelvis_rotation")):
        q[3:7] = np.roll(so3.to_quat_wxyz(so3.about_axis(axis, angle)), -1)
        # Bending forward turns about y, the left; OpenSim's tilt is positive backward.
        assert values_of(skeleton, q)[name] == pytest.approx(-angle if axis == "y" else angle)


def test_heading_is_continuous_over_turns(skeleton: SkeletonModel) -> None:
    q = np.tile(skeleton.t_pose(), (200, 1))
    heading = np.linspace(0, 15, 200)
    q[:, 3:7] = np.roll(so3.to_quat_wxyz(so3.about_axis("z", heading)), -1, axis=-1)
    _, values = coordinate_values(moving(skeleton, q))
    np.testing.assert_allclose(values[:, 2], heading, atol=1e-9)


def test_duplicate_name_is_refused(skeleton: SkeletonModel) -> None:
    joints = list(skeleton.table.joints)
    joints[2] = replace(joints[2], dofs=joints[1].dofs)
    table = replace(skeleton.table, joints=tuple(joints))
    with pytest.raises(InvalidInputError, match="lumbar_bending"):
        coordinates(table)


def read(path: Path) -> tuple[list[str], list[str], np.ndarray]:
    """Header, names and numbers, taken apart by hand."""
    lines = path.read_text().splitlines()
    end = lines.index("endheader")
    rows = [[float(cell) for cell in line.split("\t")] for line in lines[end + 2 :]]
    return lines[:end], lines[end + 1].split("\t"), np.array(rows)


def test_mot_has_degrees_metres_and_the_announced_counts(motion: Motion, tmp_path: Path) -> None:
    write_mot(tmp_path / "walk.mot", motion)
    header, names, table = read(tmp_path / "walk.mot")
    assert header[:5] == ["walk", "version=1", "nRows=60", "nColumns=67", "inDegrees=yes"]
    assert any("total_capture, zero in the T-pose; y is up" in line for line in header)
    assert table.shape == (60, 67)
    np.testing.assert_allclose(table[:, 0], motion.times, rtol=1e-15)
    knee = motion.q[:, 7 + motion.skeleton.dof_names.index("RightLeg_y")]
    np.testing.assert_allclose(table[:, names.index("knee_angle_r")], np.degrees(knee), rtol=1e-14)
    np.testing.assert_array_equal(table[:, names.index("pelvis_ty")], motion.q[:, 2])


def test_sto_has_radians_speeds_and_state_paths(motion: Motion, tmp_path: Path) -> None:
    write_sto(tmp_path / "walk.sto", motion)
    header, names, table = read(tmp_path / "walk.sto")
    assert header[2:5] == ["nRows=60", "nColumns=133", "inDegrees=no"]
    assert names[1] == "/jointset/Hips/pelvis_tilt/value"
    assert names[-1] == "/jointset/LeftFoot/LeftFoot_z/speed"
    _, values = coordinate_values(motion)
    np.testing.assert_array_equal(table[:, 1:67], values)
    central = (values[2:] - values[:-2]) * 60 / 2
    np.testing.assert_allclose(table[1:-1, 67:], central, atol=1e-9)


def test_single_frame_has_no_speed(motion: Motion, tmp_path: Path) -> None:
    write_sto(tmp_path / "one.sto", motion[:1])
    assert not read(tmp_path / "one.sto")[2][:, 67:].any()


@pytest.mark.parametrize("write", [write_mot, write_sto])
def test_gaps_and_uneven_times_are_refused(write: object, motion: Motion, tmp_path: Path) -> None:
    assert callable(write)
    q = np.array(motion.q)
    q[7] = np.nan
    with pytest.raises(InvalidInputError, match="frame 7"):
        write(tmp_path / "a.mot", replace(motion, q=q))
    times = np.array(motion.times)
    times[30:] += 0.1
    with pytest.raises(InvalidInputError, match="even times"):
        write(tmp_path / "a.mot", replace(motion, poses=replace(motion.poses, times=times)))
    assert not (tmp_path / "a.mot").exists()
    write(tmp_path / "a.mot", motion)
    with pytest.raises(OutputExistsError, match=r"a\.mot"):
        write(tmp_path / "a.mot", motion)
