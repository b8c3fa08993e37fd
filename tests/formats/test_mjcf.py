"""The person in MuJoCo: the same links, masses and feet on the floor."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from clinical_support import walk

from rtof_kin.body.motion_source import MotionSource
from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.body.soles import floor_levels
from rtof_kin.core.errors import UnknownNameError
from rtof_kin.data.poses import PoseSequence
from rtof_kin.formats.mjcf import FOOT_RADIUS
from rtof_kin.formats.motion_files import DEEPEST, write_motion_files
from rtof_kin.recording.recording import Recording


def truth() -> Motion:
    """The demo's true motion, a third of its frames: squats, and steps on the spot."""
    recording = Recording.load(Path("models/demo"))
    assert recording.truth is not None
    return recording.skeleton.motion(recording.truth[::3])


@pytest.mark.parametrize("made", [walk, truth])
def test_replay_has_the_persons_bodies_and_no_foot_deeper_than_a_centimetre(
    made: Callable[[], Motion], tmp_path: Path
) -> None:
    motion = made()
    write_motion_files(tmp_path, motion, ["mjcf"])
    saved = np.load(tmp_path / "motion_qpos.npz")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "person.xml"))
    model.geom_margin[:] = 0.03  # contacts from 3 cm on
    data = mujoco.MjData(model)
    hinges = [model.joint(i).name for i in range(1, model.njnt)]
    assert hinges == list(saved["joint_names"]) == list(motion.skeleton.dof_names)
    names = [model.body(i).name for i in range(1, model.nbody)]
    order, deepest, touched = motion.skeleton.index(*names), 0.0, 0
    for frame in range(0, len(motion.q), 2):
        data.qpos[:] = saved["qpos"][frame]
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.xpos[1:], motion.poses.p_world_joint[frame][order], atol=1e-6)
        R = motion.poses.R_world_bone[frame][order]
        np.testing.assert_allclose(data.xmat[1:].reshape(-1, 3, 3), R, atol=1e-6)
        depths = [contact.dist for contact in data.contact[: data.ncon]]
        deepest, touched = min(deepest, *depths, 0.0), touched + bool(depths)
    assert -DEEPEST - 1e-6 < deepest < -0.001
    assert touched > 0.45 * len(motion.q)
    assert saved["fps"] == pytest.approx(motion.poses.rate_hz)
    facts = json.loads((tmp_path / "files.json").read_text())["files"]["person.xml"]
    level, _ = floor_levels(MotionSource.of(motion), FOOT_RADIUS)
    assert facts["floor_m"] + facts["floor_lowered_m"] == pytest.approx(level)


def test_masses_and_inertias_are_those_of_the_urdf(skeleton: SkeletonModel, motion: Motion, tmp_path: Path) -> None:
    write_motion_files(tmp_path, motion, ["mjcf"])
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "person.xml"))
    data = mujoco.MjData(model)
    data.qpos[:] = np.load(tmp_path / "motion_qpos.npz")["qpos"][7]
    mujoco.mj_forward(model, data)
    own, q = skeleton.model, motion.q[7]
    light = 0.001 * 2 * (len(skeleton.names) - 1)  # the URDF's links between revolutes
    assert model.body_mass.sum() == pytest.approx(pin.computeTotalMass(own) - light, abs=1e-6)
    center = pin.centerOfMass(own, own.createData(), q)
    np.testing.assert_allclose(data.subtree_com[1], center, atol=2e-4)
    matrix = np.empty((model.nv, model.nv))
    mujoco.mj_fullM(model, data, matrix)
    ours = pin.crba(own, own.createData(), q)
    np.testing.assert_allclose(np.diag(matrix)[6:], np.diag(ours)[6:], rtol=0.01, atol=2e-5)


def test_floor_is_under_slow_soles() -> None:
    motion = walk()
    level, lowest = floor_levels(MotionSource.of(motion))
    p = motion.poses.p_world_joint
    heels = motion.skeleton.landmark_positions(p, motion.poses.R_world_bone)[..., 2].min()
    assert heels - 0.02 < lowest <= level < lowest + 0.04
    poses = replace(motion.poses, p_world_joint=p + np.array([0, 0, 0.5]))
    assert floor_levels(MotionSource.of(motion.skeleton.motion(poses)))[0] == pytest.approx(level + 0.5)


def test_skeleton_without_heels_is_refused() -> None:
    body = SkeletonModel.human36m()
    p, R = body.forward_kinematics(body.n_pose()[None])
    poses = PoseSequence(np.zeros(1), p, R, body.names)
    with pytest.raises(UnknownNameError, match="LeftFoot"):
        floor_levels(MotionSource.of(body.motion(poses)))
