"""Joint trajectories: CSV with units, ROS messages, and the URDF they belong to."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import planted
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.core.errors import FileFormatError
from rtof_kin.formats.joint_trajectory import (
    BASE_COLUMNS,
    joint_velocities,
    read_joint_trajectory_csv,
    write_joint_trajectory_csv,
    write_ros_trajectory,
)

Array = NDArray[np.float64]
BODY = SkeletonModel.default().with_height(1.6)
T = 20


@pytest.fixture(scope="module")
def motion() -> MotionSequence:
    motion = planted.seen(BODY, T)
    return replace(motion, poses=replace(motion.poses, times=motion.poses.times + 12.25))


@pytest.fixture
def table(tmp_path: Path, motion: MotionSequence) -> Path:
    write_joint_trajectory_csv(tmp_path / "walk.csv", motion)
    return tmp_path / "walk.csv"


def messages(folder: Path, motion: MotionSequence) -> tuple[dict[str, Any], dict[str, Any]]:
    joints, base = write_ros_trajectory(folder, motion)
    return json.loads(joints.read_text()), json.loads(base.read_text())


# --- velocities ----------------------------------------------------------------------------------


def test_velocities_carry_one_configuration_to_the_next(motion: MotionSequence) -> None:
    v = joint_velocities(BODY, motion.q, motion.times)
    assert v.shape == (T, BODY.nv)
    step = 1 / planted.RATE_HZ
    for t in range(1, T - 1):
        # A central difference is the mean of the two steps beside it.
        both = [
            pin.difference(BODY.model, a, b) / step for a, b in (motion.q[t - 1 : t + 1], motion.q[t : t + 2])
        ]
        np.testing.assert_allclose(v[t], np.mean(both, axis=0), atol=1e-9)


def test_joint_velocities_are_numpys_gradient_of_the_angles(motion: MotionSequence) -> None:
    v = joint_velocities(BODY, motion.q, motion.times)
    np.testing.assert_allclose(v[:, 6:], np.gradient(motion.q[:, 7:], motion.times, axis=0), atol=1e-9)


def test_the_base_velocity_is_in_the_roots_own_axes(motion: MotionSequence) -> None:
    v = joint_velocities(BODY, motion.q, motion.times)
    R = motion.poses.R_world_bone[:, 0]
    world = np.gradient(motion.q[:, :3], motion.times, axis=0)
    linear = np.einsum("tji,tj->ti", R, world)
    np.testing.assert_allclose(v[1:-1, :3], linear[1:-1], atol=5e-3)
    turn = Rotation.from_matrix(np.swapaxes(R[:-2], -1, -2) @ R[2:]).as_rotvec()
    np.testing.assert_allclose(v[1:-1, 3:6], turn * planted.RATE_HZ / 2, atol=5e-3)


def test_uneven_times_are_divided_by_as_they_are() -> None:
    q = np.tile(BODY.t_pose(), (3, 1))
    q[:, 7] = [0.0, 0.1, 0.4]
    v = joint_velocities(BODY, q, np.array([0.0, 0.1, 0.2]))
    np.testing.assert_allclose(v[:, 6], [1.0, 2.0, 3.0])
    v = joint_velocities(BODY, q, np.array([0.0, 0.1, 0.4]))
    np.testing.assert_allclose(v[:, 6], [1.0, 1.0, 1.0])


def test_a_single_frame_does_not_move() -> None:
    np.testing.assert_array_equal(
        joint_velocities(BODY, BODY.t_pose()[None], np.zeros(1)), np.zeros((1, BODY.nv))
    )


# --- CSV -----------------------------------------------------------------------------------------


def test_the_table_is_read_as_it_was_written(table: Path, motion: MotionSequence) -> None:
    names, numbers = read_joint_trajectory_csv(table)
    valid = [f"{name}_valid" for name in ("base_q", *BODY.dof_names)]
    assert names == ("time", *BASE_COLUMNS, *BODY.dof_names, *valid)
    np.testing.assert_array_equal(numbers[:, 0], motion.times)
    np.testing.assert_array_equal(numbers[:, 1 : 1 + BODY.nq], motion.q)
    assert (numbers[:, 1 + BODY.nq :] == 1).all()


def test_any_spreadsheet_can_read_it(table: Path) -> None:
    with table.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == T
    assert float(rows[0]["time"]) == 12.25
    quat = [float(rows[3][name]) for name in ("base_qx", "base_qy", "base_qz", "base_qw")]
    assert np.linalg.norm(quat) == pytest.approx(1.0)


def test_the_sidecar_has_a_unit_a_name_and_limits_for_every_column(table: Path) -> None:
    sidecar = json.loads(table.with_suffix(".json").read_text())
    names, _ = read_joint_trajectory_csv(table)
    assert tuple(sidecar["units"]) == names
    assert sidecar["units"]["time"] == "s"
    assert sidecar["units"]["base_z"] == "m"
    assert sidecar["units"]["base_qw"] == "1"
    assert {sidecar["units"][name] for name in BODY.dof_names} == {"rad"}
    assert (sidecar["file"], sidecar["urdf"]) == ("walk.csv", "skeleton.urdf")
    assert tuple(sidecar["names"]) == tuple(sidecar["limits"]) == BODY.dof_names
    knee = {name: n for name, n in sidecar["names"].items() if "knee flexion" in n["clinical"]}
    assert len(knee) == 2
    for name, (low, high) in sidecar["limits"].items():
        assert low < high, name
    assert all({"clinical", "opensim"} == set(n) for n in sidecar["names"].values())


def test_a_gap_is_nan_and_comes_back_as_nan(tmp_path: Path, motion: MotionSequence) -> None:
    q = np.array(motion.q)
    q[4] = np.nan
    write_joint_trajectory_csv(tmp_path / "a.csv", replace(motion, q=q))
    _, numbers = read_joint_trajectory_csv(tmp_path / "a.csv")
    np.testing.assert_array_equal(numbers[:, 1 : 1 + BODY.nq], q)
    np.testing.assert_array_equal((numbers[:, 1 + BODY.nq :] == 0).all(axis=1), np.arange(T) == 4)


def test_an_ankle_that_nobody_observed_is_not_valid_and_no_joint_of_the_message(
    tmp_path: Path, motion: MotionSequence
) -> None:
    observed = np.array(motion.poses.orientation_observed)
    observed[:, BODY.names.index("RightFoot")] = False
    motion = replace(motion, poses=replace(motion.poses, orientation_observed=observed))
    write_joint_trajectory_csv(tmp_path / "a.csv", motion)
    names, numbers = read_joint_trajectory_csv(tmp_path / "a.csv")
    ankle = {"RightFoot_y", "RightFoot_x", "RightFoot_z"}
    valid = {n: column for n, column in zip(names, numbers.T, strict=True) if n.endswith("_valid")}
    assert {n for n, column in valid.items() if not column.any()} == {f"{n}_valid" for n in ankle}
    joints, _ = messages(tmp_path, motion)
    assert set(BODY.dof_names) - set(joints["joint_names"]) == ankle
    assert {len(point["positions"]) for point in joints["points"]} == {57}
    assert {len(point["velocities"]) for point in joints["points"]} == {57}


@pytest.mark.parametrize("text", [
    "", "time,a\n", "time,a\n1\n2\n", "time,a\n1,x\n", "a,time\n1,2\n", "1,2\n3,4\n",
    "time,a\n1,2,3\n", "time,a\n1,2\n3\n", "\x00\x01\x02", '"' + 200_000 * "x",
])  # fmt: skip
def test_a_table_that_is_none_is_refused_with_its_name(tmp_path: Path, text: str) -> None:
    (tmp_path / "walk.csv").write_text(text)
    with pytest.raises(FileFormatError, match=r"walk\.csv"):
        read_joint_trajectory_csv(tmp_path / "walk.csv")


def test_bytes_that_are_no_text_and_files_that_are_none_are_refused(tmp_path: Path) -> None:
    (tmp_path / "walk.csv").write_bytes(b"time,\xff\xfe\n1,2\n")
    with pytest.raises(FileFormatError, match=r"walk\.csv: not a text file in UTF-8"):
        read_joint_trajectory_csv(tmp_path / "walk.csv")
    with pytest.raises(FileFormatError, match=r"none\.csv: there is no such file"):
        read_joint_trajectory_csv(tmp_path / "none.csv")


# --- ROS -----------------------------------------------------------------------------------------


def test_the_joint_message_has_the_angles_and_their_velocities(
    tmp_path: Path, motion: MotionSequence
) -> None:
    joints, _ = messages(tmp_path, motion)
    assert set(joints) == {"header", "joint_names", "points"}
    assert tuple(joints["joint_names"]) == BODY.dof_names
    positions = np.array([point["positions"] for point in joints["points"]])
    np.testing.assert_allclose(positions, motion.q[:, 7:], atol=1e-9)
    velocities = np.array([point["velocities"] for point in joints["points"]])
    central = (motion.q[2:, 7:] - motion.q[:-2, 7:]) * planted.RATE_HZ / 2
    np.testing.assert_allclose(velocities[1:-1], central, atol=1e-8)


def test_the_base_message_has_the_pose_of_the_root_link(tmp_path: Path, motion: MotionSequence) -> None:
    _, base = messages(tmp_path, motion)
    assert base["joint_names"] == ["Hips"]
    assert base["header"]["frame_id"] == "world"
    for point, p, R in zip(
        base["points"], motion.poses.p_world_joint, motion.poses.R_world_bone, strict=True
    ):
        (transform,) = point["transforms"]
        xyz = [transform["translation"][axis] for axis in "xyz"]
        np.testing.assert_allclose(xyz, p[0], atol=1e-9)
        quat_xyzw = [transform["rotation"][axis] for axis in "xyzw"]
        np.testing.assert_allclose(Rotation.from_quat(quat_xyzw).as_matrix(), R[0], atol=1e-9)


def test_stamps_count_from_the_start_in_seconds_and_nanoseconds(
    tmp_path: Path, motion: MotionSequence
) -> None:
    times = np.linspace(12.25, 12.25 + 0.7 * (T - 1), T)
    long = replace(motion, poses=replace(motion.poses, times=times))
    for message in messages(tmp_path, long):
        stamps = [point["time_from_start"] for point in message["points"]]
        assert stamps[0] == {"sec": 0, "nanosec": 0}
        assert stamps[3] == {"sec": 2, "nanosec": 100_000_000}
        seconds = [stamp["sec"] + 1e-9 * stamp["nanosec"] for stamp in stamps]
        np.testing.assert_allclose(seconds, 0.7 * np.arange(T), atol=1e-9)
        assert all(0 <= stamp["nanosec"] < 10**9 for stamp in stamps)


def test_a_robot_that_plays_the_messages_on_the_urdf_stands_where_the_motion_does(
    tmp_path: Path, motion: MotionSequence
) -> None:
    joints, base = messages(tmp_path, motion)
    model = pin.buildModelFromXML(BODY.to_urdf(), pin.JointModelFreeFlyer())
    data = model.createData()
    for t in range(T):
        q = pin.neutral(model)
        (transform,) = base["points"][t]["transforms"]
        q[:3] = [transform["translation"][axis] for axis in "xyz"]
        q[3:7] = [transform["rotation"][axis] for axis in "xyzw"]
        for name, angle in zip(joints["joint_names"], joints["points"][t]["positions"], strict=True):
            q[model.joints[model.getJointId(name)].idx_q] = angle
        pin.framesForwardKinematics(model, data, q)
        for j, name in enumerate(BODY.names):
            placement = data.oMf[model.getFrameId(name, pin.FrameType.BODY)]
            np.testing.assert_allclose(placement.translation, motion.poses.p_world_joint[t, j], atol=1e-9)
            np.testing.assert_allclose(placement.rotation, motion.poses.R_world_bone[t, j], atol=1e-9)


def test_a_trajectory_ends_where_nothing_is_known_and_another_begins_after_it(
    tmp_path: Path, motion: MotionSequence
) -> None:
    q = np.array(motion.q)
    q[8:11] = np.nan
    paths = write_ros_trajectory(tmp_path, replace(motion, q=q))
    assert [path.name for path in paths] == [
        "ros_joint_trajectory_1.json", "ros_base_trajectory_1.json",
        "ros_joint_trajectory_2.json", "ros_base_trajectory_2.json",
    ]  # fmt: skip
    assert all("NaN" not in path.read_text() for path in paths)
    before, after = (json.loads(path.read_text())["points"] for path in paths[::2])
    assert (len(before), len(after)) == (8, T - 11)
    stamp = after[0]["time_from_start"]  # all of them count from the motion's first frame
    assert stamp["sec"] + 1e-9 * stamp["nanosec"] == pytest.approx(11 / planted.RATE_HZ)
    np.testing.assert_allclose(after[0]["positions"], motion.q[11, 7:])
