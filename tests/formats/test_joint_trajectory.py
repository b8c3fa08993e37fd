"""Joint trajectories: velocities, CSV with units, ROS messages; `test_motion_files` plays the messages."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import planted
import pytest

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core.files.arrays import read_csv
from rtof_kin.formats.joint_trajectory import BASE_COLUMNS, joint_velocities, write_ros_trajectory
from rtof_kin.formats.motion_files import TABLES, write_csv

BODY = SkeletonModel.default().with_height(1.6)
T = 20


@pytest.fixture(scope="module")
def motion() -> Motion:
    motion = planted.seen(BODY, T)
    return replace(motion, poses=replace(motion.poses, times=motion.poses.times + 12.25))


@pytest.fixture
def table(tmp_path: Path, motion: Motion) -> Path:
    write_csv(tmp_path, motion)
    return tmp_path / TABLES[0]


def messages(folder: Path, motion: Motion) -> tuple[dict[str, Any], dict[str, Any]]:
    joints, base = write_ros_trajectory(folder, motion)
    return json.loads(joints.read_text()), json.loads(base.read_text())


def test_velocities_are_central_differences_on_the_manifold(motion: Motion) -> None:
    v = joint_velocities(BODY, motion.q, motion.times)
    assert v.shape == (T, BODY.nv)
    steps = [pin.difference(BODY.model, *motion.q[t : t + 2]) * planted.RATE_HZ for t in range(T - 1)]
    np.testing.assert_allclose(v[1:-1], (np.array(steps[1:]) + steps[:-1]) / 2, atol=1e-9)
    np.testing.assert_allclose(v[:, 6:], np.gradient(motion.q[:, 7:], motion.times, axis=0), atol=1e-9)


@pytest.mark.parametrize("times, expected", [([0.0, 0.1, 0.2], [1, 2, 3]), ([0.0, 0.1, 0.4], [1, 1, 1]), ([0.0], [0])])
def test_velocities_use_the_times_given(times: list[float], expected: list[float]) -> None:
    q = np.tile(BODY.t_pose(), (3, 1))
    q[:, 7] = [0.0, 0.1, 0.4]
    v = joint_velocities(BODY, q[: len(times)], np.array(times))
    np.testing.assert_allclose(v[:, 6], expected)


def test_written_table_is_read_back(table: Path, motion: Motion) -> None:
    columns = read_csv(table)
    names, numbers = tuple(columns), np.stack([*columns.values()], axis=1)
    valid = [f"{name}_valid" for name in ("base_q", *BODY.dof_names)]
    assert names == ("time", *BASE_COLUMNS, *BODY.dof_names, *valid)
    np.testing.assert_array_equal(numbers[:, 0], motion.times)
    np.testing.assert_array_equal(numbers[:, 1 : 1 + BODY.nq], motion.q)
    assert (numbers[:, 1 + BODY.nq :] == 1).all()


def test_gap_is_nan_and_not_valid(tmp_path: Path, motion: Motion) -> None:
    q = np.array(motion.q)
    q[4] = np.nan
    write_csv(tmp_path, replace(motion, q=q))
    numbers = np.stack([*read_csv(tmp_path / TABLES[0]).values()], axis=1)
    np.testing.assert_array_equal(numbers[:, 1 : 1 + BODY.nq], q)
    np.testing.assert_array_equal((numbers[:, 1 + BODY.nq :] == 0).all(axis=1), np.arange(T) == 4)


def test_messages_have_angles_velocities_and_root_pose(tmp_path: Path, motion: Motion) -> None:
    joints, base = messages(tmp_path, motion)
    assert set(joints) == set(base) == {"header", "joint_names", "points"}
    assert tuple(joints["joint_names"]) == BODY.dof_names
    positions = np.array([point["positions"] for point in joints["points"]])
    np.testing.assert_allclose(positions, motion.q[:, 7:], atol=1e-9)
    velocities = np.array([point["velocities"] for point in joints["points"]])
    np.testing.assert_allclose(velocities, np.gradient(positions, motion.times, axis=0), atol=1e-8)
    assert (base["joint_names"], base["header"]["frame_id"]) == (["Hips"], "world")
    (transform,) = base["points"][3]["transforms"]
    np.testing.assert_allclose(list(transform["translation"].values()), motion.q[3, :3])
    np.testing.assert_allclose(list(transform["rotation"].values()), motion.q[3, 3:7])


def test_unknown_frames_separate_two_trajectories(tmp_path: Path, motion: Motion) -> None:
    q = np.array(motion.q)
    q[8:11] = np.nan
    paths = write_ros_trajectory(tmp_path, replace(motion, q=q))
    assert [path.name for path in paths] == [
        "ros_joint_trajectory_1.json",
        "ros_base_trajectory_1.json",
        "ros_joint_trajectory_2.json",
        "ros_base_trajectory_2.json",
    ]
    assert all("NaN" not in path.read_text() for path in paths)
    before, after = (json.loads(path.read_text())["points"] for path in paths[::2])
    assert (len(before), len(after)) == (8, T - 11)
    stamp = after[0]["time_from_start"]  # counted from the motion's first frame
    assert stamp["sec"] + 1e-9 * stamp["nanosec"] == pytest.approx(11 / planted.RATE_HZ)
    np.testing.assert_allclose(after[0]["positions"], motion.q[11, 7:])
