"""Models as OpenSim loads them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import planted
import pytest
from opensim_support import read_by_opensim

from rtof_kin.body import urdf
from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core import rotations as so3
from rtof_kin.core.errors import FileFormatError, InvalidInputError, OutputExistsError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.opensim import coordinates, read_opensim_table, value_blocks, write_mot, write_osim, write_sto

R_GROUND_WORLD = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])


@pytest.fixture
def body(any_skeleton: SkeletonModel) -> SkeletonModel:
    """A person of given height and mass, on either skeleton."""
    return any_skeleton.with_height(1.83).with_mass(68, "female")


def coordinate_values(motion: Motion) -> np.ndarray:
    return np.concatenate([values[block.own] for block, values in value_blocks(MotionSource.of(motion))])


def test_opensim_mass_and_inertia(body: SkeletonModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_osim(tmp_path / "skeleton.osim", body)
    found = read_by_opensim(tmp_path, tmp_path / "found.npz")
    # Without the light links between revolutes, which OpenSim does not need, it is the same mechanism.
    monkeypatch.setattr(urdf, "LIGHT_MASS_KG", 1e-12)
    monkeypatch.setattr(urdf, "LIGHT_INERTIA", 1e-15)
    model = pin.buildModelFromXML(body.to_urdf(), pin.JointModelFreeFlyer())
    data, q = model.createData(), pin.neutral(model)
    assert found["mass"] == pytest.approx(sum(inertia.mass for inertia in model.inertias), abs=1e-9)
    center = pin.centerOfMass(model, data, q)
    np.testing.assert_allclose(found["center_of_mass"], R_GROUND_WORLD @ center, atol=1e-9)

    every = {c.name: c for c in coordinates(body.table)}
    revolutes = {d.opensim.lstrip("-") or d.urdf: d.urdf for j in body.table.joints for d in j.dofs}
    names = [name for name in found["coordinates"] if name in revolutes]
    ours = [model.joints[model.getJointId(revolutes[name])].idx_v for name in names]
    theirs = [list(found["coordinates"]).index(name) for name in names]
    sign = np.array([every[name].sign for name in names])
    M = pin.crba(model, data, q)
    M = np.triu(M) + np.triu(M, 1).T
    expected = M[np.ix_(ours, ours)] * np.outer(sign, sign)
    np.testing.assert_allclose(found["mass_matrix"][np.ix_(theirs, theirs)], expected, atol=1e-9)


def test_opensim_finds_the_coordinates_and_their_ranges(body: SkeletonModel, tmp_path: Path) -> None:
    write_osim(tmp_path / "skeleton.osim", body)
    found = read_by_opensim(tmp_path, tmp_path / "found.npz")
    expected = {c.name: c.range for c in coordinates(body.table)}
    assert set(found["coordinates"]) == set(expected)
    for name, limits in zip(found["coordinates"], found["ranges"], strict=True):
        np.testing.assert_allclose(limits, expected[name])


def test_opensim_reproduces_the_motion_of_either_skeleton(body: SkeletonModel, tmp_path: Path) -> None:
    motion = planted.seen(body, 12)
    write_osim(tmp_path / "skeleton.osim", body)
    write_mot(tmp_path / "motion.mot", motion)
    found = read_by_opensim(tmp_path, tmp_path / "found.npz")
    p = body.landmark_positions(motion.poses.p_world_joint, motion.poses.R_world_bone)
    np.testing.assert_allclose(found["motion.mot/markers"], p @ R_GROUND_WORLD.T, atol=1e-9)


def values_of(skeleton: SkeletonModel, q: np.ndarray | None = None, **angles: float) -> dict[str, float]:
    """Coordinates of a configuration, by default the T-pose with some revolutes turned, rad."""
    q = skeleton.t_pose() if q is None else q
    for name, angle in angles.items():
        q[7 + skeleton.dof_names.index(name)] = angle
    found, values = coordinates(skeleton.table), coordinate_values(moving(skeleton, q[None]))
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
    values = coordinate_values(moving(skeleton, q))
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
    values = coordinate_values(motion)
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


GOOD = "Coordinates\nversion=1\nnRows=2\nnColumns=3\ninDegrees=yes\nendheader\ntime\tknee_angle_r\tpelvis_tx\n"
ROWS = "0.0\t10.0\t1.0\n0.1\t20.0\t1.1\n"


def read_text_as_table(tmp_path: Path, text: str, name: str = "a.mot") -> object:
    (tmp_path / name).write_text(text)
    return read_opensim_table(tmp_path / name)


def test_tabs_blanks_and_states_are_read(tmp_path: Path) -> None:
    for text in (GOOD + ROWS, (GOOD + ROWS).replace("\t", "   "), (GOOD + ROWS).replace("\n", "\r\n")):
        read_text_as_table(tmp_path, text)
        found = read_opensim_table(tmp_path / "a.mot")
        assert found.names == ("knee_angle_r", "pelvis_tx")
        np.testing.assert_allclose(found.values, [[10, 1.0], [20, 1.1]])
        assert found.rotation("knee_angle_r") == pytest.approx(np.radians([10, 20]))
        assert found.skeleton == ""
    states = "x\ninDegrees=no\nendheader\ntime\t/jointset/k/knee_angle_r/value\t/jointset/k/knee_angle_r/speed\n"
    read_text_as_table(tmp_path, states + ROWS)
    found = read_opensim_table(tmp_path / "a.mot")
    assert found.names == ("knee_angle_r",)
    assert found.rotation("knee_angle_r") == pytest.approx([10, 20])


def test_an_empty_cell_is_missing(tmp_path: Path) -> None:
    read_text_as_table(tmp_path, GOOD + "0.0\t\t1.0\n0.1\t5\t1.0\n")
    assert np.isnan(read_opensim_table(tmp_path / "a.mot").values[0, 0])


@pytest.mark.parametrize(
    "text, named",
    [
        (GOOD.replace("inDegrees=yes", "") + ROWS, "inDegrees"),
        (GOOD.replace("time", "frame") + ROWS, "time"),
        (GOOD + "0.0\tx\t1.0\n", "numbers"),
        (GOOD.replace("pelvis_tx", "knee_angle_r") + ROWS, "more than once"),
    ],
)
def test_damage_is_named(text: str, named: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=named):
        read_text_as_table(tmp_path, text)
