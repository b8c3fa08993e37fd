"""Estimates as ROS messages: angles, velocities, what is unknown."""

from __future__ import annotations

import json

import numpy as np
import planted
import pytest

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.data.poses import PoseSequence, Provenance
from rtof_kin.formats.joint_trajectory import joint_velocities
from rtof_kin.live.samples import OnlineEstimate
from rtof_kin.live.websocket_server import JointStates

BODY = SkeletonModel.default().with_height(1.6)
MOTION = planted.human(BODY, 30)


def estimate(frame: int, poses: PoseSequence = MOTION.poses) -> OnlineEstimate:
    return OnlineEstimate(poses[frame : frame + 1], 0.05, 0.002)


def test_angles_root_and_joints_are_those_of_the_motion() -> None:
    states = JointStates(BODY)
    message = json.loads(json.dumps(states.message(estimate(7)), allow_nan=False))
    assert message["name"] == list(BODY.dof_names)
    q = np.array(
        [
            *message["root"]["transform"]["translation"].values(),
            *message["root"]["transform"]["rotation"].values(),
            *message["position"],
        ]
    )
    p, R = BODY.forward_kinematics(q[None])
    np.testing.assert_allclose(R[0], MOTION.poses.R_world_bone[7], atol=1e-9)
    np.testing.assert_allclose(p[0], message["joints"]["position"], atol=1e-5)
    assert message["joints"]["provenance"] == [int(Provenance.CAMERA)] * len(BODY.names)
    assert all(message["joints"]["valid"])
    assert (message["lag_s"], message["frame_s"]) == (0.05, 0.002)
    stamp = message["header"]["stamp"]
    assert stamp["sec"] + 1e-9 * stamp["nanosec"] == pytest.approx(7 / planted.RATE_HZ, abs=1e-9)
    assert message["header"]["frame_id"] == message["root"]["header"]["frame_id"] == "world"
    assert message["root"]["child_frame_id"] == BODY.root


def test_angles_are_on_the_turn_within_the_limits() -> None:
    q = BODY.n_pose()
    q[7 + BODY.dof_names.index("RightLeg_y")] += 2 * np.pi + 0.3
    p, R = BODY.forward_kinematics(q[None])
    message = JointStates(BODY).message(estimate(0, PoseSequence(np.array([1.0]), p, R, BODY.names)))
    low, high = BODY.limits.T
    assert np.all(low - 1e-9 <= message["position"])
    assert np.all(message["position"] <= high + 1e-9)


def test_velocities_are_differences_of_successive_messages() -> None:
    states = JointStates(BODY)
    assert states.message(estimate(3))["velocity"] == []
    expected = joint_velocities(BODY, MOTION.q[3:5], MOTION.times[3:5])[0, 6:]
    np.testing.assert_allclose(states.message(estimate(4))["velocity"], expected, atol=1e-8)
    assert states.message(estimate(4))["velocity"] == []
    assert states.message(estimate(29))["velocity"] == []


def test_velocity_does_not_jump_by_whole_turns() -> None:
    dof = 7 + BODY.dof_names.index("LeftUpLeg_z")
    q = np.tile(BODY.t_pose(), (2, 1))
    q[:, dof] = BODY.limits[dof - 7].mean() + np.pi + np.array([-0.01, 0.01])
    p, R = BODY.forward_kinematics(q)
    poses = PoseSequence(np.array([0.0, 0.1]), p, R, BODY.names)
    states = JointStates(BODY)
    first, second = (states.message(estimate(frame, poses)) for frame in (0, 1))
    assert abs(second["position"][dof - 7] - first["position"][dof - 7]) > 6
    np.testing.assert_allclose(second["velocity"][dof - 7], 0.2, atol=1e-9)


def test_unknown_poses_are_null_and_empty() -> None:
    p, R = np.array(MOTION.poses.p_world_joint[:2]), np.array(MOTION.poses.R_world_bone[:2])
    p[1, 4], R[1, 4] = np.nan, np.nan
    poses = PoseSequence(MOTION.times[:2], p, R, BODY.names)
    states = JointStates(BODY)
    states.message(estimate(0, poses))
    message = json.loads(json.dumps(states.message(estimate(1, poses)), allow_nan=False))
    assert message["position"] == message["velocity"] == []
    assert message["root"]["transform"] is None
    assert message["joints"]["position"][4] is None
    assert message["joints"]["valid"].count(False) == 1
    assert states.message(estimate(1))["velocity"] != []


def test_description_names_every_joint_angle_and_provenance() -> None:
    found = json.loads(json.dumps(JointStates(BODY).description()))
    assert found["joints"] == list(BODY.names)
    assert [angle["name"] for angle in found["angles"]] == list(BODY.dof_names)
    knee = found["angles"][BODY.dof_names.index("RightLeg_y")]
    assert (knee["clinical"], knee["sign"]) == ("right knee flexion", 1)
    assert found["angles"][BODY.dof_names.index("RightUpLeg_y")]["sign"] == -1
    assert found["provenance"][Provenance.CAMERA_AND_IMU] == "camera and imu"
    assert found["height_m"] == pytest.approx(1.6)
